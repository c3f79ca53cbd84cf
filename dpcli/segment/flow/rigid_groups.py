"""The points that move as one body, judged from a flow alone: several rigid motions are fitted to it, greedily.

This is the start of unsupervised training. A network that knows nothing puts all points into one part and stays there,
since parts that are alike get the same motion; labels from the flow, wrong as some are, show it what a part is.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dpcli.ops import apply_motions, fps, gather_points, knn, weighted_kabsch

_SEEDS = 32  # neighborhoods that propose motions
_TOLERANCE = (0.01, 0.04)  # diameters, bounds of the residual up to which a motion explains a point
_GAIN = 0.03  # share of the points that a further motion has to explain
_SMALLEST = 0.02  # share of the points that a body has at least


@torch.no_grad()
def rigid_groups(
    points: Tensor,  # [B, N, 3]
    flow: Tensor,  # [B, N, 3]
    *,
    most: int = 8,
) -> Tensor:  # [B, N]
    """Returns labels i64 (B,N), 0 = the largest body; -1 = no motion found explains the point.

    Hypotheses are the motions of neighborhoods of far-apart points, of two sizes, and of the whole. The one that explains
    most is taken and fitted again to what it explains, then the one that explains most of the rest, until a motion would
    gain less than the share _GAIN of the points or there are `most`. A point counts as explained within a tolerance: three
    times the median residual of the small neighborhoods' own fits, kept within bounds.

    The left 60 points of a block stand still, the right 40 rise:

    >>> points = torch.cartesian_prod(torch.arange(5.0), torch.arange(4.0), torch.arange(5.0))[None] / 8
    >>> flow = (points[..., :1] > 0.3) * torch.tensor([0.0, 0.0, 0.3])
    >>> rigid_groups(points, flow)[0].bincount().tolist()
    [60, 40]
    """
    moved = points + flow
    hypotheses, noise = _hypotheses(points, moved, min(_SEEDS, points.shape[1]))
    bound = (3 * noise).clamp(*_TOLERANCE)[:, None]  # [B, 1]
    cost = bound.expand(points.shape[:2]).clone()
    open_ = torch.ones(len(points), dtype=torch.bool, device=points.device)
    chosen = []
    residual = _residuals(points, moved, *hypotheses)  # [B, H, N]
    for _ in range(most):
        saved = (cost[:, None] - residual).clamp(min=0).sum(-1)  # [B, H]
        best = saved.argmax(1)
        open_ = open_ & (saved.gather(1, best[:, None])[:, 0] > _GAIN * bound[:, 0] * points.shape[1])
        if not open_.any():
            break
        own = _refined(points, moved, cost, residual[torch.arange(len(points)), best], bound)
        own = torch.where(open_[:, None], own, torch.inf)
        cost = torch.minimum(cost, own)
        chosen.append(own)
    return _labels(points, torch.stack(chosen, 1), bound) if chosen else torch.full_like(cost, -1, dtype=torch.int64)


def _hypotheses(points: Tensor, moved: Tensor, seeds: int) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """Returns motions (B,H,3,3), (B,H,3) and the flow's noise (B)."""
    centers = gather_points(points, fps(points, seeds))
    rotations, shifts, noise = [], [], None
    for count in (16, 48):
        _, index = knn(centers, points, min(count, points.shape[1]))
        weights = torch.zeros(len(points), points.shape[1], seeds, device=points.device)
        weights.scatter_(1, index.transpose(1, 2), 1.0)
        rotation, shift = weighted_kabsch(points, moved, weights)
        if noise is None:
            own = _residuals(points, moved, rotation, shift).gather(2, index)
            noise = own.mean(-1).median(1).values
        rotations.append(rotation)
        shifts.append(shift)
    rotation, shift = weighted_kabsch(points, moved, torch.ones(*points.shape[:2], 1, device=points.device))
    return (torch.cat([*rotations, rotation], 1), torch.cat([*shifts, shift], 1)), noise


def _residuals(points: Tensor, moved: Tensor, rotation: Tensor, shift: Tensor) -> Tensor:
    """Returns how far (B,H,N) each motion takes each point from where the flow does."""
    return (apply_motions(points, rotation, shift) - moved[:, None]).square().sum(-1).sqrt()


def _refined(points: Tensor, moved: Tensor, cost: Tensor, residual: Tensor, bound: Tensor) -> Tensor:
    """Returns residuals (B,N) of a motion fitted again, twice, to the points it explains better than what is there."""
    for _ in range(2):
        inside = (residual < torch.minimum(cost, bound)).to(points.dtype)
        enough = inside.sum(1, keepdim=True) >= 4
        rotation, shift = weighted_kabsch(points, moved, inside[..., None])
        residual = torch.where(enough, _residuals(points, moved, rotation, shift)[:, 0], residual)
    return residual


def _labels(points: Tensor, residual: Tensor, bound: Tensor) -> Tensor:
    """Returns the motion (B,N) with the least residual over each point's neighbors.

    Points of smaller bodies than _SMALLEST, and unexplained ones, are -1.
    """
    _, index = knn(points, points, min(8, points.shape[1]))
    capped = torch.minimum(residual, 2 * bound[..., None]).transpose(1, 2)  # [B, N, M]
    smooth = gather_points(capped, index).mean(2)
    value, label = smooth.min(-1)
    label = torch.where(value < 2 * bound, label, -1)
    share = torch.stack([(label == m).float().mean(1) for m in range(residual.shape[1])], 1)  # [B, M]
    order = share.argsort(1, descending=True).argsort(1)
    order = torch.where(share >= _SMALLEST, order, -1)
    return torch.where(label >= 0, order.gather(1, label.clamp(min=0)), -1)
