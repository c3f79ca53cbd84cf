"""Segmentation metrics: frames -> sufficient statistics -> metrics, so the statistics of shards add up exactly.

`segmentation_compute` gives the metrics of all sequences, `segmentation_weighted` those of many resamples at once; both
take panoptic quality, F1, precision and recall from `part_scores`, and average precision from `average_precision.py`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import WeightedMetric, means_of_samples
from dpcli.evaluate.proportions import divide, mean_defined
from dpcli.evaluate.results import merge_statistics
from dpcli.evaluate.segmentation.average_precision import RankedPredictions, average_precision
from dpcli.evaluate.segmentation.part_matching import FrameMatch, match_parts, mean_iou
from dpcli.evaluate.segmentation.rand_index import adjusted_rand_index, rand_index

_RELEASE_FLOOR = 1e-10  # of the published denominators


@dataclass(frozen=True)
class Frame:
    """Holds one frame: true ids i (N), -1 = unknown; predicted hard ids i (N), -1 = none; probability f (N,K)."""

    truth: np.ndarray
    part: np.ndarray
    probability: np.ndarray


@dataclass(frozen=True)
class SegmentationStatistics:
    """Holds all that the metrics need, concatenated over objects (sequences) in the order they came.

    iou f64, matched bool, confidence f64 (P): the predictions that count; object_iou, object_rand, object_adjusted f64 (O):
    mean over the frames of each object, NaN where no frame counts; truth_parts, frames, skipped: counted true parts and frames,
    and frames without truth; dropped: predictions on ignored ground; unknown: points without a true part.
    """

    iou: np.ndarray
    matched: np.ndarray
    confidence: np.ndarray
    object_iou: np.ndarray
    object_rand: np.ndarray
    object_adjusted: np.ndarray
    truth_parts: int
    frames: int
    skipped: int
    dropped: int
    unknown: int


@dataclass(frozen=True)
class SegmentationMetrics:
    """Holds shares in [0, 1] (with the published matching, recall and F1 can exceed 1); NaN = undefined (0/0).

    ap: average precision, pq: panoptic quality, f1, pre(cision), rec(all): at IoU 0.5, pooled over all frames.
    miou, ri (Rand index), ari (adjusted Rand index): mean over the frames of an object, then over objects.
    """

    ap: float
    pq: float
    f1: float
    pre: float
    rec: float
    miou: float
    ri: float
    ari: float
    predictions: int
    true_positives: int
    truth_parts: int
    frames: int
    skipped: int
    dropped: int
    unknown: int
    objects: int


def segmentation_update(
    frames: Iterable[Frame], *, ignore_below: int = 0, protocol: str = "dpc"
) -> SegmentationStatistics:
    """Returns the statistics of one object, given its frames. True parts of fewer than `ignore_below` points are ignored.

    Frames without a true part that counts are skipped; protocol `release` (see `match_parts`, `mean_iou`) can't skip
    them and raises DataError.
    """
    options = {"ignore_below": ignore_below, "release": protocol == "release"}
    matches: list[FrameMatch] = []
    ious, rands, adjusted, skipped, present, unknown = [], [], [], 0, 0, 0
    for number, frame in enumerate(frames):
        unknown += int((frame.truth < 0).sum())
        match = match_parts(frame.truth, frame.part, frame.probability, **options)
        if match.truth_parts == 0:
            if protocol == "release":
                raise DataError(
                    f"frame {number} has no true part that counts, where the published protocol fails; "
                    "use --protocol dpc, which skips such frames"
                )
            skipped += 1
            continue
        matches.append(match)
        present += len(np.unique(frame.part[frame.part >= 0]))
        ious.append(mean_iou(frame.truth, frame.part, **options))
        rands.append(rand_index(frame.truth, frame.part, ignore_below=ignore_below))
        adjusted.append(adjusted_rand_index(frame.truth, frame.part, ignore_below=ignore_below))
    joined = [
        np.concatenate([np.zeros(0, kind), *(getattr(match, key) for match in matches)])
        for key, kind in (("iou", np.float64), ("matched", bool), ("confidence", np.float64))
    ]
    means = [np.array([mean_defined(np.array(values))]) for values in (ious, rands, adjusted)]
    parts = sum(match.truth_parts for match in matches)
    return SegmentationStatistics(*joined, *means, parts, len(matches), skipped, present - len(joined[0]), unknown)


def part_scores(
    true_positives: np.ndarray,
    predictions: np.ndarray,
    iou_sum: np.ndarray,  # of the true positives
    truth_parts: np.ndarray,
    protocol: str = "dpc",
) -> dict[str, np.ndarray]:
    """Returns PQ, F1, precision and recall from counts, which are numbers or arrays of one shape.

    PQ: the sum of the found parts' IoU over the mean number of predictions and true parts (Kirillov et al. 2019).
    F1 = 2 TP / (predictions + true parts). Protocol `release` takes F1 from precision and recall, and 0/0 as 0.

    >>> {key: round(float(value), 3) for key, value in part_scores(2, 3, 1.7, 2).items()}
    {'pq': 0.68, 'f1': 0.8, 'pre': 0.667, 'rec': 1.0}
    """
    release = protocol == "release"
    ratio = _floored_ratio if release else divide
    precision, recall = ratio(true_positives, predictions), ratio(true_positives, truth_parts)
    return {
        "pq": ratio(iou_sum, (predictions + truth_parts) / 2),
        "f1": ratio(2 * precision * recall, precision + recall)
        if release
        else ratio(2 * true_positives, predictions + truth_parts),
        "pre": precision,
        "rec": recall,
    }


def _floored_ratio(top: np.ndarray, bottom: np.ndarray) -> np.ndarray:
    return top / np.maximum(bottom, _RELEASE_FLOOR)


def segmentation_compute(statistics: SegmentationStatistics, protocol: str = "dpc") -> SegmentationMetrics:
    """Returns the metrics that statistics stand for.

    `release` keeps the order of the predictions where confidences are equal (`dpc` counts them together), and takes 0/0
    as 0 (see `part_scores`).
    """
    matched, truth = statistics.matched, statistics.truth_parts
    hits, count = int(matched.sum()), len(matched)
    scores = part_scores(hits, count, float(statistics.iou[matched].sum()), truth, protocol)
    return SegmentationMetrics(
        ap=average_precision(statistics.confidence, matched, truth, keep_order=protocol == "release"),
        **{key: float(value) for key, value in scores.items()},
        miou=mean_defined(statistics.object_iou),
        ri=mean_defined(statistics.object_rand),
        ari=mean_defined(statistics.object_adjusted),
        predictions=count,
        true_positives=hits,
        truth_parts=truth,
        frames=statistics.frames,
        skipped=statistics.skipped,
        dropped=statistics.dropped,
        unknown=statistics.unknown,
        objects=int((~np.isnan(statistics.object_iou)).sum()),
    )


def segmentation_weighted(sequences: Sequence[SegmentationStatistics], protocol: str = "dpc") -> WeightedMetric:
    """Returns ap, pq, f1, pre, rec, miou, ri and ari as functions of how often each sequence counts.

    sequences: the statistics of each one.
    """
    whole = merge_statistics(sequences)
    sequence = np.repeat(np.arange(len(sequences)), [len(one.iou) for one in sequences])
    hits, predictions, iou = (
        np.bincount(sequence, weights, len(sequences)) for weights in (whole.matched, None, whole.iou * whole.matched)
    )
    truth_parts = [one.truth_parts for one in sequences]
    sums = np.stack([hits, predictions, iou, truth_parts], axis=1).astype(np.float64)
    over_sequences = means_of_samples({"miou": whole.object_iou, "ri": whole.object_rand, "ari": whole.object_adjusted})
    ranked = RankedPredictions(whole.confidence, whole.matched, sequence, keep_order=protocol == "release")

    def metric(counts: np.ndarray) -> dict[str, np.ndarray]:
        totals = (counts @ sums).T
        precision = ranked.average_precision(counts, totals[3])
        return {"ap": precision, **part_scores(*totals, protocol), **over_sequences(counts)}

    return metric
