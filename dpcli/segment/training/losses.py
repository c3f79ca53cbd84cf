"""The losses of a part network: rigidity of the flow, invariance, consensus; and cross-entropy with labels."""

from __future__ import annotations

import torch
from torch import Tensor

from dpcli.ops import apply_motions
from dpcli.segment.network.slot_matching import hungarian_assignment, one_hot, permute_slots, soft_iou


def dynamic_loss(
    points: Tensor,  # [B, N, 3]
    flow: Tensor,  # [B, N, 3]
    mask: Tensor,  # [B, N, S]
    rotation: Tensor,  # [B, S, 3, 3]
    translation: Tensor,  # [B, S, 3]
    trust: Tensor | None = None,  # [B, N]
) -> Tensor:
    """Returns the rigidity loss as released: mean_i c_i |sum_s m_is (R_s p_i + t_s) - (p_i + f_i)|_2, a scalar.

    OGC's "dynamic rigid consistency" (Song and Yang 2022). trust: the weights c, of which None counts as 1. The moved
    points are detached: the gradient reaches the mask only. At a residual of exactly zero it is zero.
    """
    moved = apply_motions(points, rotation, translation).detach()
    blended = torch.einsum("bns,bsnd->bnd", mask, moved)
    gap = _length(blended - (points + flow).detach())
    return (gap if trust is None else trust * gap).mean()


def rigid_loss(
    points: Tensor,  # [B, N, 3]
    flow: Tensor,  # [B, N, 3]
    mask: Tensor,  # [B, N, S]
    rotation: Tensor,  # [B, S, 3, 3]
    translation: Tensor,  # [B, S, 3]
    beta: Tensor | None = None,  # [B, N, S]
) -> Tensor:
    """Returns the rigidity loss of thesis equation 4.8, its segmentation loss, a scalar.

    It is the mean over points and slots of beta_is m_is |p_i + f_i - (R_s p_i + t_s)|_2. beta: `consensus_weights`,
    detached here; None counts as 1. The gradient reaches the mask only.
    """
    weighted = mask * residuals(points, flow, rotation, translation).detach()
    return (weighted if beta is None else weighted * beta.detach()).mean()


def residuals(points: Tensor, flow: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    """Returns how far (B,N,S) each slot's motion takes a point from where the flow does.

    That is |R_s p_i + t_s - p_i - f_i|_2; points (B,N,3), flow (B,N,3), rotation (B,S,3,3), translation (B,S,3).
    """
    gap = apply_motions(points, rotation, translation) - (points + flow)[:, None]
    return _length(gap).mT


def consensus_weights(
    points: Tensor,  # [B, N, 3]
    flow: Tensor,  # [B, N, 3]
    rotation: Tensor,  # [B, S, 3, 3]
    translation: Tensor,  # [B, S, 3]
    *,
    tau: float = 2.0,
    form: str = "thesis",
    mask: Tensor | None = None,  # [B, N, S]
    gate: float = 1e-5,
) -> Tensor:  # [B, N, S]
    """Returns the consensus score beta of eq. 4.7: how well the motion head's motion of slot s agrees with the flow at point i.

    form "thesis": exp(-tau r_is), r the residual's norm. "release": exp(-tau r_is^2), and only for slots with sum_i
    m_is r_is^2 < gate (needs mask), 1 for the others. The thesis states no tau; the release has 2, or 0.5 with gate 5
    for OGC-DR. Carries no gradient. Raises ValueError for another form, or the release's without a mask.

    A point that stands still agrees with the identity, and less with a shift by 1:

    >>> points, shift = torch.zeros(1, 1, 3), torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])
    >>> beta = consensus_weights(points, torch.zeros(1, 1, 3), torch.eye(3).expand(1, 2, 3, 3), shift, tau=2.0)
    >>> [round(weight, 4) for weight in beta[0, 0].tolist()]
    [1.0, 0.1353]
    """
    gap = residuals(points, flow, rotation, translation).detach()
    if form == "thesis":
        return torch.exp(-tau * gap)
    if form != "release" or mask is None:
        raise ValueError(f"form must be thesis or release, the latter with a mask, but is {form!r}")
    square = gap.square()
    trusted = (mask.detach() * square).sum(1, keepdim=True) < gate
    return torch.where(trusted, torch.exp(-tau * square), 1.0)


def invariance_loss(mask1: Tensor, mask2: Tensor) -> Tensor:
    """Returns how much two masks (B,N,S) of the same points, seen differently, disagree: mean |m1 - m2|_2, both ways.

    Slots are matched by hard IoU first; in each direction the other mask is detached (OGC's last round), and the two
    are summed.
    """
    order = hungarian_assignment(soft_iou(one_hot(mask1.detach()), one_hot(mask2.detach())))
    forth = _length(mask1 - permute_slots(mask2, order).detach()).mean()
    back = _length(mask2 - permute_slots(mask1, order.argsort(1)).detach()).mean()
    return forth + back


def supervised_loss(mask: Tensor, labels: Tensor) -> Tensor:
    """Returns twice the mean binary cross-entropy of each slot with the part it is matched to, as released; a scalar.

    The Hungarian match is made on that cost. mask (B,N,S); labels (B,N): part ids i64 from 0, -1 = unknown: such points
    count nothing, but stay in the denominator, as in the release. Parts beyond the number of slots find no slot; slots
    beyond the parts should stay empty.
    """
    known = (labels >= 0).to(mask.dtype)[..., None]
    parts = max(int(labels.max()) + 1, mask.shape[2])
    truth = torch.nn.functional.one_hot(labels.clamp(min=0), parts).to(mask.dtype) * known
    inside, outside = _log(mask) * known, _log(1 - mask) * known
    gain = (inside.mT @ truth + outside.mT @ (1 - truth)) / mask.shape[1]  # [B, S, parts]
    order = hungarian_assignment(gain)
    return -2 * gain.gather(2, order[..., None]).mean()


def _log(share: Tensor) -> Tensor:
    """Returns the logarithm, not below that of 1e-30; without a gradient there."""
    return share.clamp(min=1e-30).log()


def _length(vectors: Tensor) -> Tensor:
    """Returns the Euclidean norm of the last axis; its gradient at zero is zero, not NaN."""
    square = vectors.square().sum(-1)
    zero = square == 0
    return torch.where(zero, 0.0, torch.where(zero, 1.0, square).sqrt())
