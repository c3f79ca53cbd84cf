"""Rigid motions: the weighted Kabsch fit, and moving points by several motions at once (thesis 4.4.4)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dpcli.ops.backend import chosen_backend, run_in_threads

_SUM_NS, _TURN_NS, _BLEND_NS = 6.0, 2e3, 4.0  # measured: per point and slot, per slot, per point and slot
_EMPTY = 1e-12  # a slot with less weight in all has no motion to be fitted
_TOWARD_IDENTITY = 1e-6  # share of the covariance's norm; decides the turns that the points leave open


def weighted_kabsch(
    source: Tensor,  # [B, N, 3]
    target: Tensor,  # [B, N, 3]
    weights: Tensor,  # [B, N, S]
) -> tuple[Tensor, Tensor]:  # [B, S, 3, 3], [B, S, 3]
    """Fits rotation R (B,S,3,3), det +1, and translation t (B,S,3) that minimize sum_i w_is |R_s x_i + t_s - y_i|^2.

    Kabsch 1976 with the sign of the determinant fixed (Umeyama 1991); the thesis's T-hat of section 4.4.4. Weights are
    zero or more and need no norm. What the points leave open (all equal, on a line) is settled toward no turn.
    A slot of weight below 1e-12 in all, or with NaN or infinite values, gets the identity and zero.
    Differentiable in all three, once; the gradient of the rotation is the polar factor's, finite also where singular
    values coincide (a gradient through the SVD itself is not), and zero along turns that the points leave open; it fades
    for points that spread less than about 1e-6, as those of a slot with a single point do by rounding.
    Backends: a numba kernel on CPU in float32 where no gradient is wanted, else torch; equal up to rounding.
    Raises ValueError on shapes that don't fit.

    >>> corner = torch.eye(3)[None]
    >>> rotation, shift = weighted_kabsch(corner, corner + torch.tensor([0.0, 0.0, 2.0]), torch.ones(1, 3, 1))
    >>> torch.allclose(rotation[0, 0], torch.eye(3), atol=1e-5), shift.round(decimals=4).tolist()
    (True, [[[0.0, 0.0, 2.0]]])
    """
    _check(source, target, weights)
    if not _by_kernel(source, target, weights):
        return _kabsch_torch(source, target, weights)
    from dpcli.ops.cpu.rigid import kabsch_kernel

    (batch, count), slots = source.shape[:2], weights.shape[2]
    rotation, translation = source.new_empty(batch, slots, 3, 3), source.new_empty(batch, slots, 3)
    arrays = [_array(tensor) for tensor in (source, target, weights, rotation, translation)]
    run_in_threads(kabsch_kernel, tuple(arrays), batch * slots, count * _SUM_NS + _TURN_NS)
    return rotation, translation


def weighted_kabsch_reference(source: Tensor, target: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Computes `weighted_kabsch` in plain torch, as a reference: same arguments, same result up to rounding."""
    _check(source, target, weights)
    return _kabsch_torch(source, target, weights)


def _kabsch_torch(source: Tensor, target: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    total = weights.sum(1)  # [B, S]
    share = (weights / total.clamp(min=_EMPTY)[:, None]).mT  # [B, S, N]
    x_mean, y_mean = share @ source, share @ target
    centered = source[:, None] - x_mean[:, :, None]  # [B, S, N, 3]
    spread = target[:, None] - y_mean[:, :, None]
    covariance = spread.mT @ (centered * share[..., None])  # [B, S, 3, 3]
    sound = (total >= _EMPTY) & covariance.isfinite().all(-1).all(-1)
    sound &= x_mean.isfinite().all(-1) & y_mean.isfinite().all(-1)
    eye = torch.eye(3, dtype=source.dtype, device=source.device)
    noise = _rounding(x_mean, spread, share) + _rounding(y_mean, centered, share)
    rotation = _Rotation.apply(torch.where(sound[..., None, None], covariance, eye), noise)
    moved = y_mean - (rotation @ x_mean[..., None]).squeeze(-1)
    return rotation, torch.where(sound[..., None], moved, 0.0)


def apply_motions(
    points: Tensor,  # [B, N, 3]
    rotation: Tensor,  # [B, S, 3, 3]
    translation: Tensor,  # [B, S, 3]
) -> Tensor:  # [B, S, N, 3]
    """Moves every point by every motion: out[b,s,n] = R_s x_n + t_s.

    >>> shifts = torch.tensor([[[0.0, 0, 0], [0, 0, 5]]])
    >>> apply_motions(torch.ones(1, 1, 3), torch.eye(3).expand(1, 2, 3, 3), shifts).tolist()
    [[[[1.0, 1.0, 1.0]], [[1.0, 1.0, 6.0]]]]
    """
    return points[:, None] @ rotation.mT + translation[:, :, None]


def rigid_flow(
    points: Tensor,  # [B, N, 3]
    mask: Tensor,  # [B, N, S]
    rotation: Tensor,  # [B, S, 3, 3]
    translation: Tensor,  # [B, S, 3]
) -> Tensor:  # [B, N, 3]
    """Computes the displacement of each point by its slots' motions, blended by the mask: sum_s m_ns (R_s x_n + t_s) - x_n.

    Backends as `weighted_kabsch`. Raises ValueError on shapes that don't fit.

    >>> shifts, half = torch.tensor([[[0.0, 0, 0], [0, 0, 4]]]), torch.tensor([[[0.5, 0.5]]])
    >>> rigid_flow(torch.ones(1, 1, 3), half, torch.eye(3).expand(1, 2, 3, 3), shifts).tolist()
    [[[0.0, 0.0, 2.0]]]
    """
    (batch, count), slots = points.shape[:2], mask.shape[-1]
    wanted = ((batch, count, 3), (batch, count, slots), (batch, slots, 3, 3), (batch, slots, 3))
    given = tuple(tuple(x.shape) for x in (points, mask, rotation, translation))
    if given != wanted:
        raise ValueError(f"points (B,N,3), mask (B,N,S), rotation (B,S,3,3), translation (B,S,3) do not fit: {given}")
    if not _by_kernel(points, mask, rotation, translation):
        return rigid_flow_reference(points, mask, rotation, translation)
    from dpcli.ops.cpu.rigid import flow_kernel

    out = points.new_empty(points.shape)
    arrays = [_array(tensor) for tensor in (points, mask, rotation, translation, out)]
    run_in_threads(flow_kernel, tuple(arrays), batch * count, slots * _BLEND_NS)
    return out


def rigid_flow_reference(points: Tensor, mask: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    """Computes `rigid_flow` in plain torch, as a reference: same arguments, same result up to rounding."""
    return torch.einsum("bns,bsnd->bnd", mask, apply_motions(points, rotation, translation)) - points


def _by_kernel(*tensors: Tensor) -> bool:
    plain = all(x.dtype == torch.float32 and x.device.type == "cpu" for x in tensors)
    wanted = torch.is_grad_enabled() and any(x.requires_grad for x in tensors)
    return plain and not wanted and chosen_backend() == "numba"


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _check(source: Tensor, target: Tensor, weights: Tensor) -> None:
    if source.ndim != 3 or source.shape[-1] != 3 or source.shape != target.shape:
        raise ValueError(
            f"source and target must both have shape (B,N,3): {tuple(source.shape)}, {tuple(target.shape)}"
        )
    if weights.ndim != 3 or weights.shape[:2] != source.shape[:2]:
        raise ValueError(f"weights must have shape (B,N,S) for points {tuple(source.shape)}: {tuple(weights.shape)}")


@torch.no_grad()
def _rounding(mean: Tensor, other: Tensor, share: Tensor) -> Tensor:
    """Returns how large a covariance (B,S) rounding alone makes: of points about `mean`, with others (B,S,N,3) that do spread."""
    deviation = (share * other.square().sum(-1)).sum(-1).sqrt()
    return 4 * torch.finfo(mean.dtype).eps * mean.square().sum(-1).sqrt() * deviation


class _Rotation(torch.autograd.Function):
    """Finds the rotation nearest to M = sum w (y - y_mean)(x - x_mean)^T: V diag(1,1,det) U^T of M = V diag(s) U^T."""

    @staticmethod
    def forward(ctx, matrix: Tensor, noise: Tensor) -> Tensor:
        norm = matrix.square().sum((-2, -1), keepdim=True).sqrt()
        eye = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
        scaled = torch.where(norm > 0, matrix / norm.clamp(min=torch.finfo(matrix.dtype).tiny), eye)
        least = noise[..., None, None] / norm.clamp(min=torch.finfo(matrix.dtype).tiny)
        pull = torch.where(norm > 0, least.nan_to_num(0.0, 0.0).clamp(max=1e6), 0.0) + _TOWARD_IDENTITY
        left, values, right = torch.linalg.svd(scaled + pull * eye)
        flip = torch.det(left @ right).sign()[..., None]
        left = torch.cat([left[..., :2], left[..., 2:] * flip[..., None]], -1)
        values = torch.cat([values[..., :2], values[..., 2:] * flip], -1)
        ctx.save_for_backward(left, values, right, norm)
        return left @ right

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        # A small change dM turns R by V A U^T with A_ij = (K_ij - K_ji) / (s_i + s_j), K = V^T dM U.
        left, values, right, norm = ctx.saved_tensors
        inner = left.mT @ grad @ right.mT
        sums = values[..., :, None] + values[..., None, :]
        # s_1 >= s_2 >= |s_3|: a sum is below 0 only on the diagonal, where A is 0
        open_turn = sums < 10 * _TOWARD_IDENTITY
        inner = torch.where(open_turn, 0.0, (inner - inner.mT) / torch.where(open_turn, 1.0, sums))
        return left @ inner @ right / norm.clamp(min=_EMPTY), None
