"""The segmentation protocol: which frames of a parts file count, and against which truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import NO_INTERVALS, Resampling, WeightedMetric
from dpcli.evaluate.choices import check_protocol
from dpcli.evaluate.results import Report, measure_by_class, merge_statistics
from dpcli.evaluate.segmentation.metrics import (
    Frame,
    SegmentationMetrics,
    SegmentationStatistics,
    segmentation_compute,
    segmentation_update,
    segmentation_weighted,
)
from dpcli.evaluate.segmentation.sequence_pass import (
    NOT_KEPT,
    Counted,
    Keeping,
    count_sequences,
    read_counted,
    statistics_of,
)
from dpcli.evaluate.segmentation.truth_pairing import PairedSequences, SequencePair, named_truth

FIXES = (
    "parts are matched one to one (release: two predictions of IoU exactly 0.5 both find the same part)",
    "a true part that has no points in a frame doesn't count there (release: it scores 0 in mIoU)",
    "a confidence is the mean over the part's own points (release: over other points once a prediction was dropped)",
    "frames without a true part are skipped (release: fails)",
    "predictions of equal confidence enter AP together (release: in the order of the file)",
)


@dataclass(kw_only=True)
class SegmentationReport(Report):
    """Holds the metrics of all sequences, and of those of each label that occurs; `objects` has what pictures need.

    metric: of how often each sequence counts.
    """

    protocol: str
    ignore_below: int
    split: str
    main: SegmentationMetrics
    objects: SegmentationStatistics
    classes: dict[int, SegmentationMetrics]
    class_names: list[str]
    metric: WeightedMetric


def evaluate_segmentation(
    path: str | Path,
    truth: str | Path | None,
    *,
    protocol: str = "dpc",
    ignore_below: int = 0,
    split: str | None = None,
    intersect: bool = False,
    resampling: Resampling = NO_INTERVALS,
    keeping: Keeping = NOT_KEPT,
) -> SegmentationReport:
    """Returns the metrics of a parts file against the `part` of a clouds file, over all frames of all sequences that count.

    path may be the statistics that `keeping` wrote; they tell the other choices, and need no truth. protocol: "dpc", or
    "release" with the quirks of the published code (FIXES lists the differences); UsageError for another. ignore_below:
    true parts of fewer points are ignored. split, intersect and DataErrors: as `PairedSequences`. resampling: how to find
    the intervals; without it there are none.
    """
    check_protocol(protocol)
    asked = {"protocol": protocol if protocol != "dpc" else None, "ignore_below": ignore_below or None, "split": split}
    counted = read_counted(path, "segmentation", asked, truth, keeping)
    if counted is None:
        with PairedSequences(path, named_truth(truth), split=split, intersect=intersect) as paired:
            about = {"task": "segmentation", "protocol": protocol, "ignore_below": ignore_below}
            measure = partial(_sequence_values, protocol=protocol, ignore_below=ignore_below)
            counted = count_sequences(paired, measure, about, keeping)
    return _make_report(counted, path, resampling)


def _make_report(counted: Counted, path: str | Path, resampling: Resampling) -> SegmentationReport:
    about, labels = counted.about, [row["label"] for row in counted.rows]
    sequences = statistics_of(SegmentationStatistics, counted.rows, path)
    protocol, ignore_below = about["protocol"], about["ignore_below"]
    whole = merge_statistics(sequences)
    if whole.frames == 0:
        of_size = f" of at least {ignore_below} points" if ignore_below else ""
        raise DataError(f"{about['truth']}: not one frame has a true part{of_size}")
    metric = segmentation_weighted(sequences, protocol)
    return SegmentationReport(
        **counted.facts(),
        ignore_below=ignore_below,
        main=segmentation_compute(whole, protocol),
        objects=whole,
        classes=measure_by_class(labels, sequences, lambda own: segmentation_compute(merge_statistics(own), protocol)),
        names=counted.names,
        left_out=counted.left_out,
        metric=metric,
        resampling=resampling,
        intervals=resampling.intervals(metric, len(sequences)),
    )


def _sequence_values(pair: SequencePair, protocol: str, ignore_below: int) -> dict[str, Any]:
    truths = [pair.truth.part[span] for span in pair.spans]
    if protocol == "release":
        truths = compressed_over_pairs(truths)
    frames = [
        Frame(ids, pair.predicted.part[span], pair.parts.probability[span])
        for ids, span in zip(truths, pair.spans, strict=True)
    ]
    found = segmentation_update(frames, ignore_below=ignore_below, protocol=protocol)
    return {"label": pair.truth.label, "statistics": vars(found)}


def compressed_over_pairs(frames: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Returns the true ids i (N) of each frame, counted from 0 over the ids of the frame and its partner; negative ones stay.

    The partner is the next frame, of the last one the frame before, as in the published list of pairs.

    >>> [ids.tolist() for ids in compressed_over_pairs([np.array([2, 5]), np.array([5, 9])])]
    [[0, 1], [1, 2]]
    """
    made = []
    for t, ids in enumerate(frames):
        partner = frames[t + 1] if t + 1 < len(frames) else frames[max(t - 1, 0)]
        occurring = np.unique(np.concatenate([ids, partner]))
        made.append(np.where(ids >= 0, np.searchsorted(occurring[occurring >= 0], ids), -1))
    return made
