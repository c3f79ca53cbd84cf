"""The losses that a flow network learns from without labels: Chamfer distance of the warped frame, and smoothness."""

from __future__ import annotations

import torch
from torch import Tensor

from dpcli.ops import gather_points, knn
from dpcli.segment.smoothness import smoothness_loss, smoothness_neighbors

_FIRST, _LATER = 0.5, 0.3  # weights of the iterations' losses


def chamfer(moved: Tensor, points: Tensor) -> Tensor:
    """Returns the mean distance to the nearest point of the other cloud, both ways, summed: (B,N,3), (B,M,3) -> scalar.

    Nearest points are found without a gradient; at a distance of zero the gradient is zero.

    >>> float(chamfer(torch.zeros(1, 1, 3), torch.tensor([[[3.0, 4.0, 0.0]]])))
    10.0
    """
    total = moved.new_zeros(())
    for query, other in ((moved, points), (points, moved)):
        _, idx = knn(query.detach(), other.detach(), 1)
        square = (gather_points(other, idx[..., 0]) - query).square().sum(-1)
        zero = square == 0
        total = total + torch.where(zero, 0.0, torch.where(zero, 1.0, square).sqrt()).mean()
    return total


def flow_loss(points1: Tensor, points2: Tensor, flows: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Returns the loss of the flows (B,N,3) of all iterations, and the last one's Chamfer distance alone.

    The loss is the sum over iterations, with weights 0.5, then 0.3, of 0.75 Chamfer + 0.25 smoothness (4 nearest within
    0.05, 8 of a ball of 0.1), as FlowStep3D (Kittenplon et al. 2021) has it on SAPIEN.
    """
    neighbors = smoothness_neighbors(points1, k=4, radius=0.05, ball_k=8, ball_radius=0.1)
    total, distance = points1.new_zeros(()), points1.new_zeros(())
    for i, flow in enumerate(flows):
        distance = chamfer(points1 + flow, points2)
        total = total + (_LATER if i else _FIRST) * (0.75 * distance + 0.25 * smoothness_loss(flow, neighbors))
    return total, distance.detach()
