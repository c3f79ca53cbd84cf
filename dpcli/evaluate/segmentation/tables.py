"""The segmentation and motion reports as tables and notes."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import starmap
from typing import Any

import numpy as np

from dpcli.evaluate.bootstrap import Interval
from dpcli.evaluate.classification.protocol import LeftOut
from dpcli.evaluate.classification.tables import TextTable, percent, percent_ends, resampling_note
from dpcli.evaluate.compare.resampled import flow_keys
from dpcli.evaluate.segmentation.metrics import SegmentationMetrics
from dpcli.evaluate.segmentation.motion_metrics import TAUS, MotionMetrics
from dpcli.evaluate.segmentation.motion_protocol import MAIN_TAU, MotionReport
from dpcli.evaluate.segmentation.protocol import FIXES, SegmentationReport, shares

TITLES = {"ap": "AP", "pq": "PQ", "f1": "F1", "pre": "Pre", "rec": "Rec", "miou": "mIoU", "ri": "RI"}
_NAMES_SHOWN = 10
_DISPLACEMENT = "Displacement: how far apart true and predicted motion put a true part's centroid."
_NO_POSES = (
    "True flow: scene_flow, from each frame to the next. No poses in the truth: motions of parts aren't compared."
)


def class_rows(main: Any, classes: Mapping[int, Any], names: list[str]) -> list[tuple[str, Any]]:
    """(title, metrics) of each label, when there is more than one, and of all sequences."""
    named = [(f"{label} {names[label] if label < len(names) else ''}".strip(), own) for label, own in classes.items()]
    return [*(named if len(named) > 1 else []), ("all", main)]


def segmentation_tables(report: SegmentationReport) -> list[TextTable]:
    """One row for each class and for all; percentages."""
    header = ["sequences of", "number", "frames", "true parts", "predicted", "found", *TITLES.values()]
    rows = [_segmentation_row(*row) for row in class_rows(report.main, report.classes, report.class_names)]
    main = TextTable("Parts (AP, PQ, F1, Pre, Rec at IoU 0.5)", header, rows)
    values = shares(report.main)
    return [
        main,
        *_intervals(
            report,
            [[title, percent(values[key]), percent_ends(report.intervals.get(key))] for key, title in TITLES.items()],
        ),
    ]


def _intervals(report: SegmentationReport | MotionReport, rows: list[list[str]]) -> list[TextTable]:
    """A table of (metric, value, interval) over all sequences; none without intervals."""
    title = f"{100 * report.resampling.confidence:.4g} % interval"
    return [TextTable("All sequences", ["metric", "value", title], rows)] if report.intervals else []


def _segmentation_row(title: str, own: SegmentationMetrics) -> list[str]:
    counts = (own.objects, own.frames, own.truth_parts, own.predictions, own.true_positives)
    return [title, *map(str, counts), *(percent(value) for value in shares(own).values())]


def segmentation_notes(report: SegmentationReport) -> list[str]:
    """What was counted and how, and what was left out."""
    main = report.main
    lines = [
        f"Split {report.split!r}, truth: {report.truth}. AP, PQ, F1, Pre, Rec: {main.true_positives} found of "
        f"{main.truth_parts} true parts, {main.predictions} predictions, pooled over {main.frames} frames; "
        f"mIoU, RI: mean over the frames of each of {main.objects} sequences, then over these.",
        *resampling_note(report.resampling, "sequences", len(report.names)),
        *_protocol_lines(report.protocol),
    ]
    if report.ignore_below:
        lines.append(f"True parts of fewer than {report.ignore_below} points are ignored.")
    for count, what in (
        (main.skipped, "frames without a true part that counts"),
        (main.dropped, "predictions that lie mostly on ignored parts or unknown points"),
        (main.unknown, "points without a true part (-1)"),
    ):
        if count:
            lines.append(f"Left out, {what}: {count}.")
    return [*lines, *_left_out(report.left_out)]


def _protocol_lines(protocol: str) -> list[str]:
    if protocol == "release":
        return ["Protocol release: as the published code computes them, quirks included."]
    return ["Protocol dpc, unlike the published code (--protocol release):", *(f"- {fix};" for fix in FIXES)]


def _left_out(entries: list[LeftOut]) -> list[str]:
    lines = []
    for entry in entries:
        shown = ", ".join(entry.names[:_NAMES_SHOWN]) + (", ..." if len(entry.names) > _NAMES_SHOWN else "")
        lines.append(f"Left out, {entry.reason}: {len(entry.names)} sequences ({shown}).")
    return lines


def motion_tables(report: MotionReport) -> list[TextTable]:
    """Flow errors at both thresholds, and errors of part motions where poses are known; one row for each class and all."""
    rows = class_rows(report.main, report.classes, report.class_names)
    unit = f" ({report.length_unit})" if report.length_unit else ""
    shares = [f"{name} {tau:g}" for tau in TAUS for name in ("AccS", "AccR", "Outlier")]
    header = ["sequences of", "pairs", "points", f"EPE3D{unit}", "no motion", *shares]
    parts = ["sequences of", "true parts", "matched", "rotation (deg)", f"displacement{unit}"]
    return [
        TextTable("Flow", header, [_flow_row(*row) for row in rows]),
        *([TextTable("Motions of matched parts", parts, list(starmap(_part_row, rows)))] if report.from_poses else []),
        *_intervals(report, _motion_interval_rows(report, unit)),
    ]


def _motion_interval_rows(report: MotionReport, unit: str) -> list[list[str]]:
    main, found = report.main, report.intervals
    lengths = (
        ("epe3d", f"EPE3D{unit}", main.epe3d),
        ("part_rotation", "rotation (deg)", np.degrees(main.rotation)),
        ("part_displacement", f"displacement{unit}", main.displacement),
    )
    lengths = lengths if report.from_poses else lengths[:1]
    rows = [[title, _number(value), _ends(found.get(key))] for key, title, value in lengths]
    names = ("AccS", "AccR", "Outlier")
    for key, row, column in flow_keys(MAIN_TAU[report.protocol]):
        share = getattr(main.shares[TAUS[row]], names[column].lower())
        rows.append([f"{names[column]} {TAUS[row]:g}", percent(share), percent_ends(found.get(key))])
    return rows


def _ends(own: Interval | None) -> str:
    return f"{own.low:.4g} - {own.high:.4g}" if own is not None and own.defined else "-"


def _flow_row(title: str, own: MotionMetrics) -> list[str]:
    found = [own.shares[tau] for tau in TAUS]
    values = [percent(value) for one in found for value in (one.accs, one.accr, one.outlier)]
    return [title, str(own.pairs), str(own.points), _number(own.epe3d), _number(own.still), *values]


def _part_row(title: str, own: MotionMetrics) -> list[str]:
    matched = str(own.parts - own.unmatched)
    return [title, str(own.parts), matched, _number(np.degrees(own.rotation)), _number(own.displacement)]


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.4g}"


def motion_notes(report: MotionReport) -> list[str]:
    """What was counted and how, and what was left out."""
    main = report.main
    how = (
        "over the points of 6 pairs, then over these batches, as the published code"
        if report.protocol == "release"
        else "over all points"
    )
    lines = [
        f"Split {report.split!r}, truth: {report.truth}. {main.pairs} frame pairs of {report.sequences} sequences; "
        f"means {how}. no motion: EPE3D of predicting none.",
        "At tau: AccS error < tau or 5 %, AccR < 2 tau or 10 %, Outlier > 6 tau or 10 % of the true flow. The published "
        "tables of SAPIEN and OGC-DR take tau 0.01; the thesis's text, KITTI and Waymo 0.05.",
        *resampling_note(report.resampling, "sequences", len(report.names)),
        _DISPLACEMENT if report.from_poses else _NO_POSES,
    ]
    if report.without_truth:
        lines.append(f"Left out, frame pairs other than f -> f + 1: {report.without_truth}.")
    if main.unknown:
        lines.append(f"Left out, points without a true part (-1): {main.unknown} over all pairs.")
    return [*lines, *_left_out(report.left_out)]
