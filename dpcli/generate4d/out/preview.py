"""A strip of pictures while a fit goes on, and of a finished one: input, render, parts, the object seen from elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dpcli.draw.palette import part_colors
from dpcli.generate4d.out.picture_colors import weight_colors
from dpcli.generate4d.scene.model import Model4D
from dpcli.generate4d.targets import Targets
from dpcli.ops.cameras import orbit_of, orbit_pose
from dpcli.ops.splatting.rasterization import rasterization
from dpcli.runtime.whole_file import whole_file
from dpcli.store.gaussians import SH_C0, GaussianScene


@dataclass
class _Instants:
    """N Gaussians at F times, tensors of one device, and what colors them."""

    mean: Tensor  # [F, N, 3]
    quaternion: Tensor  # [F, N, 4]
    scale: Tensor  # [N, 3]
    opacity: Tensor  # [N]
    color: Tensor  # [N, 3]
    part: Tensor  # [F, N] whole numbers
    weight: Tensor  # [F, N]


def _of_model(model: Model4D, times: Tensor) -> _Instants:
    own, device = model.gaussians, model.gaussians.mean.device
    instant, field = model.at(times.to(device)), model.field(own.mean, times.to(device))
    return _Instants(
        instant.mean,
        instant.quaternion,
        own.log_scale.exp(),
        own.opacity_logit.sigmoid(),
        own.color,
        field.part.argmax(-1),
        field.weight[..., 0],
    )


def _of_scene(scene: GaussianScene, frames: list[int]) -> _Instants:
    arrays = (
        scene.frame_mean[frames],
        scene.frame_quaternion[frames],
        scene.scale,
        scene.opacity,
        0.5 + SH_C0 * scene.sh[:, 0],
        np.tile(scene.part, (len(frames), 1)),
        scene.rigid_weight[frames],
    )
    return _Instants(*map(torch.from_numpy, arrays))


@torch.no_grad()
def write_preview(
    fitted: Model4D | GaussianScene, targets: Targets, path: Path, columns: int = 5, side: int = 128
) -> None:
    """Rows: input, render, parts in color, rigid weight, a view from 60 degrees to the side; columns: times."""
    import imageio.v3 as imageio

    frames = np.unique(np.linspace(0, targets.num_frames - 1, columns).round().astype(int)).tolist()
    shrink = max(targets.size[1] // side, 1)
    wanted, intrinsics, poses = targets.at([targets.reference] * len(frames), frames, shrink)
    height, width = wanted.shape[1:3]
    own = _of_scene(fitted, frames) if isinstance(fitted, GaussianScene) else _of_model(fitted, targets.times()[frames])
    device = own.mean.device
    wanted, intrinsics, poses = wanted.to(device), intrinsics.to(device), poses.to(device)
    parts = torch.from_numpy(part_colors(own.part.cpu().numpy()) / 255).float().to(device)
    rigid = torch.from_numpy(weight_colors(own.weight.cpu().numpy()) / 255).float().to(device)
    azimuth, elevation, radius = orbit_of(targets.world_to_camera[targets.reference])
    aside = (
        torch.from_numpy(orbit_pose(azimuth + np.pi / 3, elevation + 0.3, radius))
        .float()
        .expand(len(frames), 4, 4)
        .to(device)
    )

    def draw(colors: Tensor, cameras: Tensor) -> Tensor:
        return rasterization(
            own.mean,
            own.quaternion,
            own.scale,
            own.opacity,
            colors,
            cameras,
            intrinsics,
            width,
            height,
            backgrounds=torch.ones(len(frames), 3, device=device),
        )[0]

    own_color = own.color.expand(len(frames), -1, -1)
    rows = [
        wanted[..., :3] + 1 - wanted[..., 3:],
        draw(own_color, poses),
        draw(parts, poses),
        draw(rigid, poses),
        draw(own_color, aside),
    ]
    sheet = torch.cat([torch.cat(list(row), 1) for row in rows], 0)
    with whole_file(path) as part:
        imageio.imwrite(part, (sheet.clamp(0, 1) * 255).round().byte().cpu().numpy())
