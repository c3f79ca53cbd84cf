"""The first flow of a pair of frames, both ways."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def pair_flow(first: Tensor, second: Tensor, method: str) -> tuple[Tensor, Tensor]:
    """Flow forth (N,3) and back (M,3) between two frames (N,3), (M,3), by `estimate_flow`.

    ICP runs once: its bodies' motions are inverted for the way back, and each point of frame 2 belongs to the body of
    the nearest point that was moved there, so that both frames tell of the same bodies.
    """
    from dpcli.segment.flow.estimate import estimate_flow, rigid_bodies

    if method != "icp":
        both = [estimate_flow(a[None], b[None], method=method)[0] for a, b in ((first, second), (second, first))]
        return both[0], both[1]
    from scipy.spatial import cKDTree

    one, two = (cloud.numpy().astype(np.float64) for cloud in (first, second))
    bodies = rigid_bodies(one, two)
    moved = _apply(bodies.motion[bodies.label], one)
    label = bodies.label[cKDTree(moved).query(two)[1]]
    rotation = bodies.motion[:, :, :3].swapaxes(1, 2)
    inverse = np.concatenate([rotation, -rotation @ bodies.motion[:, :, 3:]], 2)
    return torch.from_numpy(np.float32(moved - one)), torch.from_numpy(np.float32(_apply(inverse[label], two) - two))


def _apply(motion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Each point (N,3) by its own motion (N,3,4)."""
    return np.einsum("nij,nj->ni", motion[:, :, :3], points) + motion[:, :, 3]
