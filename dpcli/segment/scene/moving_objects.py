"""Moving objects of a scene: proposed by clusters that other frames contradict, tracked through all frames, and judged."""

from __future__ import annotations

import numpy as np

from dpcli.segment.rigid_motions import move
from dpcli.segment.scene.clusters import cluster, groups
from dpcli.segment.scene.object_motion import refine, search_velocity
from dpcli.segment.scene.settings import SceneSettings
from dpcli.segment.scene.tracking import MovingObject, claim_around, merge_alike, track
from dpcli.segment.scene.world import UNSEEN, Frame, World

_FEWEST = 6  # points of an object in the frame that proposes it
_FEW_FREE = 2  # of them that some other frame sees through
_LARGEST = 14.0  # meters: a longer cluster is no object, but may hold some
_TALLEST = 5.0
_DOUBT = 0.12  # mean cost of standing still above which a cluster is looked at
_GAIN = 0.15  # mean saving of the motion per point and frame, in points that a frame contradicts
_THROUGH = 0.05  # share of an object's points that frames must see through, in the mean
_SHARE = (0.4, 0.6)  # share of the cost of standing still that a motion must save, the second where more is demanded
_PIECE = 2.0  # times the evidence for the smaller piece of a cluster
_FLAT = 0.4  # meters, and gaps between rows of beams: what is flatter, or lower above the ground, is a bump or a mirror
_ROWS = 0.7
_VEHICLE = 4.0  # meters around the sensor that its own vehicle takes up
_STAYS = 0.3  # meters, of things on board
_WORSE = 0.3  # a point that its object's motion explains worse by so much stands


def find_moving_objects(world: World, settings: SceneSettings) -> list[MovingObject]:
    """Returns what moves on its own, its points in all frames, each in one object at most; the largest first."""
    for t, frame in enumerate(world.frames):
        frame.doubt, frame.free = measure_doubt(world, t)
    found: list[MovingObject] = []
    for t, frame in enumerate(world.frames):
        for own, demand in _propose(frame):
            own = own[frame.label[own] == 0]
            if len(own) < _FEWEST or (frame.free[own] > 0).sum() < max(_FEW_FREE, _THROUGH * len(own) / 2):
                continue
            one = _explain(own, t, world, settings, demand)
            if one is not None:
                found.append(one)
                world.label(one, len(found))
    found = merge_alike(found, world)
    found.sort(key=lambda one: -one.size)
    for number, one in enumerate(found, 1):
        world.label(one, number)
    for number, one in enumerate(found, 1):
        claim_around(one, world)
        world.label(one, number)
    return found


def measure_doubt(world: World, t: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns what the frames around say against frame t's points standing still: f64 (N) 0..1 in the mean, and how many
    of them see through a place, f64 (N). Points on the ground are in no doubt.
    """
    frame, around = world.frames[t], world.around(t)
    cost, free = np.zeros(len(frame.points)), np.zeros(len(frame.points))
    for u in around:
        one, through = world.frames[u].cost(frame.points[frame.raised])
        cost[frame.raised] += one / len(around)
        free[frame.raised] += through
    return cost, free


def _propose(frame: Frame) -> list[tuple[np.ndarray, float]]:
    """Returns the points i64 of clusters in doubt, those that are seen through most first, and the evidence demanded.

    Those points of a cluster that are in doubt are proposed by themselves, too: something may pass by what stands. But so
    look windows and leaves; a small piece of a cluster needs more evidence.
    """
    raised, proposals = frame.raised, []
    points, doubt, free = frame.points[raised], frame.doubt[raised], frame.free[raised] > 0
    reach = frame.reach(points)
    for own in groups(cluster(points, reach, frame.across)):
        if len(own) < _FEWEST or not free[own].any():
            continue
        extent = np.ptp(points[own], axis=0)
        if max(extent[:2]) <= _LARGEST and extent[2] <= _TALLEST and doubt[own].mean() > _DOUBT:
            proposals.append((own, 1.0))
        doubtful = own[free[own] | (doubt[own] > 0.9 * UNSEEN)]
        if len(doubtful) < 0.8 * len(own):
            inner = groups(cluster(points[doubtful], reach[doubtful], frame.across))
            pieces = [doubtful[few] for few in inner]
            proposals += [(piece, _PIECE if len(piece) < 0.5 * len(own) else 1.0) for piece in pieces]
    proposals.sort(key=lambda proposal: -free[proposal[0]].sum())
    return [(raised[own], demand) for own, demand in proposals]


def _explain(own: np.ndarray, t: int, world: World, settings: SceneSettings, demand: float) -> MovingObject | None:
    """Returns the object of these points of frame t, tracked through all frames, or None where they may as well stand.

    demand: times the usual evidence that it needs.
    """
    around, frame = world.around(t), world.frames[t]
    if not around:
        return None
    points = frame.points[own]
    near = [u for u in around if abs(u - t) == abs(around[0] - t)]
    best, least = {}, float(np.mean([world.frames[u].cost(points)[0].mean() for u in near]))
    for start in search_velocity(points, t, around, world, settings.travel):
        motions = {u: refine(points, world.frames[u], _shift(start * (u - t))) for u in near}
        cost = np.mean([world.frames[u].cost(move(motion, points))[0].mean() for u, motion in motions.items()])
        if cost < least:
            best, least = motions, float(cost)
    one = MovingObject(t, {t: own}, {t: np.eye(4)}, demand=demand)
    for u, motion in best.items():
        track(one, t, u - t, motion, world)
    return one if _judge(one, world, settings) else None


def _shift(way: np.ndarray) -> np.ndarray:
    motion = np.eye(4)
    motion[:3, 3] = way
    return motion


def _judge(one: MovingObject, world: World, settings: SceneSettings) -> bool:
    """Returns whether an object's motion explains its points clearly better than standing still, over all its frames.

    Points that stand are taken out before. Things on the sensor's own vehicle, which go where it goes, are no objects.
    """
    if len(one.points) < 2:
        return False
    saved, still, through, count, upright = 0.0, 0.0, 0.0, 0, False
    for t in one.points:
        costs, moving, free = _costs(one, t, world)
        kept = costs - moving > -_WORSE
        one.points[t] = one.points[t][kept]
        saved, still = saved + (costs - moving)[kept].sum(), still + costs[kept].sum()
        through, count = through + free[kept].sum(), count + int(kept.sum())
        upright = upright or _stands_upright(one.points[t], world.frames[t])
    one.saved = float(saved)
    share = _SHARE[0] if one.demand == 1 else _SHARE[1]
    enough = saved >= max(one.demand * settings.evidence, one.demand * _GAIN * count, share * still)
    seen_through = through >= max(settings.evidence, _THROUGH * count)
    return bool(enough and seen_through and upright and not _on_board(one, world))


def _costs(one: MovingObject, t: int, world: World) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns, for an object's points in frame t, the mean cost f64 (N) of standing still, that of its motion, and the
    share of the frames that see through them.
    """
    others = [u for u in world.around(t) if u in one.motion]
    points = world.frames[t].points[one.points[t]]
    still, moving, free = np.zeros((3, len(points)))
    for u in others:
        cost, seen = world.frames[u].cost(points)
        still += cost / len(others)
        moving += world.frames[u].cost(move(one.between(t, u), points))[0] / len(others)
        free += seen / len(others)
    return still, moving, free


def _stands_upright(own: np.ndarray, frame: Frame) -> bool:
    """Returns whether points i64 of a frame reach up as an object does, as far as rows of beams can show it."""
    if not len(own):
        return False
    points = frame.points[own]
    flat = min(_FLAT, _ROWS * frame.across * float(frame.reach(points).min()))
    return bool(np.ptp(points[:, 2]) >= flat and frame.height[own].max() > _FLAT)


def _on_board(one: MovingObject, world: World) -> bool:
    """Returns whether an object is near the sensor in all its frames and stays where it is from there."""
    places = []
    for t, own in one.points.items():
        frame = world.frames[t]
        if frame.origin is None or not len(own):
            return False
        places.append(frame.points[own].mean(0) - frame.origin)
    away = np.array(places)
    return bool(np.linalg.norm(away, axis=1).max() < _VEHICLE and np.ptp(away, axis=0).max() < _STAYS)
