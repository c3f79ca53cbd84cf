"""An articulated object in motion: a few frames of points with part ids and exact poses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.ops.rotations import axis_rotation, quaternion_to_matrix
from dpcli.prepare.articulated.articulated_object import (
    ArticulatedObject,
    finite_limits,
    idle_joints,
    lock_small,
    lock_some,
    parts,
    require_surface,
    sample_values,
    sampling_weights,
    transform,
)
from dpcli.prepare.articulated.true_joints import true_joints
from dpcli.prepare.meshes.surface_points import Camera, choose_on_surface, choose_visible, points_on
from dpcli.prepare.reader import Sample, require_known, require_least
from dpcli.runtime.seeds import PrepareStream, generator
from dpcli.store import CloudSequence

VIEWS = ("full", "single")
ORIENTATIONS = ("random", "upright")
_DENSER = 4  # so many times more points are sampled when --sampling fps or voxel will choose among them
_GLUED = 0.25  # of min_part: a part with fewer expected points is glued to its parent


@dataclass(frozen=True, kw_only=True)
class Articulation:
    """Says how sequences are drawn from an object; see `dpc prepare sapien --help`.

    Angles in degrees, lengths in diameters.
    """

    points_per_frame: int = 512
    frames: int = 4
    view: str = "full"
    orientation: str = "random"
    rotation: float = 15.0
    translation: float = 0.05
    joint_step: float = 0.3
    max_parts: int = 8
    min_part: int = 8
    min_motion: float = 0.02
    visible_only: bool = False
    sampling: str = "random"

    def __post_init__(self) -> None:
        if self.points_per_frame < 1:
            raise UsageError(f"--points {self.points_per_frame}: expected 1 or more")
        require_least(self, frames=1, max_parts=2, min_part=0)
        require_known(self, view=VIEWS, orientation=ORIENTATIONS)
        if not 0 < self.joint_step <= 1:
            raise UsageError(
                f"--joint-step {self.joint_step}: expected a fraction of a joint's range, above 0, up to 1"
            )


@dataclass
class Study:
    """Holds an object and what the options say about its joints, found out once for all its sequences."""

    obj: ArticulatedObject
    locked: set[int]
    notes: Counter = field(default_factory=Counter)


def study(obj: ArticulatedObject, options: Articulation) -> Study:
    """Decides which joints move. Raises DataError when fewer than two rigid parts remain.

    A joint stays still, and what hangs on it belongs to its parent's part, when it moves nothing by ``min_motion`` of
    the object's diameter (see ``idle_joints``), or when its part's share of the surface is below a quarter of
    ``min_part`` points; parts between that and ``min_part`` get that many, by denser sampling. What moves most, and the
    largest moving part, stay in any case, unless nothing moves ``visible_only``.
    """
    obj = finite_limits(require_surface(obj))
    idle = idle_joints(obj, options.min_motion, options.visible_only, generator(0, PrepareStream.OBJECT_STUDY))
    if parts(obj, idle).max() < 1:
        raise DataError(
            f"{obj.name}: one rigid part only; none of its joints ({len(obj.joints)}) moves its part "
            f"{'visibly ' if options.visible_only else ''}by {options.min_motion} of the object's size (--min-motion)"
        )
    locked = lock_small(obj, idle, _GLUED * options.min_part / options.points_per_frame)
    return Study(obj, locked, Counter(obj.notes))


def draw_sequence(
    name: str, studied: Study, options: Articulation, pad_parts: int, rng: np.random.Generator, **known: Any
) -> Sample:
    """Draws one sequence of ``options.frames`` frames; ``known``: fields of the CloudSequence that the index holds.

    The object of frame 0 fits a sphere of diameter 1 about the origin; every frame's points are drawn independently.
    pose f64 (F,pad_parts,4,4) takes a part's own frame to the frame's points; unused parts are the identity. joint: as
    `true_joints`.
    """
    obj = studied.obj
    locked = lock_some(obj, studied.locked, options.max_parts, rng)
    part = parts(obj, locked)
    values = sample_values(obj, options.frames, options.joint_step, rng)
    still = sorted(locked)
    values[:, still] = values[:1, still]
    scale, poses = _normalized(obj, obj.poses(values))
    poses = global_motions(options, rng)[:, None] @ poses
    clouds, ids = zip(*_frames(obj, scale, poses, part, options, rng), strict=True)
    padded = max(pad_parts, part.max() + 1)
    poses_of_parts = np.tile(np.eye(4), (options.frames, padded, 1, 1))
    for body in reversed(range(obj.num_bodies)):  # the topmost body of a part comes last and stays
        if part[body] >= 0:
            poses_of_parts[:, part[body]] = poses[:, body]
    joint = true_joints(obj, locked, values, poses, scale, padded)
    sequence = CloudSequence.from_frames(name, list(clouds), part=list(ids), pose=poses_of_parts, joint=joint, **known)
    return Sample(sequence, _notes(studied, clouds, ids, int(part.max()) + 1, options))


def _normalized(obj: ArticulatedObject, poses: np.ndarray) -> tuple[float, np.ndarray]:
    """Returns the scale of the bodies, and poses f64 (F,bodies,4,4) of the scaled bodies: still rigid, frame 0 centered."""
    center, radius = obj.extent(poses[0])
    scale = 0.5 / radius
    poses = poses.copy()
    poses[..., :3, 3] = (poses[..., :3, 3] - center) * scale
    return scale, poses


def global_motions(options: Articulation, rng: np.random.Generator) -> np.ndarray:
    """Draws the motion of the whole object, f64 (F,4,4): one orientation for all frames, and a small motion for each."""
    upright = options.orientation == "upright"
    motions = np.tile(np.eye(4), (options.frames, 1, 1))
    turn = axis_rotation(np.array([0.0, 0, 1]), rng.uniform(0, 2 * np.pi, 1))[0] if upright else random_rotation(rng)
    angles = np.radians(rng.uniform(-options.rotation, options.rotation, options.frames))
    for motion, angle in zip(motions, angles, strict=True):
        axis = rng.normal(size=3)
        axis = np.array([0.0, 0, 1]) if upright else axis / np.linalg.norm(axis)
        motion[:3, :3] = axis_rotation(axis, angle[None])[0] @ turn
        motion[:3, 3] = rng.uniform(-options.translation, options.translation, 3)
    return motions


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Draws a rotation f64 (3,3), uniform over SO(3): a unit quaternion from a normal distribution."""
    quaternion = rng.normal(size=4)
    return quaternion_to_matrix(quaternion / np.linalg.norm(quaternion))


def _frames(
    obj: ArticulatedObject,
    scale: float,
    poses: np.ndarray,
    part: np.ndarray,
    options: Articulation,
    rng: np.random.Generator,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields points f32 (N,3) and part ids i16 (N) of every frame. poses f64 (F,bodies,4,4), part i64 (bodies)."""
    count = options.points_per_frame * (1 if options.sampling == "random" else _DENSER)
    camera = _camera(obj, scale, poses, options, rng) if options.view == "single" else None
    weights = sampling_weights(obj, part, options.min_part / options.points_per_frame)
    for placed in poses:
        if camera is None:
            chosen = choose_on_surface(weights, count, rng)
        else:
            chosen = choose_visible(obj.triangles * scale, placed[obj.body_of_triangle], camera, count, rng)
        if not len(chosen.triangle):
            raise DataError(f"{obj.name}: the camera sees nothing of it; its surface is too thin")
        body = obj.body_of_triangle[chosen.triangle]
        points = scale * points_on(obj.triangles, chosen)
        yield transform(placed[body], points).astype(np.float32), part[body].astype(np.int16)


def _camera(
    obj: ArticulatedObject, scale: float, poses: np.ndarray, options: Articulation, rng: np.random.Generator
) -> Camera:
    """Returns one camera for all frames, which sees the object whole in each."""
    points, body = obj.vertices
    radius = max(np.linalg.norm(transform(placed[body], scale * points), axis=1).max() for placed in poses)
    return Camera.random(float(radius), options.orientation == "upright", rng)


def _notes(studied: Study, clouds: tuple, ids: tuple, num_parts: int, options: Articulation) -> dict[str, int]:
    few = sum(len(cloud) < options.points_per_frame for cloud in clouds)
    unseen = sum(len(np.unique(part)) < num_parts for part in ids)
    found = {"frames with fewer points than asked for": few, "frames in which not every part is seen": unseen}
    return {**studied.notes, **found}
