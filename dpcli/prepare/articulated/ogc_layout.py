"""The layout of a generated room: objects stand on its floor and move, by the recipe of OGC-DR (Song and Yang 2022)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.errors import DataError
from dpcli.ops.rotations import axis_rotation

GROUND = -0.49  # y of the floor; x and z are centered; the room is 1 wide
_TRIES = 40  # places or motions drawn for one object before the room is begun anew
_ROOMS = 400  # rooms begun before it is given up
_SHRINK_AFTER, _SHRINK = 20, 0.99  # objects too bulky for the floor: from this room on, each has smaller ones


@dataclass(frozen=True)
class RoomMotion:
    """Limits one step: ``rotation`` degrees at most, about y in ``upright`` of all cases, else x or z; a shift in x and
    in z each of ``shift`` (least, most) either way.
    """

    rotation: float = 10.0
    upright: float = 0.6
    shift: tuple[float, float] = (0.02, 0.04)


@dataclass
class Layout:
    """Holds scale f64 (n) of the shapes, pose f64 (T,n,4,4), scaled shape to room, and shrunk: how much smaller than
    drawn.
    """

    scale: np.ndarray
    pose: np.ndarray
    shrunk: float


def scale_range(objects: int) -> tuple[float, float]:
    """Returns the range of an object's longest side: 0.25 to 0.45 in a room of 4, 0.2 to 0.3 in one of 8, linear
    between.
    """
    share = (objects - 4) / 4
    return 0.25 - 0.05 * share, 0.45 - 0.15 * share


def draw_layout(hulls: list[np.ndarray], frames: int, motion: RoomMotion, rng: np.random.Generator) -> Layout:
    """Stands objects on the floor and moves them so that their axis-parallel boxes never overlap.

    hulls: for each object, points f64 (V,3) that span it, centered, longest side 1, y up. In frame 0 all boxes are on
    the floor of 1 x U(0.6, 1). An object turns about its own middle. Raises DataError when there is no room for them.
    """
    low, high = scale_range(len(hulls))
    for number in range(_ROOMS):
        shrunk = _SHRINK ** max(0, number - _SHRINK_AFTER)
        scale = shrunk * rng.uniform(low, high, len(hulls))
        shapes = [hull * size for hull, size in zip(hulls, scale, strict=True)]
        poses = _stand(shapes, rng.uniform(0.6, 1.0), rng)
        steps = [poses]
        while steps[-1] is not None and len(steps) < frames:
            steps.append(_step(shapes, steps[-1], motion, rng))
        if steps[-1] is not None:
            return Layout(scale, np.stack(steps), shrunk)
    raise DataError(f"{len(hulls)} objects of these meshes don't fit into a room side by side; --objects fewer")


def box(shape: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Returns the axis-parallel box f64 (2,3) of points (V,3) under a pose (4,4)."""
    placed = shape @ pose[:3, :3].T + pose[:3, 3]
    return np.stack([placed.min(0), placed.max(0)])


def overlaps(one: np.ndarray, others: list[np.ndarray]) -> bool:
    """Returns whether a box (2,3) and any other have a common point."""
    return any((one[0] <= other[1]).all() and (other[0] <= one[1]).all() for other in others)


def _stand(shapes: list[np.ndarray], depth: float, rng: np.random.Generator) -> np.ndarray | None:
    """Returns poses f64 (n,4,4) of frame 0, or None when one finds no place. The bulkiest choose first."""
    poses, boxes = np.tile(np.eye(4), (len(shapes), 1, 1)), []
    for index in sorted(range(len(shapes)), key=lambda k: -np.ptp(shapes[k][:, ::2], axis=0).prod()):
        pose = poses[index]
        pose[:3, :3] = axis_rotation(np.array([0.0, 1, 0]), rng.uniform(0, 2 * np.pi, 1))[0]
        turned = box(shapes[index], pose)
        least, most = np.array([-0.5, -depth / 2]) - turned[0, ::2], np.array([0.5, depth / 2]) - turned[1, ::2]
        if (least > most).any():
            return None
        for place in rng.uniform(least, most, (_TRIES, 2)):
            offset = np.array([place[0], GROUND - turned[0, 1], place[1]])
            if not overlaps(turned + offset, boxes):
                break
        else:
            return None
        pose[:3, 3] = offset
        boxes.append(turned + offset)
    return poses


def _step(
    shapes: list[np.ndarray], before: np.ndarray, motion: RoomMotion, rng: np.random.Generator
) -> np.ndarray | None:
    """Returns the next frame's poses f64 (n,4,4): each object turned and shifted, boxes apart; None when one finds no
    way.
    """
    poses, boxes = before.copy(), []
    for index, shape in enumerate(shapes):
        for _ in range(_TRIES):
            pose = _moved(before[index], motion, rng)
            own = box(shape, pose)
            if not overlaps(own, boxes):
                break
        else:
            return None
        poses[index] = pose
        boxes.append(own)
    return poses


def _moved(pose: np.ndarray, motion: RoomMotion, rng: np.random.Generator) -> np.ndarray:
    axis = np.eye(3)[1 if rng.random() < motion.upright else rng.choice([0, 2])]
    angle = np.radians(rng.uniform(-motion.rotation, motion.rotation, 1))
    moved = pose.copy()
    moved[:3, :3] = axis_rotation(axis, angle)[0] @ pose[:3, :3]
    moved[[0, 2], 3] += rng.choice([-1, 1], 2) * rng.uniform(*motion.shift, 2)
    return moved
