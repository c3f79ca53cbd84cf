"""The motion protocol: flow and part motions of a parts file against true poses or scene flow, and the result as data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.bootstrap import Interval, Resampling
from dpcli.evaluate.classification.protocol import LeftOut, intervals_json, samples_json
from dpcli.evaluate.compare.resampled import motion_weighted
from dpcli.evaluate.segmentation.metrics import PROTOCOLS
from dpcli.evaluate.segmentation.motion_metrics import (
    RELEASE_BATCH,
    TAUS,
    MotionMetrics,
    MotionStatistics,
    flow_update,
    motion_compute,
    motion_merge,
    part_motion_update,
    true_flow,
    true_motion,
)
from dpcli.evaluate.segmentation.truth_pairing import Compared, Comparison

MAIN_TAU = {"dpc": 0.05, "release": 0.01}  # the thesis's text; what its code takes on SAPIEN and OGC-DR


@dataclass
class MotionReport:
    """Metrics of all sequences, and of those of each label that occurs.

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


def evaluate_motion(
    path: str | Path,
    truth: str | Path,
    *,
    protocol: str = "dpc",
    split: str | None = None,
    intersect: bool = False,
    resampling: Resampling | None = None,
) -> MotionReport:
    """Metrics of all frame pairs of a parts file against the `part` and `pose` of a clouds file.

    Where it has no poses but `scene_flow`, the flow of pairs f -> f + 1 is compared with that, at all points; other
    pairs are left out and counted, motions of parts are not compared. `protocol`: "dpc", every point counts the same;
    "release", as the published code: means over the points of each 6 successive pairs, then over these batches. Points
    without a true part don't count. `split`, `intersect` and DataErrors as `Comparison`. `resampling`: how to find the
    intervals; without it there are none.
    """
    if protocol not in PROTOCOLS:
        raise UsageError(f"--protocol {protocol}: expected {' or '.join(PROTOCOLS)}")
    names, labels, found, pairs, without = [], [], [], [], []
    resampling, without_truth = resampling or Resampling(0), 0
    with Comparison(
        path, truth, split=split, intersect=intersect, fields=("part", "pose"), instead=("scene_flow",)
    ) as comparison:
        from_poses = "pose" in comparison.fields
        for compared in comparison:
            predicted = len(compared.said.pairs)
            compared = compared if from_poses else _to_the_next_frame(compared)
            without_truth += predicted - len(compared.said.pairs)
            if len(compared.said.pairs) == 0:
                without.append(compared.truth.name)
                continue
            names.append(compared.truth.name)
            pairs.append(compared.said.pairs)
            labels.append(compared.truth.label)
            found.append(_object(compared, Path(truth)))
        reason = "no frame pair predicted" if from_poses else "no frame pair f -> f + 1 predicted"
        left_out = [*comparison.left_out, *([LeftOut(reason, without)] if without else [])]
        split, class_names, unit = comparison.split, comparison.truth.class_names, comparison.truth.length_unit
    if not any(one.points.any() for one in found):
        why = "no point has a true part" if found else "holds no frame pairs; sequences of one frame have no motion"
        if without_truth and not found:
            why = f"none of its {without_truth} frame pairs is f -> f + 1, of which alone scene_flow tells"
        raise DataError(f"{path}: nothing to compare: {why}")
    batch = RELEASE_BATCH if protocol == "release" else None
    classes = {
        label: motion_compute(motion_merge(o for own, o in zip(labels, found, strict=True) if own == label), batch)
        for label in sorted({label for label in labels if label >= 0})
    }
    main = motion_compute(motion_merge(found), batch)
    return MotionReport(
        protocol,
        split,
        str(truth),
        unit,
        main,
        classes,
        class_names,
        left_out,
        len(found),
        names,
        found,
        pairs,
        resampling,
        resampling.intervals(motion_weighted(found, MAIN_TAU[protocol], batch), len(found)),
        from_poses,
        without_truth,
    )


def _to_the_next_frame(compared: Compared) -> Compared:
    """Only what is said of pairs f -> f + 1."""
    said = compared.said
    rows = np.flatnonzero(said.pairs[:, 1] == said.pairs[:, 0] + 1)
    kept = replace(said, pairs=said.pairs[rows], motion=said.motion[rows], flow=[said.flow[row] for row in rows])
    return replace(compared, said=kept)


def _object(compared: Compared, path: Path) -> MotionStatistics:
    try:
        return motion_merge(_pairs(compared) if compared.truth.pose is not None else _flows(compared))
    except DataError as error:
        raise DataError(f"{path}: {compared.truth.name!r}: {error}; make the file again") from None


def _pairs(compared: Compared) -> Iterator[MotionStatistics]:
    truth, said = compared.truth, compared.said
    if truth.part.max() >= truth.pose.shape[1]:
        raise DataError(f"part {truth.part.max()}, but there are poses of {truth.pose.shape[1]} parts")
    for (source, target), motions, flow in zip(said.pairs.tolist(), said.motion, said.flow, strict=True):
        span = slice(int(truth.frame_offsets[source]), int(truth.frame_offsets[source + 1]))
        points, part, predicted = truth.points[span], truth.part[span], compared.predicted.part[span]
        known = part >= 0
        real = true_motion(truth.pose, source, target)
        yield replace(
            flow_update(flow[known], true_flow(points[known], part[known], real)), unknown=int((~known).sum())
        )
        yield part_motion_update(points, part, predicted, real, motions)


def _flows(compared: Compared) -> Iterator[MotionStatistics]:
    """Of pairs f -> f + 1 against scene_flow, which every point has."""
    truth = compared.truth
    for (source, _), flow in zip(compared.said.pairs.tolist(), compared.said.flow, strict=True):
        real = truth.scene_flow[int(truth.frame_offsets[source]) : int(truth.frame_offsets[source + 1])]
        if not np.isfinite(real).all():
            wrong = int((~np.isfinite(real)).any(axis=1).sum())
            raise DataError(f"the true flow of {wrong} of the {len(real)} points of frame {source} is NaN or infinite")
        yield flow_update(flow, real)


def motion_json(report: MotionReport, source: str, provenance: Sequence[dict] = ()) -> dict[str, Any]:
    """One object for `--json`: numbers under `metrics`, None where a number is undefined (0/0).

    accs, accr, outlier are those of the protocol's own tau; `thresholds` has both.
    """
    unit, tau, names = report.length_unit, MAIN_TAU[report.protocol], report.class_names
    batches = f"means over the points of {RELEASE_BATCH} pairs, then over these batches"
    return {
        "task": "motion",
        "input": source,
        "protocol": {
            "name": report.protocol,
            "split": report.split,
            "truth": report.truth,
            "true_flow": "part poses" if report.from_poses else "scene_flow, frame f to f + 1",
            "tau": tau,
            "mean": batches if report.protocol == "release" else "over all points of all pairs",
            "accs": "share of points with error < tau or < 5 % of the true flow",
            "accr": "share of points with error < 2 tau or < 10 % of the true flow",
            "outlier": "share of points with error > 6 tau or > 10 % of the true flow",
            "part_motion": "mean over true parts of each pair, matched to predicted parts one to one by IoU",
        },
        "metrics": _numbers(report.main, tau)
        | {
            "per_class": [
                {
                    "label": label,
                    "name": names[label] if label < len(names) else "",
                    **_numbers(own, tau),
                    **_counts(own),
                }
                for label, own in report.classes.items()
            ]
        },
        "intervals": intervals_json(report.resampling, "sequences", len(report.names), report.intervals),
        "samples": samples_json("sequences", report.names),
        "units": {
            "epe3d": unit,
            "epe3d_no_motion": unit,
            "accs": "fraction",
            "accr": "fraction",
            "outlier": "fraction",
            "tau": unit,
            "part_rotation": "degree",
            "part_displacement": unit,
        },
        "denominators": {
            "sequences": report.sequences,
            **_counts(report.main),
            "pairs_without_truth": report.without_truth,
        },
        "left_out": [{"reason": e.reason, "count": len(e.names), "names": e.names} for e in report.left_out],
        "provenance": list(provenance),
    }


def _numbers(metrics: MotionMetrics, tau: float) -> dict[str, Any]:
    main = metrics.shares[tau]
    return {
        "epe3d": _defined(metrics.epe3d),
        "epe3d_no_motion": _defined(metrics.still),
        **{key: _defined(getattr(main, key)) for key in ("accs", "accr", "outlier")},
        "thresholds": [
            {"tau": tau, **{key: _defined(getattr(metrics.shares[tau], key)) for key in ("accs", "accr", "outlier")}}
            for tau in TAUS
        ],
        "part_rotation": _defined(np.degrees(metrics.rotation)),
        "part_displacement": _defined(metrics.displacement),
    }


def _defined(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


def _counts(metrics: MotionMetrics) -> dict[str, int]:
    return {
        "pairs": metrics.pairs,
        "points": metrics.points,
        "true_part_motions": metrics.parts,
        "unmatched_part_motions": metrics.unmatched,
        "points_without_truth": metrics.unknown,
    }
