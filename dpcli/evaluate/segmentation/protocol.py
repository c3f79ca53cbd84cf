"""The segmentation protocol: which frames of a parts file count, against which truth, and the result as data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.bootstrap import Interval, Resampling
from dpcli.evaluate.classification.protocol import LeftOut, intervals_json, samples_json
from dpcli.evaluate.compare.resampled import segmentation_weighted
from dpcli.evaluate.segmentation.metrics import (
    PROTOCOLS,
    Frame,
    SegmentationMetrics,
    SegmentationStatistics,
    segmentation_compute,
    segmentation_merge,
    segmentation_update,
)
from dpcli.evaluate.segmentation.truth_pairing import Compared, Comparison

SHARES = ("ap", "pq", "f1", "pre", "rec", "miou", "ri")
FIXES = (
    "parts are matched one to one (release: two predictions of IoU exactly 0.5 both find the same part)",
    "a true part that has no points in a frame doesn't count there (release: it scores 0 in mIoU)",
    "a confidence is the mean over the part's own points (release: over other points once a prediction was dropped)",
    "frames without a true part are skipped (release: fails)",
    "predictions of equal confidence enter AP together (release: in the order of the file)",
)


@dataclass
class SegmentationReport:
    """Metrics of all sequences, and of those of each label that occurs; `objects` has what pictures need.

    names, sequences: each sequence that counts and its statistics; intervals: by metric, empty without `resampling`.
    """

    protocol: str
    ignore_below: int
    split: str
    truth: str
    main: SegmentationMetrics
    objects: SegmentationStatistics
    classes: dict[int, SegmentationMetrics]
    class_names: list[str]
    left_out: list[LeftOut]
    names: list[str] = field(default_factory=list)
    sequences: list[SegmentationStatistics] = field(default_factory=list)
    resampling: Resampling = field(default_factory=lambda: Resampling(0))
    intervals: dict[str, Interval] = field(default_factory=dict)


def evaluate_segmentation(
    path: str | Path,
    truth: str | Path,
    *,
    protocol: str = "dpc",
    ignore_below: int = 0,
    split: str | None = None,
    intersect: bool = False,
    resampling: Resampling | None = None,
) -> SegmentationReport:
    """Metrics of a parts file against the `part` of a clouds file; all frames of all sequences that count.

    `protocol`: "dpc", or "release" with the quirks of the published code (FIXES lists the differences). `ignore_below`:
    true parts of fewer points are ignored. `split`, `intersect` and DataErrors as `Comparison`. `resampling`: how to find
    the intervals; without it there are none.
    """
    if protocol not in PROTOCOLS:
        raise UsageError(f"--protocol {protocol}: expected {' or '.join(PROTOCOLS)}")
    names, labels, found = [], [], []
    resampling = resampling or Resampling(0)
    with Comparison(path, truth, split=split, intersect=intersect) as comparison:
        for compared in comparison:
            names.append(compared.truth.name)
            labels.append(compared.truth.label)
            found.append(_object(compared, protocol, ignore_below))
        left_out, split = comparison.left_out, comparison.split
        class_names = comparison.truth.class_names
    main = segmentation_merge(found)
    if main.frames == 0:
        raise DataError(
            f"{truth}: not one frame has a true part" + (f" of at least {ignore_below} points" if ignore_below else "")
        )
    return SegmentationReport(
        protocol,
        ignore_below,
        split,
        str(truth),
        segmentation_compute(main, protocol),
        main,
        _by_class(labels, found, protocol),
        class_names,
        left_out,
        names,
        found,
        resampling,
        resampling.intervals(segmentation_weighted(found, protocol), len(found)),
    )


def _object(compared: Compared, protocol: str, ignore_below: int) -> SegmentationStatistics:
    offsets = compared.truth.frame_offsets
    spans = [slice(int(a), int(b)) for a, b in zip(offsets[:-1], offsets[1:], strict=True)]
    truths = [compared.truth.part[span] for span in spans]
    if protocol == "release":
        truths = compressed_over_pairs(truths)
    frames = [
        Frame(ids, compared.predicted.part[span], compared.said.probability[span])
        for ids, span in zip(truths, spans, strict=True)
    ]
    try:
        return segmentation_update(frames, ignore_below=ignore_below, protocol=protocol)
    except DataError as error:
        raise DataError(f"{compared.truth.name!r}: {error}") from None


def compressed_over_pairs(frames: Sequence[np.ndarray]) -> list[np.ndarray]:
    """True ids i (N) of each frame, counted from 0 over the ids of the frame and its partner; negative ones stay.

    The partner is the next frame, of the last one the frame before, as in the published list of pairs.
    """
    made = []
    for t, ids in enumerate(frames):
        partner = frames[t + 1] if t + 1 < len(frames) else frames[max(t - 1, 0)]
        occurring = np.unique(np.concatenate([ids, partner]))
        made.append(np.where(ids >= 0, np.searchsorted(occurring[occurring >= 0], ids), -1))
    return made


def _by_class(labels: list[int], found: list[SegmentationStatistics], protocol: str) -> dict[int, SegmentationMetrics]:
    return {
        label: segmentation_compute(
            segmentation_merge(one for own, one in zip(labels, found, strict=True) if own == label), protocol
        )
        for label in sorted({label for label in labels if label >= 0})
    }


def segmentation_json(report: SegmentationReport, source: str, provenance: Sequence[dict] = ()) -> dict[str, Any]:
    """One object for `--json`: numbers under `metrics`, None where a number is undefined (0/0)."""
    names = report.class_names
    return {
        "task": "segmentation",
        "input": source,
        "protocol": {
            "name": report.protocol,
            "split": report.split,
            "truth": report.truth,
            "iou_threshold": 0.5,
            "ignore_below": report.ignore_below,
            "fixes": list(FIXES) if report.protocol == "dpc" else [],
            "ap_pq_f1_pre_rec": "pooled over all frames of all sequences",
            "miou_ri": "mean over the frames of a sequence, then over sequences",
        },
        "metrics": shares(report.main)
        | {
            "per_class": [
                {"label": label, "name": names[label] if label < len(names) else "", **shares(own), **_counts(own)}
                for label, own in report.classes.items()
            ]
        },
        "intervals": intervals_json(report.resampling, "sequences", len(report.names), report.intervals),
        "samples": samples_json("sequences", report.names),
        "units": dict.fromkeys(SHARES, "fraction"),
        "denominators": _counts(report.main),
        "left_out": [{"reason": e.reason, "count": len(e.names), "names": e.names} for e in report.left_out],
        "provenance": list(provenance),
    }


def shares(metrics: SegmentationMetrics) -> dict[str, float | None]:
    """The seven scores by name; None = undefined."""
    return {key: None if np.isnan(getattr(metrics, key)) else float(getattr(metrics, key)) for key in SHARES}


def _counts(metrics: SegmentationMetrics) -> dict[str, int]:
    values = asdict(metrics)
    return {
        "sequences": values["objects"],
        "frames": values["frames"],
        "true_parts": values["truth_parts"],
        "predictions": values["predictions"],
        "true_positives": values["true_positives"],
        "frames_without_truth": values["skipped"],
        "predictions_on_ignored_ground": values["dropped"],
        "points_without_truth": values["unknown"],
    }
