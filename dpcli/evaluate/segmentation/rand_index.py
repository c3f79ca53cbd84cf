"""Rand index and adjusted Rand index: on how many pairs of points two groupings agree."""

from __future__ import annotations

import numpy as np

from dpcli.evaluate.segmentation.part_overlap import overlap, valid_points


def rand_index(truth: np.ndarray, part: np.ndarray, *, ignore_below: int = 0) -> float:
    """Returns the share of ordered point pairs, a point with itself among them, on which "same part" agrees.

    So has OGC's code; the index of Rand 1971 has no such pairs and is lower by (1 - it) / N.

    Ids i (N) each. Predicted -1 is one more group; unknown points and those of true parts of fewer than `ignore_below`
    points are taken out. NaN when nothing is left.

    >>> rand_index(np.array([0, 0, 1, 1]), np.array([5, 5, 5, 7]))
    0.625
    """
    valid = valid_points(truth, ignore_below)
    count = int(valid.sum())
    if count == 0:
        return np.nan
    found = overlap(truth[valid], part[valid].astype(np.int64) + 1)
    squares = [float((sizes**2).sum()) for sizes in (found.truth_sizes, found.sizes, found.shared)]
    return 1 - (squares[0] + squares[1] - 2 * squares[2]) / count**2


def adjusted_rand_index(truth: np.ndarray, part: np.ndarray, *, ignore_below: int = 0) -> float:
    """Returns the Rand index less its expectation under random labels, over its largest value less that.

    Hubert & Arabie 1985. Ids i (N) each, taken as `rand_index` does. It is 1 for equal groupings, also where both are one
    group or all single points (0/0); NaN without points.

    >>> round(adjusted_rand_index(np.array([0, 0, 1, 1]), np.array([5, 5, 5, 7])), 4)
    0.0
    >>> adjusted_rand_index(np.array([0, 0, 1, 1]), np.array([3, 3, 2, 2]))
    1.0
    """
    known = valid_points(truth, ignore_below)
    if not known.any():
        return np.nan
    found = overlap(truth[known], part[known].astype(np.int64) + 1)
    together, rows, columns = (float((n * (n - 1)).sum()) for n in (found.shared, found.truth_sizes, found.sizes))
    every = float(known.sum()) * (float(known.sum()) - 1)
    expected = rows * columns / every if every else 0.0
    largest = 0.5 * (rows + columns)
    return 1.0 if largest == expected else float((together - expected) / (largest - expected))
