"""New rooms by the recipe of OGC-DR from any meshes: the whole surface, or one depth view of it (OGC-DRSV)."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.prepare.articulated.articulated_object import triangle_areas
from dpcli.prepare.articulated.object_splits import SplitRule, counts_of_splits
from dpcli.prepare.articulated.ogc_layout import RoomMotion, draw_layout
from dpcli.prepare.articulated.ogc_meshes import Shape, find_meshes, load_shape
from dpcli.prepare.meshes.raycast import world_rays
from dpcli.prepare.meshes.surface_points import (
    SurfacePoints,
    choose_on_surface,
    first_hits,
    points_on,
    raycasting_scene,
)
from dpcli.prepare.reader import Item, Reader, Sample, describe, require_known, require_least
from dpcli.store import CloudSequence

POINTS = 2048
FRACTIONS = (0.75, 0.05, 0.2)
_SURFACE = 100_000  # points drawn on all surfaces, among which farthest point sampling chooses
_BAD_MESHES = 50  # meshes that cannot be read before a room is given up
_PICTURE = (640, 360)  # pixels; Open3D's window has the same shape
_ZOOM, _VIEW_ANGLE = 0.7, 60.0  # of Open3D's default camera; degrees, vertical


@dataclass(frozen=True)
class RoomOptions:
    """Says what rooms are made: ``rooms`` of each number in ``objects``; ``view`` full or single; ``points`` a frame;
    ``up``.
    """

    objects: tuple[int, ...] = (8, 7, 6, 5, 4)
    rooms: int = 1000
    frames: int = 4
    view: str = "full"
    points: int = POINTS
    up: str = "y"
    motion: RoomMotion = RoomMotion()

    def __post_init__(self) -> None:
        if not self.objects or not all(2 <= n <= 8 for n in self.objects) or len(set(self.objects)) < len(self.objects):
            given = ",".join(map(str, self.objects))
            raise UsageError(f"--objects {given}: expected different numbers of 2 to 8, such as 8,7,6,5,4")
        require_least(self, rooms=1, frames=1, points=1)
        require_known(self, up=("y", "z"))


@dataclass(frozen=True)
class GeneratedRooms(Reader):
    """Makes rooms of objects drawn from a folder of meshes, by a seed. One room is in one split, 75, 5 and 20 %."""

    meshes: Path
    options: RoomOptions = RoomOptions()
    split: SplitRule = SplitRule(fractions=FRACTIONS)
    seed: int = 0
    length_unit: ClassVar[str] = "room width"
    fields: ClassVar[tuple[str, ...]] = ("part", "pose")

    @property
    def config(self) -> dict[str, Any]:
        names = "\n".join(find_meshes(self.meshes)).encode("utf-8", "surrogateescape")
        digest = hashlib.sha256(names).hexdigest()[:16]
        return {**asdict(self.options), "fractions": list(self.split.fractions), "meshes_digest": digest}

    def items(self) -> list[Item]:
        find_meshes(self.meshes)
        counts = self.options.objects
        names = [(n, f"{n}_{k:06d}") for n in counts for k in range(self.options.rooms)]
        splits = self.split.assign([""] * len(names), self.seed)
        extra = {"parts": max(counts)}
        return [
            Item(name, self.meshes, split=split, extra={**extra, "objects": n})
            for (n, name), split in zip(names, splits, strict=True)
        ]

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        notes: Counter = Counter()
        shapes = self._draw_shapes(item.extra["objects"], notes, rng)
        layout = draw_layout([shape.hull for shape in shapes], self.options.frames, self.options.motion, rng)
        triangles = np.concatenate([s.triangles * size for s, size in zip(shapes, layout.scale, strict=True)])
        owner = np.repeat(np.arange(len(shapes)), [len(shape.triangles) for shape in shapes])
        clouds, parts = zip(*(self._frame(triangles, owner, poses, rng) for poses in layout.pose), strict=True)
        filling = np.tile(np.eye(4), (len(clouds), item.extra["parts"] - len(shapes), 1, 1))
        pose = np.concatenate([layout.pose, filling], axis=1)
        notes["rooms whose objects were made smaller to fit"] = int(layout.shrunk < 1)
        notes["frames with fewer points than asked for"] = sum(len(c) < self.options.points for c in clouds)
        notes["frames in which not every object is seen"] = sum(len(np.unique(p)) < len(shapes) for p in parts)
        sequence = CloudSequence.from_frames(item.name, list(clouds), part=list(parts), pose=pose, **describe(item))
        return Sample(sequence, notes)

    def _draw_shapes(self, count: int, notes: Counter, rng: np.random.Generator) -> list[Shape]:
        """Draws meshes with equal chances; another is drawn in place of one that cannot be read, and that is counted."""
        names, shapes = find_meshes(self.meshes), []
        for _ in range(count + _BAD_MESHES):
            name = names[rng.integers(len(names))]
            try:
                shapes.append(load_shape(self.meshes / name, self.options.up))
            except DataError as error:
                notes[f"another mesh drawn, for {name} cannot be used"] += 1
                last = error
            if len(shapes) == count:
                return shapes
        raise last

    def _frame(
        self, triangles: np.ndarray, owner: np.ndarray, poses: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns points f32 (N,3) and the object i16 (N) of each."""
        from dpcli.ops import fps_numpy

        placed = triangles @ poses[owner, :3, :3].transpose(0, 2, 1) + poses[owner, None, :3, 3]
        if self.options.view == "full":
            chosen = choose_on_surface(triangle_areas(placed), max(_SURFACE, self.options.points), rng)
        else:
            chosen = seen_by_camera(placed)
        points, part = points_on(placed, chosen).astype(np.float32), owner[chosen.triangle].astype(np.int16)
        if len(points) > self.options.points:
            index = fps_numpy(points, self.options.points)
            points, part = points[index], part[index]
        return points, part

    def summary(self, items: list[Item]) -> list[str]:
        shares = counts_of_splits(item.split for item in items)
        kinds = ",".join(map(str, self.options.objects))
        return [f"{len(items)} rooms of {kinds} objects ({shares}) from {len(find_meshes(self.meshes))} meshes"]


def seen_by_camera(triangles: np.ndarray) -> SurfacePoints:
    """Returns what the pixels of one picture show of triangles f64 (T,3,3). Raises DataError when they show nothing.

    The camera is Open3D's default: it looks along -z at the middle of the scene's box, from a distance that makes 0.7
    of the box's longest side half of the picture's height.
    """
    corners = triangles.reshape(-1, 3)
    low, high = corners.min(0), corners.max(0)
    half = np.tan(np.radians(_VIEW_ANGLE / 2))
    eye = (low + high) / 2 + [0, 0, _ZOOM * (high - low).max() / half]
    pose = np.diag([1.0, -1, -1, 1])  # OpenCV axes: y down, looking along -z
    pose[:3, 3] = -pose[:3, :3] @ eye
    width, height = _PICTURE
    focal = height / 2 / half
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    rays = world_rays(intrinsics, pose, slice(0, height), slice(0, width), 1).reshape(-1, 6)
    seen = first_hits(raycasting_scene(triangles), rays)
    if not len(seen.triangle):
        raise DataError("the camera sees nothing of the room's objects; their surfaces are too thin")
    return seen
