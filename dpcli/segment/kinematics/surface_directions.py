"""The directions of a part's own surface, along which its joints nearly always lie."""

from __future__ import annotations

import numpy as np

from dpcli.segment.flow.surface_icp import Surface
from dpcli.segment.thinning import thin_evenly

_COSINE = np.cos(np.radians(12))  # of the normals that make one direction
_NORMALS = 3  # directions of normals of a part
_FEWEST = 9  # points that make a surface
_MOST, _AT_ONCE = 8192, 2048  # points of a part whose normals are counted, and of them those that count at once
_ACROSS = 0.3  # least sine between two normals whose cross product is a direction
_ALIKE = np.cos(np.radians(10))  # of directions that count as one
_ANGLES = np.radians(np.arange(90))  # of a rectangle's edges that are tried
_ENDS = 0.01  # share of the points that may lie outside a rectangle, on each side


def surface_directions(points: np.ndarray) -> np.ndarray:
    """Returns unit vectors f64 (D,3): the part's most frequent normals and those at right angles to two of them.

    points (n,3). Fewer than 9 have none.
    """
    if len(points) < _FEWEST:
        return np.zeros((0, 3))
    points = thin_evenly(points, _MOST)
    centered = points - points.mean(0)
    normals = Surface(centered / max(float(np.abs(centered).max()), 1e-9)).normals.astype(np.float64)
    found: list[np.ndarray] = []
    left = normals
    while len(found) < _NORMALS and len(left) >= _FEWEST:
        found.append(_mean_direction(normals, left[_alike(left, normals).argmax()]))
        left = left[np.abs(left @ found[-1]) <= _COSINE]
    crossed = [np.cross(one, two) for n, one in enumerate(found) for two in found[:n]]
    found += [normal / np.linalg.norm(normal) for normal in crossed if np.linalg.norm(normal) > _ACROSS]
    return np.stack(found)


def directions_and_edges(points: np.ndarray) -> np.ndarray:
    """Returns the part's surface directions, and the edges of a plate across the most frequent, f64 (D,3)."""
    points = thin_evenly(points, _MOST)
    found = surface_directions(points)
    return np.concatenate([found, _plate_edges(points - points.mean(0), found[0])]) if len(found) else found


def distinct_directions(directions: np.ndarray) -> np.ndarray:
    """Returns the unit vectors (D,3) that lie more than 10 degrees, of either sign, from all before them.

    >>> distinct_directions(np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0]])).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """
    chosen: list[int] = []
    for k, direction in enumerate(directions):
        if not chosen or (np.abs(directions[chosen] @ direction) <= _ALIKE).all():
            chosen.append(k)
    return directions[chosen]


def _alike(some: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Returns for each of some unit vectors (m,3) how many of the normals (n,3), of either sign, lie along it; never m x n at once."""
    parts = (some[start : start + _AT_ONCE] for start in range(0, len(some), _AT_ONCE))
    return np.concatenate([(np.abs(part @ normals.T) > _COSINE).sum(1) for part in parts])


def _plate_edges(centered: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Returns the directions (2,3) of the least rectangle around points (n,3), seen along a normal.

    A plate has one normal, and turns about one of its edges.
    """
    plane = np.linalg.svd(normal[None])[2][1:]
    turns = np.stack([np.cos(_ANGLES), np.sin(_ANGLES), -np.sin(_ANGLES), np.cos(_ANGLES)], 1).reshape(-1, 2, 2)
    low, high = np.quantile(turns @ (plane @ centered.T), [_ENDS, 1 - _ENDS], axis=2)
    return turns[(high - low).prod(1).argmin()] @ plane


def _mean_direction(normals: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Returns the mean (3) of the normals (n,3), of either sign, about a first direction, after a few rounds."""
    direction = first
    for _ in range(5):
        cosine = normals @ direction
        near = np.abs(cosine) > _COSINE
        direction = (normals[near] * np.sign(cosine[near])[:, None]).sum(0)
        direction = direction / np.linalg.norm(direction)
    return direction
