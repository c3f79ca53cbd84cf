"""The two passes over neighbours in a weighted plane fit: its normal equations, and the deviations from a fitted plane.

Both take features in the layout networks make them, so nothing is transposed or copied. torch reference (any device, any
dtype, twice differentiable) and numba CPU kernels with their own backward (float32).
"""

from __future__ import annotations

import torch
from torch import Tensor

from dpcli.ops.backend import chosen_backend
from dpcli.ops.parallel import parallel_kernels


def normal_equations(features: Tensor, times: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """X'WX and X'Wt with rows x = [f, 1] of X, for every group.

    features (...,n,K,d), times (...,n), weights (...,n,K) or None for 1 -> matrix (...,K,d+1,d+1), right (...,K,d+1).
    Differentiable in features and weights.
    """
    if not _fast(features):
        return normal_equations_reference(features, times, weights)
    lead, (n, groups, size) = features.shape[:-3], features.shape[-3:]
    empty = features.new_zeros(0, 0, 0)
    flat_weights = empty if weights is None else weights.reshape(-1, n, groups)
    matrix, right = _NormalEquations.apply(features.reshape(-1, n, groups, size), times.reshape(-1, n), flat_weights)
    return matrix.view(*lead, groups, size + 1, size + 1), right.view(*lead, groups, size + 1)


def normal_equations_reference(features: Tensor, times: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """`normal_equations` as batched matrix products."""
    design = torch.cat([features, torch.ones_like(features[..., :1])], -1).transpose(-3, -2)
    weighted = design if weights is None else design * weights.transpose(-1, -2)[..., None]
    return weighted.transpose(-1, -2) @ design, (weighted * times[..., None, :, None]).sum(-2)


def plane_deviations(features: Tensor, times: Tensor, coefficients: Tensor) -> Tensor:
    """A f + b - t: features (...,n,K,d), times (...,n), coefficients [A, b] (...,K,d+1) -> (...,n,K). Not differentiable in times."""
    if not _fast(features):
        return plane_deviations_reference(features, times, coefficients)
    lead, (n, groups, size) = features.shape[:-3], features.shape[-3:]
    flat = (features.reshape(-1, n, groups, size), times.reshape(-1, n), coefficients.reshape(-1, groups, size + 1))
    return _Deviations.apply(*flat).view(*lead, n, groups)


def plane_deviations_reference(features: Tensor, times: Tensor, coefficients: Tensor) -> Tensor:
    """`plane_deviations` in plain torch."""
    plane = coefficients[..., None, :, :]
    return (features * plane[..., :-1]).sum(-1) + plane[..., -1] - times[..., None]


def _fast(features: Tensor) -> bool:
    return chosen_backend(features.device) == "numba" and features.dtype == torch.float32


class _NormalEquations(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features, times, weights):
        kernels = parallel_kernels("kernels_planes")
        features, times, weights = (value.detach().contiguous() for value in (features, times, weights))
        count, _, groups, size = features.shape
        matrix, right = torch.empty(count, groups, size + 1, size + 1), torch.empty(count, groups, size + 1)
        kernels.normal_forward(features.numpy(), times.numpy(), weights.numpy(), matrix.numpy(), right.numpy())
        ctx.save_for_backward(features, times, weights)
        return matrix, right

    @staticmethod
    def backward(ctx, grad_matrix, grad_right):
        kernels = parallel_kernels("kernels_planes")
        features, times, weights = ctx.saved_tensors
        both = (grad_matrix + grad_matrix.transpose(-1, -2)).contiguous()
        grad_features, grad_weights = torch.zeros_like(features), torch.empty_like(weights)
        kernels.normal_backward(features.numpy(), times.numpy(), weights.numpy(), both.numpy(), grad_right.contiguous().numpy(),
                                grad_features.numpy(), grad_weights.numpy())  # fmt: skip
        return grad_features, None, grad_weights


class _Deviations(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features, times, coefficients):
        kernels = parallel_kernels("kernels_planes")
        features, times, coefficients = (value.detach().contiguous() for value in (features, times, coefficients))
        out = torch.empty(features.shape[:3])
        kernels.deviation_forward(features.numpy(), times.numpy(), coefficients.numpy(), out.numpy())
        ctx.save_for_backward(features, coefficients)
        return out

    @staticmethod
    def backward(ctx, grad):
        kernels = parallel_kernels("kernels_planes")
        features, coefficients = ctx.saved_tensors
        grad_features, grad_coefficients = torch.empty_like(features), torch.zeros_like(coefficients)
        kernels.deviation_backward(
            features.numpy(),
            coefficients.numpy(),
            grad.contiguous().numpy(),
            grad_features.numpy(),
            grad_coefficients.numpy(),
        )
        return grad_features, None, grad_coefficients
