"""The core of a set-abstraction layer: gather neighbors, two shared linear layers with batch norm and ReLU, max pooling.

`grouped_mlp` has a plain torch form (the reference, and the path on a GPU) and a CPU form whose forward and backward keep
only the first layer's activations: the second layer is pooled as it is made, and the gradient of a max-pooled batch norm
splits into a sparse part (one row per centroid and channel) and an affine one, so its dense part is a product with a
C1 x C1 matrix instead of two with C1 x C2. Both give the same numbers; tests compare them in value and gradient.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dpcli.ops.backend import check_rows, chosen_backend
from dpcli.ops.cpu.cache_blocks import TASKS, ranges, share_tasks, steps
from dpcli.ops.cpu.parallel import parallel_kernels
from dpcli.ops.gather import gather_points

# Bytes of activations between two matrix products, which then stay in the cache.
_PIECE = 1 << 21
_HELD = 8  # pieces summed in float32, in one go; fixed, so that sums repeat exactly
_BLOCKS = 32  # pieces of work of a sum: more than threads, for balance; fixed, too
_LANES = 8  # channels in a vector of the kernels


@dataclass
class Norm:
    """Holds affine batch normalization of C channels: weight and bias (C), and either given or returned statistics (C)."""

    weight: Tensor
    bias: Tensor
    mean: Tensor | None  # None: use (and return) the batch's own
    var: Tensor | None
    eps: float = 1e-3


def grouped_mlp(
    points: Tensor,  # (B,N,3)
    centers: Tensor,  # (B,M,3)
    idx: Tensor,  # (B,M,K) i64
    features: Tensor | None,  # (B,N,F)
    linear1: tuple[Tensor, Tensor],  # weight (C1,3+F), bias (C1)
    norm1: Norm,
    linear2: tuple[Tensor, Tensor],  # weight (C2,C1), bias (C2)
    norm2: Norm,
) -> tuple[Tensor, list[Tensor]]:
    """Computes max over K of relu(bn2(W2 relu(bn1(W1 [x_j - x_i, f_j])))) (PointNet++'s set abstraction with two layers).

    Returns (pooled (B,M,C2), [mean1, var1, mean2, var2]): the biased batch statistics, or the given ones.
    Differentiable in features, weights, biases and norms; not in positions. The fast path takes float32, C1 in eights and
    C2 of 8 or more. Raises ValueError, on CPU, on an index out of range.
    """
    fits = len(norm1.weight) % _LANES == 0 and len(norm2.weight) >= _LANES
    if fits and norm1.mean is None and _by_kernel(points):
        return _fast(points, centers, idx, features, linear1, norm1, linear2, norm2)
    if norm1.mean is not None and norm2.mean is not None and not torch.is_grad_enabled():
        pooled = frozen_activations(points, centers, idx, features, linear1, norm1, linear2, norm2)[1]
        return pooled, [norm1.mean, norm1.var, norm2.mean, norm2.var]
    taps, statistics = grouped_activations(points, centers, idx, features, linear1, norm1, linear2, norm2)
    return taps[1].amax(2), statistics


def grouped_activations(
    points: Tensor,
    centers: Tensor,
    idx: Tensor,
    features: Tensor | None,
    linear1: tuple[Tensor, Tensor],
    norm1: Norm,
    linear2: tuple[Tensor, Tensor],
    norm2: Norm,
) -> tuple[list[Tensor], list[Tensor]]:
    """Returns both layers' activations before pooling, [(B,M,K,C1), (B,M,K,C2)], and the statistics. Arguments as
    `grouped_mlp`.

    The first linear layer acts on points before they are gathered: W [x_j - x_i, f_j] = (W [x_j, f_j]) - W_x x_i.
    Given statistics are folded into the weights.
    """
    if norm1.mean is not None and norm2.mean is not None:
        linear1, linear2 = _folded(linear1, norm1), _folded(linear2, norm2)
    table, offset = _project(points, centers, features, linear1)
    hidden, statistics1 = _norm_relu(gather_points(table, idx) - offset[:, :, None], norm1)
    out, statistics2 = _norm_relu(torch.nn.functional.linear(hidden, *linear2), norm2)
    return [hidden, out], [*statistics1, *statistics2]


def frozen_activations(
    points: Tensor,
    centers: Tensor,
    idx: Tensor,
    features: Tensor | None,
    linear1: tuple[Tensor, Tensor],
    norm1: Norm,
    linear2: tuple[Tensor, Tensor],
    norm2: Norm,
) -> tuple[list[Tensor], Tensor]:
    """Computes as `grouped_activations` with given statistics, but without gradients, and pooled: the two activations, (B,M,C2)."""
    with torch.no_grad():
        if len(norm2.weight) % _LANES or not _by_kernel(points):
            taps, _ = grouped_activations(points, centers, idx, features, linear1, norm1, linear2, norm2)
            return taps, taps[1].amax(2)
        folded = _folded(linear1, norm1), _folded(linear2, norm2)
        return _frozen_pieces(points.contiguous(), centers.contiguous(), idx.contiguous(), features, *folded)


def _by_kernel(points: Tensor) -> bool:
    """Returns whether the CPU form can take points: of float32, outside mixed precision."""
    plain = points.dtype == torch.float32 and not torch.is_autocast_enabled(points.device.type)
    return plain and chosen_backend(points.device) == "numba"


def _frozen_pieces(
    points: Tensor,
    centers: Tensor,
    idx: Tensor,
    features: Tensor | None,
    linear1: tuple[Tensor, Tensor],
    linear2: tuple[Tensor, Tensor],
) -> tuple[list[Tensor], Tensor]:
    check_rows(idx, points.shape[1])
    kernels = parallel_kernels("dpcli.ops.cpu.grouped_mlp")
    if features is None:  # cheaper from positions than gathered: the projected points are many
        make = kernels.hidden_xyz
        inputs = (points.numpy(), centers.numpy(), idx.numpy(), linear1[0].t().contiguous().numpy(), linear1[1].numpy())
    else:
        make = kernels.hidden_table
        projected = _project(points, centers, features, linear1)
        inputs = (*(tensor.contiguous().numpy() for tensor in projected), idx.numpy())
    (clouds, count, neighbors), widths = idx.shape, (len(linear1[1]), len(linear2[1]))
    hidden, wide = (torch.empty(idx.numel(), width) for width in widths)
    best, weight, bias = torch.empty(clouds * count, widths[1]), linear2[0].t(), linear2[1].numpy()

    def work(_: int, piece: tuple[int, int], room: None) -> None:
        rows = slice(piece[0] * neighbors, piece[1] * neighbors)
        make(*inputs, piece[0], hidden[rows].numpy())
        out = torch.mm(hidden[rows], weight, out=wide[rows])
        kernels.activate_largest(out.numpy().reshape(-1), bias, neighbors, best[slice(*piece)].numpy().reshape(-1))

    step = max(1, _PIECE // (4 * neighbors * sum(widths)))
    share_tasks(steps(0, clouds * count, step), lambda: None, work)
    return [part.view(*idx.shape, -1) for part in (hidden, wide)], best.view(clouds, count, -1)


def _folded(linear: tuple[Tensor, Tensor], norm: Norm) -> tuple[Tensor, Tensor]:
    """Returns weight and bias of the linear layer with its batch norm's scale and shift in them."""
    scale = norm.weight * torch.rsqrt(norm.var + norm.eps)
    return linear[0] * scale[:, None], (linear[1] - norm.mean) * scale + norm.bias


def _project(
    points: Tensor, centers: Tensor, features: Tensor | None, linear1: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    weight, bias = linear1
    table = torch.nn.functional.linear(points, weight[:, :3], bias)
    if features is not None:
        table = table + torch.nn.functional.linear(features, weight[:, 3:])
    return table, torch.nn.functional.linear(centers, weight[:, :3])


def _norm_relu(values: Tensor, norm: Norm) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Applies batch norm by the batch's own statistics and ReLU; ReLU alone where given statistics are folded in already."""
    if norm.mean is not None:
        return (torch.relu(values) if values.requires_grad else values.relu_()), (norm.mean, norm.var)
    if values.dtype == torch.bfloat16:  # products may come in bfloat16, whose eight bits are too few for statistics
        values = values.float()
    var, mean = torch.var_mean(values, tuple(range(values.dim() - 1)), correction=0)
    scale = norm.weight * torch.rsqrt(var + norm.eps)
    return torch.relu(values * scale + (norm.bias - mean * scale)), (mean.detach(), var.detach())


def _fast(points, centers, idx, features, linear1, norm1, linear2, norm2):
    check_rows(idx, points.shape[1])
    weight1, bias1 = linear1
    inputs = (points.detach().contiguous(), centers.detach().contiguous(), idx.contiguous())
    table, offset = (None, None) if features is None else _project(points, centers, features, linear1)
    norms = (norm1.weight, norm1.bias, norm2.weight, norm2.bias)
    pooled, *statistics = _GroupedMLP.apply(
        *inputs, table, offset, weight1, bias1, *norms, *linear2, norm1.eps, norm2.eps
    )
    return pooled, statistics


class _GroupedMLP(torch.autograd.Function):
    """Computes `grouped_mlp` and its gradients on a CPU.

    With `table` and `offset` (the projected points and centers), the gradient of the first layer's weights reaches them through
    those two; without, weight1 and bias1 act on the relative positions alone.
    """

    @staticmethod
    def forward(ctx, points, centers, idx, table, offset, weight1, bias1, g1, b1, g2, b2, weight2, bias2, eps1, eps2):
        first = _FromPositions(points, centers, idx, weight1, bias1)
        if table is not None:
            first = _FromTable(centers, idx, table.detach(), offset.detach(), weight1)
        mean1, var1 = first.statistics()
        first.fold(g1.detach() * torch.rsqrt(var1 + eps1), torch.rsqrt(var1 + eps1), b1.detach())
        signs = torch.where(g2 < 0, -1.0, 1.0)  # of the largest or smallest values, whichever the norm makes largest
        best, where, gram, total = _pool_linear(first, weight2.detach() * signs[:, None])
        mean2, var2 = _linear_statistics(gram, total, idx.numel(), weight2.detach(), bias2.detach())
        inverse2 = signs * torch.rsqrt(var2 + eps2)
        away = signs * (mean2 - bias2)  # mean of what `best` is the largest of
        out = torch.addcmul(b2 - away * inverse2 * g2, best, inverse2 * g2).relu_()
        ctx.first = first
        ctx.save_for_backward(g2, weight2, bias2, where, best, away, out, mean2, signs, inverse2, gram, total)
        ctx.mark_non_differentiable(mean1, var1, mean2, var2)
        return out.view(*idx.shape[:2], -1), mean1, var1, mean2, var2

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad, *unused):
        g2, weight2, bias2, where, best, away, out, mean2, signs, inverse2, gram, total = ctx.saved_tensors
        rows = ctx.first.rows
        pooled, sums = _sort_pooled(ctx.first, grad.reshape(out.shape).contiguous(), out, best, where, away)
        grad_b2, grad_g2 = sums[0], sums[1] * inverse2
        # d(linear output) = sparse - u - v * output, the last two from the batch statistics
        scale2, inverse2 = g2 * inverse2 * signs, inverse2 * signs
        v = scale2 * grad_g2 * inverse2 / rows
        u = scale2 * grad_b2 / rows - v * mean2
        shift = u + v * bias2
        mixed, constant = (weight2 * -v[:, None]).t() @ weight2, -(shift @ weight2)
        parts = scale2[:, None] * _back_pool(ctx.first, pooled, weight2 * scale2[:, None], mixed, constant)
        grad_w2 = parts - torch.outer(shift, total.float()) - v[:, None] * (weight2 @ gram.float())
        table, offset, weight1, bias1, grad_g1, grad_b1 = ctx.first.gradients()
        norms = (grad_g1, grad_b1, grad_g2, grad_b2)
        return None, None, None, table, offset, weight1, bias1, *norms, grad_w2, torch.zeros_like(bias2), None, None


class _FromPositions:
    """Computes a first layer on relative positions x alone, W x + b; its statistics and gradients follow from moments of x."""

    def __init__(self, points: Tensor, centers: Tensor, idx: Tensor, weight: Tensor, bias: Tensor) -> None:
        self.kernels = parallel_kernels("dpcli.ops.cpu.grouped_mlp")
        self.idx, self.rows, self.channels = idx, idx.numel(), len(bias)
        self.arrays = (points.numpy(), centers.numpy(), idx.numpy())
        self.weight, self.bias = weight.detach(), bias.detach()

    def statistics(self) -> tuple[Tensor, Tensor]:
        """Returns mean and biased variance (C) over all rows, and keeps the moments of x."""
        sums = torch.zeros(_BLOCKS, 9, dtype=torch.float64)
        self.kernels.moments_xyz(*self.arrays, sums.numpy())
        moments = sums.sum(0) / self.rows
        self.mean = moments[:3]
        square = moments[[3, 4, 5, 4, 6, 7, 5, 7, 8]].view(3, 3)
        self.covariance = square - torch.outer(self.mean, self.mean)
        weight = self.weight.double()
        var = ((weight @ self.covariance) * weight).sum(1).clamp_min(0)
        return (weight @ self.mean + self.bias).float(), var.float()

    def fold(self, scale: Tensor, inverse: Tensor, shift: Tensor) -> None:
        """Takes batch norm into the weights: relu(scale * (W x + b - mean) + shift)."""
        self.scale, self.inverse = scale, inverse
        weight = self.weight * scale[:, None]
        bias = shift - (weight.double() @ self.mean).float()
        self.inputs = (*self.arrays, weight.t().contiguous().numpy(), bias.numpy())

    def hidden(self, first: int, out: np.ndarray) -> None:
        """Writes the layer's activations of a block of rows (rows,C), from centroid `first` on, to `out`."""
        self.kernels.hidden_xyz(*self.inputs, first, out)

    def begin_backward(self) -> list[tuple[int, int]]:
        """Returns ranges of centroids that may go through `back` at the same time."""
        self.sums = torch.zeros(TASKS, 4, self.channels, dtype=torch.float64)
        return ranges(self.idx.shape[0] * self.idx.shape[1], TASKS)

    def back(self, task: int, first: int, *arrays: np.ndarray) -> None:
        """Adds the gradient of a block of rows to the sums of its task: arrays as the kernel's hidden .. grad_weight."""
        self.kernels.back_xyz(*arrays, *self.arrays, first, self.sums[task].numpy())

    def gradients(self) -> tuple[Tensor | None, ...]:
        """Returns the gradients of (table, offset, weight, bias, norm weight, norm bias); table and offset are not inputs here."""
        total, moments = self.sums.sum(0)[0], self.sums.sum(0)[1:].t()
        inverse, weight = self.inverse.double(), self.weight.double()
        centered = moments - torch.outer(total, self.mean)
        grad_norm = inverse * (weight * centered).sum(1)
        spread = (inverse * grad_norm)[:, None] * (weight @ self.covariance)
        grad_weight = self.scale[:, None] * (centered - spread)
        return None, None, grad_weight.float(), torch.zeros_like(self.bias), grad_norm.float(), total.float()


class _FromTable:
    """Computes a first layer as a difference of projected points and centers: table[j] - offset[i], offset = W_x center."""

    def __init__(self, centers: Tensor, idx: Tensor, table: Tensor, offset: Tensor, weight: Tensor) -> None:
        self.kernels = parallel_kernels("dpcli.ops.cpu.grouped_mlp")
        self.idx, self.rows, self.channels = idx, idx.numel(), table.shape[2]
        self.centers, self.weight_x = centers, weight.detach()[:, :3].t().contiguous()  # (3,C)
        self.table, self.offset = table.contiguous(), offset.contiguous()

    def statistics(self) -> tuple[Tensor, Tensor]:
        """Returns mean and biased variance (C) over all rows."""
        self.sums = torch.empty(self.idx.shape[0] * self.idx.shape[1], self.channels)
        squares = torch.zeros(_BLOCKS, self.channels, dtype=torch.float64)
        self.kernels.moments_table(
            self.table.numpy(), self.offset.numpy(), self.idx.numpy(), self.sums.numpy(), squares.numpy()
        )
        mean = self.sums.sum(0, dtype=torch.float64) / self.rows
        self.mean = mean.float()
        return self.mean, (squares.sum(0) / self.rows - mean**2).clamp_min(0).float()

    def fold(self, scale: Tensor, inverse: Tensor, shift: Tensor) -> None:
        """Takes batch norm into the table: relu(scale * (table - offset - mean) + shift)."""
        self.scale, self.inverse = scale, inverse
        table = torch.addcmul(shift - self.mean * scale, self.table, scale)
        self.inputs = (table.numpy(), (self.offset * scale).numpy(), self.idx.numpy())

    def hidden(self, first: int, out: np.ndarray) -> None:
        """Writes the layer's activations of a block of rows (rows,C), from centroid `first` on, to `out`."""
        self.kernels.hidden_table(*self.inputs, first, out)

    def begin_backward(self) -> list[tuple[int, int]]:
        """Returns ranges of centroids that may go through `back` at the same time: of whole clouds, as these share no point."""
        batch, nodes, channels = self.table.shape
        self.packed = torch.zeros(-(-channels // (2 * _LANES)), batch, nodes, 2 * _LANES)
        self.to_offset = torch.empty_like(self.sums)
        self.targets = (self.packed.view(-1).numpy(), self.to_offset.view(-1).numpy(), nodes)
        count = self.idx.shape[1]
        return [(low * count, high * count) for low, high in ranges(batch, TASKS)]

    def back(self, task: int, first: int, *arrays: np.ndarray) -> None:
        """Adds the gradient of a block of rows to those of table and offset: arrays as the kernel's hidden .. grad_weight."""
        self.kernels.back_table(*arrays, self.inputs[2], first, *self.targets)

    def gradients(self) -> tuple[Tensor | None, ...]:
        """Returns the gradients of (table, offset, weight, bias, norm weight, norm bias); weight and bias are reached through the table."""
        neighbors = self.idx.shape[2]
        reach = torch.zeros(*self.table.shape[:2], 4, dtype=torch.float64)
        self.kernels.reach(self.idx.numpy(), self.centers.numpy(), reach.numpy())
        total = self.to_offset.sum(0)
        to_table = self.packed.movedim(0, 2).reshape(*self.table.shape[:2], -1)[..., : self.channels].contiguous()
        products = self._products(to_table, self.table, self.mean)
        grad_norm = self.inverse * (products - self._products(self.to_offset, self.offset, torch.zeros_like(self.mean)))
        t0, t1 = total / self.rows, self.inverse * grad_norm / self.rows
        vectors = (self.mean.numpy(), self.scale.numpy(), t0.numpy(), t1.numpy())
        self.kernels.back_norm(to_table.numpy(), self.table.numpy(), reach.numpy(), self.weight_x.numpy(), *vectors)
        offset = self.scale * (neighbors * t0 + (self.sums - neighbors * self.mean) * t1 - self.to_offset)
        return to_table, offset.view_as(self.offset), None, None, grad_norm, total

    def _products(self, first: Tensor, second: Tensor, shift: Tensor) -> Tensor:
        """Returns, per channel, the sum over all rows of first * (second - shift)."""
        parts, shape = torch.zeros(_BLOCKS, self.channels, dtype=torch.float64), (-1, self.channels)
        self.kernels.products(first.view(shape).numpy(), second.view(shape).numpy(), shift.numpy(), parts.numpy())
        return parts.sum(0).float()


class _Room:
    """Holds a thread's workspace: a block's activations, narrow and wide, as tensors (rows,C) and as arrays for the kernels."""

    def __init__(self, hidden: Tensor, wide: Tensor) -> None:
        self.hidden, self.wide = hidden, wide
        self.transposed, self.ones = hidden.t(), torch.ones(1, len(hidden))
        self.array = hidden.numpy()
        self.flat = (self.array.reshape(-1), wide.numpy().reshape(-1))

    def cut(self, rows: int) -> _Room:
        """Returns the workspace cut to its first rows."""
        return self if rows == len(self.hidden) else _Room(self.hidden[:rows], self.wide[:rows])


class _Pieces:
    """Cuts work into blocks of about _PIECE bytes of activations, (rows,C1) and (rows,widest), shared among threads."""

    def __init__(self, first: _FromPositions | _FromTable, widest: int) -> None:
        self.neighbors, self.widths = first.idx.shape[2], (first.channels, widest)
        self.count = first.rows // self.neighbors
        self.step = min(self.count, max(1, _PIECE // (4 * self.neighbors * sum(self.widths))))

    def of(self, low: int, high: int) -> list[tuple[int, int]]:
        """Returns the blocks (low, high) of centroids low..high-1."""
        return steps(low, high, self.step)

    def share(self, tasks: list[list[tuple[int, int]]], work: Callable[[int, int, _Room], None]) -> None:
        """Calls work(task, first centroid, workspace) for every block: a task's in order, by one thread, tasks in parallel."""
        rows = self.step * self.neighbors

        def through(task: int, pieces: list[tuple[int, int]], room: _Room) -> None:
            for low, high in pieces:
                work(task, low, room.cut((high - low) * self.neighbors))

        share_tasks(tasks, lambda: _Room(*(torch.empty(rows, width) for width in self.widths)), through)


def _pool_linear(first: _FromPositions | _FromTable, weight: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Computes the second linear layer (no bias) and its pooling block by block: neither layer's activations are ever stored.

    Returns the largest values (M,C2) and their rows i32, and of the hidden layer h the Gram matrix h'h and the sum, in
    float64.
    """
    pieces, c1, c2 = _Pieces(first, len(weight)), first.channels, len(weight)
    best, where = torch.empty(pieces.count, c2), torch.empty(pieces.count, c2, dtype=torch.int32)
    targets = (best.numpy(), where.numpy())
    all_pieces = pieces.of(0, pieces.count)
    held = max(1, min(_HELD, len(all_pieces) // TASKS))
    tasks = [all_pieces[start : start + held] for start in range(0, len(all_pieces), held)]
    moments = [(torch.empty(c1, c1), torch.empty(1, c1)) for _ in tasks]
    weight = weight.t()

    def work(task: int, low: int, room: _Room) -> None:
        first.hidden(low, room.array)
        torch.mm(room.hidden, weight, out=room.wide)
        (gram, total), more = moments[task], low != tasks[task][0][0]
        torch.addmm(gram, room.transposed, room.hidden, beta=more, out=gram)
        torch.addmm(total, room.ones, room.hidden, beta=more, out=total)
        first.kernels.largest(room.flat[1], pieces.neighbors, low, *targets)

    pieces.share(tasks, work)
    gram, total = torch.zeros(c1, c1, dtype=torch.float64), torch.zeros(c1, dtype=torch.float64)
    for one in moments:
        gram += one[0]
        total += one[1][0]
    return best, where, gram, total


def _sort_pooled(
    first: _FromPositions | _FromTable, grad: Tensor, out: Tensor, best: Tensor, where: Tensor, mean: Tensor
) -> tuple[tuple[np.ndarray, ...], Tensor]:
    """Runs the kernel `sort_pooled` and returns (order, values, starts), and the sums (2,C2)."""
    count, c2 = grad.shape
    order, values = torch.empty(count, c2, dtype=torch.int32), torch.empty(count, c2)
    starts = torch.empty(count, first.idx.shape[2] + 1, dtype=torch.int32)
    found, sums = tuple(tensor.numpy() for tensor in (order, values, starts)), torch.zeros(2, _BLOCKS, c2).double()
    first.kernels.sort_pooled(*(tensor.numpy() for tensor in (grad, out, best, where, mean)), *found, sums.numpy())
    return found, sums.sum(1).float()


def _back_pool(
    first: _FromPositions | _FromTable, pooled: tuple[np.ndarray, ...], weight: Tensor, mixed: Tensor, constant: Tensor
) -> Tensor:
    """Propagates the gradient at the linear layer's output to `first`: the sparse `pooled` times weight, and h @ mixed +
    constant.

    Returns the sum of pooled times h, (C2,C1).
    """
    tasks, c1 = first.begin_backward(), first.channels
    columns = torch.arange(-(-c1 // (2 * _LANES)) * 2 * _LANES)
    columns = torch.where(columns < c1, columns, columns - _LANES)  # half a block left: twice the same
    packed = weight[:, columns].view(len(weight), -1, 2 * _LANES).transpose(0, 1).contiguous()
    parts = torch.zeros(len(tasks), *packed.shape)
    arrays, targets = (constant.numpy(), *pooled, packed.view(-1).numpy()), [part.view(-1).numpy() for part in parts]

    def work(task: int, low: int, room: _Room) -> None:
        first.hidden(low, room.array)
        torch.mm(room.hidden, mixed, out=room.wide)
        first.back(task, low, *room.flat, *arrays, targets[task])

    pieces = _Pieces(first, c1)
    pieces.share([pieces.of(*task) for task in tasks], work)
    return parts.sum(0).transpose(0, 1).reshape(len(weight), -1)[:, :c1]


def _linear_statistics(gram: Tensor, total: Tensor, rows: int, weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
    """Returns mean and biased variance of W h + b over the rows, from h'h and sum(h): no pass over the wide layer."""
    mean = total / rows
    covariance = (gram / rows - torch.outer(mean, mean)).float()  # the cancellation is over: the rest in float32
    var = ((weight @ covariance) * weight).sum(1).clamp_min(0)
    return torch.mv(weight.double(), mean).add_(bias).float(), var
