"""Hypotheses of bodies: what pairs of frames show, carried through all frames of the sequence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dpcli.segment.flow.rigid_bodies import BodySearch, find_surface_bodies
from dpcli.segment.flow.surface_icp import columns
from dpcli.segment.multibody.frames import POINT_SHARE, Frames, Trajectory
from dpcli.segment.rigid_motions import compose, motion_between, move

_ALL_PAIRS = 4  # frames up to which all ordered pairs are searched; beyond, adjacent ones both ways
_STEPS, _WIDE = 12, 0.06  # of the ICP that carries a body on
_FEWEST = 8  # points of a body
_ALIKE = 0.7  # spacings that two trajectories differ at most to be one
_MOST = 64  # hypotheses that are compared on all points
_SEARCH = BodySearch(second_looks=0, polish=(0.5,), gain=0.01)  # all frames judge small bodies later

PairMotions = dict[tuple[int, int], np.ndarray]  # (t, u) -> motions (K,3,4)


@dataclass
class Hypothesis:
    """Holds a body seen in one frame (its points (n,3) there) and its trajectory."""

    frame: int
    points: np.ndarray
    trajectory: Trajectory


def find_hypotheses(frames: Frames, map_: Callable = map) -> list[Hypothesis]:
    """Returns different bodies that pairs of frames show, the largest first; `map_` searches pairs and carries bodies on."""
    pairs, surfaces = _pairs(len(frames)), frames.surfaces
    found = list(map_(lambda pair: find_surface_bodies(surfaces[pair[0]], surfaces[pair[1]], _SEARCH), pairs))
    motions = {pair: bodies.motion for pair, bodies in zip(pairs, found)}
    seeds = [
        (pair, k, np.flatnonzero(bodies.label == k))
        for pair, bodies in zip(pairs, found)
        for k in range(len(bodies.motion))
    ]
    seeds = sorted((seed for seed in seeds if len(seed[2]) >= _FEWEST), key=lambda seed: -len(seed[2]))
    seeds = _spread(seeds, len(frames))
    carried = map_(lambda seed: carry(frames, seed[0][0], surfaces[seed[0][0]].points[seed[2]], motions), seeds)
    return keep_different(frames, list(carried))


def _pairs(frames: int) -> list[tuple[int, int]]:
    """Returns the ordered pairs of frames in which bodies are searched."""
    return [
        (t, u) for t in range(frames) for u in range(frames) if t != u and (frames <= _ALL_PAIRS or abs(t - u) == 1)
    ]


def _spread(seeds: list, frames: int) -> list:
    """Returns some of the list's bodies: of every frame as many of its largest, of all about twice as many as are kept."""
    each = max(1, 2 * _MOST // frames)
    taken: dict[int, int] = {}
    kept = []
    for seed in seeds:
        t = seed[0][0]
        taken[t] = taken.get(t, 0) + 1
        if taken[t] <= each:
            kept.append(seed)
    return kept


def carry(frames: Frames, t: int, points: np.ndarray, motions: PairMotions) -> Hypothesis:
    """Returns a body's (points (n,3) of frame t) trajectory: ICP goes outward from frame to frame.

    It starts from where the body was and from every motion that the pair of frames shows.
    """
    trajectory, part = np.tile(np.eye(3, 4), (len(frames), 1, 1)), columns(points)
    for way in (range(t + 1, len(frames)), range(t - 1, -1, -1)):
        before = t
        for u in way:
            steps = [np.eye(3, 4), *motions.get((before, u), ())]
            starts = [compose(step, trajectory[before]) for step in steps]
            starts += list(motions.get((t, u), ())) if before != t else []
            trajectory[u] = _best(frames, u, part, np.stack(starts))
            before = u
    return Hypothesis(t, points, trajectory)


def _best(frames: Frames, u: int, part: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Returns the motion (3,4) onto frame u at which ICP ends best."""
    narrow = frames.spacing
    ends, score = frames.surfaces[u].icp_many(part, starts, _STEPS, _WIDE, narrow, POINT_SHARE, frames.scales[u])
    return ends[score.argmin()]


def keep_different(frames: Frames, found: list[Hypothesis]) -> list[Hypothesis]:
    """Returns the hypotheses, in their order, that take their points elsewhere than all before."""
    kept: list[Hypothesis] = []
    for one in found:
        if len(kept) < _MOST and all(_distance(one, other) > _ALIKE * frames.spacing for other in kept):
            kept.append(one)
    return kept


def _distance(one: Hypothesis, other: Hypothesis) -> float:
    """Returns how far the other's trajectory takes the one's points from its own, on average, in the worst frame."""
    sample, t = one.points[:: max(1, len(one.points) // 24)], one.frame
    own, others = (motion_between(trajectory[t], trajectory) for trajectory in (one.trajectory, other.trajectory))
    return float(np.linalg.norm(move(own - others, sample), axis=2).mean(1).max())
