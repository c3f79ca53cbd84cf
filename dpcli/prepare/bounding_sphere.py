"""A small ball around points."""

from __future__ import annotations

import numpy as np

_DIRECTIONS = 512


def bounding_sphere(points: np.ndarray, steps: int = 300) -> tuple[np.ndarray, float]:
    """Returns center f64 (3) and radius of a small ball that holds all points (...,3).

    Badoiu and Clarkson (2003): step i moves the center by 1/(i+1) toward the farthest point; within 1/sqrt(steps)
    of the smallest ball. Started at the middle of the box, it ends far closer than that.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    outer = _extreme(points)
    center = (outer.min(0) + outer.max(0)) / 2
    for step in range(steps):
        farthest = outer[((outer - center) ** 2).sum(1).argmax()]
        center = center + (farthest - center) / (step + 5)
    return center, float(np.sqrt(((points - center) ** 2).sum(1).max()))


def _extreme(points: np.ndarray) -> np.ndarray:
    """Returns the points that can touch a bounding ball, nearly: the farthest in each of many directions; millions are
    slow.
    """
    if len(points) < 2_000:
        return points
    k = np.arange(_DIRECTIONS) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / _DIRECTIONS), np.pi * (1 + 5**0.5) * k  # a Fibonacci lattice on the sphere
    lattice = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)])
    return points[np.unique([(points @ direction).argmax() for direction in lattice.T.astype(points.dtype)])]
