"""Random new cameras, from which a prior judges the object."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dpcli.generate4d.priors.interface import RelativeCamera
from dpcli.generate4d.targets import Targets
from dpcli.ops.cameras import orbit_of, orbit_pose

_ELEVATION = np.deg2rad(30.0)  # offsets drawn from +-30 degrees, azimuth from all around (SC4D)


def novel_cameras(
    targets: Targets, count: int, size: int, rng: torch.Generator
) -> tuple[list[RelativeCamera], Tensor, Tensor]:
    """Returns random cameras, by their offsets from the reference, and their poses and intrinsics f32.

    The poses are world_to_camera (count,4,4), the intrinsics (count,3,3) are of square pictures of `size` pixels.
    """
    azimuth, elevation, radius = orbit_of(targets.world_to_camera[targets.reference])
    drawn = torch.rand(count, 2, generator=rng).numpy()
    heights = np.clip(elevation + (drawn[:, 1] * 2 - 1) * _ELEVATION, -1.5, 1.5)  # never straight above or below
    offsets = [(float((a * 2 - 1) * np.pi), float(e - elevation), 0.0) for a, e in zip(drawn[:, 0], heights)]
    poses = np.stack([orbit_pose(azimuth + a, elevation + e, radius) for a, e, _ in offsets])
    matrix = targets.intrinsics[targets.reference].copy()
    matrix[:2] *= size / max(targets.size)
    matrix[:2, 2] = size / 2
    intrinsics = torch.from_numpy(matrix).float().expand(count, 3, 3)
    return offsets, torch.from_numpy(poses).float(), intrinsics
