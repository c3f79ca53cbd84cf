"""Clusters of a frame's points: connected components whose gaps grow with the distance from the sensor."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

_BANDS = ((0.0, 20.0, 0.4), (20.0, 40.0, 0.7), (40.0, np.inf, 1.1))  # meters: from, to, and the widest gap


def cluster(points: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Returns the number i64 (N) of each point's cluster. points: f64 (N,3); reach: their distances (N) from the sensor."""
    rows, columns = [np.zeros(0, int)], [np.zeros(0, int)]
    for near, far, gap in _BANDS:
        own = np.flatnonzero((reach >= near - gap) & (reach < far + gap))
        if len(own) == 0:
            continue
        _, first, voxel = np.unique(np.floor(points[own] / (gap / 3)), axis=0, return_index=True, return_inverse=True)
        pairs = cKDTree(points[own[first]]).query_pairs(gap, output_type="ndarray")
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
