"""The points a spherical convolution looks at: centers, neighbors, and how much each counts at each kernel point.

All of it depends on coordinates alone, so one pass serves all layers of a frame and nothing here carries a gradient.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dpcli.ops import gather_points, knn
from dpcli.runtime.mixed_precision import full_precision


@dataclass
class Neighborhood:
    """Holds centers (B,P,3) and their neighbors.

    index (B,P,n): into the layer's input points; offsets (B,P,n,3) = x_n - x_p; window (B,P,n): how much a neighbor
    counts at all.
    """

    centers: Tensor
    index: Tensor
    offsets: Tensor
    window: Tensor


def nearest_neighborhood(points: Tensor, centers: Tensor, radius: float, count: int) -> Neighborhood:
    """Returns at most `count` nearest points within `radius`, with a window that falls to zero at the end.

    window = 1 - d^2 / min(radius, distance to the next point)^2: nothing jumps when rounding lets a point in or out, so
    features move as little as the coordinates do. points (B,N,3), centers (B,P,3).
    """
    count = min(count, points.shape[1])
    squared, index = knn(centers, points, count + 1)
    beyond = squared[..., -1:] if points.shape[1] > count else torch.full_like(squared[..., -1:], radius**2)
    limit = beyond.clamp(max=radius**2).clamp(min=1e-12)
    index = index[..., :count]
    offsets = gather_points(points, index) - centers[..., None, :]
    window = (1 - offsets.square().sum(-1) / limit).clamp(min=0)
    return Neighborhood(centers, index, offsets, window)


def first_neighborhood(points: Tensor, centers: Tensor, radius: float, count: int) -> Neighborhood:
    """Returns the first `count` points in index order with d < radius, repeated in turn when there are fewer.

    This is the release's rule, whose quirk is kept: with exactly count - 1 hits, the last slot is point 0. window is 1.
    """
    squared = (centers[:, :, None] - points[:, None]).square().sum(-1)
    hit = squared < radius**2
    found = hit.sum(-1, keepdim=True).clamp(min=1)
    order = torch.argsort((~hit).to(torch.uint8), dim=-1, stable=True)
    slot = torch.arange(count, device=points.device).expand(*order.shape[:2], count)
    index = order.gather(2, slot % found)
    quirk = (found == count - 1) & (slot == count - 1)
    index = torch.where(quirk, 0, index)
    offsets = gather_points(points, index) - centers[..., None, :]
    return Neighborhood(centers, index, offsets, torch.ones_like(offsets[..., 0]))


RULES = {"nearest": nearest_neighborhood, "first": first_neighborhood}


@full_precision
def kernel_weights(offsets: Tensor, positions: Tensor, sigma: float) -> Tensor:
    """Returns max(0, 1 - ||x_n - x_p - k||^2 / sigma) for positions k (D,3): (B,P,n,3) -> (B,P,n,D)."""
    apart = offsets.square().sum(-1, keepdim=True) + positions.square().sum(-1) - 2 * offsets @ positions.T
    return (1 - apart / sigma).clamp(min=0)
