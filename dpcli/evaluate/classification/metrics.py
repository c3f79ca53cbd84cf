"""Classification metrics: scores -> sufficient statistics -> metrics, so the statistics of shards add up exactly.

`classification_compute` gives the metrics of all samples, `classification_weighted` those of many resamples at once;
both take balanced accuracy and macro F1 from the same functions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import WeightedMetric, means_of_samples
from dpcli.evaluate.choices import TOP_K
from dpcli.evaluate.proportions import divide, mean_defined, mean_defined_rows, wilson_interval


@dataclass(frozen=True)
class ClassificationStatistics:
    """Holds all that the metrics need of some samples.

    confusion: the confusion matrix i64 (C,C), rows truth, columns prediction. top_hits: samples whose true class is
    among the TOP_K best scores.
    """

    confusion: np.ndarray
    top_hits: int

    def __add__(self, other: ClassificationStatistics) -> ClassificationStatistics:
        """Returns the statistics of both sets of samples together; ValueError for different classes."""
        if self.confusion.shape != other.confusion.shape:
            raise ValueError(f"cannot add statistics of {len(self.confusion)} and {len(other.confusion)} classes")
        return ClassificationStatistics(self.confusion + other.confusion, self.top_hits + other.top_hits)


@dataclass(frozen=True)
class ClassificationMetrics:
    """Holds shares in [0, 1], NaN = undefined (0/0), and per-class arrays (C,) in the order of the labels.

    accuracy: correct / samples, with `interval` its Wilson interval. balanced_accuracy: mean recall over the classes
    that occur. recall: what papers call per-class accuracy. macro_f1: mean over the classes that occur or were
    predicted. top_accuracy: truth among the TOP_K best scores; None when there are not more classes than that.
    support, predicted, hits: samples of each class, predictions of it, and right ones.
    """

    samples: int
    correct: int
    accuracy: float
    interval: tuple[float, float]
    balanced_accuracy: float
    macro_f1: float
    top_accuracy: float | None
    support: np.ndarray
    predicted: np.ndarray
    hits: np.ndarray
    recall: np.ndarray
    precision: np.ndarray
    f1: np.ndarray
    confusion: np.ndarray


def predicted_labels(scores: np.ndarray) -> np.ndarray:
    """Returns the best class of each row of scores f (S,C), i64 (S); a tie goes to the lowest label.

    >>> predicted_labels(np.array([[0.1, 0.9], [0.5, 0.5]])).tolist()
    [1, 0]
    """
    return np.asarray(scores).argmax(axis=1)


def classification_update(scores: np.ndarray, labels: np.ndarray) -> ClassificationStatistics:
    """Returns the statistics of some samples: scores f (S,C), labels i (S) in 0..C-1.

    Ties between equal scores go to the lower label, for the best class and for the k best.
    Raises DataError when there are no samples, shapes disagree, a score is not finite or a label is out of range.

    >>> found = classification_update(np.array([[0.9, 0.1], [0.2, 0.8], [0.7, 0.3]]), np.array([0, 1, 1]))
    >>> found.confusion.tolist()
    [[1, 0], [1, 1]]
    """
    scores, labels = np.asarray(scores), np.asarray(labels)
    _check(scores, labels)
    classes = scores.shape[1]
    cells = labels.astype(np.int64) * classes + predicted_labels(scores)
    confusion = np.bincount(cells, minlength=classes * classes).reshape(classes, classes)
    return ClassificationStatistics(confusion.astype(np.int64), int(top_hits(scores, labels).sum()))


def top_hits(scores: np.ndarray, labels: np.ndarray, top_k: int = TOP_K) -> np.ndarray:
    """Returns whether the true class is among the `top_k` best scores of each row, bool (S).

    scores f (S,C), labels i (S); a tie goes to the lower label.

    >>> top_hits(np.array([[0.5, 0.3, 0.2], [0.5, 0.3, 0.2]]), np.array([1, 2]), top_k=2).tolist()
    [True, False]
    """
    own = np.take_along_axis(scores, labels[:, None].astype(np.int64), axis=1)
    before = (scores > own) | ((scores == own) & (np.arange(scores.shape[1]) < labels[:, None]))
    return before.sum(axis=1) < top_k


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


def class_recall(hits: np.ndarray, support: np.ndarray) -> np.ndarray:
    """Returns the share of each class's samples that were recognized, f64 (...,C); NaN for a class that doesn't occur."""
    return divide(hits, support)


def class_f1(hits: np.ndarray, support: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Returns the F1 score of each class, f64 (...,C): the harmonic mean of its recall and precision.

    It is 0 for a class that occurs and was never predicted, NaN for one that neither occurs nor was predicted.

    >>> class_f1(np.array([1, 0]), np.array([1, 2]), np.array([3, 0])).tolist()
    [0.5, 0.0]
    """
    return divide(2 * hits, support + predicted)


def classification_compute(statistics: ClassificationStatistics, confidence: float = 0.95) -> ClassificationMetrics:
    """Returns the metrics that statistics stand for; confidence: of the Wilson interval of the accuracy."""
    confusion = statistics.confusion
    support, predicted, hits = confusion.sum(axis=1), confusion.sum(axis=0), confusion.diagonal()
    samples, correct = int(support.sum()), int(hits.sum())
    recall, f1 = class_recall(hits, support), class_f1(hits, support, predicted)
    ranked = len(confusion) > TOP_K
    return ClassificationMetrics(
        samples=samples,
        correct=correct,
        accuracy=float(divide(correct, samples)),
        interval=wilson_interval(correct, samples, confidence),
        balanced_accuracy=mean_defined(recall),
        macro_f1=mean_defined(f1),
        top_accuracy=float(divide(statistics.top_hits, samples)) if ranked else None,
        support=support,
        predicted=predicted,
        hits=hits,
        recall=recall,
        precision=divide(hits, predicted),
        f1=f1,
        confusion=confusion,
    )


def classification_metrics(scores: np.ndarray, labels: np.ndarray, confidence: float = 0.95) -> ClassificationMetrics:
    """Returns the metrics of scores f (S,C) and labels i (S) in 0..C-1. Raises as `classification_update`.

    >>> found = classification_metrics(np.array([[0.9, 0.1], [0.2, 0.8], [0.7, 0.3]]), np.array([0, 1, 1]))
    >>> found.correct, found.samples, found.balanced_accuracy
    (2, 3, 0.75)
    >>> [round(end, 3) for end in found.interval]
    [0.208, 0.939]
    """
    return classification_compute(classification_update(scores, labels), confidence)


def classification_weighted(scores: np.ndarray, labels: np.ndarray) -> WeightedMetric:
    """Returns the metrics of scores f (S,C) and labels i (S) as functions of how often each sample counts.

    They are accuracy, balanced_accuracy, macro_f1 and, where there are more classes than TOP_K, top-k accuracy.
    """
    classes = scores.shape[1]
    best = predicted_labels(scores)
    # samples of equal truth and prediction are alike: counts are summed over these cells, then over classes
    cells, order = np.unique(labels.astype(np.int64) * classes + best, return_inverse=True)
    of_truth, of_prediction = cells // classes, cells % classes
    right = np.flatnonzero(of_truth == of_prediction)
    sort = np.argsort(order, kind="stable")
    starts = np.searchsorted(order[sort], np.arange(len(cells)))
    shares = {"accuracy": best == labels}
    if classes > TOP_K:
        shares[f"top{TOP_K}_accuracy"] = top_hits(scores, labels)
    share_of_samples = means_of_samples({key: hit.astype(np.float64) for key, hit in shares.items()})

    def metric(counts: np.ndarray) -> dict[str, np.ndarray]:
        summed = np.add.reduceat(counts[:, sort], starts, axis=1)
        support, predicted = (_class_sums(summed, of, classes) for of in (of_truth, of_prediction))
        hits = np.zeros_like(support)
        hits[:, of_truth[right]] = summed[:, right]
        return share_of_samples(counts) | {
            "balanced_accuracy": mean_defined_rows(class_recall(hits, support)),
            "macro_f1": mean_defined_rows(class_f1(hits, support, predicted)),
        }

    return metric


def _class_sums(values: np.ndarray, labels: np.ndarray, classes: int) -> np.ndarray:
    """Returns the sums of the columns of each class, f64 (R,classes), of values f64 (R,N) whose columns are of labels i64 (N)."""
    order = np.argsort(labels, kind="stable")
    present, starts = np.unique(labels[order], return_index=True)
    sums = np.zeros((len(values), classes))
    sums[:, present] = np.add.reduceat(values[:, order], starts, axis=1)
    return sums
