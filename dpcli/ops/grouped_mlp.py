"""The core of a set-abstraction layer: gather neighbours, two shared linear layers with batch norm and ReLU, max pooling.

`grouped_mlp` has a plain torch form (the reference, and the path on a GPU) and a CPU form whose forward and backward keep
only the first layer's activations: the second layer is pooled as it is made, and the gradient of a max-pooled batch norm
splits into a sparse part (one row per centroid and channel) and an affine one, so its dense part is a product with a
C1 x C1 matrix instead of two with C1 x C2. Both give the same numbers; tests compare them in value and gradient.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dpcli.ops.backend import chosen_backend
from dpcli.ops.gather import gather_points
from dpcli.ops.parallel import parallel_kernels

_PIECE = 1 << 13  # rows between two matrix products: 2 to 8 MB of activations, which then stay in the cache
_BLOCKS = 32  # pieces of work per kernel: more than threads, for balance; fixed, so that sums repeat exactly


@dataclass
class Norm:
    """Affine batch normalisation of C channels: weight and bias (C), and either given or returned statistics (C)."""

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
    """max over K of relu(bn2(W2 relu(bn1(W1 [x_j - x_i, f_j])))) (PointNet++'s set abstraction with two layers).

    Returns (pooled (B,M,C2), [mean1, var1, mean2, var2]): the biased batch statistics, or the given ones.
    Differentiable in features, weights, biases and norms; not in positions. float32 on the fast path.
    """
    fast = (
        chosen_backend(points.device) == "numba"
        and norm1.mean is None
        and idx.shape[2] <= 256
        and points.dtype == torch.float32
    )
    if fast:
        return _fast(points, centers, idx, features, linear1, norm1, linear2, norm2)
    taps, statistics = grouped_activations(points, centers, idx, features, linear1, norm1, linear2, norm2)
    return taps[1].amax(2), statistics


def grouped_activations(
    points: Tensor, centers: Tensor, idx: Tensor, features: Tensor | None, linear1: tuple[Tensor, Tensor], norm1: Norm,
    linear2: tuple[Tensor, Tensor], norm2: Norm,
) -> tuple[list[Tensor], list[Tensor]]:  # fmt: skip
    """The two layers' activations before pooling, [(B,M,K,C1), (B,M,K,C2)], and the statistics. Arguments as `grouped_mlp`.

    The first linear layer acts on points before they are gathered: W [x_j - x_i, f_j] = (W [x_j, f_j]) - W_x x_i.
    Given statistics are folded into the weights.
    """
    if norm1.mean is not None and norm2.mean is not None:
        linear1, linear2 = _folded(linear1, norm1), _folded(linear2, norm2)
    table, offset = _project(points, centers, features, linear1)
    hidden, statistics1 = _norm_relu(gather_points(table, idx) - offset[:, :, None], norm1)
    out, statistics2 = _norm_relu(torch.nn.functional.linear(hidden, *linear2), norm2)
    return [hidden, out], [*statistics1, *statistics2]


def _folded(linear: tuple[Tensor, Tensor], norm: Norm) -> tuple[Tensor, Tensor]:
    """The linear layer with its batch norm's scale and shift in it."""
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
    """Batch norm by the batch's own statistics and ReLU; ReLU alone where given statistics are folded in already."""
    if norm.mean is not None:
        return (torch.relu(values) if values.requires_grad else values.relu_()), (norm.mean, norm.var)
    var, mean = torch.var_mean(values, tuple(range(values.dim() - 1)), correction=0)
    scale = norm.weight * torch.rsqrt(var + norm.eps)
    return torch.relu(values * scale + (norm.bias - mean * scale)), (mean.detach(), var.detach())


def _fast(points, centers, idx, features, linear1, norm1, linear2, norm2):
    norms = (norm1.weight, norm1.bias, norm2.weight, norm2.bias)
    if features is None:
        first = (points.contiguous(), centers.contiguous(), *linear1)
    else:
        first = (*_project(points, centers, features, linear1), None, None)
    pooled, *statistics = _GroupedMLP.apply(idx.contiguous(), *first, *norms, *linear2, norm1.eps, norm2.eps)
    return pooled, statistics


def _statistics(sums: Tensor, rows: int) -> tuple[Tensor, Tensor]:
    total = sums.sum(0) / rows
    return total[0].float(), (total[1] - total[0] ** 2).clamp_min(0).float()


class _GroupedMLP(torch.autograd.Function):
    """The training path on a CPU. `table`/`offset` are points and centres when weight1 is given, else projected ones."""

    @staticmethod
    def forward(ctx, idx, table, offset, weight1, bias1, g1, b1, g2, b2, weight2, bias2, eps1, eps2):
        kernels = parallel_kernels("kernels_grouped")
        batch, count, neighbors = idx.shape
        rows, c1, c2 = idx.numel(), len(g1), len(g2)
        hidden = torch.empty(batch, count, neighbors, c1)
        sums = torch.zeros(_BLOCKS, 2, c1, dtype=torch.float64)
        if weight1 is not None:
            kernels.project_xyz(table.numpy(), offset.numpy(), idx.numpy(), weight1.detach().t().contiguous().numpy(),
                                bias1.detach().numpy(), hidden.numpy(), sums.numpy())  # fmt: skip
        else:
            table, offset = table.detach().contiguous(), offset.detach().contiguous()
            kernels.gather_difference(table.numpy(), offset.numpy(), idx.numpy(), hidden.numpy(), sums.numpy())
        mean1, var1 = _statistics(sums, rows)
        inverse1 = torch.rsqrt(var1 + eps1)
        scale1 = g1.detach() * inverse1
        best, where, gram, total = _pool_linear(hidden, scale1, b1.detach() - mean1 * scale1, weight2, bias2, g2)
        mean2, var2 = _linear_statistics(gram, total, rows, weight2, bias2)
        inverse2 = torch.rsqrt(var2 + eps2)
        normal = (best - mean2) * inverse2
        out = torch.relu_(normal * g2 + b2)
        ctx.save_for_backward(idx, table, offset, weight1, bias1, g1, b1, g2, weight2, bias2, hidden, where, normal, out,
                              mean1, inverse1, mean2, inverse2, gram, total)  # fmt: skip
        ctx.mark_non_differentiable(mean1, var1, mean2, var2)
        return out.view(batch, count, c2), mean1, var1, mean2, var2

    @staticmethod
    def backward(ctx, grad, *unused):
        kernels = parallel_kernels("kernels_grouped")
        (idx, table, offset, weight1, bias1, g1, b1, g2, weight2, bias2, hidden, where, normal, out,
         mean1, inverse1, mean2, inverse2, gram, total) = ctx.saved_tensors  # fmt: skip
        rows, c1, c2 = idx.numel(), len(g1), len(g2)
        grad = grad.reshape(-1, c2) * (out > 0)
        grad_b2, grad_g2 = grad.sum(0), (grad * normal).sum(0)
        # d(linear output) = sparse - u - v * output, the last two from the batch statistics
        scale2 = g2 * inverse2
        v = scale2 * grad_g2 * inverse2 / rows
        u = scale2 * grad_b2 / rows - v * mean2
        sparse = (grad * scale2).contiguous()
        flat = hidden.view(rows, c1)
        lean = (v[:, None] * weight2).t()
        constant = -((u + v * bias2) @ weight2)
        safe = torch.where(g1.abs() < 1e-12, torch.full_like(g1, 1e-12), g1.detach())
        recover = ((1 / safe).numpy(), (-b1.detach() / safe).numpy())
        dense, mixed, plain = torch.empty_like(flat), lean @ weight2, weight2.detach().contiguous()
        parts, sums = torch.zeros(_BLOCKS, c2, c1), torch.zeros(_BLOCKS, 2, c1, dtype=torch.float64)
        neighbors = idx.shape[2]
        for first, last in _pieces(rows // neighbors, neighbors):
            h, d = flat[first * neighbors : last * neighbors], dense[first * neighbors : last * neighbors]
            torch.addmm(constant, h, mixed, alpha=-1, out=d)
            kernels.scatter_pooled(
                sparse[first:last].numpy(), where[first:last].numpy(), plain.numpy(),
                h.view(-1, neighbors, c1).numpy(), d.view(-1, neighbors, c1).numpy(), parts.numpy(),
            )  # fmt: skip
            kernels.relu_norm_sums(d.numpy(), h.numpy(), *recover, sums.numpy())
        grad_w2 = parts.sum(0) - torch.outer(u + v * bias2, total.float()) - v[:, None] * (weight2 @ gram.float())
        grad_b1, grad_g1 = sums.sum(0).float()
        first = _back_first(kernels, ctx.needs_input_grad, dense.view(*idx.shape, c1), idx, table, offset, weight1, bias1,
                            mean1, inverse1, g1 * inverse1, grad_b1 / rows, grad_g1 / rows)  # fmt: skip
        return None, *first, grad_g1, grad_b1, grad_g2, grad_b2, grad_w2, torch.zeros_like(bias2), None, None


def _pieces(count: int, neighbors: int) -> list[tuple[int, int]]:
    """Cut `count` centroids into ranges of about _PIECE rows."""
    step = max(1, _PIECE // neighbors)
    return [(first, min(first + step, count)) for first in range(0, count, step)]


def _pool_linear(
    hidden: Tensor, scale: Tensor, shift: Tensor, weight: Tensor, bias: Tensor, sign: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """First activation (in place), second linear layer and its pooling, piece by piece: the wide layer is never stored.

    Returns the extremes (M,C2) and their rows, and of the hidden layer h the Gram matrix h'h and the sum, in float64.
    """
    kernels = parallel_kernels("kernels_grouped")
    neighbors, c1, c2 = hidden.shape[2], hidden.shape[3], len(bias)
    flat = hidden.view(-1, c1)
    count = len(flat) // neighbors
    best, where = torch.empty(count, c2), torch.empty(count, c2, dtype=torch.uint8)
    gram, total = torch.zeros(c1, c1, dtype=torch.float64), torch.zeros(c1, dtype=torch.float64)
    ones = torch.ones(1, _PIECE + neighbors)
    buffer = torch.empty(max(last - first for first, last in _pieces(count, neighbors)) * neighbors, c2)
    weight, bias = weight.detach().t(), bias.detach()
    signs = torch.where(sign < 0, -1.0, 1.0).numpy()
    for first, last in _pieces(count, neighbors):
        h, y = flat[first * neighbors : last * neighbors], buffer[: (last - first) * neighbors]
        kernels.affine_relu(h.numpy(), scale.numpy(), shift.numpy())
        torch.addmm(bias, h, weight, out=y)
        gram += h.t() @ h
        total += (ones[:, : len(h)] @ h)[0]
        kernels.extreme(y.view(-1, neighbors, c2).numpy(), signs, best[first:last].numpy(), where[first:last].numpy())
    return best, where, gram, total


def _linear_statistics(gram: Tensor, total: Tensor, rows: int, weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and biased variance of W h + b over the rows, from h'h and sum(h): no pass over the wide layer."""
    weight = weight.detach().double()
    mean = total / rows
    covariance = gram / rows - torch.outer(mean, mean)
    var = ((weight @ covariance) * weight).sum(1).clamp_min(0)
    return (weight @ mean + bias.detach()).float(), var.float()


def _back_first(kernels, needs, grad, idx, table, offset, weight1, bias1, mean, inverse, scale, t0, t1):
    """Gradients of (table, offset, weight1, bias1) from the gradient after the first ReLU."""
    statistics = (mean.numpy(), inverse.numpy(), scale.detach().numpy(), t0.numpy(), t1.numpy())
    if weight1 is not None:
        parts = torch.zeros(_BLOCKS, 3, len(bias1), dtype=torch.float64)
        kernels.back_xyz(grad.numpy(), table.numpy(), offset.numpy(), idx.numpy(), weight1.detach().t().contiguous().numpy(),
                         bias1.detach().numpy(), *statistics, parts.numpy())  # fmt: skip
        return None, None, parts.sum(0).float().t().contiguous(), torch.zeros_like(bias1)
    grad_table, grad_offset = torch.zeros_like(table), torch.zeros_like(offset)
    kernels.back_gather(
        grad.numpy(), table.numpy(), offset.numpy(), idx.numpy(), *statistics, grad_table.numpy(), grad_offset.numpy()
    )
    return grad_table, grad_offset, None, None
