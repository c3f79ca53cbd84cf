"""The motion protocol: which frame pairs of a parts file count, against true poses or against true scene flow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import Interval, Resampling
from dpcli.evaluate.choices import check_protocol
from dpcli.evaluate.results import LeftOut
from dpcli.evaluate.segmentation.motion_metrics import (
    MAIN_TAU,
    RELEASE_BATCH,
    MotionMetrics,
    MotionStatistics,
    flow_update,
    motion_compute,
    motion_merge,
    motion_weighted,
    part_motion_update,
)
from dpcli.evaluate.segmentation.rigid_motion import true_flow, true_motion
from dpcli.evaluate.segmentation.truth_pairing import PairedSequences, SequencePair


@dataclass
class MotionReport:
    """Holds the metrics of all sequences, and of those of each label that occurs.

    names, statistics, pairs: each sequence that counts, its statistics and frame pairs i (Q,2). intervals: by metric
    (part_rotation in degrees; see `motion_weighted`), empty without `resampling`. from_poses: false when the true flow
    is the field `scene_flow`; without_truth then counts the predicted pairs that it doesn't tell of.
    """

    protocol: str
    split: str
    truth: str
    length_unit: str
    main: MotionMetrics
    classes: dict[int, MotionMetrics]
    class_names: list[str]
    left_out: list[LeftOut]
    sequences: int
    names: list[str] = field(default_factory=list)
    statistics: list[MotionStatistics] = field(default_factory=list)
    pairs: list[np.ndarray] = field(default_factory=list)
    resampling: Resampling = field(default_factory=lambda: Resampling(0))
    intervals: dict[str, Interval] = field(default_factory=dict)
    from_poses: bool = True
    without_truth: int = 0


@dataclass
class _Collected:
    """Holds what is known of each sequence that counts, which have no pair that counts, and how many pairs don't."""

    names: list[str] = field(default_factory=list)
    labels: list[int] = field(default_factory=list)
    statistics: list[MotionStatistics] = field(default_factory=list)
    pairs: list[np.ndarray] = field(default_factory=list)
    without_pairs: list[str] = field(default_factory=list)
    without_truth: int = 0


def evaluate_motion(
    path: str | Path,
    truth: str | Path,
    *,
    protocol: str = "dpc",
    split: str | None = None,
    intersect: bool = False,
    resampling: Resampling | None = None,
) -> MotionReport:
    """Returns the metrics of all frame pairs of a parts file against the `part` and `pose` of a clouds file.

    Where it has no poses but `scene_flow`, the flow of pairs f -> f + 1 is compared with that, at all points; other
    pairs are left out and counted, motions of parts are not compared. Points without a true part don't count.
    protocol: "dpc", every point counts the same; "release", as the published code: means over the points of each 6
    successive pairs, then over these batches; UsageError for another. split, intersect and DataErrors: as
    `PairedSequences`. resampling: how to find the intervals; without it there are none.
    """
    check_protocol(protocol)
    resampling = resampling or Resampling(0)
    with PairedSequences(
        path, truth, split=split, intersect=intersect, fields=("part", "pose"), instead=("scene_flow",)
    ) as paired:
        from_poses = "pose" in paired.fields
        found = _collect(paired, from_poses)
    _check_found(found, path)
    reason = "no frame pair predicted" if from_poses else "no frame pair f -> f + 1 predicted"
    batch = RELEASE_BATCH if protocol == "release" else None
    metric = motion_weighted(found.statistics, MAIN_TAU[protocol], batch)
    return MotionReport(
        protocol,
        paired.split,
        str(truth),
        paired.truth.length_unit,
        motion_compute(motion_merge(found.statistics), batch),
        _metrics_by_class(found, batch),
        paired.truth.class_names,
        [*paired.left_out, *([LeftOut(reason, found.without_pairs)] if found.without_pairs else [])],
        len(found.statistics),
        found.names,
        found.statistics,
        found.pairs,
        resampling,
        resampling.intervals(metric, len(found.statistics)),
        from_poses,
        found.without_truth,
    )


def _collect(paired: PairedSequences, from_poses: bool) -> _Collected:
    found = _Collected()
    for pair in paired:
        predicted = len(pair.parts.pairs)
        pair = pair if from_poses else _only_next_frames(pair)
        found.without_truth += predicted - len(pair.parts.pairs)
        if len(pair.parts.pairs) == 0:
            found.without_pairs.append(pair.truth.name)
            continue
        found.names.append(pair.truth.name)
        found.pairs.append(pair.parts.pairs)
        found.labels.append(pair.truth.label)
        found.statistics.append(_sequence_statistics(pair, Path(paired.truth.path)))
    return found


def _check_found(found: _Collected, path: str | Path) -> None:
    """Raises DataError where no point of no pair counts."""
    if any(one.points.any() for one in found.statistics):
        return
    why = "no point has a true part"
    if not found.statistics:
        why = "holds no frame pairs; sequences of one frame have no motion"
        if found.without_truth:
            why = f"none of its {found.without_truth} frame pairs is f -> f + 1, of which alone scene_flow tells"
    raise DataError(f"{path}: nothing to compare: {why}")


def _metrics_by_class(found: _Collected, batch: int | None) -> dict[int, MotionMetrics]:
    rows = list(zip(found.labels, found.statistics, strict=True))
    return {
        label: motion_compute(motion_merge(one for own, one in rows if own == label), batch)
        for label in sorted({label for label in found.labels if label >= 0})
    }


def _only_next_frames(pair: SequencePair) -> SequencePair:
    """Returns the sequence with only what is predicted of pairs f -> f + 1."""
    parts = pair.parts
    rows = np.flatnonzero(parts.pairs[:, 1] == parts.pairs[:, 0] + 1)
    flow = [parts.flow[row] for row in rows]
    return replace(pair, parts=replace(parts, pairs=parts.pairs[rows], motion=parts.motion[rows], flow=flow))


def _sequence_statistics(pair: SequencePair, truth: Path) -> MotionStatistics:
    try:
        return motion_merge(_compare_with_poses(pair) if pair.truth.pose is not None else _compare_with_flow(pair))
    except DataError as error:
        raise DataError(f"{truth}: {pair.truth.name!r}: {error}; make the file again") from None


def _compare_with_poses(pair: SequencePair) -> Iterator[MotionStatistics]:
    truth, parts = pair.truth, pair.parts
    if truth.part.max() >= truth.pose.shape[1]:
        raise DataError(f"part {truth.part.max()}, but there are poses of {truth.pose.shape[1]} parts")
    for (source, target), motions, flow in zip(parts.pairs.tolist(), parts.motion, parts.flow, strict=True):
        span = slice(int(truth.frame_offsets[source]), int(truth.frame_offsets[source + 1]))
        points, part, predicted = truth.points[span], truth.part[span], pair.predicted.part[span]
        known = part >= 0
        real = true_motion(truth.pose, source, target)
        compared = flow_update(flow[known], true_flow(points[known], part[known], real))
        yield replace(compared, unknown=int((~known).sum()))
        yield part_motion_update(points, part, predicted, real, motions)


def _compare_with_flow(pair: SequencePair) -> Iterator[MotionStatistics]:
    """Compares pairs f -> f + 1 with scene_flow, which every point has."""
    truth = pair.truth
    for (source, _), flow in zip(pair.parts.pairs.tolist(), pair.parts.flow, strict=True):
        real = truth.scene_flow[int(truth.frame_offsets[source]) : int(truth.frame_offsets[source + 1])]
        if not np.isfinite(real).all():
            wrong = int((~np.isfinite(real)).any(axis=1).sum())
            raise DataError(f"the true flow of {wrong} of the {len(real)} points of frame {source} is NaN or infinite")
        yield flow_update(flow, real)
