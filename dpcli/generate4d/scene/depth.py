"""Motion along one camera's line of sight, of which a fit of a single view knows little."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

_KEPT = 0.75  # share of slow change of depth; chosen on clips of known tracks, of which each gains
_SLOW = 2  # half swings over the clip that are slow: a way to or fro, and one to and fro


def calm_depth(places: Tensor, pose: np.ndarray) -> Tensor:
    """Returns places f (T,N,3) whose depth in a camera (world_to_camera (4,4)) changes slowly, and less.

    Depth over time keeps the first cosines of its discrete cosine transform, so that what walks towards the camera need not
    return. Every place stays on its ray, so that the camera's pictures stay as they are but for the size of what came
    nearer. What lies at or behind the camera isn't touched.
    """
    turn, shift = torch.from_numpy(pose[:3, :3]).to(places), torch.from_numpy(pose[:3, 3]).to(places)
    center = -turn.T @ shift
    ray = places - center
    depth = ray @ turn[2]
    half_swings = torch.arange(_SLOW + 1).to(depth) * torch.pi / len(depth)
    slow = torch.cos((torch.arange(len(depth)).to(depth)[:, None] + 0.5) * half_swings)
    mean = depth.mean(0)
    calm = mean + _KEPT * (slow @ (torch.linalg.pinv(slow) @ depth) - mean)
    before = (depth > 0).all(0) & (calm > 0).all(0)
    return torch.where(before[:, None], center + ray * (calm / depth)[..., None], places)
