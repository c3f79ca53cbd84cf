"""Bodies that are alike around an axis: of the motions that explain one equally well, the one that turns least is taken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpcli.ops.rotations import rotation_matrix, rotation_vector
from dpcli.segment.multibody.explanation import Body, Explanation, body_of
from dpcli.segment.multibody.frames import Frames, Trajectory, relative_motion
from dpcli.segment.rigid_motions import compose, move
from dpcli.segment.thinning import thin_evenly

_AS_GOOD = 0.02  # cost of a point by which two motions of a body may differ by chance of the points drawn
_CLEARLY = 0.05  # radians by which another motion must turn less
_FITS = (1.0, 0.5)  # residuals of the fits after a turn, in spacings
_APART = 0.5  # spacings by which a point must be taken elsewhere for a motion to be another one
_MOST = 512  # points of a body that say where its axes lie


def turn_least(frames: Frames, found: Explanation) -> Explanation:
    """Returns the explanation with bodies that turn no more than their points demand.

    The points of a bottle say little of how far it turned about its own axis, so that the search ends anywhere. The largest
    body is compared with standing still from frame to frame, the others with the largest. Labels and costs stay as they are.
    """
    still = np.tile(np.eye(3, 4), (len(frames), 1, 1))
    largest = _least_turning(frames, found.bodies[0], found.label == 0, still)
    others = [
        _least_turning(frames, body, found.label == k, largest.trajectory)
        for k, body in enumerate(found.bodies[1:], start=1)
    ]
    return replace(found, bodies=[largest, *others])


def _least_turning(frames: Frames, body: Body, inside: np.ndarray, reference: Trajectory) -> Body:
    """Returns the body whose motion turns least against the reference, of those that explain its points (mask) as well."""
    own = _own_points(frames, body.trajectory, inside)
    center = own.mean(0)
    axes = np.linalg.svd(own - center, full_matrices=False)[2]
    turned = [_turned_back(body.trajectory, reference, own, center, axis) for axis in axes]
    tried = [body, *(_fitted(frames, one, inside) for one in turned if _differs(frames, one, body.trajectory, own))]
    cost = np.array([one.cost[inside].mean() for one in tried])
    turn = np.array([_turning(one.trajectory, reference) for one in tried])
    gain = np.where(cost < cost.min() + _AS_GOOD, turn[0] - turn, 0)
    return tried[int(gain.argmax())] if gain.max() > _CLEARLY else body


def _own_points(frames: Frames, trajectory: Trajectory, inside: np.ndarray) -> np.ndarray:
    """Returns points (n,3) of the body, of all frames, in its own coordinates, evenly thinned to `_MOST`."""
    rows = thin_evenly(np.flatnonzero(inside), _MOST)
    motion = trajectory[np.searchsorted(frames.starts, rows, side="right") - 1]
    return np.einsum("nij,ni->nj", motion[:, :, :3], frames.points[rows] - motion[:, :, 3])


def _turned_back(
    trajectory: Trajectory, reference: Trajectory, own: np.ndarray, center: np.ndarray, axis: np.ndarray
) -> Trajectory:
    """Returns the trajectory turned in every frame about an axis of the body, given in its own coordinates.

    By the angle that brings its points (n,3) nearest to where the reference takes them from the frame before.
    """
    new, arm = trajectory.copy(), own - center
    arm = arm - np.outer(arm @ axis, axis)
    for u in range(1, len(new)):
        wanted = move(compose(relative_motion(reference, u - 1, u), new[u - 1]), own)
        seen = (wanted - trajectory[u, :, 3]) @ trajectory[u, :, :3] - center
        angle = np.arctan2((np.cross(arm, seen) @ axis).sum(), (arm * seen).sum())
        turn = rotation_matrix(angle * axis)
        new[u] = compose(trajectory[u], np.concatenate([turn, (center - turn @ center)[:, None]], 1))
    return new


def _differs(frames: Frames, one: Trajectory, other: Trajectory, own: np.ndarray) -> bool:
    apart = (np.linalg.norm(move(a - b, own), axis=1).max() for a, b in zip(one, other))
    return max(apart) > _APART * frames.spacing


def _fitted(frames: Frames, trajectory: Trajectory, inside: np.ndarray) -> Body:
    for tight in _FITS:
        trajectory = frames.fit(trajectory, inside, False, tight)
    return body_of(frames, trajectory)


def _turning(trajectory: Trajectory, reference: Trajectory) -> float:
    """Returns the mean angle by which a body turns from frame to frame against the reference, in radians."""
    steps = [
        relative_motion(trajectory, t, t + 1)[:, :3] @ relative_motion(reference, t, t + 1)[:, :3].T
        for t in range(len(trajectory) - 1)
    ]
    return float(np.linalg.norm(rotation_vector(np.stack(steps)), axis=-1).mean())
