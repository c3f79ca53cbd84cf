"""Splits of bodies: motions fitted to patches of a body's points, as one body may hold halves of two parts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dpcli.segment.flow.motion_proposals import cluster_patches
from dpcli.segment.multibody.explanation import Body, Explanation, body_of
from dpcli.segment.multibody.frames import Frames, Trajectory
from dpcli.segment.rigid_motions import bring_to_rest

_PATCHES = (2, 4)  # that a body is divided into
_FEWEST = 12  # points of a patch in a frame, on average
_TOUCHING = 2  # bodies around whose motions a patch is tried with, besides its own body's
_FITS = (2.0, 1.0)  # last residual of the fits one after the other, in spacings


def split_bodies(frames: Frames, found: Explanation, map_: Callable = map) -> list[Body]:
    """Returns a body for each patch of each body, its motions fitted by `map_` to the patch's points of all frames."""
    patches = [patch for k in range(len(found.bodies)) for patch in _patches_of(frames, found, k)]
    return list(map_(lambda patch: _fit_patch(frames, *patch), patches))


def _patches_of(frames: Frames, found: Explanation, k: int) -> list[tuple[np.ndarray, list[Trajectory]]]:
    """Returns the patches (masks (N)) of body k that have points enough, with the motions that each may start from."""
    own = np.flatnonzero(found.label == k)
    counts = [count for count in _PATCHES if len(own) >= count * _FEWEST * len(frames)]
    if not counts:
        return []
    around = np.bincount(found.label[frames.neighbors[own]].ravel(), minlength=len(found.bodies))
    around[k] = 0
    nearest = [j for j in np.argsort(-around, kind="stable")[:_TOUCHING] if around[j]]
    starts = [found.bodies[j].trajectory for j in (k, *nearest)]
    at_rest = _at_rest(frames, found.bodies[k].trajectory)[own].astype(np.float32)
    masks = []
    for count in counts:
        patch = cluster_patches(at_rest, count)
        masks += [np.isin(np.arange(len(found.label)), own[patch == c]) for c in range(count)]
    return [(mask, starts) for mask in masks if mask.sum() >= _FEWEST * len(frames)]


def _at_rest(frames: Frames, trajectory: Trajectory) -> np.ndarray:
    """Returns all points (N,3) in the coordinates of a body, so that patches hold the same surface in all frames."""
    return np.concatenate([bring_to_rest(frames.points[frames.slice(t)], trajectory[t]) for t in range(len(frames))])


def _fit_patch(frames: Frames, inside: np.ndarray, starts: list[Trajectory]) -> Body:
    """Returns the body that explains the points of a patch (mask (N)) best, of those fitted from each start."""
    ends = []
    for trajectory in starts:
        for tight in _FITS:
            trajectory = frames.fit(trajectory, inside, False, tight)
        ends.append(body_of(frames, trajectory))
    return min(ends, key=lambda body: float(body.cost[inside].mean()))
