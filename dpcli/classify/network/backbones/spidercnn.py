"""SpiderCNN (Xu et al. 2018) over the points of a clip: the convolution-based backbone of thesis A.1.2.3.

The published classification network on coordinates: neighbors found once, four convolutions whose kernels are a Taylor
polynomial of the offset times a step function of the neighbor's rank, concatenation, the two largest of each channel,
two hidden layers. 5,834,436 parameters for 20 classes; the thesis's table A.1 implies about 2.8 M, which neither published
variant has. Ours: neighbors come from the frames within the temporal radius (`frame_graph`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import gcd

import torch
from torch import Tensor, nn

from dpcli.classify.network.backbones.dgcnn import DenseHead, expect_widths, xavier_init
from dpcli.classify.network.backbones.frame_graph import frame_graph
from dpcli.classify.network.backbones.interface import Backbone, Grouping, Stage, require_frozen
from dpcli.classify.network.config import KinetConfig
from dpcli.ops import gather_points
from dpcli.ops.backend import chosen_backend, run_in_threads

PUBLISHED = ((32, 64, 128, 256), (5,), (1024, 512))  # convolutions, Taylor channels, hidden layers
_PIECE, _ENTRY_NS = 1 << 18, 0.2  # modulated numbers held at once, and the time of one
_NORM_GROUPS, _NORM_EPS, _TOP = 16, 1e-6, 2
_POWERS = [(a, b, c) for a in range(4) for b in range(4) for c in range(4) if 1 <= a + b + c <= 3]


def monomials(offsets: Tensor) -> Tensor:
    """Returns the 19 monomials x^a y^b z^c of degree 1 to 3 of offsets (...,3), (...,19)."""
    powers = [torch.ones_like(offsets), offsets, offsets.square(), offsets.square() * offsets]
    return torch.stack([powers[a][..., 0] * powers[b][..., 1] * powers[c][..., 2] for a, b, c in _POWERS], -1)


class SpiderConv(nn.Module):
    """Computes sum_k W_k (f_k (x) g(x_k - x_i)) over the neighbors k by distance, group norm, ReLU; g has T Taylor channels."""

    def __init__(self, inputs: int, width: int, taylor: int, neighbors: int) -> None:
        super().__init__()
        self.taylor = nn.Linear(len(_POWERS), taylor)
        self.kernel = nn.Parameter(torch.empty(neighbors, inputs * taylor, width))
        self.bias = nn.Parameter(torch.zeros(width))
        self.norm = nn.GroupNorm(gcd(_NORM_GROUPS, width), width, eps=_NORM_EPS)
        self.reset()

    def reset(self) -> None:
        """Draws the weights as published: Xavier's uniform draw, the kernel as a 1 x K convolution, each Taylor weight as a 1 x 1 one."""
        neighbors, inputs, width = self.kernel.shape
        limit = (6 / (neighbors * (inputs + width))) ** 0.5
        nn.init.uniform_(self.kernel, -limit, limit)
        limit = (6 / (1 + self.taylor.out_features)) ** 0.5
        nn.init.uniform_(self.taylor.weight, -limit, limit)
        nn.init.zeros_(self.taylor.bias)

    def forward(self, features: Tensor, idx: Tensor, offsets: Tensor) -> Tensor:
        """Returns (B,N,width) from features (B,N,C), neighbors idx (B,N,K) and the monomials of their offsets (B,N,K,19)."""
        gathered, taylor = self._factors(features, idx, offsets)
        return self._normed(_RankedProducts.apply(gathered, taylor, self.kernel))

    def contributions(self, features: Tensor, idx: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """Returns each neighbor's term of the sum (B,N,K,width), and the layer's output (B,N,width)."""
        gathered, taylor = self._factors(features, idx, offsets)
        terms = _terms(gathered, taylor, self.kernel)
        return terms, self._normed(terms.sum(2))

    def _factors(self, features: Tensor, idx: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
        dtype = self.kernel.dtype  # also where matrix products are made in bfloat16
        return gather_points(features.to(dtype), idx), self.taylor(offsets).to(dtype)

    def _normed(self, summed: Tensor) -> Tensor:
        return torch.relu(self.norm((summed + self.bias).transpose(1, 2)).transpose(1, 2))


def _modulated(gathered: Tensor, taylor: Tensor, k: int) -> Tensor:
    """Returns the features of the k-th neighbors times each of their Taylor channels, (B,N,C*T)."""
    return (gathered[:, :, k, :, None] * taylor[:, :, k, None, :]).flatten(2)


class _RankedProducts(torch.autograd.Function):
    """Computes sum_k modulated_k @ kernel_k, rank after rank, so that the modulated features, T times larger, are never all held.

    gathered (B,N,K,C), taylor (B,N,K,T), kernel (K,C*T,width) -> (B,N,width). On a CPU some rows at a time, whose modulated
    features a kernel makes Taylor channel by Taylor channel: then they stay in the cache, and so do their gradients.
    """

    @staticmethod
    def forward(ctx, gathered: Tensor, taylor: Tensor, kernel: Tensor) -> Tensor:
        ctx.save_for_backward(gathered, taylor, kernel)
        batch, count = gathered.shape[:2]
        out = gathered.new_zeros(batch * count, kernel.shape[-1])
        if _by_kernel(gathered):
            from dpcli.ops.cpu.ranked_products import modulate_kernel

            weights = _by_taylor_channel(kernel, taylor)
            for rows, line, factor, buffer in _pieces(gathered, taylor):
                for k, weight in enumerate(weights):
                    _run(modulate_kernel, buffer, line, factor, k, buffer)
                    out[rows].addmm_(buffer.flatten(1), weight)
            return out.view(batch, count, -1)
        for k, weight in enumerate(kernel):
            out.addmm_(_modulated(gathered, taylor, k).flatten(0, 1), weight)
        return out.view(batch, count, -1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        gathered, taylor, kernel = ctx.saved_tensors
        to_gathered, to_taylor = (torch.empty_like(value) for value in (gathered, taylor))
        grad = grad.reshape(-1, grad.shape[-1])
        if _by_kernel(gathered):
            from dpcli.ops.cpu.ranked_products import modulate_back_kernel, modulate_kernel

            weights = _by_taylor_channel(kernel, taylor)
            to_weights = torch.zeros_like(weights)
            targets = (to_gathered.flatten(0, 1), to_taylor.flatten(0, 1))
            for rows, line, factor, buffer in _pieces(gathered, taylor):
                given, into = grad[rows], [target[rows] for target in targets]
                for k, weight in enumerate(weights):
                    _run(modulate_kernel, buffer, line, factor, k, buffer)
                    to_weights[k].addmm_(buffer.flatten(1).T, given)
                    torch.mm(given, weight.T, out=buffer.flatten(1))
                    _run(modulate_back_kernel, buffer, buffer, line, factor, k, *into)
            taylors = taylor.shape[-1]
            to_kernel = to_weights.unflatten(1, (taylors, -1)).transpose(1, 2).flatten(1, 2)
            return to_gathered, to_taylor, to_kernel
        to_kernel = torch.empty_like(kernel)
        for k, weight in enumerate(kernel):
            to_kernel[k] = _modulated(gathered, taylor, k).flatten(0, 1).T @ grad
            pairs = (grad @ weight.T).view(*gathered.shape[:2], gathered.shape[-1], -1)
            to_gathered[:, :, k] = (pairs @ taylor[:, :, k, :, None])[..., 0]
            to_taylor[:, :, k] = (gathered[:, :, k, None] @ pairs)[:, :, 0]
        return to_gathered, to_taylor, to_kernel


def _terms(gathered: Tensor, taylor: Tensor, kernel: Tensor) -> Tensor:
    """Returns modulated_k @ kernel_k for every rank k, (B,N,K,width), which `_RankedProducts` sums."""
    if torch.is_grad_enabled() or not _by_kernel(gathered):
        return torch.stack([_modulated(gathered, taylor, k) @ weight for k, weight in enumerate(kernel)], 2)
    from dpcli.ops.cpu.ranked_products import modulate_kernel

    terms, weights = gathered.new_empty(*gathered.shape[:3], kernel.shape[-1]), _by_taylor_channel(kernel, taylor)
    for rows, line, factor, buffer in _pieces(gathered, taylor):
        for k, weight in enumerate(weights):
            _run(modulate_kernel, buffer, line, factor, k, buffer)
            torch.mm(buffer.flatten(1), weight, out=terms.flatten(0, 1)[rows, k])
    return terms


def _by_kernel(values: Tensor) -> bool:
    return values.dtype in (torch.float32, torch.float64) and chosen_backend(values.device) == "numba"


def _by_taylor_channel(kernel: Tensor, taylor: Tensor) -> Tensor:
    """Returns the rows (C,T) of each rank's weights as (T,C)."""
    return kernel.unflatten(1, (-1, taylor.shape[-1])).transpose(1, 2).flatten(1, 2)


def _pieces(gathered: Tensor, taylor: Tensor) -> Iterator[tuple[slice, Tensor, Tensor, Tensor]]:
    """Yields blocks of all clips' rows that fit the cache: rows, features, Taylor channels, and a buffer for their product."""
    gathered, taylor = gathered.flatten(0, 1), taylor.flatten(0, 1)
    width = (taylor.shape[-1], gathered.shape[-1])
    step = max(1, _PIECE // (width[0] * width[1]))
    room = gathered.new_empty(min(step, len(gathered)), *width)
    for first in range(0, len(gathered), step):
        rows = slice(first, min(first + step, len(gathered)))
        yield rows, gathered[rows], taylor[rows], room[: rows.stop - first]


def _run(kernel: Callable[..., None], product: Tensor, *arguments: Tensor | int) -> None:
    arrays = tuple(value.numpy() if isinstance(value, Tensor) else value for value in arguments)
    run_in_threads(kernel, arrays, len(product), product[0].numel() * _ENTRY_NS)


class SpiderCNN(Backbone):
    """Classifies by four SpiderConvs on one graph, concatenated, the two largest of each channel, and hidden layers (Xu et al.,
    2018).

    Of the config: neighbors (20 as published; the kernels' length), temporal_radius, grouping (balanced: equal shares of
    the frames; any other: the nearest of all of them), dropout (0.7 as published), and widths: convolutions, number of
    Taylor channels, hidden layers. Radii and centroids have no part: all points are centroids.

    The taps: a convolution pools its neighborhood by summing, and what it sums is a vector of the layer's own width for
    each neighbor, as an edge's activation is in DGCNN before the maximum. Norm and ReLU come after the sum and so belong
    to the point. (The modulated features before the kernel would be other candidates, but are the layer's input, not its
    response, and T times as wide.)
    """

    def __init__(self, config: KinetConfig) -> None:
        super().__init__()
        widths, (taylor,), hidden = expect_widths(config, PUBLISHED)
        self.config, self.tap_widths = config, tuple((width,) for width in widths)
        self.head = DenseHead(_TOP * sum(widths), hidden, config.num_classes, config.dropout)
        xavier_init(self)
        self.convs = nn.ModuleList(SpiderConv(a, b, taylor, config.neighbors) for a, b in zip((3, *widths), widths))

    def group(self, points: Tensor, times: Tensor) -> list[Grouping]:
        """Returns the one graph, by coordinates, neighbors in order of distance."""
        config = self.config
        shared = config.grouping == "balanced"
        idx = frame_graph(points, times, config.neighbors, config.temporal_radius, shared)
        return [Grouping(points, times, points, times, idx)]

    def forward(self, groups: list[Grouping]) -> Tensor:
        group, levels = groups[0], []
        features, offsets = group.points, monomials(group.relative())
        for conv in self.convs:
            features = conv(features, group.idx, offsets)
            levels.append(features)
        return self._classified(levels)

    @torch.no_grad()
    def taps(self, groups: list[Grouping]) -> tuple[list[Stage], Tensor]:
        """Returns four stages of one layer on the same graph: each convolution gathers what the one before pooled; and the logits."""
        require_frozen(self)
        group, levels, stages = groups[0], [], []
        features, offsets = group.points, monomials(group.relative())
        for conv in self.convs:
            terms, features = conv.contributions(features, group.idx, offsets)
            levels.append(features)
            stages.append(Stage(group, [terms]))
        return stages, self._classified(levels)

    def _classified(self, levels: list[Tensor]) -> Tensor:
        largest = torch.cat(levels, -1).transpose(1, 2).topk(_TOP, dim=-1).values
        return self.head(largest.flatten(1))

    def macs_as_written(self) -> int:
        """Returns multiply-adds of one clip as papers count them: the convolutions' and the hidden layers' products."""
        vertices, slots = self.config.num_frames * self.config.points_per_frame, self.config.neighbors
        per_point = sum(conv.kernel.numel() + slots * conv.taylor.weight.numel() for conv in self.convs)
        return vertices * per_point + self.head.macs()
