"""Proportions: the one owner of 0/0, and how far a measured one can be trusted."""

from __future__ import annotations

import math

import numpy as np

_NORMAL_95 = 1.959963984540054  # 97.5 % quantile of the standard normal distribution


def divide(numerator: np.ndarray | float, denominator: np.ndarray | float) -> np.ndarray:
    """Element-wise quotient in float64; 0/0 and x/0 are NaN, which every reader of a result takes as "undefined"."""
    top, bottom = np.broadcast_arrays(np.asarray(numerator, np.float64), np.asarray(denominator, np.float64))
    return np.divide(top, bottom, out=np.full(top.shape, np.nan), where=bottom != 0)


def mean_defined(values: np.ndarray) -> float:
    """Mean over the entries that are defined (not NaN); NaN when there are none."""
    defined = np.asarray(values)[~np.isnan(values)]
    return float(divide(defined.sum(), len(defined)))


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """95 % score interval of a proportion (Wilson 1927); NaN, NaN without trials.

    Unlike the normal approximation it stays inside [0, 1] and has width at 0 % and 100 %. It takes the samples as
    independent; videos of the same subject are not, so the truth is wider.
    """
    if trials == 0:
        return math.nan, math.nan
    share, z2 = successes / trials, _NORMAL_95**2
    center = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = math.sqrt(share * (1 - share) * z2 / trials + (z2 / (2 * trials)) ** 2) / (1 + z2 / trials)
    return max(0.0, center - half), min(1.0, center + half)
