"""A hinge where two parts touch: found from where they stay together and how the child lies in every frame.

Motions of a thin part are ambiguous: turned by half, a flap looks as before, so that each frame may be explained by another
of two motions and no hinge fits them. What touches in all frames says where the hinge is without any motion of the child.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from dpcli.ops.rotations import axis_rotation
from dpcli.segment.kinematics.joint_fit import JointFit
from dpcli.segment.thinning import thin_evenly
from dpcli.store.joints import REVOLUTE

_TOUCHING = 1.5, 2.0, 3.0  # spacings between points that touch: the least by which enough do
_FEWEST, _ENOUGH = 4, 8  # points that lie along a line, and along one that is sure
_MOST, _PLACES = 64, 512  # points of the child in a frame that are turned; places where it touches that are looked at
_ANGLES = np.radians(np.arange(-180, 180, 10)), np.radians(np.arange(-7.5, 8, 2.5))  # all around, then near the best


def contact_hinge(child: list[np.ndarray], parent: list[np.ndarray], spacing: float) -> JointFit | None:
    """Returns the hinge about which a child turns where it touches its parent; None where they don't keep touching.

    child, parent: points f64 (n,3) of every frame in the parent's own coordinates, in which the parent is at rest; spacing of
    the points. The axis is that direction of the place they touch at, long, across or normal, about which turns bring the
    child's points of one frame nearest to those of the others.
    """
    place = _lasting_contact(child, parent, spacing)
    if len(place) < _FEWEST:
        return None
    point = np.median(place, axis=0)
    thinned = [thin_evenly(own, _MOST) for own in child]
    first = thinned[0]
    near = cKDTree(first).query(first, k=2)[0][:, 1] if len(first) > 1 else np.zeros(1)
    scale = max(float(np.median(near)), spacing)
    tried = []
    for axis in np.linalg.svd(place - place.mean(0), full_matrices=False)[2]:
        found = [_best_angle(first, own, axis, point, scale) for own in thinned[1:]]
        value, misfit = np.array([(0.0, 0.0), *found]).T
        tried.append(JointFit(REVOLUTE, axis, point, np.unwrap(value), float(misfit.mean())))
    return min(tried, key=lambda fit: fit.residual)


def _lasting_contact(child: list[np.ndarray], parent: list[np.ndarray], spacing: float) -> np.ndarray:
    """Returns points (n,3) of the child, of all frames, near the parent, at places where it has points in every frame.

    A flap that is shut touches its parent all around, but only its hinge stays where it is when it opens.
    """
    if not all(map(len, (*child, *parent))):
        return np.zeros((0, 3))
    apart = np.concatenate([cKDTree(other).query(own)[0] for own, other in zip(child, parent)])
    touching = thin_evenly(np.flatnonzero(apart < _TOUCHING[-1] * spacing), _PLACES)
    places, apart = np.concatenate(child)[touching], apart[touching]
    for own in child:
        apart = np.maximum(apart, cKDTree(own).query(places)[0])
    for reach in _TOUCHING:
        lasting = places[apart < reach * spacing]
        if len(lasting) >= _ENOUGH:
            break
    return lasting


def _best_angle(
    first: np.ndarray, other: np.ndarray, axis: np.ndarray, point: np.ndarray, scale: float
) -> tuple[float, float]:
    """Returns the turn about a line, in radians, that brings a cloud nearest to another one, and their misfit 0..1."""
    best = 0.0
    for angles in _ANGLES:
        tried = best + angles
        misfit = _misfits(first, other, axis_rotation(axis, tried), point, scale)
        best = float(tried[misfit.argmin()])
    return best, float(misfit.min())


def _misfits(first: np.ndarray, other: np.ndarray, turns: np.ndarray, point: np.ndarray, scale: float) -> np.ndarray:
    """Returns the robust distances (A) between a cloud (n,3) turned about a point by turns (A,3,3) and another (m,3)."""
    turned, still = (first - point) @ np.swapaxes(turns, 1, 2), other - point
    squared = (turned**2).sum(-1)[..., None] + (still**2).sum(-1) - 2 * turned @ still.T
    both = [np.maximum(squared.min(axis), 0) for axis in (2, 1)]
    return sum((near / (near + scale**2)).mean(-1) for near in both) / 2
