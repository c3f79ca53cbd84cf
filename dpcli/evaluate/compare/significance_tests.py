"""Tests of whether chance explains a difference: McNemar's exact test and Wilcoxon's signed-rank test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class McNemar:
    """Holds the samples that only A, only B gets right, and the exact two-sided p value of "equally many" (McNemar 1947)."""

    only_a: int
    only_b: int
    p: float


def wilcoxon_signed_rank(apart: np.ndarray) -> float:
    """Returns the p value of the signed-rank test (Wilcoxon 1945) of differences f64 (n), those of 0 left out.

    It is 1 where nothing differs, NaN without differences.

    >>> wilcoxon_signed_rank(np.array([1.0, 2.0, 3.0, 4.0, 0.0]))
    0.125
    """
    if len(apart) == 0:
        return float("nan")
    apart = apart[apart != 0]
    if len(apart) == 0:
        return 1.0
    from scipy.stats import wilcoxon

    return float(wilcoxon(apart).pvalue)


def mcnemar(only_a: int, only_b: int) -> McNemar:
    """Tests the samples on which two classifiers disagree exactly: binomial with share 1/2; p = 1 without any.

    >>> mcnemar(5, 0).p
    0.0625
    """
    from scipy.stats import binomtest

    total = only_a + only_b
    return McNemar(only_a, only_b, float(binomtest(only_a, total, 0.5).pvalue) if total else 1.0)
