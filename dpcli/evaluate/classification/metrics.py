"""Classification metrics: scores -> sufficient statistics -> metrics, so the statistics of shards add up exactly."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.proportions import divide, mean_defined, wilson_interval

TOP_K = 5


@dataclass(frozen=True)
class ClassificationStatistics:
    """All that the metrics need: confusion i64 (C,C), rows truth, columns prediction; hits within the k best scores."""

    confusion: np.ndarray
    top_hits: int
    top_k: int = TOP_K

    def __add__(self, other: ClassificationStatistics) -> ClassificationStatistics:
        """Statistics of both sets of samples together; ValueError when they are of different classes or k."""
        if self.confusion.shape != other.confusion.shape or self.top_k != other.top_k:
            raise ValueError(
                f"cannot add statistics of {len(self.confusion)} and {len(other.confusion)} classes, "
                f"top {self.top_k} and {other.top_k}"
            )
        return ClassificationStatistics(self.confusion + other.confusion, self.top_hits + other.top_hits, self.top_k)


@dataclass(frozen=True)
class ClassificationMetrics:
    """Shares lie in [0, 1]; NaN = undefined (0/0). Per-class arrays have shape (C,), in the order of the labels.

    accuracy: correct / samples, with `interval` its 95 % Wilson interval. balanced_accuracy: mean recall over the
    classes that occur. recall is what papers call per-class accuracy. macro_f1: mean over the classes that occur or
    were predicted. top_accuracy: truth among the `top_k` best scores; None when there are not more classes than that.
    """

    samples: int
    correct: int
    accuracy: float
    interval: tuple[float, float]
    balanced_accuracy: float
    macro_f1: float
    top_k: int
    top_accuracy: float | None
    support: np.ndarray
    predicted: np.ndarray
    hits: np.ndarray
    recall: np.ndarray
    precision: np.ndarray
    f1: np.ndarray
    confusion: np.ndarray


def predicted_labels(scores: np.ndarray) -> np.ndarray:
    """Best class of each row of scores (S,C), i64 (S); a tie goes to the lowest label."""
    return np.asarray(scores).argmax(axis=1)


def classification_update(scores: np.ndarray, labels: np.ndarray, top_k: int = TOP_K) -> ClassificationStatistics:
    """Statistics of some samples: scores f (S,C), labels i (S) in 0..C-1.

    Ties between equal scores go to the lower label, for the best class and for the k best.
    Raises DataError when there are no samples, shapes disagree, a score is not finite or a label is out of range.
    """
    scores, labels = np.asarray(scores), np.asarray(labels)
    _check(scores, labels)
    classes = scores.shape[1]
    cells = labels.astype(np.int64) * classes + predicted_labels(scores)
    confusion = np.bincount(cells, minlength=classes * classes).reshape(classes, classes)
    return ClassificationStatistics(confusion.astype(np.int64), int(top_hits(scores, labels, top_k).sum()), top_k)


def top_hits(scores: np.ndarray, labels: np.ndarray, top_k: int = TOP_K) -> np.ndarray:
    """Whether the true class is among the `top_k` best scores of each row, bool (S); ties go to the lower label."""
    return _ranks(scores, labels) < top_k


def _ranks(scores: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """How many classes come before the true one in each row, i64 (S)."""
    own = np.take_along_axis(scores, labels[:, None].astype(np.int64), axis=1)
    before = (scores > own) | ((scores == own) & (np.arange(scores.shape[1]) < labels[:, None]))
    return before.sum(axis=1)


def _check(scores: np.ndarray, labels: np.ndarray) -> None:
    if scores.ndim != 2 or labels.shape != scores.shape[:1]:
        raise DataError(f"scores {scores.shape} and labels {labels.shape}: expected (samples, classes) and (samples,)")
    if scores.size == 0:
        raise DataError("no samples to evaluate: a share of nothing is undefined")
    finite = np.isfinite(scores).all(axis=1)
    if not finite.all():
        raise DataError(
            f"{int((~finite).sum())} of {len(scores)} samples have NaN or infinite scores, "
            f"the first is number {int(finite.argmin())}"
        )
    wrong = (labels < 0) | (labels >= scores.shape[1])
    if wrong.any():
        first = int(wrong.argmax())
        raise DataError(f"label {labels[first]} of sample {first} is out of range; expected 0..{scores.shape[1] - 1}")


def classification_merge(parts: Iterable[ClassificationStatistics]) -> ClassificationStatistics:
    """Statistics of all parts together, equal to those of all samples at once. DataError without parts."""
    parts = list(parts)
    if not parts:
        raise DataError("no statistics to merge: evaluate at least one shard")
    return sum(parts[1:], parts[0])


def classification_compute(statistics: ClassificationStatistics) -> ClassificationMetrics:
    """Metrics from statistics. recall = hits / support, precision = hits / predicted, F1 their harmonic mean."""
    confusion = statistics.confusion
    support, predicted, hits = confusion.sum(axis=1), confusion.sum(axis=0), confusion.diagonal()
    samples, correct = int(support.sum()), int(hits.sum())
    f1 = divide(2 * hits, support + predicted)  # defined, 0, for a class that occurs but was never predicted
    recall = divide(hits, support)
    ranked = len(confusion) > statistics.top_k
    return ClassificationMetrics(
        samples=samples,
        correct=correct,
        accuracy=float(divide(correct, samples)),
        interval=wilson_interval(correct, samples),
        balanced_accuracy=mean_defined(recall),
        macro_f1=mean_defined(f1),
        top_k=statistics.top_k,
        top_accuracy=float(divide(statistics.top_hits, samples)) if ranked else None,
        support=support,
        predicted=predicted,
        hits=hits,
        recall=recall,
        precision=divide(hits, predicted),
        f1=f1,
        confusion=confusion,
    )


def classification_metrics(scores: np.ndarray, labels: np.ndarray, top_k: int = TOP_K) -> ClassificationMetrics:
    """Update and compute in one: scores f (S,C), labels i (S) in 0..C-1. Raises as `classification_update`."""
    return classification_compute(classification_update(scores, labels, top_k))
