"""The frames of a scene in one place: registered, with the ground told apart, and asked what they say of any place."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from dpcli.segment.scene.line_of_sight import LineOfSight

UNSEEN = 0.4  # cost of a place that a frame doesn't look at, in points that a frame contradicts
_NOISE = 0.1  # meters, of ranges and of registration together
_USUAL = np.radians(0.5)
_SPACING = 0.6  # distances between rows of beams at which a surface still counts as met


@dataclass
class Frame:
    """Holds a registered frame: points f64 (N,3) and the sensor's origin (3) in the world, z up, meters; height f64 (N).

    origin: None where the sensor's position is unknown. raised_above: meters over the ground from which points are
    looked at. label: the object of each point from 1, i64 (N). doubt, free: what others say against its standing still.
    """

    points: np.ndarray
    height: np.ndarray
    origin: np.ndarray | None
    raised_above: float
    label: np.ndarray = field(init=False)
    doubt: np.ndarray = field(init=False)
    free: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.label = np.zeros(len(self.points), np.int64)
        self.doubt, self.free = np.zeros(len(self.points)), np.zeros(len(self.points))

    @cached_property
    def raised(self) -> np.ndarray:
        """Returns the indices of the points above the ground, i64."""
        return np.flatnonzero(self.height >= self.raised_above)

    @cached_property
    def solid(self) -> np.ndarray:
        """Returns the points f64 (M,3) that others are compared with: those above the ground, and a little below that."""
        return self.points[self.height >= self.raised_above / 2]

    @cached_property
    def tree(self) -> cKDTree:
        """Holds the solid points for nearest neighbors."""
        return cKDTree(self.solid) if len(self.solid) else cKDTree(np.full((1, 3), 1e9))

    @cached_property
    def sight(self) -> LineOfSight | None:
        """Returns the lines of sight of this frame; None without a known origin or points."""
        return LineOfSight(self.points, self.origin) if self.origin is not None and len(self.points) else None

    @property
    def across(self) -> float:
        """Returns the angle between rows of beams, radians; a typical one where the sensor is unknown."""
        return self.sight.across if self.sight is not None else _USUAL

    def reach(self, points: np.ndarray) -> np.ndarray:
        """Returns the distance (M) of points from the sensor, or from the frame's middle where the sensor is unknown."""
        middle = self.points.mean(0) if self.origin is None else self.origin
        return np.linalg.norm(points - middle, axis=1)

    def tolerance(self, points: np.ndarray) -> np.ndarray:
        """Returns the distance (M) up to which a place (M,3) counts as met, meters; it grows with the gap between rows."""
        return np.minimum(_NOISE + _SPACING * self.across * self.reach(points), 1.0)

    def cost(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns what it costs this frame, f64 (M) 0..1, that there be surface at places (M,3), and which it sees through."""
        tolerance = self.tolerance(points)
        told = 1 if self.sight is not None else 2  # tolerances up to which distances are told apart
        farthest = told * float(tolerance.max(initial=_NOISE))
        distance = self.tree.query(points, distance_upper_bound=farthest)[0]
        cost = np.minimum(distance / tolerance, 1.0) ** 2
        far = np.flatnonzero(distance >= tolerance)
        free = np.zeros(len(points), bool)
        cost[far] = UNSEEN
        if self.sight is None:
            free[far] = distance[far] >= told * tolerance[far]
        elif len(far):
            free[far] = self.sight.look(points[far], 0.5 * tolerance[far])
        cost[free] = 1.0
        return cost, free


@dataclass
class World:
    """Holds the frames of a sequence, and which of them see the same place: `run` (T) numbers stretches that overlap."""

    frames: list[Frame]
    run: np.ndarray
    window: int

    def around(self, t: int) -> list[int]:
        """Returns the frames that frame t is compared with, the nearest in time first."""
        near = [u for u in range(t - self.window, t + self.window + 1) if 0 <= u < len(self.frames) and u != t]
        near = [u for u in near if self.run[u] == self.run[t] and len(self.frames[u].points)]
        return sorted(near, key=lambda u: (abs(u - t), u))

    def label(self, one, number: int) -> None:
        """Labels the points of a moving object in all frames."""
        for t, own in one.points.items():
            self.frames[t].label[own] = number
