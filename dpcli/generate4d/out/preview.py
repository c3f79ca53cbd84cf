"""The preview of a fit, running or finished: input, render, parts, and the object seen from elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dpcli.draw.palette import part_colors
from dpcli.draw.sheet import save_picture, spread_evenly
from dpcli.generate4d.out.camera_paths import SOLID, orbit_around, seen_from, turning_point
from dpcli.generate4d.out.picture_colors import weight_colors
from dpcli.generate4d.scene.model import Model4D
from dpcli.generate4d.targets import Targets
from dpcli.ops.splatting.rasterization import rasterization
from dpcli.store.gaussians import SH_C0, GaussianScene

_SIDES = (60, 120, 180, -120, -60)  # degrees from the reference camera
_COLUMNS, _SIDE = 5, 128  # times, and about how many pixels wide a picture is


@dataclass
class _Instants:
    """Holds N Gaussians at F times and what colors them, as tensors of one device."""

    mean: Tensor  # [F, N, 3]
    quaternion: Tensor  # [F, N, 4]
    scale: Tensor  # [N, 3]
    opacity: Tensor  # [N]
    color: Tensor  # [N, 3]
    part: Tensor  # [F, N] whole numbers
    weight: Tensor  # [F, N]


def _instants_of_model(model: Model4D, times: Tensor) -> _Instants:
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


def _instants_of_scene(scene: GaussianScene, frames: list[int]) -> _Instants:
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
def write_preview(fitted: Model4D | GaussianScene, targets: Targets, path: Path) -> None:
    """Writes a picture whose rows are input, render, parts, rigid weight, and views from _SIDES; columns: times."""
    frames = spread_evenly(targets.num_frames, _COLUMNS)
    shrink = max(targets.size[1] // _SIDE, 1)
    truth, intrinsics, poses = targets.at([targets.reference] * len(frames), frames, shrink)
    if isinstance(fitted, GaussianScene):
        instants = _instants_of_scene(fitted, frames)
    else:
        instants = _instants_of_model(fitted, targets.times()[frames])
    size, color = (truth.shape[2], truth.shape[1]), instants.color.expand(len(frames), -1, -1)
    parts, weights = part_colors(instants.part.cpu().numpy()), weight_colors(instants.weight.cpu().numpy())
    centered = intrinsics.clone()  # cameras aside look at the object, wherever the reference has it in its picture
    centered[:, :2, 2] = 0.5 * torch.tensor(size)
    rows = [
        truth[..., :3] + 1 - truth[..., 3:],
        _draw(instants, color, poses, intrinsics, size),
        _draw(instants, torch.from_numpy(parts / 255), poses, intrinsics, size),
        _draw(instants, torch.from_numpy(weights / 255), poses, intrinsics, size),
        *(_draw(instants, color, pose.expand(len(frames), 4, 4), centered, size) for pose in _aside(instants, targets)),
    ]
    sheet = torch.cat([torch.cat(list(row), 1) for row in rows], 0)
    save_picture((sheet.clamp(0, 1) * 255).round().byte().numpy(), path)


def _aside(instants: _Instants, targets: Targets) -> list[Tensor]:  # of [4, 4]
    """Returns cameras about the upright from the reference camera by _SIDES, and above it, around what those of `render` turn around."""
    pose, lens = targets.world_to_camera[targets.reference], targets.intrinsics[targets.reference]
    places = instants.mean[:, instants.opacity >= min(SOLID, float(instants.opacity.max()))]
    middle = turning_point(places.cpu().numpy(), pose, lens, targets.size)
    azimuth, elevation, radius = seen_from(middle, pose)
    turned = (orbit_around(middle, azimuth + np.deg2rad(turn), elevation + 0.3, radius) for turn in _SIDES)
    return [torch.from_numpy(pose) for pose in turned]


def _draw(instants: _Instants, colors: Tensor, poses: Tensor, intrinsics: Tensor, size: tuple[int, int]) -> Tensor:
    """Returns pictures f32 (F,H,W,3) on white, on the CPU."""
    device = instants.mean.device
    return rasterization(
        instants.mean,
        instants.quaternion,
        instants.scale,
        instants.opacity,
        colors.float().to(device),
        poses.float().to(device),
        intrinsics.to(device),
        *size,
        backgrounds=torch.ones(len(poses), 3, device=device),
    )[0].cpu()
