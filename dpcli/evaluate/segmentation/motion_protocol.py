"""The motion protocol: which frame pairs of a parts file count, against true poses or against true scene flow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import NO_INTERVALS, Resampling, WeightedMetric
from dpcli.evaluate.choices import check_protocol
from dpcli.evaluate.results import Report, left_out, measure_by_class, merge_statistics
from dpcli.evaluate.segmentation.motion_metrics import (
    MAIN_TAU,
    RELEASE_BATCH,
    MotionMetrics,
    MotionStatistics,
    flow_update,
    motion_compute,
    motion_weighted,
    part_motion_update,
)
from dpcli.evaluate.segmentation.rigid_motion import true_flow, true_motion
from dpcli.evaluate.segmentation.sequence_pass import (
    NOT_KEPT,
    Counted,
    Keeping,
    count_sequences,
    read_counted,
    statistics_of,
)
from dpcli.evaluate.segmentation.truth_pairing import PairedSequences, SequencePair, named_truth
from dpcli.store.schema import METERS


@dataclass(kw_only=True)
class MotionReport(Report):
    """Holds the metrics of all sequences, and of those of each label that occurs.

    pairs: the frame pairs i (Q,2) of each sequence that counts. metric: of how often each counts (part_rotation in degrees;
    see `motion_weighted`). from_poses: false when the true flow is the field `scene_flow`; without_truth then counts the
    predicted pairs that it doesn't tell of.
    """

    protocol: str
    split: str
    length_unit: str
    main: MotionMetrics
    classes: dict[int, MotionMetrics]
    class_names: list[str]
    pairs: list[np.ndarray]
    metric: WeightedMetric
    from_poses: bool
    without_truth: int


def evaluate_motion(
    path: str | Path,
    truth: str | Path | None,
    *,
    protocol: str = "dpc",
    split: str | None = None,
    intersect: bool = False,
    resampling: Resampling = NO_INTERVALS,
    keeping: Keeping = NOT_KEPT,
) -> MotionReport:
    """Returns the metrics of all frame pairs of a parts file against the `part` and `pose` of a clouds file.

    path may be the statistics that `keeping` wrote; they tell the other choices, and need no truth. Where the truth has no
    poses but `scene_flow`, the flow of pairs f -> f + 1 is compared with that, at all points; other pairs are left out and
    counted, motions of parts are not compared. Points without a true part don't count. protocol: "dpc", every point
    counts the same; "release", as the published code: means over the points of each 6 successive pairs, then over these
    batches; UsageError for another. split, intersect and DataErrors: as `PairedSequences`. resampling: how to find the
    intervals; without it there are none.
    """
    check_protocol(protocol)
    asked = {"protocol": protocol if protocol != "dpc" else None, "split": split}
    counted = read_counted(path, "motion", asked, truth, keeping)
    if counted is None:
        with PairedSequences(
            path, named_truth(truth), split=split, intersect=intersect, fields=("part", "pose"), instead=("scene_flow",)
        ) as paired:
            from_poses = "pose" in paired.fields
            about = {"task": "motion", "protocol": protocol, "from_poses": from_poses}
            meters = METERS.get(paired.truth.length_unit, 1.0)
            measure = partial(_sequence_values, from_poses=from_poses, truth=str(truth), meters=meters)
            counted = count_sequences(paired, measure, about, keeping)
    return _make_report(counted, path, resampling)


def _make_report(counted: Counted, path: str | Path, resampling: Resampling) -> MotionReport:
    protocol, from_poses = counted.about["protocol"], counted.about["from_poses"]
    found = [(name, row) for name, row in zip(counted.names, counted.rows, strict=True) if len(row["pairs"])]
    without_pairs = [name for name, row in zip(counted.names, counted.rows, strict=True) if not len(row["pairs"])]
    without_truth = sum(row["predicted_pairs"] - len(row["pairs"]) for row in counted.rows)
    statistics = statistics_of(MotionStatistics, [row for _, row in found], path)
    _check_found(statistics, without_truth, path)
    reason = "no frame pair predicted" if from_poses else "no frame pair f -> f + 1 predicted"
    batch = RELEASE_BATCH if protocol == "release" else None
    metric = motion_weighted(statistics, MAIN_TAU[protocol], batch)
    return MotionReport(
        **counted.facts(),
        length_unit=counted.length_unit,
        main=motion_compute(merge_statistics(statistics), batch),
        classes=measure_by_class(
            [row["label"] for _, row in found], statistics, lambda own: motion_compute(merge_statistics(own), batch)
        ),
        names=[name for name, _ in found],
        left_out=[*counted.left_out, *left_out({reason: without_pairs})],
        pairs=[row["pairs"] for _, row in found],
        metric=metric,
        resampling=resampling,
        intervals=resampling.intervals(metric, len(statistics)),
        from_poses=from_poses,
        without_truth=without_truth,
    )


def _sequence_values(pair: SequencePair, from_poses: bool, truth: str, meters: float) -> dict[str, Any]:
    predicted = len(pair.parts.pairs)
    pair = pair if from_poses else _only_next_frames(pair)
    values = {"label": pair.truth.label, "pairs": pair.parts.pairs, "predicted_pairs": predicted}
    statistics = vars(_sequence_statistics(pair, Path(truth), meters)) if len(pair.parts.pairs) else {}
    return values | {"statistics": statistics}


def _check_found(statistics: list[MotionStatistics], without_truth: int, path: str | Path) -> None:
    """Raises DataError where no point of no pair counts."""
    if any(one.points.any() for one in statistics):
        return
    why = "no point has a true part"
    if not statistics:
        why = "holds no frame pairs; sequences of one frame have no motion"
        if without_truth:
            why = f"none of its {without_truth} frame pairs is f -> f + 1, the only ones that scene_flow describes"
    raise DataError(f"{path}: nothing to compare: {why}")


def _only_next_frames(pair: SequencePair) -> SequencePair:
    """Returns the sequence with only what is predicted of pairs f -> f + 1."""
    parts = pair.parts
    rows = np.flatnonzero(parts.pairs[:, 1] == parts.pairs[:, 0] + 1)
    flow = [parts.flow[row] for row in rows]
    return replace(pair, parts=replace(parts, pairs=parts.pairs[rows], motion=parts.motion[rows], flow=flow))


def _sequence_statistics(pair: SequencePair, truth: Path, meters: float) -> MotionStatistics:
    compare = _compare_with_poses if pair.truth.pose is not None else _compare_with_flow
    try:
        return merge_statistics(compare(pair, meters))
    except DataError as error:
        raise DataError(f"{truth}: {error}; make the file again") from None


def _compare_with_poses(pair: SequencePair, meters: float) -> Iterator[MotionStatistics]:
    truth, parts = pair.truth, pair.parts
    if truth.part.max() >= truth.pose.shape[1]:
        raise DataError(f"part {truth.part.max()}, but there are poses of {truth.pose.shape[1]} parts")
    for (source, target), motions, flow in zip(parts.pairs.tolist(), parts.motion, parts.flow, strict=True):
        span = pair.span(source)
        points, part, predicted = truth.points[span], truth.part[span], pair.predicted.part[span]
        known = part >= 0
        real = true_motion(truth.pose, source, target)
        compared = flow_update(flow[known], true_flow(points[known], part[known], real), meters)
        yield replace(compared, unknown=int((~known).sum()))
        yield part_motion_update(points, part, predicted, real, motions)


def _compare_with_flow(pair: SequencePair, meters: float) -> Iterator[MotionStatistics]:
    """Compares pairs f -> f + 1 with scene_flow, which every point has."""
    for (source, _), flow in zip(pair.parts.pairs.tolist(), pair.parts.flow, strict=True):
        real = pair.truth.scene_flow[pair.span(source)]
        if not np.isfinite(real).all():
            wrong = int((~np.isfinite(real)).any(axis=1).sum())
            raise DataError(f"the true flow of {wrong} of the {len(real)} points of frame {source} is NaN or infinite")
        yield flow_update(flow, real, meters)
