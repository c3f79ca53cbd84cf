"""An animated mesh in front of cameras: the pictures of a views file, its true tracks and rigid parts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.ops.cameras import DEFAULT_FOVY, DEFAULT_RADIUS, orbit_pose, pinhole
from dpcli.prepare.meshes.animated_mesh import AnimatedMesh, normalized
from dpcli.prepare.meshes.bone_parts import choose_points, heaviest_bones, hidden_points, rigid_parts, track_points
from dpcli.prepare.meshes.raycast import FrameCaster
from dpcli.prepare.views.orbit_world import OBJECT_RADIUS
from dpcli.prepare.views.views_pipeline import Clip
from dpcli.runtime.pool import ordered_map
from dpcli.runtime.progress import log
from dpcli.runtime.seeds import generator
from dpcli.store.views import ViewsHeader

_CHUNK = 4  # frames that a worker gets at a time: the mesh travels with them
_STILL = 1e-3  # of the object's radius: what moves less than this is no motion


@dataclass(frozen=True, kw_only=True)
class Filming:
    """Says how an animated mesh is filmed. Angles in degrees; the reference camera stands at azimuth 0.

    yaw turns the object about the upright first. size: picture side, samples: rays per pixel and axis. tracks: points
    of ground truth. part_tolerance, min_part: see `rigid_parts`, as shares of the object's radius and of the points.
    """

    size: int = 512
    test_azimuths: tuple[float, ...] = (15.0, -75.0, 105.0, 195.0)
    train_azimuths: tuple[float, ...] = ()
    elevation: float = 0.0
    yaw: float = 0.0
    travel: bool = True
    samples: int = 2
    shading: float = 0.5
    tracks: int = 4096
    part_tolerance: float = 0.01
    min_part: float = 0.01
    seed: int = 0

    def __post_init__(self) -> None:
        limits = {"elevation": (-90, 90), "shading": (0, 1), "part_tolerance": (0, 1), "min_part": (0, 1)}
        for key, (low, high) in limits.items():
            if not low <= getattr(self, key) <= high:
                raise UsageError(f"--{key.replace('_', '-')} {getattr(self, key)}: expected {low} to {high}")
        azimuths = [0.0, *self.train_azimuths, *self.test_azimuths]
        turns = [round(azimuth % 360, 6) for azimuth in azimuths]
        twice = [azimuth for index, azimuth in enumerate(azimuths) if turns[index] in turns[:index]]
        if twice:
            raise UsageError(
                f"azimuth {twice[0]:g} is given twice; 0 is the reference view, and each may be used only once"
            )

    @property
    def config(self) -> dict[str, Any]:
        """Returns everything that decides the pictures, except the seed."""
        return {key: value for key, value in asdict(self).items() if key != "seed"}

    @property
    def roles(self) -> list[str]:
        """Returns the role of every view: reference, then train, then test."""
        return ["reference", *["train"] * len(self.train_azimuths), *["test"] * len(self.test_azimuths)]

    def cameras(self) -> np.ndarray:
        """Returns world_to_camera f64 (V,4,4): the reference, the train and the test views."""
        azimuths = np.radians([0.0, *self.train_azimuths, *self.test_azimuths])
        return np.stack([orbit_pose(azimuth, np.radians(self.elevation), DEFAULT_RADIUS) for azimuth in azimuths])


def film(mesh: AnimatedMesh, filming: Filming, jobs: int = 1) -> Clip:
    """Returns a Clip of the mesh, normalized to a ball of radius 0.75 at the origin; its pictures are drawn when asked
    for.

    The pictures don't depend on jobs. Raises DataError when the mesh has no extent; a warning when it doesn't move.
    """
    if not np.isfinite(mesh.positions).all():
        frame = int(np.argmax(~np.isfinite(mesh.positions).all((1, 2))))
        raise DataError(f"{mesh.name}: vertices of frame {frame} are not finite; repair the model, export it again")
    corners = mesh.positions[:, np.unique(mesh.triangles)]
    if not np.ptp(corners.reshape(-1, 3), axis=0).any():
        raise DataError(f"{mesh.name}: all vertices are one point; expected a mesh with an extent")
    mesh = normalized(mesh, OBJECT_RADIUS, np.radians(filming.yaw), filming.travel)
    if np.ptp(mesh.positions, axis=0).max() < _STILL * OBJECT_RADIUS:
        log.warn(f"{mesh.name}: nothing moves in this clip")
    track, part = ground_truth(mesh, filming)
    views = len(filming.roles)
    intrinsics = np.tile(pinhole(DEFAULT_FOVY, filming.size, filming.size), (views, 1, 1))
    header = ViewsHeader(
        mesh.name, intrinsics, filming.cameras(), mesh.time, filming.roles, 0, (filming.size, filming.size)
    )
    return Clip(header, partial(_pictures, mesh, header, filming, jobs), track, part)


def ground_truth(mesh: AnimatedMesh, filming: Filming) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Returns track f32 (T,M,3) and part i16 (M) of `tracks` points; None, None when 0 are asked for.

    Where a point is hidden, it rests on a point within the object's ball.
    """
    if not filming.tracks:
        return None, None
    points = choose_points(mesh, filming.tracks, generator(filming.seed))
    track, bone = track_points(mesh, points), heaviest_bones(mesh, points)
    hidden = hidden_points(mesh, points)
    if hidden.any():
        log.warn(
            f"{mesh.name}: hidden in some frames, a point of no extent there: {hidden.any(0).sum()} of {counted(filming.tracks, 'track')}"
        )
    smallest = int(np.ceil(filming.min_part * filming.tracks))
    tolerance = filming.part_tolerance * OBJECT_RADIUS
    part = rigid_parts(mesh.bone_pose, mesh.bone_parent, bone, track, tolerance, smallest)
    far = np.linalg.norm(track[hidden], axis=1, keepdims=True)
    track[hidden] *= OBJECT_RADIUS / np.maximum(far, OBJECT_RADIUS)  # whatever waits outside the picture
    log.info(f"{mesh.name}: {int(part.max()) + 1} rigid parts of {len(np.unique(bone))} bones")
    return track, part


def _pictures(
    mesh: AnimatedMesh, header: ViewsHeader, filming: Filming, jobs: int
) -> Iterator[tuple[int, int, np.ndarray]]:
    starts = range(0, mesh.num_frames, _CHUNK)
    pieces = ((start, mesh.frames(start, start + _CHUNK)) for start in starts)
    jobs = min(jobs, len(starts))
    work = partial(draw_frames, header.intrinsics, header.world_to_camera, header.size, filming)
    for (start, _), result in ordered_map(work, pieces, jobs):
        if isinstance(result, Exception):
            raise result
        for frame, pictures in enumerate(result, start):
            for view, picture in enumerate(pictures):
                yield view, frame, picture


def draw_frames(
    intrinsics: np.ndarray,
    world_to_camera: np.ndarray,
    size: tuple[int, int],
    filming: Filming,
    piece: tuple[int, AnimatedMesh],
) -> list[list[np.ndarray]]:
    """Draws the pictures u8 (H,W,4) of all views of some frames: [frame][view]. Runs in a worker process."""
    casters = (FrameCaster(piece[1], frame, filming.shading) for frame in range(piece[1].num_frames))
    cameras = list(zip(intrinsics, world_to_camera, strict=True))
    return [[caster.picture(*camera, size, filming.samples) for camera in cameras] for caster in casters]
