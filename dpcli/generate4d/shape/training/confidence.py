"""The confidence of a shape network: the probability that it is better than the inflation, fitted on held-out models."""

from __future__ import annotations

import numpy as np

_PULL = 0.1  # toward a slope of 0: few pictures say little


def calibrate(claimed: np.ndarray, better: np.ndarray, rounds: int = 30) -> tuple[float, float]:
    """Returns slope and offset of p = 1 / (1 + exp(-(slope x claimed + offset))) by Newton's method.

    claimed (N): gains that the network claims. better bool (N): whether its layers had the smaller error.
    """
    rows = np.stack([claimed, np.ones(len(claimed))], 1).astype(np.float64)
    at = np.zeros(2)
    for _ in range(rounds):
        share = 1 / (1 + np.exp(-rows @ at))
        slope = rows.T @ (better - share) - _PULL * at
        bend = (rows * (share * (1 - share))[:, None]).T @ rows + _PULL * np.eye(2)
        at = at + np.clip(np.linalg.solve(bend, slope), -2, 2)
    return float(at[0]), float(at[1])


def probability(claimed: float, slope: float, offset: float) -> float:
    """Returns the confidence 0..1 that a claimed gain stands for."""
    return float(1 / (1 + np.exp(-(slope * claimed + offset))))
