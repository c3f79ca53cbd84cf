"""The arrays of a `gaussians` file, made from a fitted model."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dpcli.generate4d.scene.depth import calm_depth
from dpcli.generate4d.scene.model import Model4D
from dpcli.generate4d.scene.seen_gaussians import trust
from dpcli.generate4d.targets import Targets
from dpcli.ops.rigid import weighted_kabsch
from dpcli.ops.rigid_parts import find_parts
from dpcli.ops.rotations import normalize_quaternion
from dpcli.store.gaussians import SH_C0, GaussianScene

_SOLID = 0.1  # opacity of a Gaussian whose motion counts; fainter ones float anywhere


@torch.no_grad()
def to_scene(model: Model4D, targets: Targets, metrics: dict, *, calm: bool = False) -> GaussianScene:
    """Returns every frame's Gaussians, their parts and how those move.

    Parts are found again on the whole motion, but where the settings leave the temporal cue out: those of its network
    then stand. A part's motion is the one that best explains where its Gaussians went (weighted Kabsch, weights part probability
    times opacity), which is also what a fit without rigid motion can be asked for. calm: motion along the reference
    view's line of sight comes from layers that differ from frame to frame, and only its slow share is kept.
    """
    gaussians, control = model.gaussians, model.control
    motion = _motion_of_frames(model, targets)
    frame_mean, solid = motion["mean"], gaussians.opacity_logit.sigmoid() >= _SOLID
    probability = motion["part"].mean(0)
    if model.config.rigid and model.config.temporal:
        probability = _found_parts(frame_mean, solid, targets, model.config.parts)
    if calm:  # after the parts, whose number was chosen on the motion as fitted
        pose = targets.world_to_camera[targets.reference]
        frame_mean, motion["control"] = (calm_depth(places, pose) for places in (frame_mean, motion["control"]))
    return GaussianScene(
        mean=_array(gaussians.mean),
        log_scale=_array(gaussians.log_scale),
        quaternion=_array(normalize_quaternion(gaussians.quaternion)),
        opacity_logit=_array(gaussians.opacity_logit),
        sh=_array((gaussians.color[:, None] - 0.5) / SH_C0),
        time=targets.seconds,
        frame_mean=_array(frame_mean),
        frame_quaternion=_array(normalize_quaternion(motion["quaternion"])),
        part=probability.argmax(1).numpy().astype(np.int16),
        part_probability=_array(probability),
        part_motion=_part_motion(gaussians.mean, frame_mean, probability, gaussians.opacity_logit.sigmoid()),
        rigid_weight=_array(motion["weight"]),
        control_point=_array(torch.zeros(0, 3) if control is None else control.position),
        control_radius=_array(torch.zeros(0) if control is None else control.log_radius.exp()),
        control_position=_array(motion["control"]),
        control_quaternion=_array(normalize_quaternion(motion["turn"])),
        camera_intrinsics=targets.intrinsics,
        camera_world_to_camera=targets.world_to_camera,
        size=targets.size,
        reference=targets.reference,
        metrics=metrics,
    )


def _motion_of_frames(model: Model4D, targets: Targets) -> dict[str, Tensor]:
    """Returns what changes from frame to frame, each (T,N,...), of control points (T,K,...); K = 0 where there are none."""
    rows: dict[str, list[Tensor]] = {name: [] for name in ("mean", "quaternion", "weight", "part", "control", "turn")}
    times = targets.times()
    model.refresh_neighbors()
    for frame in range(len(times)):
        instant = model.at(times[[frame]])
        field = model.field(model.gaussians.mean, times[[frame]])
        rows["mean"].append(instant.mean[0])
        rows["quaternion"].append(instant.quaternion[0])
        rows["weight"].append(field.weight[0, :, 0])
        rows["part"].append(field.part[0])
        sparse = model.control is not None
        rows["control"].append(model.control.position + instant.motion.displacement[0] if sparse else torch.zeros(0, 3))
        rows["turn"].append(instant.motion.quaternion[0] if sparse else torch.zeros(0, 4))
    return {name: torch.stack(values) for name, values in rows.items()}


def _found_parts(frame_mean: Tensor, solid: Tensor, targets: Targets, most: int) -> Tensor:  # [N, S]
    """Returns the parts that the motion of all frames shows, one for each Gaussian."""
    frames = frame_mean.double().numpy()
    trusted = trust(frames, solid.numpy(), targets.world_to_camera, targets.intrinsics, targets.size)
    part = torch.from_numpy(find_parts(frames, trusted, most))
    return torch.nn.functional.one_hot(part).float()


def _part_motion(mean: Tensor, frame_mean: Tensor, probability: Tensor, opacity: Tensor) -> np.ndarray:
    """Returns the motion of each part f32 (T,S,4,4), canonical to frame."""
    count = len(frame_mean)
    start = mean.double().expand(count, -1, -1)
    weights = (probability * opacity[:, None]).double().expand(count, -1, -1)
    rotation, translation = weighted_kabsch(start, frame_mean.double(), weights)
    motion = np.tile(np.eye(4, dtype=np.float32), (count, probability.shape[1], 1, 1))
    motion[..., :3, :3], motion[..., :3, 3] = rotation.numpy(), translation.numpy()
    return motion


def _array(value: Tensor) -> np.ndarray:
    return value.detach().cpu().float().contiguous().numpy()
