"""The first flow of a training pair, both ways."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def pair_flow(points: Tensor, method: str) -> Tensor:
    """Flow f32 (2,N,3), forth and back, of a pair's points (2,N,3), by `estimate_flow`.

    ICP runs once: its bodies' motions are inverted for the way back, and each point of frame 2 belongs to the body of
    the nearest point that was moved there, so that both frames tell of the same bodies.
    """
    from dpcli.segment.flow.estimate import estimate_flow, rigid_bodies

    if method != "icp":
        return estimate_flow(points, points.flip(0), method=method)
    from scipy.spatial import cKDTree

    first, second = (cloud.numpy().astype(np.float64) for cloud in points)
    bodies = rigid_bodies(first, second)
    moved = _apply(bodies.motion[bodies.label], first)
    label = bodies.label[cKDTree(moved).query(second)[1]]
    rotation = bodies.motion[:, :, :3].swapaxes(1, 2)
    inverse = np.concatenate([rotation, -rotation @ bodies.motion[:, :, 3:]], 2)
    return torch.from_numpy(np.float32(np.stack([moved - first, _apply(inverse[label], second) - second])))


def _apply(motion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Each point (N,3) by its own motion (N,3,4)."""
    return np.einsum("nij,nj->ni", motion[:, :, :3], points) + motion[:, :, 3]
