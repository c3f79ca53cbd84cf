"""Tracking of moving objects: their points and motions in each frame, and which of them are pieces of one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import fractional_matrix_power
from scipy.spatial import cKDTree

from dpcli.segment.rigid_motions import move
from dpcli.segment.scene.object_motion import refine
from dpcli.segment.scene.world import UNSEEN, Frame, World

_MARGIN = 0.35  # meters around an object's moved points in which a frame's points are its own
_CLOSE = 0.15  # the same for points that may as well stand
_STANDING = 0.15  # mean cost of standing still below which a point may as well stand
_AROUND = 1.0  # meters around its box in which points in doubt are its own
_FOOT = (0.25, 0.4)  # meters beside an object, and share of the ground's height, where low points are its own
_FOUND = 0.3  # share of an object's points that must meet a frame's for it to be tracked there
_JERK = (0.3, 0.3)  # meters, and share of a step: how far steps that follow one another may differ
_UNSTEADY = 2.5  # times the evidence for something that could only be tracked with a jerk
_ALIKE = (0.3, 0.25)  # the same for two pieces of one object
_APART = 1.5  # meters between pieces of one object
_THROUGH = 0.05  # share of a piece's points that the motion of the whole may take to where a frame sees through


@dataclass
class MovingObject:
    """Holds an object: its points in each frame, numbers i64, and its motion, f64 (4,4) in the world, from `start` to it.

    saved: what its motion explains better than standing still, in points that a frame contradicts. demand: times
    the usual evidence that it needs, more than 1 for pieces of a larger cluster, and what could only be tracked with a jerk.
    """

    start: int
    points: dict[int, np.ndarray]
    motion: dict[int, np.ndarray]
    saved: float = 0.0
    demand: float = 1.0

    @property
    def size(self) -> int:
        """Returns the number of its points in all frames."""
        return sum(map(len, self.points.values()))

    def between(self, source: int, target: int) -> np.ndarray:
        """Returns its motion f64 (4,4) from a frame to another one, in the world."""
        return motion_from_to(self.motion, source, target)


def motion_from_to(known: dict[int, np.ndarray], source: int, target: int) -> np.ndarray:
    """Returns the motion f64 (4,4) from a frame to another one, from known motions to frames, `extended` where needed."""
    return extended(known, target) @ np.linalg.inv(extended(known, source))


def extended(known: dict[int, np.ndarray], frame: int) -> np.ndarray:
    """Returns the motion (4,4) to a frame; to one that is not known, with the nearest step repeated, a part of it a frame where it
    leads over several.
    """
    if frame in known or len(known) < 2:
        return known.get(frame, next(iter(known.values())))
    numbers = np.array(sorted(known))
    edge = int(numbers[np.abs(numbers - frame).argmin()])
    inner = int(numbers[np.argsort(np.abs(numbers - edge), kind="stable")[1]])
    step = known[edge] @ np.linalg.inv(known[inner])
    step = step if edge > inner else np.linalg.inv(step)
    return fractional_matrix_power(step, (frame - edge) / abs(edge - inner)).real @ known[edge]


def track(one: MovingObject, t: int, way: int, step: np.ndarray, world: World) -> None:
    """Tracks an object from frame t, `way` (1 or -1 ...) frames at a time, as long as it is met; `step` (4,4): its first motion."""
    while 0 <= t + way < len(world.frames) and world.run[t + way] == world.run[t]:
        here, there = world.frames[t], world.frames[t + way]
        points = here.points[one.points[t]]
        if t != one.start:
            before, step = step, refine(points, there, step)
            if not _alike(points, before, step, _JERK):
                one.demand *= _UNSTEADY
                return
        places = move(step, points)
        members = _members(places, there)
        if len(members) == 0 or (there.cost(places)[0] < 0.9 * UNSEEN).mean() < _FOUND:
            return
        t += way
        one.motion[t] = step @ one.motion[t - way]
        one.points[t] = members


def _alike(points: np.ndarray, first: np.ndarray, second: np.ndarray, limits: tuple[float, float]) -> bool:
    """Returns whether two motions (4,4) take the corners of the box around points (N,3) to about the same places."""
    low, high = points.min(0), points.max(0)
    corners = np.stack(np.meshgrid(*zip(low, high)), -1).reshape(-1, 3)
    ways = [move(motion, corners) - corners for motion in (first, second)]
    apart = np.linalg.norm(ways[0] - ways[1], axis=1).max()
    return bool(apart <= limits[0] + limits[1] * np.linalg.norm(ways[0].mean(0)))


def _members(moved_points: np.ndarray, frame: Frame) -> np.ndarray:
    """Returns the raised points i64 of a frame, in no object yet, around an object's moved points.

    Those that may as well stand must lie closer, lest an object takes along what it passes.
    """
    tolerance = float(np.median(frame.tolerance(moved_points)))
    margin = max(_MARGIN, tolerance)
    near = _inside(frame, moved_points, margin)
    if len(near) == 0:
        return near
    distance = cKDTree(moved_points).query(frame.points[near], distance_upper_bound=margin)[0]
    standing = frame.doubt[near] < _STANDING
    return near[distance < np.where(standing, max(_CLOSE, 0.5 * tolerance), margin)]


def _inside(frame: Frame, points: np.ndarray, margin: float) -> np.ndarray:
    """Returns the raised points i64 of a frame, in no object yet, in the box around points (N,3)."""
    free = frame.raised[frame.label[frame.raised] == 0]
    own = frame.points[free]
    return free[np.all((own > points.min(0) - margin) & (own < points.max(0) + margin), axis=1)]


def claim_around(one: MovingObject, world: World) -> None:
    """Gives an object the points in doubt around it, and those right below it, in every frame that it was met in."""
    for t, frame in enumerate(world.frames):
        if t in one.points and len(one.points[t]):
            near = _inside(frame, frame.points[one.points[t]], _AROUND)
            near = near[(frame.doubt[near] > 0.9 * UNSEEN) | (frame.free[near] > 0)]
            one.points[t] = np.union1d(np.union1d(one.points[t], near), _feet(one.points[t], frame))


def _feet(own: np.ndarray, frame: Frame) -> np.ndarray:
    """Returns the points i64 of a frame near the ground that lie right below an object's points (its wheels, its feet)."""
    low = np.flatnonzero((frame.height >= _FOOT[1] * frame.raised_above) & (frame.height < frame.raised_above))
    low = low[frame.label[low] == 0]
    tree = cKDTree(frame.points[own][:, :2])
    return low[np.isfinite(tree.query(frame.points[low][:, :2], distance_upper_bound=_FOOT[0])[0])]


def merge_alike(found: list[MovingObject], world: World) -> list[MovingObject]:
    """Returns the objects with pieces of one joined: those that touch, or follow one another, and move alike."""
    merged: list[MovingObject] = []
    for one in sorted(found, key=lambda one: -one.size):
        whole = next((other for other in merged if _one_body(other, one, world)), None)
        if whole is None:
            merged.append(one)
            continue
        for t, points in one.points.items():
            if t not in whole.points:
                whole.motion[t] = one.between(one.start, t) @ extended(whole.motion, one.start)
            whole.points[t] = np.union1d(whole.points.get(t, points[:0]), points)
        whole.saved += one.saved
    return merged


def _one_body(whole: MovingObject, one: MovingObject, world: World) -> bool:
    """Returns whether a piece touches a larger one where that goes, and moves as it does, or may as well."""
    gaps = []
    for t, own in one.points.items():
        frame = world.frames[t]
        if not len(own) or world.run[t] != world.run[whole.start]:
            return False
        near = min(whole.points, key=lambda u: (abs(u - t), u))
        body = move(whole.between(near, t), world.frames[near].points[whole.points[near]])
        if len(body) == 0:
            return False
        points = frame.points[own]
        gaps.append(float(np.median(cKDTree(body).query(points)[0])))
        for u in one.points:
            way, both = whole.between(t, u), t in whole.points and u in whole.points
            alike = abs(u - t) != 1 or _alike(points, way, one.between(t, u), _ALIKE)
            if not alike and not (both and _may_follow(points, way, world.frames[u])):
                return False
    return min(gaps) < _APART


def _may_follow(points: np.ndarray, motion: np.ndarray, frame: Frame) -> bool:
    """Returns whether nothing in a frame contradicts a motion (4,4) of points (N,3).

    A side that is seen along its length shows few columns of points, which wander over it and seem to have a speed of their own.
    """
    return bool(frame.cost(move(motion, points))[1].mean() <= _THROUGH)
