"""From a fitted model to the arrays of a `gaussians` file."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dpcli.generate4d.scene.canonical_gaussians import SH0
from dpcli.generate4d.scene.model import Model4D
from dpcli.generate4d.scene.quaternion import normalize
from dpcli.generate4d.targets import Targets
from dpcli.ops.rigid import weighted_kabsch
from dpcli.store.gaussians import GaussianScene


@torch.no_grad()
def to_scene(model: Model4D, targets: Targets, metrics: dict) -> GaussianScene:
    """Every frame's Gaussians, their parts and how those move.

    A part's motion is the one that best explains where its Gaussians went (weighted Kabsch, weights part probability
    times opacity), which is also what a fit without rigid motion can be asked for.
    """
    own, times = model.gaussians, targets.times()
    model.refresh_neighbors()
    means, quaternions, weights, parts, control, turns = [], [], [], [], [], []
    for frame in range(len(times)):
        instant = model.at(times[[frame]])
        field = model.field(own.mean, times[[frame]])
        means.append(instant.mean[0])
        quaternions.append(instant.quaternion[0])
        weights.append(field.weight[0, :, 0])
        parts.append(field.part[0])
        if model.control is not None:
            control.append(model.control.position + instant.motion.displacement[0])
            turns.append(instant.motion.quaternion[0])
    probability = torch.stack(parts).mean(0)
    frame_mean = torch.stack(means)
    empty = torch.zeros(len(times), 0, 3)
    points = torch.zeros(0, 3) if model.control is None else model.control.position
    return GaussianScene(
        mean=_array(own.mean),
        log_scale=_array(own.log_scale),
        quaternion=_array(normalize(own.quaternion)),
        opacity_logit=_array(own.opacity_logit),
        sh=_array((own.color[:, None] - 0.5) / SH0),
        time=targets.seconds,
        frame_mean=_array(frame_mean),
        frame_quaternion=_array(normalize(torch.stack(quaternions))),
        part=probability.argmax(1).numpy().astype(np.int16),
        part_probability=_array(probability),
        part_motion=_part_motion(own.mean, frame_mean, probability, own.opacity_logit.sigmoid()),
        rigid_weight=_array(torch.stack(weights)),
        control_point=_array(points),
        control_radius=_array(torch.zeros(0) if model.control is None else model.control.log_radius.exp()),
        control_position=_array(torch.stack(control) if control else empty),
        control_quaternion=_array(normalize(torch.stack(turns)) if turns else torch.zeros(len(times), 0, 4)),
        camera_intrinsics=targets.intrinsics,
        camera_world_to_camera=targets.world_to_camera,
        size=targets.size,
        reference=targets.reference,
        metrics=metrics,
    )


def _part_motion(mean: Tensor, frame_mean: Tensor, probability: Tensor, opacity: Tensor) -> np.ndarray:
    """f32 (T,S,4,4), canonical to frame."""
    count = len(frame_mean)
    start = mean.double().expand(count, -1, -1)
    weights = (probability * opacity[:, None]).double().expand(count, -1, -1)
    rotation, translation = weighted_kabsch(start, frame_mean.double(), weights)
    motion = np.tile(np.eye(4, dtype=np.float32), (count, probability.shape[1], 1, 1))
    motion[..., :3, :3], motion[..., :3, 3] = rotation.numpy(), translation.numpy()
    return motion


def _array(value: Tensor) -> np.ndarray:
    return value.detach().cpu().float().contiguous().numpy()
