"""Points that nobody measured: NaN, the origin where a scanner had no return, and numbers that stand for "nothing"."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from dpcli.prepare.cloud_formats.cloud import AT_ORIGIN, Cloud

NOT_FINITE = "points with NaN or infinity dropped"
IMPOSSIBLE = "points at impossible places (such as 1e30 or -9999 on all axes) dropped"
_STAND_INS = (-9999.0, -99999.0, -999.0, 9999.0, 99999.0, 65535.0, 32767.0, -32768.0, -(2.0**31), 2.0**31 - 1)
# on all three axes
_FARTHEST = 1e10  # no map has such coordinates, in any unit


def clean(clouds: Sequence[Cloud]) -> dict[str, int]:
    """Removes from the frames of one sequence, in place, what is no measurement. Returns how many points, by reason.

    One point at the origin in a frame may be a corner of a modeled shape and stays, unless some frame has more: two
    points of one measurement are never at the same place.
    """
    found: Counter[str] = Counter()
    origins = []
    for cloud in clouds:
        ends = ends_of(cloud.points)
        if not np.isfinite(ends).all():  # a number that isn't finite is an end
            found[NOT_FINITE] += _drop(cloud, ~np.isfinite(cloud.points).all(1))
            ends = ends_of(cloud.points)
        found[IMPOSSIBLE] += _drop(cloud, _impossible(cloud.points, float(np.abs(ends).max())))
        zero = cloud.points[:, 0] == 0
        origins.append(zero & (cloud.points[:, 1:] == 0).all(1) if zero.any() else zero)
    if any(np.count_nonzero(own) > 1 for own in origins) or _far_from_origin(clouds, origins):
        found[AT_ORIGIN] = sum(_drop(cloud, own) for cloud, own in zip(clouds, origins))
    return {what: count for what, count in found.items() if count}


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


def _far_from_origin(clouds: Sequence[Cloud], origins: Sequence[np.ndarray]) -> bool:
    """Returns whether some frame has a point at the origin and all its others far away, as on maps."""
    for cloud, own in zip(clouds, origins):
        if own.any() and not own.all() and np.abs(cloud.points[~own]).max(1).min() > 1e4:
            return True
    return False
