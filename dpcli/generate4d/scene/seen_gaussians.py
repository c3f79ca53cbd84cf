"""Chooses the Gaussians of a fitted scene whose motion can be trusted; hidden ones move as the network extrapolates."""

from __future__ import annotations

import numpy as np

_SEEN, _ENOUGH = 0.3, 0.15  # share of the frames that shows a Gaussian; share of such Gaussians that speaks for all
_CELLS, _BEHIND = 96, 0.02  # of the depth buffer along a side; depth in diameters within which a surface is seen


def trust(
    frames: np.ndarray, solid: np.ndarray, poses: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Returns which Gaussians have a motion that can be trusted, bool (N): solid ones (mask (N)) that some view often sees.

    frames: f (T,N,3); poses (V,4,4), intrinsics (V,3,3) and the size of pictures are those of the fitted views. Where
    they see too small a share, as from an animal's front, all solid ones do; where nothing is solid, all do.
    """
    solid = solid if solid.any() else np.ones_like(solid)
    shown = np.zeros(frames.shape[1])
    for places in frames:
        shown[solid] += np.any([_front(places[solid], *view, size) for view in zip(poses, intrinsics)], 0)
    often = solid & (shown > _SEEN * len(frames))
    return often if often.sum() >= _ENOUGH * solid.sum() else solid


def _front(points: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Returns which points (N,3) no other hides from a camera, bool (N), by the nearest depth in each cell and around it."""
    from scipy.ndimage import minimum_filter

    camera = points @ pose[:3, :3].T + pose[:3, 3]
    depth = camera[:, 2].clip(1e-6)
    cell = (camera @ intrinsics.T)[:, :2] / depth[:, None] * (_CELLS / max(size))
    column, row = np.moveaxis(np.clip(cell, 0, _CELLS - 1).astype(int), -1, 0)
    nearest = np.full((_CELLS, _CELLS), np.inf)
    np.minimum.at(nearest, (row, column), depth)
    nearest = minimum_filter(nearest, 3)
    return depth <= nearest[row, column] + _BEHIND * np.linalg.norm(np.ptp(points, axis=0))
