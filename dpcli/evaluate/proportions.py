"""Proportions and means where some entries are undefined: quotients, means, and the Wilson interval of a share."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np


def divide(numerator: np.ndarray | float, denominator: np.ndarray | float) -> np.ndarray:
    """Returns the element-wise quotient, f64 of the broadcast shape; 0/0 and x/0 are NaN.

    Every reader of a result takes NaN as "undefined", so no metric decides on its own what 0/0 is.

    >>> divide([3, 0, 1], [4, 0, 0]).tolist()
    [0.75, nan, nan]
    """
    top, bottom = np.broadcast_arrays(np.asarray(numerator, np.float64), np.asarray(denominator, np.float64))
    return np.divide(top, bottom, out=np.full(top.shape, np.nan), where=bottom != 0)


def mean_defined(values: np.ndarray) -> float:
    """Returns the mean over the entries that are defined (not NaN); NaN when there are none.

    >>> mean_defined(np.array([1.0, np.nan, 0.5]))
    0.75
    """
    defined = np.asarray(values)[~np.isnan(values)]
    return float(divide(defined.sum(), len(defined)))


def mean_defined_rows(values: np.ndarray) -> np.ndarray:
    """Returns `mean_defined` of each row of f (R,n), f64 (R)."""
    return divide(np.nansum(values, axis=1), (~np.isnan(values)).sum(axis=1))


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Returns the score interval of a proportion (Wilson 1927), two shares in [0, 1]; NaN, NaN without trials.

    Unlike the normal approximation it stays inside [0, 1] and has width at 0 % and 100 %. It takes the samples as
    independent; videos of the same subject are not, so the truth is wider.

    >>> [round(end, 4) for end in wilson_interval(9, 10)]
    [0.5958, 0.9821]
    """
    if trials == 0:
        return math.nan, math.nan
    share, z2 = successes / trials, NormalDist().inv_cdf(0.5 + confidence / 2) ** 2
    center = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = math.sqrt(share * (1 - share) * z2 / trials + (z2 / (2 * trials)) ** 2) / (1 + z2 / trials)
    return max(0.0, center - half), min(1.0, center + half)
