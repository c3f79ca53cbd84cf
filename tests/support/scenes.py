"""A 4D scene made by hand: two boxes of Gaussians, red and blue, the second swinging on a hinge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpcli.ops.cameras import DEFAULT_FOVY, orbit_pose, pinhole
from dpcli.store.gaussians import SH_C0, GaussianScene

RED, BLUE = (0.85, 0.15, 0.1), (0.1, 0.25, 0.9)
SWING = np.deg2rad(70.0)  # of the blue box about the hinge, between the first and the last frame
HINGE = np.array([0.05, 0.0, 0.0])


def toy_scene(
    per_part: int = 150, frames: int = 5, degree: int = 0, size: int = 64, controls: int = 6
) -> GaussianScene:
    """Part 0 (red, x < 0) stands still, part 1 (blue, x > 0) turns about z at HINGE; 1 second long, two cameras."""
    rng = np.random.default_rng(7)
    mean = rng.uniform([-0.6, -0.12, -0.12], [-0.02, 0.12, 0.12], (per_part, 3))
    mean = np.concatenate([mean, mean * [-1, 1, 1] + [0.02, 0, 0]])
    count, part = len(mean), np.repeat([0, 1], per_part)
    angles = np.linspace(0, SWING, frames)
    motion = np.tile(np.eye(4), (frames, 2, 1, 1))
    turned = np.zeros((frames, count, 4))
    for t, angle in enumerate(angles):
        c, s = np.cos(angle), np.sin(angle)
        motion[t, 1, :2, :2] = [[c, -s], [s, c]]
        motion[t, 1, :3, 3] = HINGE - motion[t, 1, :3, :3] @ HINGE
        turned[t] = np.where(part[:, None] == 1, [np.cos(angle / 2), 0, 0, np.sin(angle / 2)], [1, 0, 0, 0])
    moved = np.einsum("tnij,nj->tni", motion[:, part][..., :3, :3], mean) + motion[:, part][..., :3, 3]
    sh = np.zeros((count, (degree + 1) ** 2, 3))
    sh[:, 0] = (np.array([RED, BLUE])[part] - 0.5) / SH_C0
    sh[:, 1:] = 0.05 * rng.normal(size=sh[:, 1:].shape)
    chosen = np.linspace(0, count - 1, controls).astype(int)
    single = {
        "mean": mean,
        "log_scale": np.log(np.tile([0.05, 0.03, 0.03], (count, 1))),
        "quaternion": np.tile([1.0, 0, 0, 0], (count, 1)),
        "opacity_logit": np.full(count, 2.2),
        "sh": sh,
        "frame_mean": moved,
        "frame_quaternion": turned,
        "part_probability": np.eye(2)[part] * 0.9 + 0.05,
        "part_motion": motion,
        "rigid_weight": np.linspace(0, 1, frames * count).reshape(frames, count),
        "control_point": mean[chosen],
        "control_radius": np.full(controls, 0.1),
        "control_position": moved[:, chosen],
        "control_quaternion": turned[:, chosen],
    }
    return GaussianScene(
        **{key: np.float32(value) for key, value in single.items()},
        part=part.astype(np.int16),
        time=np.linspace(0, 1, frames),
        camera_intrinsics=np.tile(pinhole(DEFAULT_FOVY, size, size), (2, 1, 1)),
        camera_world_to_camera=np.stack([orbit_pose(0.0, 0.0), orbit_pose(0.8, 0.2)]),
        size=(size, size),
        reference=0,
        metrics={"psnr": 31.5},
    )


def in_unit(scene: GaussianScene, unit: float) -> GaussianScene:
    """The same scene with lengths `unit` times as large, its cameras as far away."""
    poses = scene.camera_world_to_camera.copy()
    poses[:, :3, 3] *= unit
    names = ("mean", "frame_mean", "control_point", "control_radius", "control_position")
    lengths = {name: getattr(scene, name) * np.float32(unit) for name in names}
    motion = scene.part_motion.copy()
    motion[..., :3, 3] *= np.float32(unit)
    sizes = scene.log_scale + np.float32(np.log(unit))
    return replace(scene, **lengths, part_motion=motion, log_scale=sizes, camera_world_to_camera=poses)


def shifted(scene: GaussianScene, away: np.ndarray) -> GaussianScene:
    """The same scene with all of it, cameras too, moved by `away` (3)."""
    poses = scene.camera_world_to_camera.copy()
    poses[:, :3, 3] -= poses[:, :3, :3] @ away
    step = np.float32(away)
    motion = scene.part_motion.copy()  # x + away to R x + t + away
    motion[..., :3, 3] += step - motion[..., :3, :3] @ step
    places = {name: getattr(scene, name) + step for name in ("mean", "frame_mean", "control_point", "control_position")}
    return replace(scene, **places, part_motion=motion, camera_world_to_camera=poses)
