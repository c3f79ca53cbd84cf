"""Parts that the network took for one although they move apart: split where the flow of the frame shows two bodies."""

from __future__ import annotations

import torch
from torch import Tensor

from dpcli.segment.rigid_groups import rigid_groups


def split_by_motion(points: Tensor, flow: Tensor, mask: Tensor, smallest: float = 0.03) -> Tensor:
    """Mask (N,S) of one frame with moving-apart slots divided, given its flow (N,3) to another frame.

    A slot whose points move as several rigid bodies, each of at least `smallest` of the frame's points, keeps the largest;
    the others get slots that no point has, as long as there are any. Probabilities move along, so rows still sum to 1.
    """
    mask = mask.clone()
    labels = mask.argmax(1)
    free = [s for s in range(mask.shape[1]) if not (labels == s).any()]
    for slot in labels.unique().tolist():
        inside = torch.nonzero(labels == slot)[:, 0]
        if len(inside) < 2 * smallest * len(points) or len(inside) < 16:
            continue
        bodies = rigid_groups(points[inside][None], flow[inside][None], most=4)[0]
        for body in range(1, int(bodies.max()) + 1):
            own = inside[bodies == body]
            if len(own) < smallest * len(points) or not free:
                continue
            target = free.pop(0)
            mask[own, target], mask[own, slot] = mask[own, slot], mask[own, target]
    return mask
