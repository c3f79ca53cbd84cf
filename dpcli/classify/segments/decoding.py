"""The best division of a recording into segments of one class each, exact, by dynamic programming.

A hidden semi-Markov model with a least duration (Murphy 2002): the sum of each step's evidence for its segment's class,
less a cost for each change of class, is the greatest that any division into segments of at least that length reaches.
"""

from __future__ import annotations

import numpy as np


def best_path(evidence: np.ndarray, least: int, change: float) -> np.ndarray:
    """Returns the class of each step, i64 (N), of the best division.

    evidence: f (N,C), for each step and class, such as log probabilities; -inf forbids. least: steps that a segment lasts
    at least. change: cost of each change of class. A recording of fewer steps than `least` is one segment.

    >>> flicker = np.log(np.array([[0.9, 0.1], [0.9, 0.1], [0.4, 0.6], [0.9, 0.1], [0.1, 0.9], [0.1, 0.9]]))
    >>> best_path(flicker, least=2, change=0.0).tolist()
    [0, 0, 0, 0, 1, 1]
    """
    evidence = np.maximum(np.asarray(evidence, np.float64), -1e6)  # sums of -inf could not be compared
    steps, classes = evidence.shape
    if not steps:
        return np.zeros(0, np.int64)
    least = min(max(least, 1), steps)
    sums = np.vstack([np.zeros(classes), np.cumsum(evidence, 0)])
    value = np.full((steps + 1, classes), -np.inf)  # of the best division of the first t steps that ends with class c
    before = np.full((steps + 1, classes), -1, np.int64)  # class of the segment before, where one begins; else -1
    value[least] = sums[least]
    for t in range(least + 1, steps + 1):
        stay = value[t - 1] + evidence[t - 1]
        enter, come_from = _best_other(value[t - least])
        enter = enter - change + sums[t] - sums[t - least]
        value[t] = np.maximum(stay, enter)
        before[t] = np.where(enter > stay, come_from, -1)
    return _traced(value, before, least)


def _best_other(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns, for each class, the greatest value of another class and which class that is, f64 and i64 (C)."""
    best = int(value.argmax())
    others = value.copy()
    others[best] = -np.inf
    second = int(others.argmax())
    own = np.arange(len(value)) == best
    return np.where(own, others[second], value[best]), np.where(own, second, best)


def _traced(value: np.ndarray, before: np.ndarray, least: int) -> np.ndarray:
    """Returns the classes of the best division, i64 (N), from its end to its beginning."""
    t = len(value) - 1
    path = np.zeros(t, np.int64)
    label = int(value[t].argmax())
    while t > 0:
        come_from = int(before[t, label])
        if come_from >= 0:
            path[t - least : t] = label
            t, label = t - least, come_from
        elif t == least:
            path[:t] = label
            t = 0
        else:
            path[t - 1] = label
            t -= 1
    return path


def runs(path: np.ndarray) -> list[tuple[int, int]]:
    """Returns where runs of equal values begin and end (one past the last), in order.

    >>> runs(np.array([2, 2, 0, 0, 0]))
    [(0, 2), (2, 5)]
    """
    if not len(path):
        return []
    edges = [0, *(np.flatnonzero(np.diff(path)) + 1).tolist(), len(path)]
    return list(zip(edges, edges[1:]))
