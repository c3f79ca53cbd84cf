"""Triangles around the inside of a sampled field: naive surface nets (Gibson 1998)."""

from __future__ import annotations

import numpy as np

_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1]


def surface_nets(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the zero surface of a field (X,Y,Z), negative inside: vertices f64 (V,3) in grid units, triangles i64
    (F,3).

    One vertex in each cell that the surface crosses, at the mean of its crossings; corners run anticlockwise seen from
    outside. The surface is closed when the field is positive on all sides of the grid.
    """
    inside = field < 0
    cells = tuple(n - 1 for n in field.shape)
    corner = np.stack([inside[tuple(slice(o, o + n) for o, n in zip(c, cells))] for c in _CORNERS])
    count = corner.sum(0)
    where = np.argwhere((count > 0) & (count < 8))
    number = np.full(cells, -1)
    number[tuple(where.T)] = np.arange(len(where))
    return where + _offsets(field, where), _faces(inside, number)


def _offsets(field: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Returns the mean of the crossings of a cell's twelve edges, (V,3) in 0..1."""
    values = np.stack([field[tuple((where + c).T)] for c in _CORNERS], axis=1).astype(np.float64)
    total, crossings = np.zeros((len(where), 3)), np.zeros((len(where), 1))
    for a, b in _EDGES:
        first, last = values[:, a, None], values[:, b, None]
        crosses = (first < 0) != (last < 0)
        s = np.where(crosses, first / np.where(crosses, first - last, 1), 0)
        total += crosses * (_CORNERS[a] + s * (_CORNERS[b] - _CORNERS[a]))
        crossings += crosses
    return total / crossings


def _faces(inside: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Makes of every grid edge that crosses the surface a quad of the four cells around it."""
    triangles = []
    for axis in range(3):
        u, v = across = [(axis + 1) % 3, (axis + 2) % 3]
        step = np.diff(inside.astype(np.int8), axis=axis)  # -1: the edge leads out
        edge = np.argwhere(step)
        last = np.array(inside.shape)[across] - 1
        edge = edge[((edge[:, across] > 0) & (edge[:, across] < last)).all(1)]
        ring = []
        for du, dv in ((-1, -1), (0, -1), (0, 0), (-1, 0)):  # anticlockwise seen from the end of the axis
            cell = edge.copy()
            cell[:, u] += du
            cell[:, v] += dv
            ring.append(number[tuple(cell.T)])
        quad = np.stack(ring, axis=1)
        leaves = step[tuple(edge.T)] < 0
        quad = np.where(leaves[:, None], quad, quad[:, ::-1])
        triangles += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    return np.concatenate(triangles)
