"""Segmentation metrics: frames -> sufficient statistics -> metrics, so the statistics of shards add up exactly."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.proportions import divide, mean_defined
from dpcli.evaluate.segmentation.part_matching import FrameMatch, match_parts, mean_iou, rand_index

PROTOCOLS = ("dpc", "release")
RECALLS = np.linspace(0, 1, 101)
FLOOR = 1e-10  # of the published denominators


@dataclass(frozen=True)
class Frame:
    """One frame: true ids i (N), -1 = unknown; predicted hard ids i (N), -1 = none; probability f (N,K)."""

    truth: np.ndarray
    part: np.ndarray
    probability: np.ndarray


@dataclass(frozen=True)
class SegmentationStatistics:
    """All that the metrics need, concatenated over objects in the order they came.

    iou f64, matched bool, confidence f64 (P): the predictions that count; object_iou, object_rand f64 (O): mean over
    the frames of each object, NaN where no frame counts; truth_parts, frames, skipped: counted true parts and frames,
    and frames without truth; dropped: predictions on ignored ground; unknown: points without a true part.
    """

    iou: np.ndarray
    matched: np.ndarray
    confidence: np.ndarray
    object_iou: np.ndarray
    object_rand: np.ndarray
    truth_parts: int
    frames: int
    skipped: int
    dropped: int
    unknown: int

    def __add__(self, other: SegmentationStatistics) -> SegmentationStatistics:
        """Statistics of both sets of objects together."""
        return segmentation_merge([self, other])


@dataclass(frozen=True)
class SegmentationMetrics:
    """Shares lie in [0, 1] (with the published matching, recall and F1 can exceed 1); NaN = undefined (0/0).

    ap: average precision, pq: panoptic quality, f1, pre(cision), rec(all): at IoU 0.5, pooled over all frames.
    miou, ri (Rand index): mean over the frames of an object, then over objects.
    """

    ap: float
    pq: float
    f1: float
    pre: float
    rec: float
    miou: float
    ri: float
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
    """Statistics of one object, given its frames. Parts of fewer than `ignore_below` points are ignored.

    Frames without a true part that counts are skipped; protocol `release` (see `match_parts`, `mean_iou`) can't:
    DataError.
    """
    options = {"ignore_below": ignore_below, "release": _is_release(protocol)}
    matches: list[FrameMatch] = []
    ious, rands, skipped, present, unknown = [], [], 0, 0, 0
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
    joined = [
        np.concatenate([np.zeros(0, kind), *(getattr(match, key) for match in matches)])
        for key, kind in (("iou", np.float64), ("matched", bool), ("confidence", np.float64))
    ]
    means = [np.array([mean_defined(np.array(values))]) for values in (ious, rands)]
    parts = sum(match.truth_parts for match in matches)
    return SegmentationStatistics(*joined, *means, parts, len(matches), skipped, present - len(joined[0]), unknown)


def _is_release(protocol: str) -> bool:
    if protocol not in PROTOCOLS:
        raise ValueError(f"protocol {protocol!r}: expected one of {', '.join(PROTOCOLS)}")
    return protocol == "release"


def segmentation_merge(parts: Iterable[SegmentationStatistics]) -> SegmentationStatistics:
    """Statistics of all parts together, equal to those of all objects at once. DataError without parts."""
    parts = list(parts)
    if not parts:
        raise DataError("no statistics to merge: evaluate at least one sequence")
    columns = {own.name: [getattr(part, own.name) for part in parts] for own in fields(SegmentationStatistics)}
    return SegmentationStatistics(
        **{key: np.concatenate(rows) if isinstance(rows[0], np.ndarray) else sum(rows) for key, rows in columns.items()}
    )


def segmentation_compute(statistics: SegmentationStatistics, protocol: str = "dpc") -> SegmentationMetrics:
    """Metrics from statistics: F1 = 2 TP / (predictions + true parts), PQ = sum of TP's IoU / their mean number.

    `release` keeps the order of the predictions where confidences are equal (`dpc` counts them together) and takes
    0/0 as 0.
    """
    release = _is_release(protocol)
    matched, truth = statistics.matched, statistics.truth_parts
    hits, count = int(matched.sum()), len(matched)
    ap = average_precision(statistics.confidence, matched, truth, keep_order=release)
    ratio = (lambda top, bottom: top / max(bottom, FLOOR)) if release else (lambda a, b: float(divide(a, b)))
    precision, recall = ratio(hits, count), ratio(hits, truth)
    return SegmentationMetrics(
        ap=ap,
        pq=ratio(float(statistics.iou[matched].sum()), (count + truth) / 2),
        f1=ratio(2 * precision * recall, precision + recall) if release else ratio(2 * hits, count + truth),
        pre=precision,
        rec=recall,
        miou=mean_defined(statistics.object_iou),
        ri=mean_defined(statistics.object_rand),
        predictions=count,
        true_positives=hits,
        truth_parts=truth,
        frames=statistics.frames,
        skipped=statistics.skipped,
        dropped=statistics.dropped,
        unknown=statistics.unknown,
        objects=int((~np.isnan(statistics.object_iou)).sum()),
    )


def average_precision(
    confidence: np.ndarray, matched: np.ndarray, truth_parts: int, *, keep_order: bool = False
) -> float:
    """Mean of the precision envelope at recall 0, 0.01, ..., 1 (the 101 points of COCO); NaN without true parts.

    confidence f (P), matched bool (P). Predictions of equal confidence enter together, so their order doesn't matter;
    with `keep_order` one after the other in the given order, as the published code.
    """
    if truth_parts == 0:
        return np.nan
    order = np.argsort(-confidence, kind="stable")
    hits = np.cumsum(matched[order])
    recall, precision = hits / truth_parts, hits / np.arange(1, len(hits) + 1)
    if not keep_order:
        ends = np.append(np.diff(confidence[order]) != 0, True)[: len(hits)]
        recall, precision = recall[ends], precision[ends]
    envelope = np.append(np.maximum.accumulate(precision[::-1])[::-1], 0.0)
    return float(envelope[np.searchsorted(recall, RECALLS, side="left")].mean())
