"""The motion of one object between frames: a search over displacements, and ICP that keeps it upright."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from dpcli.segment.rigid_motions import move
from dpcli.segment.scene.world import Frame, World
from dpcli.segment.thinning import thin_evenly

_CELL = 0.2  # meters, of the map of distances
_CUT = 0.6  # meters: a point farther from everything has no partner
_FEW = 150  # points of an object that the search looks at
_STARTS = 3
_CUTS = (1.0, 0.6, 0.35)  # meters, farthest partners of ICP, one stage after the other
_STEPS = 8
_TURN = 0.15  # radians that an object may turn by against its start
_MOST = 600  # points of an object that ICP looks at


def search_velocity(points: np.ndarray, t: int, others: list[int], world: World, reach: float) -> np.ndarray:
    """Returns the best displacements per frame f64 (K,3), meters, of an object's points (N,3) in frame t, the best first.

    Displacements up to `reach` on a grid, the same from frame to frame; fine ones near zero.
    """
    points = thin_evenly(points, _FEW)
    coarse = np.arange(-reach, reach + 1e-9, _CELL)
    fine = np.arange(-0.5, 0.51, 0.05)
    steps = np.concatenate([np.stack(np.meshgrid(a, a), -1).reshape(-1, 2) for a in (coarse, fine)])
    steps = steps[np.hypot(steps[:, 0], steps[:, 1]) <= reach]
    total = np.zeros(len(steps))
    for u in others:
        total += _displaced_cost(points, steps * (u - t), world.frames[u].solid, reach * min(abs(u - t), 2))
    order, chosen = np.argsort(total, kind="stable"), []
    for place in order:
        if all(np.linalg.norm(steps[place] - one) > 0.4 for one in chosen):
            chosen.append(steps[place])
        if len(chosen) == _STARTS:
            break
    return np.concatenate([np.array(chosen), np.zeros((len(chosen), 1))], 1)


def _displaced_cost(points: np.ndarray, shifts: np.ndarray, target: np.ndarray, reach: float) -> np.ndarray:
    """Returns the mean cut distance f64 (S), 0..1, of points shifted by each of `shifts` (S,2) to the target's points."""
    low, high = points.min(0) - [reach, reach, 0.5], points.max(0) + [reach, reach, 0.5]
    size = np.ceil((high - low) / _CELL).astype(int) + 1
    own = target[((target >= low) & (target < high)).all(1)]
    if len(own) == 0:
        return np.ones(len(shifts))
    empty = np.ones(size, bool)
    empty[tuple(((own - low) / _CELL).astype(int).T)] = False
    distance = np.minimum(ndimage.distance_transform_edt(empty).astype(np.float32) * _CELL / _CUT, 1.0)
    cell = (points - low) / _CELL
    place = (cell[None, :, :2] + shifts[:, None] / _CELL).astype(np.int32)  # [S, N, 2]
    inside = ((place >= 0) & (place < size[:2])).all(2)
    place = np.where(inside[..., None], place, 0)
    found = distance[place[..., 0], place[..., 1], cell[:, 2].astype(np.int32)[None]]
    return np.where(inside, found, 1.0).mean(1)


def refine(points: np.ndarray, frame: Frame, start: np.ndarray) -> np.ndarray:
    """Returns the motion f64 (4,4) of an object's points (N,3) onto a frame, by ICP both ways from a start (4,4).

    Objects stay level: they turn about the upright axis only, and only where they are large enough to show it.
    """
    points = thin_evenly(points, _MOST)
    motion, moved = start.copy(), move(start, points)
    middle, radius = (moved.min(0) + moved.max(0)) / 2, np.linalg.norm(np.ptp(moved, axis=0)) / 2 + _CUTS[0]
    target = frame.solid[frame.tree.query_ball_point(middle, radius)] if len(frame.solid) else frame.solid
    target = target[np.all((target > moved.min(0) - _CUTS[0]) & (target < moved.max(0) + _CUTS[0]), axis=1)]
    turns = len(points) >= 40 and np.ptp(points[:, :2], axis=0).max() > 1.0
    if len(target) < 3 or len(points) < 3:
        return motion
    target = thin_evenly(target, 3 * _MOST)
    tree = cKDTree(target)
    for cut in _CUTS:
        for _ in range(_STEPS):
            step = _step(moved, target, tree, cut, turns)
            if step is None or abs(_angle(step @ motion) - _angle(start)) > _TURN:
                return motion
            motion = step @ motion
            before, moved = moved, move(motion, points)
            if abs(moved - before).max() < 3e-3:
                break
    return motion


def _angle(motion: np.ndarray) -> float:
    return float(np.arctan2(motion[1, 0], motion[0, 0]))


def _step(moved: np.ndarray, target: np.ndarray, tree: cKDTree, cut: float, turns: bool) -> np.ndarray | None:
    """Returns one step f64 (4,4) of upright ICP, partners sought from both sides; None without partners."""
    distance, index = tree.query(moved, distance_upper_bound=cut)
    inside = np.all((target > moved.min(0) - 0.1) & (target < moved.max(0) + 0.1), axis=1)
    back, partner = cKDTree(moved).query(target[inside], distance_upper_bound=cut)
    here, there = np.isfinite(distance), np.isfinite(back)
    source = np.concatenate([moved[here], moved[partner[there]]])
    aim = np.concatenate([target[index[here]], target[inside][there]])
    weight = (1 - np.minimum(np.concatenate([distance[here], back[there]]) / cut, 1) ** 2) ** 2
    if weight.sum() < 2:
        return None
    return _upright_fit(source, aim, weight / weight.sum(), turns)


def _upright_fit(source: np.ndarray, aim: np.ndarray, weight: np.ndarray, turns: bool) -> np.ndarray:
    """Returns the level motion f64 (4,4) that takes source (N,3) nearest to aim (N,3), weights (N) that sum to 1."""
    middle, goal = weight @ source, weight @ aim
    motion = np.eye(4)
    if turns:
        a, b = (source - middle)[:, :2], (aim - goal)[:, :2]
        angle = np.arctan2(weight @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), weight @ (a * b).sum(1))
        c, s = np.cos(angle), np.sin(angle)
        motion[:2, :2] = [[c, -s], [s, c]]
    motion[:2, 3] = goal[:2] - motion[:2, :2] @ middle[:2]  # rows of beams would draw it up or down
    return motion
