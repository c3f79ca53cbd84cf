"""Even thinning: some of many rows at equal steps, the same ones every time."""

from __future__ import annotations

import numpy as np


def spread_places(count: int, most: int) -> np.ndarray:
    """Returns at most `most` of the numbers 0 to count - 1, i64, ascending and evenly spread, rounded down.

    >>> spread_places(9, 3).tolist(), spread_places(2, 5).tolist(), spread_places(0, 4).tolist()
    ([0, 4, 8], [0, 1], [])
    """
    return np.linspace(0, count - 1, min(count, most)).astype(int)


def thin_evenly(rows: np.ndarray, most: int) -> np.ndarray:
    """Returns at most `most` of the rows (N,...), evenly spread over them."""
    return rows[spread_places(len(rows), most)]
