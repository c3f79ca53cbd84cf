"""Moving objects of a scene: proposed by clusters that other frames contradict, carried through all frames, and judged."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from dpcli.segment.scene.clusters import cluster, groups
from dpcli.segment.scene.object_motion import refine, search_velocity
from dpcli.segment.scene.settings import SceneSettings
from dpcli.segment.scene.world import UNSEEN, Frame, World

_FEWEST = 6  # points of an object in the frame that proposes it
_LARGEST = 14.0  # meters: a longer cluster is no object, but may hold some
_TALLEST = 5.0
_DOUBT = 0.15  # mean cost of standing still above which a cluster is looked at
_MARGIN = 0.35  # meters around an object's moved points in which a frame's points are its own
_FOUND = 0.3  # share of an object's points that must meet a frame's for it to be carried there
_GAIN = 0.1  # mean saving of the motion per point and frame, in points that a frame contradicts


@dataclass
class MovingObject:
    """Holds an object: its points in each frame, numbers i64, and its motion, f64 (4,4) in the world, from `start` to it."""

    start: int
    points: dict[int, np.ndarray]
    motion: dict[int, np.ndarray] = field(default_factory=dict)
    saved: float = 0.0  # what its motion explains better than standing still, in points
    seen_through: float = 0.0  # points, per frame, at whose place another frame sees nothing

    @property
    def size(self) -> int:
        """The number of its points in all frames."""
        return sum(map(len, self.points.values()))


@dataclass
class StaticDoubt:
    """Holds, for the raised points of a frame, the mean cost of standing still f64 (N), and how many frames see through."""

    cost: np.ndarray
    free: np.ndarray


def find_moving_objects(world: World, settings: SceneSettings) -> list[MovingObject]:
    """Returns what moves on its own, the one with the most points first; frames' `label` numbers them from 1."""
    doubts = [measure_doubt(world, t) for t in range(len(world.frames))]
    found: list[MovingObject] = []
    for t, frame in enumerate(world.frames):
        for own in _propose(frame, doubts[t]):
            own = own[frame.label[own] == 0]
            if len(own) < _FEWEST:
                continue
            one = _explain(own, t, world, doubts, settings)
            if one is not None:
                found.append(one)
                _claim(one, world, len(found))
    return found


def measure_doubt(world: World, t: int) -> StaticDoubt:
    """Returns what the frames around say against frame t's raised points standing still; 0 where none is around."""
    frame, around = world.frames[t], world.around(t)
    cost, free = np.zeros(len(frame.raised)), np.zeros(len(frame.raised))
    for u in around:
        one, through = world.frames[u].cost(frame.points[frame.raised])
        cost += one / len(around)
        free += through
    return StaticDoubt(cost, free)


def _propose(frame: Frame, doubt: StaticDoubt) -> list[np.ndarray]:
    """Returns the points i64 of clusters in doubt, those that are seen through most first.

    Of clusters that are no single object, the points in doubt are clustered by themselves.
    """
    raised, proposals = frame.raised, []
    points = frame.points[raised]
    for own in groups(cluster(points, frame.reach(points))):
        if len(own) < _FEWEST:
            continue
        extent = np.ptp(points[own], axis=0)
        whole = max(extent[:2]) <= _LARGEST and extent[2] <= _TALLEST
        if whole and doubt.cost[own].mean() > _DOUBT:
            proposals.append(own)
            continue
        doubtful = own[(doubt.free[own] > 0) | (doubt.cost[own] > 0.9 * UNSEEN)]
        inner = groups(cluster(points[doubtful], frame.reach(points[doubtful])))
        proposals += [doubtful[few] for few in inner if len(few) >= _FEWEST and doubt.free[doubtful[few]].any()]
    proposals.sort(key=lambda own: -(doubt.free[own] > 0).sum())
    return [raised[own] for own in proposals]


def _explain(
    own: np.ndarray, t: int, world: World, doubts: list[StaticDoubt], settings: SceneSettings
) -> MovingObject | None:
    """Returns the object of these points of frame t, carried through all frames, or None where they may as well stand."""
    around, frame = world.around(t), world.frames[t]
    if not around:
        return None
    points = frame.points[own]
    near = [u for u in around if abs(u - t) == 1]
    starts = search_velocity(points, t, around, world, settings.travel)
    best, least = None, np.inf
    for start in starts:
        motions = {u: refine(points, world.frames[u].solid, _shift(start * (u - t))) for u in near}
        cost = np.mean([_moved_cost(points, motion, world.frames[u]).mean() for u, motion in motions.items()])
        if cost < least:
            best, least = motions, cost
    one = MovingObject(t, {t: own}, {t: np.eye(4)})
    if best is None:
        return None
    for way in (1, -1):
        if t + way in best:
            _carry(one, t, way, best[t + way], world)
    return one if _judge(one, world, doubts, settings) else None


def _shift(way: np.ndarray) -> np.ndarray:
    motion = np.eye(4)
    motion[:3, 3] = way
    return motion


def _moved_cost(points: np.ndarray, motion: np.ndarray, frame: Frame) -> np.ndarray:
    return frame.cost(points @ motion[:3, :3].T + motion[:3, 3])[0]


def _carry(one: MovingObject, t: int, way: int, first: np.ndarray, world: World) -> None:
    """Carries an object from frame t to the next ones (`way` 1) or the ones before (-1), as far as it is met there."""
    step = first
    while 0 <= t + way < len(world.frames) and world.run[t + way] == world.run[t]:
        here, there = world.frames[t], world.frames[t + way]
        points = here.points[one.points[t]]
        if t != one.start:
            step = refine(points, there.solid, step)
        moved = points @ step[:3, :3].T + step[:3, 3]
        members = _members(moved, there)
        if len(members) == 0 or (there.cost(moved)[0] < 0.9 * UNSEEN).mean() < _FOUND:
            return
        t += way
        one.motion[t] = step @ one.motion[t - way]
        one.points[t] = members


def _members(moved: np.ndarray, frame: Frame) -> np.ndarray:
    """Returns the raised points i64 of a frame, in no object yet, around an object's moved points."""
    margin = max(_MARGIN, float(np.median(frame.tolerance(moved))))
    points = frame.points[frame.raised]
    near = np.flatnonzero(np.all((points > moved.min(0) - margin) & (points < moved.max(0) + margin), axis=1))
    near = near[frame.label[frame.raised[near]] == 0]
    if len(near) == 0:
        return near
    close = np.isfinite(cKDTree(moved).query(points[near], distance_upper_bound=margin)[0])
    return frame.raised[near[close]]


def _judge(one: MovingObject, world: World, doubts: list[StaticDoubt], settings: SceneSettings) -> bool:
    """Returns whether an object's motion explains its points clearly better than standing still, over all its frames."""
    if len(one.points) < 2:
        return False
    saved, count, through = 0.0, 0, 0.0
    for t, own in one.points.items():
        points = world.frames[t].points[own]
        others = [u for u in world.around(t) if u in one.motion]
        for u in others:
            still, free = world.frames[u].cost(points)
            moving = _moved_cost(points, one.motion[u] @ np.linalg.inv(one.motion[t]), world.frames[u])
            saved += (still - moving).sum() / len(others)
            through += free.sum() / len(others)
        count += len(own) if others else 0
    one.saved, one.seen_through = saved, through
    return saved >= settings.evidence and through >= settings.evidence and saved >= _GAIN * count


def _claim(one: MovingObject, world: World, number: int) -> None:
    """Labels the points of an object in all frames."""
    for t, own in one.points.items():
        world.frames[t].label[own] = number
