"""Points that were not measured: NaN, the origin where a scanner had no return, and sentinels that stand for "nothing"."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from dpcli.prepare.cloud_formats.cloud import AT_ORIGIN, Cloud

NOT_FINITE = "points with NaN or infinity dropped"
CROWDED = (
    "sequences in which many points of a frame lie at one and the same place; returns that met nothing, or padding?"
)
IMPOSSIBLE = "points at impossible places (such as 1e30 or -9999 on all axes) dropped"
LONE = "frames whose only point lies at {}; if that stands for nothing seen, leave those rows out"
# on all three axes; the greatest of 32 bits twice, as float32 rounds it up
_STAND_INS = (-9999.0, -99999.0, -999.0, 9999.0, 99999.0, 65535.0, 32767.0, -32768.0, -(2.0**31), 2.0**31 - 1, 2.0**31)
_ROUNDED = 1e-8  # what remains of 0 where points were turned, or the smallest number of a type
_SAMPLED, _SEVERAL = 2048, 8
_JUMP, _OF_SIZE = 5, 0.25  # times the longest other step of any point; share of the widest frame
_FARTHEST = 1e10  # no map has such coordinates, in any unit


def clean(clouds: Sequence[Cloud]) -> dict[str, int]:
    """Removes from the frames of one sequence, in place, what is no measurement. Returns how many points, by reason.

    One point at the origin in a frame may be a corner of a modeled shape and stays, unless some frame has more, as two points
    of one measurement are never at the same place, or has nothing else while others have several points: radars log a row of
    zeros for a frame in which they saw nothing; or unless a point with an identity jumps there, as markers that nobody sees
    do in tables. Other lone points with equal coordinates, such as -1, are counted only.
    """
    found: Counter[str] = Counter()
    origins = []
    for cloud in clouds:
        ends = ends_of(cloud.points)
        if not np.isfinite(ends).all():  # a number that isn't finite is an end
            found[NOT_FINITE] += _drop(cloud, ~np.isfinite(cloud.points).all(1))
            ends = ends_of(cloud.points)
        found[IMPOSSIBLE] += _drop(cloud, _impossible(cloud.points, float(np.abs(ends).max())))
        zero = np.abs(cloud.points[:, 0]) < _ROUNDED
        origins.append(zero & (np.abs(cloud.points[:, 1:]) < _ROUNDED).all(1) if zero.any() else zero)
    several = any(len(cloud.points) > 1 for cloud in clouds)
    alone = several and any(own.all() for own in origins if len(own))
    if several:
        found |= _lone(clouds)
    doubled = any(np.count_nonzero(own) > 1 for own in origins)
    if alone or doubled or _far_from_origin(clouds, origins) or _jumps_to_origin(clouds, origins):
        found[AT_ORIGIN] = sum(_drop(cloud, own) for cloud, own in zip(clouds, origins))
    return {what: count for what, count in found.items() if count}


def is_crowded(points: np.ndarray) -> bool:
    """Returns whether a hundredth of some points (N,3) or more are at one place: these were not measured, but they aren't the
    origin, such as where a scanner's own axes were turned into those of a vehicle.
    """
    some = points[:: max(1, len(points) // _SAMPLED)]
    least = max(_SEVERAL, len(some) // 100)
    x = np.sort(some[:, 0])
    alike = x[least:][x[least:] == x[:-least]] if len(some) > least else x[:0]
    for value in dict.fromkeys(alike.tolist()):
        others = some[some[:, 0] == value, 1:]
        if np.unique(others, axis=0, return_counts=True)[1].max() > least:
            return True
    return False


def _drop(cloud: Cloud, bad: np.ndarray) -> int:
    count = int(np.count_nonzero(bad))
    if count:
        cloud.keep(~bad)
    return count


def ends_of(points: np.ndarray) -> np.ndarray:
    """Returns the least and the greatest x, y and z of points (N,3), f64 (2,3), zeros of none; NumPy is slow along short
    rows.
    """
    if not len(points):
        return np.zeros((2, 3))
    return np.array([[column.min() for column in points.T], [column.max() for column in points.T]], np.float64)


def _impossible(points: np.ndarray, farthest: float) -> np.ndarray:
    equal = (points[:, 0] == points[:, 1]) & (points[:, 1] == points[:, 2])
    stand_in = equal & np.isin(points[:, 0], _STAND_INS) if equal.any() else equal
    if farthest > _FARTHEST:
        return stand_in | (np.abs(points) > _FARTHEST).any(1)
    return stand_in


def _lone(clouds: Sequence[Cloud]) -> Counter[str]:
    """Returns how many frames hold one point alone, with the same value on all axes, by that place; none of a place that one
    frame alone has.
    """
    places = (tuple(map(float, cloud.points[0])) for cloud in clouds if len(cloud.points) == 1)
    counts = Counter(place for place in places if place[0] and len(set(place)) == 1)
    return Counter({LONE.format("({:g}, {:g}, {:g})".format(*place)): n for place, n in counts.items() if n > 1})


def _far_from_origin(clouds: Sequence[Cloud], origins: Sequence[np.ndarray]) -> bool:
    """Returns whether some frame has a point at the origin and all its others far away, as on maps."""
    for cloud, own in zip(clouds, origins):
        if own.any() and not own.all() and np.abs(cloud.points[~own]).max(1).min() > 1e4:
            return True
    return False


def _jumps_to_origin(clouds: Sequence[Cloud], origins: Sequence[np.ndarray]) -> bool:
    """Returns whether some point that is followed is at the origin in one frame and far away in the next, or the other way
    round, far more than any point moves else.
    """
    if not any(own.any() for own in origins) or any(cloud.track is None for cloud in clouds):
        return False
    away, most = 0.0, 0.0
    for (first, at_first), (second, at_second) in pairwise(zip(clouds, origins)):
        _, ours, theirs = np.intersect1d(first.track, second.track, return_indices=True)
        steps = np.linalg.norm(first.points[ours].astype(np.float64) - second.points[theirs], axis=1)
        left = at_first[ours] != at_second[theirs]
        away, most = max(away, steps[left].max(initial=0)), max(most, steps[~left].max(initial=0))
    size = max(float(np.ptp(ends_of(cloud.points[~own]), axis=0).max()) for cloud, own in zip(clouds, origins))
    return away > max(_JUMP * most, _OF_SIZE * size)
