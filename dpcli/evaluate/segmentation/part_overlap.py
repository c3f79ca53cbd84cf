"""Overlap of predicted and true parts in one frame: what the matching, IoU and the Rand index are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_LARGEST_TABLE = 4  # times the points: where ids are small, a table finds them several times as fast as a search


@dataclass(frozen=True)
class Overlap:
    """Holds the points shared by the parts of one frame.

    shared f64 (G,P): points of true part g that are predicted as p; truth_sizes f64 (G); sizes f64 (P), both with the
    points in no part; truth_ids, ids: the parts' ids, ascending; truth_rows i64 (N), columns i64 (N): the part of each
    point as an index, -1 = in none. Only parts with points occur.
    """

    shared: np.ndarray
    truth_sizes: np.ndarray
    sizes: np.ndarray
    truth_ids: np.ndarray
    ids: np.ndarray
    truth_rows: np.ndarray
    columns: np.ndarray

    @property
    def union(self) -> np.ndarray:
        """Returns the number of points in one or both of true part g and predicted part p, f64 (G,P); never 0."""
        return self.truth_sizes[:, None] + self.sizes - self.shared


def overlap(truth: np.ndarray, part: np.ndarray) -> Overlap:
    """Returns the overlap of true and predicted ids, i (N) each; negative = in no part.

    >>> overlap(np.array([0, 0, 1, -1]), np.array([4, 7, 7, 7])).shared.tolist()
    [[1.0, 1.0], [0.0, 1.0]]
    """
    truth_ids, truth_rows = _compressed(truth)
    ids, columns = _compressed(part)
    both = (truth_rows >= 0) & (columns >= 0)
    cells = truth_rows[both] * len(ids) + columns[both]
    shared = np.bincount(cells, minlength=len(truth_ids) * len(ids)).reshape(len(truth_ids), len(ids))
    sizes = [
        np.bincount(rows[rows >= 0], minlength=len(own)).astype(np.float64)
        for rows, own in ((truth_rows, truth_ids), (columns, ids))
    ]
    return Overlap(shared.astype(np.float64), *sizes, truth_ids, ids, truth_rows, columns)


def _compressed(ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ids that occur, ascending, and the index of each point's id among them; -1 for negative ids."""
    inside = ids >= 0
    known = ids[inside]
    largest = int(known.max()) if len(known) else -1
    rows = np.full(len(ids), -1)
    if largest > _LARGEST_TABLE * len(ids):
        found = np.unique(known)
        rows[inside] = np.searchsorted(found, known)
        return found, rows
    occurs = np.zeros(largest + 1, bool)
    occurs[known] = True
    rows[inside] = (np.cumsum(occurs) - 1)[known]
    return np.flatnonzero(occurs).astype(ids.dtype), rows


def valid_points(truth: np.ndarray, ignore_below: int = 0) -> np.ndarray:
    """Returns which points have a known true part of at least `ignore_below` points, bool (N), from true ids i (N)."""
    known = truth >= 0
    if ignore_below <= 0 or not known.any():
        return known
    sizes = np.bincount(truth[known])
    return known & (sizes[np.where(known, truth, 0)] >= ignore_below)
