"""Simple solids as triangles f64 (T,3,3), and a builder that joins them with hinges and slides into an articulated object."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from dpcli.ops.rotations import axis_rotation
from dpcli.prepare.articulated.articulated_object import ArticulatedObject, Joint, drop_degenerate

X, Y, Z = np.eye(3)
_SECTIONS = 24  # of what is turned about an axis


def box(size: Sequence[float], at: Sequence[float] = (0, 0, 0)) -> np.ndarray:
    """Builds a box of edges ``size`` (3) centered at ``at`` (3): triangles f64 (12,3,3)."""
    corners = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * size + at
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners[[t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]]


def lathe(profile: Sequence[tuple[float, float]], at: Sequence[float] = (0, 0, 0), axis: np.ndarray = Z) -> np.ndarray:
    """Turns a profile of (radius, height) points about ``axis`` through ``at``: triangles f64 (T,3,3)."""
    angle = np.linspace(0, 2 * np.pi, _SECTIONS + 1)
    radius, height = np.array(profile, np.float64).T
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    grid = np.concatenate(
        [radius[:, None, None] * ring, np.broadcast_to(height[:, None, None], (len(radius), _SECTIONS + 1, 1))], axis=2
    )
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)], axis=2)
    return faces.reshape(-1, 3, 3) @ frame(axis).T + at


def cylinder(radius: float, length: float, at: Sequence[float] = (0, 0, 0), axis: np.ndarray = Z) -> np.ndarray:
    """Builds a closed cylinder centered at ``at``."""
    half = length / 2
    return lathe([(0, -half), (radius, -half), (radius, half), (0, half)], at, axis)


def rod(start: np.ndarray, end: np.ndarray, radius: float) -> np.ndarray:
    """Builds a cylinder from ``start`` (3) to ``end`` (3)."""
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    return cylinder(radius, float(np.linalg.norm(end - start)), (start + end) / 2, end - start)


def ball(radius: float, at: Sequence[float] = (0, 0, 0)) -> np.ndarray:
    """Builds a sphere."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 13)
    return lathe(list(zip(radius * np.cos(angle), radius * np.sin(angle), strict=True)), at)


def ring(radius: float, tube: float, at: Sequence[float] = (0, 0, 0), axis: np.ndarray = Z) -> np.ndarray:
    """Builds a torus: wheels' tires, finger holes, handles."""
    angle = np.linspace(0, 2 * np.pi, 11)
    return lathe(list(zip(radius + tube * np.cos(angle), tube * np.sin(angle), strict=True)), at, axis)


def plate(outline: Sequence[tuple[float, float]], thickness: float) -> np.ndarray:
    """Extrudes an outline (x,y), star-shaped about its mean, along z by ``thickness``, centered in z."""
    xy = np.array(outline, np.float64)
    after, middle, half = np.roll(xy, -1, axis=0), xy.mean(0), thickness / 2

    def lift(points: np.ndarray, z: float) -> np.ndarray:
        points = np.broadcast_to(points, xy.shape)
        return np.concatenate([points, np.full((len(xy), 1), z)], axis=1)

    low, high, next_low, next_high = lift(xy, -half), lift(xy, half), lift(after, -half), lift(after, half)
    faces = [
        (low, next_low, next_high),
        (low, next_high, high),
        (low, next_low, lift(middle, -half)),
        (high, next_high, lift(middle, half)),
    ]
    return np.concatenate([np.stack(face, axis=1) for face in faces])


def open_box(size: Sequence[float], wall: float, at: Sequence[float] = (0, 0, 0), without: str = "top") -> np.ndarray:
    """Builds a box of five thin walls; ``without``: the side left open, one of top, front (toward -y)."""
    w, d, h = size
    sides = {
        "top": box((w, d, wall), (0, 0, h / 2)),
        "bottom": box((w, d, wall), (0, 0, -h / 2)),
        "front": box((w, wall, h), (0, -d / 2, 0)),
        "back": box((w, wall, h), (0, d / 2, 0)),
        "left": box((wall, d, h), (-w / 2, 0, 0)),
        "right": box((wall, d, h), (w / 2, 0, 0)),
    }
    return np.concatenate([side for name, side in sides.items() if name != without]) + at


def frame(axis: np.ndarray) -> np.ndarray:
    """Returns a rotation f64 (3,3) that takes z to ``axis`` (3)."""
    z = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[np.abs(z).argmin()], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


class Builder:
    """Collects bodies, each a list of solids in its own frame. Body 0 is there from the start."""

    def __init__(self) -> None:
        self._joints: list[Joint] = []
        self._solids: list[tuple[int, np.ndarray]] = []

    def add(self, body: int, *solids: np.ndarray) -> None:
        """Puts triangles (T,3,3), in the body's frame, on a body."""
        self._solids += [(body, solid) for solid in solids]

    def hinge(
        self, at: Sequence[float], axis: np.ndarray, lower: float, upper: float, *solids: np.ndarray, on: int = 0
    ) -> int:
        """Adds a body that turns about ``axis`` (3) through ``at`` (3) of body ``on``, in degrees, and returns its
        number.

        Its frame has the parent's axes and its origin at ``at``.
        """
        return self._join("revolute", at, axis, np.radians(lower), np.radians(upper), solids, on)

    def slide(
        self, at: Sequence[float], axis: np.ndarray, lower: float, upper: float, *solids: np.ndarray, on: int = 0
    ) -> int:
        """Adds a body that slides along ``axis`` (3), else as ``hinge``."""
        return self._join("prismatic", at, axis, lower, upper, solids, on)

    def _join(self, kind, at, axis, lower, upper, solids, on) -> int:
        origin = np.eye(4)
        origin[:3, 3] = at
        body = len(self._joints) + 1
        axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
        self._joints.append(Joint(on, body, kind, origin, axis, float(lower), float(upper)))
        self.add(body, *solids)
        return body

    def build(self, name: str) -> ArticulatedObject:
        """Returns the finished object."""
        bodies = np.concatenate([np.full(len(solid), body) for body, solid in self._solids])
        kept = drop_degenerate(np.concatenate([solid for _, solid in self._solids]), bodies, Counter())
        return ArticulatedObject(name, list(self._joints), *kept)


def turned(solid: np.ndarray, axis: np.ndarray, degrees: float) -> np.ndarray:
    """Returns the triangles turned about an axis through the origin."""
    return solid @ axis_rotation(np.asarray(axis, np.float64), np.radians([degrees]))[0].T
