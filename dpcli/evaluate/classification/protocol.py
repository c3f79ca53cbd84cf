"""The classification protocol: which samples of a scores file count, and against which labels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import NO_INTERVALS, Interval, Resampling, WeightedMetric
from dpcli.evaluate.classification.calibration import Calibration, are_probabilities, calibrate, calibration_weighted
from dpcli.evaluate.classification.metrics import (
    ClassificationMetrics,
    classification_metrics,
    classification_weighted,
    predicted_labels,
)
from dpcli.evaluate.classification.truth_labels import TruthLabels, labels_in_file, match_labels
from dpcli.evaluate.results import LeftOut, counted_split, left_out, tell_split
from dpcli.runtime.progress import log
from dpcli.store import ScoresReader

FUSED = "fused"  # the file's main scores, when it also holds those of single streams


@dataclass
class ClassificationReport:
    """Holds the metrics of every stream on the same samples; `streams` ends with the main scores.

    names, labels i (S): the samples that count; scores f (S,C): the main scores of them. intervals: by stream and
    metric, empty without `resampling`. calibration: by stream, None where the scores are no probabilities.
    """

    class_names: list[str]
    split: str
    truth: str
    streams: dict[str, ClassificationMetrics]
    left_out: list[LeftOut]
    names: list[str]
    labels: np.ndarray
    scores: np.ndarray
    resampling: Resampling
    intervals: dict[str, dict[str, Interval]]
    calibration: dict[str, Calibration | None]
    rejected: np.ndarray | None  # bool (S), of the samples that count
    provenance: list[dict]

    @property
    def accepted(self) -> tuple[int, int] | None:
        """Returns how many samples are not rejected and how many of those the main scores get right; None: none could be."""
        if self.rejected is None:
            return None
        kept = ~self.rejected
        return int(kept.sum()), int((predicted_labels(self.scores[kept]) == self.labels[kept]).sum())

    @property
    def main(self) -> ClassificationMetrics:
        """Returns the metrics of the main scores."""
        return list(self.streams.values())[-1]


def evaluate_classification(
    path: str | Path,
    truth: str | Path | None = None,
    split: str | None = None,
    *,
    intersect: bool = False,
    resampling: Resampling = NO_INTERVALS,
) -> ClassificationReport:
    """Returns the metrics of a scores file.

    split: only its samples; "all" takes every one; None takes "test" when the file has such samples, else all.
    truth: a clouds file whose labels and splits, matched by name, replace those of the scores file.
    resampling: how to find the intervals; without it there are none but that of the accuracy.
    Raises DataError when nothing is left, the split doesn't exist, or truth and scores don't hold the same samples
    (with `intersect` those on one side only are left out) and classes.
    """
    scores = ScoresReader(path)
    if not scores.names:
        raise DataError(f"{path}: holds no samples; predict again")
    found = labels_in_file(scores) if truth is None else match_labels(scores, truth, split, intersect)
    tell_split(truth or path, split, found.splits)
    split = counted_split(split, found.splits)
    keep, others = _choose_samples(scores, found, split)
    labels = found.labels[keep]
    _tell_first_label(truth or path, scores.scores[keep], labels)
    streams = {name: rows[keep] for name, rows in _streams(scores).items()}
    return ClassificationReport(
        class_names=scores.class_names,
        split=split,
        truth=str(truth) if truth is not None else "labels in the scores file",
        streams={
            name: classification_metrics(rows, labels, confidence=resampling.confidence)
            for name, rows in streams.items()
        },
        left_out=others,
        names=_names(scores, keep),
        labels=labels,
        scores=scores.scores[keep],
        resampling=resampling,
        intervals={name: resampling.intervals(_metric(rows, labels), len(labels)) for name, rows in streams.items()},
        rejected=None if scores.rejected is None else scores.rejected[keep],
        provenance=scores.provenance,
        calibration={name: calibrate(rows, labels) for name, rows in streams.items()},
    )


def _tell_first_label(where: str | Path, scores: np.ndarray, labels: np.ndarray) -> None:
    """Warns where labels (S) that are all one lower or higher would fit the scores (S,C) far better, as where one side counts
    from 1 and the other from 0, and a class at the end that nobody has hides it.
    """
    best = scores.argmax(1)
    right = int(np.count_nonzero(best == labels))
    for step, free in ((-1, labels.min() > 0), (1, labels.max() < scores.shape[1] - 1)):
        moved = int(np.count_nonzero(best == labels + step))
        if free and moved - right > 3 * (moved + right) ** 0.5:
            log.warn(
                f"{where}: {moved} of {len(labels)} samples would be right if all labels were one {'lower' if step < 0 else 'higher'},"
                f" {right} are as they stand; does one side count classes from 1? Labels count from 0"
            )


def _metric(scores: np.ndarray, labels: np.ndarray) -> WeightedMetric:
    """Returns all metrics of scores as functions of how often each sample counts."""
    parts = [classification_weighted(scores, labels)]
    if are_probabilities(scores):
        parts.append(calibration_weighted(scores, labels))
    return lambda counts: {key: value for part in parts for key, value in part(counts).items()}


def _choose_samples(scores: ScoresReader, found: TruthLabels, split: str) -> tuple[np.ndarray, list[LeftOut]]:
    """Returns which samples count, bool (S), and which don't and why. Raises DataError when none does."""
    of_split = found.in_truth & np.array([split in ("all", own) for own in found.splits], bool)
    if not of_split.any():
        known = ", ".join(sorted({own or '""' for own in found.splits})) or "no samples"
        raise DataError(
            f"{scores.path}: no sample of split {split!r}; the file has {known} (--split all takes every one)"
        )
    labeled = found.labels >= 0
    keep = of_split & labeled
    if not keep.any():
        count = int(of_split.sum())
        raise DataError(f"{scores.path}: {counted(count, 'sample')} without a label; give the truth with --truth FILE")
    others = {
        f"not of split {split!r}": _names(scores, found.in_truth & ~of_split),
        "unknown label (-1)": _names(scores, of_split & ~labeled),
    }
    return keep, [*found.left_out, *left_out(others)]


def _names(scores: ScoresReader, chosen: np.ndarray) -> list[str]:
    return [scores.names[index] for index in np.flatnonzero(chosen)]


def _streams(scores: ScoresReader) -> dict[str, np.ndarray]:
    """Returns single streams in the order they are trained (static, dynamic, others), then the main scores."""
    single = {name: scores.streams[name] for name in scores.stream_names if name != FUSED}
    return {**single, FUSED if single else "scores": scores.scores}
