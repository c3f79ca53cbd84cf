"""Clusters of a frame's points: connected components whose gaps grow with the distance from the sensor."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

_BANDS = ((0, 10, 0.4), (10, 20, 0.4), (20, 40, 0.7), (40, 70, 1.1), (70, np.inf, 1.1))  # meters: from, to, widest gap
_ROWS = 1.3  # distances between rows of beams that are no gap


def cluster(points: np.ndarray, reach: np.ndarray, across: float) -> np.ndarray:
    """Returns the number i64 (N) of each point's cluster.

    points: f64 (N,3), z up; reach: their distances (N) from the sensor; across: the angle between its rows, radians.
    """
    rows, columns = [np.zeros(0, int)], [np.zeros(0, int)]
    for near, far, gap in _BANDS:
        own = np.flatnonzero((reach >= near - gap) & (reach < far + gap))
        if len(own) == 0:
            continue
        band = points[own] * [1, 1, min(1.0, gap / (_ROWS * across * min(far, 2 * near + 10)))]
        _, first, voxel = np.unique(np.floor(band / (gap / 3)), axis=0, return_index=True, return_inverse=True)
        pairs = cKDTree(band[first]).query_pairs(gap, output_type="ndarray")
        rows += [own, own[first][pairs[:, 0]]]
        columns += [own[first][voxel.reshape(-1)], own[first][pairs[:, 1]]]
    row, column = np.concatenate(rows), np.concatenate(columns)
    graph = coo_matrix((np.ones(len(row), bool), (row, column)), shape=(len(points), len(points)))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def groups(number: np.ndarray) -> list[np.ndarray]:
    """Returns the members i64 of each cluster, by their numbers (N).

    >>> [own.tolist() for own in groups(np.array([1, 0, 1]))]
    [[1], [0, 2]]
    """
    order = np.argsort(number, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(number[order])) + 1) if len(number) else []
