"""The split of parts that the network took for one although the frame's flow shows that they move apart."""

from __future__ import annotations

import torch
from torch import Tensor

from dpcli.ops import rigid_flow, weighted_kabsch
from dpcli.segment.flow.rigid_groups import rigid_groups
from dpcli.segment.network.slot_matching import one_hot

_SMALLEST = 0.03  # share of the frame's points that a body split off has at least
_RIGID = 3e-4  # mean residual of one motion, diameters, up to which `rigid_groups` can find no second body worth taking


def split_by_motion(points: Tensor, flow: Tensor, mask: Tensor) -> Tensor:
    """Returns the mask (N,S) of one frame with slots divided whose points move apart.

    flow (N,3): to another frame. A slot whose points move as several rigid bodies, each of at least _SMALLEST of the
    frame's points, keeps the largest; the others get slots that no point has, as long as there are any. Probabilities
    move along, so rows still sum to 1.
    """
    mask = mask.clone()
    labels = mask.argmax(1)
    rigid = _moves_as_one(points, flow, mask)
    free = [s for s in range(mask.shape[1]) if not (labels == s).any()]
    for slot in labels.unique().tolist():
        inside = torch.nonzero(labels == slot)[:, 0]
        if rigid[slot] or len(inside) < 2 * _SMALLEST * len(points) or len(inside) < 16:
            continue
        bodies = rigid_groups(points[inside][None], flow[inside][None], most=4)[0]
        for body in range(1, int(bodies.max()) + 1):
            own = inside[bodies == body]
            if len(own) < _SMALLEST * len(points) or not free:
                continue
            target = free.pop(0)
            mask[own, target], mask[own, slot] = mask[own, slot], mask[own, target]
    return mask


def _moves_as_one(points: Tensor, flow: Tensor, mask: Tensor) -> list[bool]:
    """Returns, for each slot, whether one motion explains the flow (N,3) of its points so well that no search is
    needed.

    A second body must save 3 % (`_GAIN` of `rigid_groups`) of the least tolerance, 0.01. Most slots move as one, and a search of all
    was slow.
    """
    share = one_hot(mask)
    motions = weighted_kabsch(points[None], (points + flow)[None], share[None])
    residual = (rigid_flow(points[None], share[None], *motions)[0] - flow).norm(dim=1)
    return ((share * residual[:, None]).sum(0) <= _RIGID * share.sum(0)).tolist()
