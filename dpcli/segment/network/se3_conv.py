"""Separable SE(3) convolution: over space with rotated kernels, then over the rotation group (EPN, Chen et al. 2021)."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from dpcli.ops.backend import chosen_backend, run_in_threads
from dpcli.ops.kernel_convolution import kernel_convolution
from dpcli.runtime.mixed_precision import REDUCED, is_reduced
from dpcli.segment.network.config import Layer, PartConfig
from dpcli.segment.network.icosahedron import GROUPS
from dpcli.segment.network.kernel_points import kernel_points
from dpcli.segment.network.neighborhood import Neighborhood, kernel_weights


class SpatialConv(nn.Module):
    """Convolves over space with rotated kernels (as in EPN), without bias.

    out[p,a,c'] = sum_{c,k} W[c,k,c'] sum_n w(x_n - x_p - R_a k) f[n,a,c]. features (B,N,G,C) or None for the constant 1
    of a first layer -> (B,P,G,C').
    """

    def __init__(self, channels: int, layer: Layer, config: PartConfig) -> None:
        super().__init__()
        self.layer, self.channels = layer, channels
        kernel = kernel_points(config.kernel, config.group)
        self.closed = kernel.closed
        self.register_buffer("orbit", torch.tensor(kernel.orbit, dtype=torch.float32), persistent=False)
        self.register_buffer("slot", torch.tensor(kernel.slot), persistent=False)
        count = len(kernel.points)
        self.weight = nn.Parameter(torch.empty(count * channels, layer.channels))  # rows: kernel point, channel
        nn.init.normal_(self.weight, std=(2 / ((channels + layer.channels) * count)) ** 0.5 * 2**0.5)

    def forward(self, features: Tensor | None, near: Neighborhood) -> Tensor:
        """Returns features (B,P,G,C') at the centers of the neighborhood."""
        if features is None:
            return self._of_constant(near) @ self.weight
        if self.closed:
            weight = self._weights(near, self.orbit)
            return kernel_convolution(features, near.index, weight, self.slot, self.weight)
        grouped = [
            checkpoint(self._one_rotation, features[:, :, a], near, a, use_reentrant=False)
            for a in range(len(self.slot))
        ]
        return torch.stack(grouped, 2)

    def _weights(self, near: Neighborhood, positions: Tensor) -> Tensor:
        """Returns what every neighbor counts at every kernel position (D,3) of radius 1: (B,P,n,D)."""
        weight = kernel_weights(near.offsets, positions * self.layer.kernel_radius, self.layer.sigma)
        return weight * near.window[..., None]

    def _of_constant(self, near: Neighborhood) -> Tensor:
        """Returns the sums (B,P,G,K) of the constant 1, in pieces of the orbit."""
        total = torch.cat([self._weights(near, part).sum(2) for part in self.orbit.split(128)], -1)
        return total[..., self.slot]

    def _one_rotation(self, features: Tensor, near: Neighborhood, rotation: int) -> Tensor:
        """Returns the result of one rotation a.

        The correlations of (P,K,n) live only here and are made again for the gradient.
        """
        weight = self._weights(near, self.orbit[self.slot[rotation]])
        rows = torch.arange(len(features), device=features.device)[:, None, None]
        grouped = weight.transpose(2, 3) @ features[rows, near.index]  # [B, P, K, C]
        return grouped.flatten(-2) @ self.weight


class GroupConv(nn.Module):
    """Convolves over the rotation group (as in EPN), without bias.

    out[p,a,c'] = sum_{c,q} W[q,c,c'] f[p, a q, c] over the nearby elements q. (B,P,G,C) -> (B,P,G,C').
    """

    def __init__(self, channels: int, out_channels: int, config: PartConfig) -> None:
        super().__init__()
        group = GROUPS[config.group]()
        table = group.product[:, group.nearby]  # [G, Q]: a q
        back = group.product[:, group.inverse[group.nearby]]  # b q^-1
        self.register_buffer("table", torch.tensor(table), persistent=False)
        self.register_buffer("back", torch.tensor(back), persistent=False)
        self.weight = nn.Parameter(torch.empty(len(group.nearby), channels, out_channels))
        nn.init.normal_(self.weight, std=(2 / ((channels + out_channels) * len(group.nearby))) ** 0.5 * 2**0.5)

    def forward(self, features: Tensor) -> Tensor:
        """Returns features (B,P,G,C') of features (B,P,G,C)."""
        features = features.to(REDUCED) if is_reduced(features) else features
        return _GroupConv.apply(features, self.weight, self.table, self.back)


# how many points' turned features are held at a time: a MiB or two, which stay in the cache until they are multiplied
_POINTS = 32


class _GroupConv(torch.autograd.Function):
    """Computes the group convolution in pieces, which are gathered again for the gradient and never scattered.

    So the twelve copies of the features needn't be kept.
    """

    @staticmethod
    def forward(ctx, features: Tensor, weight: Tensor, table: Tensor, back: Tensor) -> Tensor:
        """Returns the product of the turned features and the weights."""
        ctx.save_for_backward(features, weight, table, back)
        return _multiply_turned(features, table, weight.flatten(0, 1).to(features.dtype))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        """Returns the gradients of features and weights."""
        features, weight, table, back = ctx.saved_tensors
        grad = grad.contiguous()
        given = to_weight = None
        if ctx.needs_input_grad[0]:
            given = _multiply_turned(grad, back, weight.transpose(1, 2).flatten(0, 1).to(grad.dtype))
        if ctx.needs_input_grad[1]:
            to_weight = torch.zeros_like(weight.flatten(0, 1), dtype=torch.promote_types(grad.dtype, weight.dtype))
            rows = grad.flatten(0, 1)
            for piece, turned in _turned(features, table):
                if grad.dtype == to_weight.dtype:
                    to_weight.addmm_(turned.T, rows[piece].flatten(0, 1))
                else:  # a sum of many pieces would stand still in bfloat16
                    to_weight += turned.T @ rows[piece].flatten(0, 1)
            to_weight = to_weight.view(weight.shape).to(weight.dtype)
        return given, to_weight, None, None


def _multiply_turned(features: Tensor, table: Tensor, matrix: Tensor) -> Tensor:
    """Returns the turned features (B,P,G,Q*C) times a matrix (Q*C,C'), piece by piece."""
    out = features.new_empty(*features.shape[:3], matrix.shape[1])
    rows = out.flatten(0, 1)
    for piece, turned in _turned(features, table):
        torch.mm(turned, matrix, out=rows[piece].flatten(0, 1))
    return out


def _turned(features: Tensor, table: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """Yields pieces of (B*P), each with every element's features at the Q elements of its row, (points*G, Q*C).

    They lie in a buffer that is used again.
    """
    rows = features.flatten(0, 1)
    size = _POINTS if features.device.type == "cpu" else len(rows)
    buffer = features.new_empty(size, table.numel(), features.shape[-1])
    for start in range(0, len(rows), size):
        piece = slice(start, min(start + size, len(rows)))
        part = buffer[: piece.stop - start]
        torch.index_select(rows[piece], 1, table.flatten(), out=part)
        yield piece, part.view(len(part) * len(table), -1)


def instance_norm(features: Tensor) -> Tensor:
    """Returns features (B,P,G,C) with zero mean and unit variance of every channel over points and rotations.

    These only permute under the group, so the norm is equivariant (Ulyanov et al. 2016).
    """
    features = features.to(torch.promote_types(features.dtype, torch.float32))  # sums of thousands: not in bfloat16
    mean = features.mean((1, 2), keepdim=True)
    variance = (features - mean).square().mean((1, 2), keepdim=True)
    return (features - mean) * torch.rsqrt(variance + 1e-5)


_LEAK = 0.01  # slope of the activation below zero
_NORM_NS = 0.3  # measured: the kernel's, per number


class SeparableConv(nn.Module):
    """Convolves over space, then over the group, each with norm and leaky ReLU, plus a 1x1 shortcut.

    This is the release's layer.
    """

    def __init__(self, channels: int, layer: Layer, config: PartConfig) -> None:
        super().__init__()
        self.spatial = SpatialConv(channels, layer, config)
        self.across = GroupConv(layer.channels, layer.channels, config)
        self.shortcut = nn.Linear(channels, layer.channels)

    def forward(self, features: Tensor | None, near: Neighborhood) -> Tensor:
        """Returns features (B,P,G,C').

        features (B,N,G,C), or None for the constant 1, lie at points whose first P are the centers.
        """
        out = _activate(self.across(_activate(self.spatial(features, near))))
        if features is None:  # the norm of a constant is zero: so is the shortcut
            return out
        return out + _activate(self.shortcut(features[:, : near.centers.shape[1]]))


def _activate(features: Tensor) -> Tensor:
    """Returns instance norm and leaky ReLU of features (B,P,G,C) that are not needed afterwards.

    Without gradient, they are overwritten. Backends: a numba kernel on CPU in float32 for channels in sixteens where no
    gradient is wanted, else torch; equal up to rounding.
    """
    if not _by_kernel(features):
        return nn.functional.leaky_relu(instance_norm(features), _LEAK)
    from dpcli.segment.network.instance_norm_kernel import norm_kernel

    batch, channels = len(features), features.shape[-1]
    rows = features[0].numel() // channels
    flat = features.detach().view(-1).numpy()
    run_in_threads(norm_kernel, (flat, rows, channels, _LEAK), batch, rows * channels * _NORM_NS)
    return features


def _by_kernel(features: Tensor) -> bool:
    """Returns whether the numba kernel can take these features."""
    wanted = torch.is_grad_enabled() and features.requires_grad
    fits = features.dtype == torch.float32 and features.numel() and features.shape[-1] % 16 == 0
    return bool(fits and not wanted and features.is_contiguous() and chosen_backend(features.device) == "numba")
