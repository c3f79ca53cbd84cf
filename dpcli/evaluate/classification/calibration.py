"""Calibration: whether the probability of the best class is the share of the samples that are right at that probability.

Expected calibration error of Naeini et al. (2015) as Guo et al. (2017) report it: the probability of the best class falls
into one of 15 bins of equal width; the error is the mean over samples of |share right - mean probability| of their bin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.evaluate.bootstrap import WeightedMetric
from dpcli.evaluate.proportions import divide
from dpcli.runtime.seeds import generator

BINS = 15
_ONE = 1e-3  # how far a sum of probabilities may be from 1
_DRAWS = 1000  # of answers, to find the error that chance alone makes


@dataclass(frozen=True)
class Calibration:
    """Holds the reliability of some samples: error, a share in [0, 1], and for each bin, NaN where it is empty, arrays (15).

    by_chance: the mean error of as many samples of just these probabilities if they were perfectly calibrated; less than
    this can't be told from none. samples i64: of each bin. confidence, accuracy f64: mean probability, and share right.
    """

    error: float
    by_chance: float
    samples: np.ndarray
    confidence: np.ndarray
    accuracy: np.ndarray


def are_probabilities(scores: np.ndarray) -> bool:
    """Returns whether each row of scores f (S,C) is a distribution: none below 0, sum 1 within 0.001."""
    return bool(scores.size and scores.min() >= 0 and np.abs(scores.sum(1, dtype=np.float64) - 1).max() < _ONE)


def calibrate(scores: np.ndarray, labels: np.ndarray) -> Calibration | None:
    """Returns the reliability of probabilities f (S,C) for labels i (S); None where the scores are no probabilities.

    >>> scores = np.array([[0.9, 0.1], [0.9, 0.1], [0.2, 0.8], [0.3, 0.7]])
    >>> round(calibrate(scores, np.array([0, 1, 1, 1])).error, 3)  # 0.9 is right half the time; 0.8 and 0.7 always
    0.325
    """
    if not are_probabilities(scores):
        return None
    confidence, right, bins = _best(scores, labels)
    samples = np.bincount(bins, minlength=BINS)
    sums = [np.bincount(bins, weights=values, minlength=BINS) for values in (confidence, right)]
    rng = generator(0)
    answers = ((rng.random(len(bins)) < confidence).astype(np.float64) for _ in range(_DRAWS))  # one draw in memory
    chance = np.stack([np.bincount(bins, weights=own - confidence, minlength=BINS) for own in answers])
    return Calibration(
        error=float(np.abs(sums[1] - sums[0]).sum() / len(bins)),
        by_chance=float(np.abs(chance).sum(1).mean() / len(bins)),
        samples=samples,
        confidence=divide(sums[0], samples),
        accuracy=divide(sums[1], samples),
    )


def calibration_weighted(scores: np.ndarray, labels: np.ndarray) -> WeightedMetric:
    """Returns the calibration error of probabilities f (S,C) and labels i (S) as a function of how often each sample counts."""
    confidence, right, bins = _best(scores, labels)
    gaps = np.eye(BINS)[bins] * (right - confidence)[:, None]

    def metric(counts: np.ndarray) -> dict[str, np.ndarray]:
        return {"calibration_error": divide(np.abs(counts @ gaps).sum(1), counts.sum(1))}

    return metric


def _best(scores: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns each sample's best probability f64, whether it is right (0 or 1) f64, and its bin i64, (S) each; bin b holds what
    is above b / 15 up to (b + 1) / 15."""
    confidence = np.clip(scores.max(1).astype(np.float64), 0, 1)
    bins = np.clip(np.ceil(confidence * BINS).astype(np.int64) - 1, 0, BINS - 1)
    return confidence, (scores.argmax(1) == labels).astype(np.float64), bins
