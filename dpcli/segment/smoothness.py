"""The smoothness loss that masks and flows share: neighbors should have like values (OGC, Song and Yang 2022)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dpcli.ops import gather_points, knn, space_time_ball_query


class Neighbors(NamedTuple):
    """Holds indices (B,N,k) i64 into a cloud: the nearest points within a radius, and any within a larger one."""

    nearest: Tensor
    ball: Tensor


def smoothness_neighbors(
    points: Tensor, *, k: int = 8, radius: float = 0.1, ball_k: int = 16, ball_radius: float = 0.2
) -> Neighbors:
    """Returns the neighbors of every point of (B,N,3) for `smoothness_loss`; the defaults are those for SAPIEN.

    nearest: the k nearest points, those farther than `radius` replaced by the point itself. ball: the first ball_k in
    index order with distance below ball_radius, unused places repeating the first. Other data sets: OGC-DR 8, 0.02, 16,
    0.04; KITTI 32, 1.0, 64, 2.0. The loss of a flow network takes 4, 0.05, 8, 0.1.
    """
    squared, nearest = knn(points, points, k)
    nearest = torch.where(squared > radius**2, nearest[..., :1], nearest)
    still = torch.zeros(points.shape[:2], device=points.device)
    ball, _ = space_time_ball_query(points, still, points, still, [ball_radius], ball_k)
    return Neighbors(nearest, ball)


def smoothness_loss(values: Tensor, neighbors: Neighbors, weights: tuple[float, float] = (3.0, 1.0)) -> Tensor:
    """Returns the weighted sum, a scalar, of the mean |v_i - v_j|_1 over nearest neighbors and over those of the ball.

    values (B,N,S): a mask or a flow; the norm sums over its channels.

    Two points 0.05 apart with values that differ by 1: each has the other among its two neighbors, so both means are 1/2.

    >>> points = torch.tensor([[[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]]])
    >>> neighbors = smoothness_neighbors(points, k=2, ball_k=2)
    >>> smoothness_loss(torch.tensor([[[0.0], [1.0]]]), neighbors).item()
    2.0
    """
    near, far = ((values[:, :, None] - gather_points(values, index)).abs().sum(-1).mean() for index in neighbors)
    return weights[0] * near + weights[1] * far
