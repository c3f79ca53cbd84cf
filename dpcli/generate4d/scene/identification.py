"""Finding quasi-rigid parts without labels: temporal-change and spatial-coherence preservation (eq. 5.3, 5.4)."""

from __future__ import annotations

import torch
from torch import Tensor

from dpcli.ops.gather import gather_points
from dpcli.ops.nearest_neighbors import knn
from dpcli.ops.rigid import rigid_flow, weighted_kabsch


def temporal_loss(
    points: Tensor,  # [N, 3] canonical
    displacement: Tensor,  # [B, N, 3] taken as given
    part: Tensor,  # [B, N, S]
) -> Tensor:
    """Returns temporal-change preservation, eq. 5.3: how badly one rigid motion per part explains where points went.

    The motion is that of weighted Kabsch; the squared distance is averaged over points and times.

    The displacement is a target ("from the previous iteration"), so gradients reach the partition alone.
    """
    target = displacement.detach()
    start = points.detach().expand(len(target), -1, -1)
    rotation, translation = weighted_kabsch(start, start + target, part)
    return (rigid_flow(start, part, rotation, translation) - target).square().sum(-1).mean()


def spatial_loss(
    part: Tensor,  # [B, N, S]
    neighbors: Tensor,  # [N, H] indices of points nearby; a row's own index fills what is missing
) -> Tensor:
    """Returns spatial coherence, eq. 5.4: the mean distance between part probabilities of a point and its neighbors.

    >>> parts = torch.tensor([[[1.0, 0.0], [0.0, 1.0]]])
    >>> round(spatial_loss(parts, torch.tensor([[1], [0]])).item(), 4)
    1.4142
    """
    difference = part[:, :, None] - gather_points(part, neighbors.expand(len(part), -1, -1))
    return (difference.square().sum(-1) + 1e-12).sqrt().mean()


def ball_neighbors(points: Tensor, radius: float, count: int) -> Tensor:  # [N, 3] -> [N, count]
    """Returns up to `count` other points within `radius`, nearest first, as indices; a point's own index fills the rest.

    >>> ball_neighbors(torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]]), 1.5, 2).tolist()
    [[1, 0], [0, 1], [2, 2]]
    """
    own = torch.arange(len(points), device=points.device)[:, None]
    if len(points) < 2:
        return own
    squared, index = knn(points.detach()[None], points.detach()[None], min(count, len(points) - 1) + 1)
    near = (squared[0] <= radius**2) & (index[0] != own)
    return torch.where(near, index[0], own)[:, 1:]
