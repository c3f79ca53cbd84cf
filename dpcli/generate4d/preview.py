"""A strip of pictures while a fit goes on: input, render, parts, and the object seen from elsewhere."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dpcli.generate4d.colours import weight_colours
from dpcli.generate4d.model import Model4D
from dpcli.generate4d.targets import Targets
from dpcli.ops.cameras import orbit_of, orbit_pose
from dpcli.ops.splatting import rasterization
from dpcli.runtime.palette import part_colours


@torch.no_grad()
def write_preview(model: Model4D, targets: Targets, path: Path, columns: int = 5, side: int = 128) -> None:
    """Rows: input, render, parts in colour, rigid weight, a view from 60 degrees to the side; columns: times."""
    import imageio.v3 as imageio

    frames = np.unique(np.linspace(0, targets.num_frames - 1, columns).round().astype(int)).tolist()
    shrink = max(targets.size[1] // side, 1)
    wanted, intrinsics, poses = targets.at([targets.reference] * len(frames), frames, shrink)
    height, width = wanted.shape[1:3]
    device = model.gaussians.mean.device
    wanted, intrinsics, poses = wanted.to(device), intrinsics.to(device), poses.to(device)
    times = targets.times()[frames].to(device)
    instant = model.at(times)
    field = model.field(model.gaussians.mean, times)
    parts = torch.from_numpy(part_colours(field.part.argmax(-1).cpu().numpy()) / 255).float().to(device)
    rigid = torch.from_numpy(weight_colours(field.weight[..., 0].cpu().numpy()) / 255).float().to(device)
    azimuth, elevation, radius = orbit_of(targets.world_to_camera[targets.reference])
    aside = torch.from_numpy(orbit_pose(azimuth + np.pi / 3, elevation + 0.3, radius)).float().expand(len(frames), 4, 4).to(device)

    def draw(colours: Tensor, cameras: Tensor) -> Tensor:
        own = model.gaussians
        return rasterization(
            instant.mean, instant.quaternion, own.log_scale.exp(), own.opacity_logit.sigmoid(), colours, cameras,
            intrinsics, width, height, backgrounds=torch.ones(len(frames), 3, device=device),
        )[0]  # fmt: skip

    own_colour = model.gaussians.colour.expand(len(frames), -1, -1)
    rows = [wanted[..., :3] + 1 - wanted[..., 3:], draw(own_colour, poses), draw(parts, poses), draw(rigid, poses),
            draw(own_colour, aside)]  # fmt: skip
    sheet = torch.cat([torch.cat(list(row), 1) for row in rows], 0)
    part = path.with_name(f".{path.stem}.part.png")
    imageio.imwrite(part, (sheet.clamp(0, 1) * 255).round().byte().cpu().numpy())
    os.replace(part, path)
