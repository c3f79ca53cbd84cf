"""The motion report as tables and notes."""

from __future__ import annotations

from itertools import starmap

import numpy as np

from dpcli.counted import counted
from dpcli.evaluate.results import left_out_note
from dpcli.evaluate.segmentation.motion_metrics import MAIN_TAU, SHARES, TAUS, MotionMetrics, flow_keys, tau_unit
from dpcli.evaluate.segmentation.motion_protocol import MotionReport
from dpcli.evaluate.segmentation.tables import class_rows, interval_tables
from dpcli.evaluate.text_tables import TextTable, four_digit_ends, four_digits, percent, percent_ends, resampling_note

SHARE_TITLES = {"accs": "AccS", "accr": "AccR", "outlier": "Outlier"}
_DISPLACEMENT = "Displacement error: how far apart true and predicted motion put a true part's centroid."
_NO_POSES = (
    "True flow: scene_flow, from each frame to the next. No poses in the truth: motions of parts aren't compared."
)


def motion_tables(report: MotionReport) -> list[TextTable]:
    """Returns flow errors at both thresholds and, where poses are known, errors of part motions: a row for each class and all."""
    rows = class_rows(report.main, report.classes, report.class_names)
    unit = f" ({report.length_unit})" if report.length_unit else ""
    shares = [f"{name} {tau:g}" for tau in TAUS for name in SHARE_TITLES.values()]
    header = ["class", "pairs", "points", f"EPE3D{unit}", f"no motion{unit}", *shares]
    parts = ["class", "true parts", "matched parts", "rotation error (deg)", f"displacement error{unit}"]
    return [
        TextTable("Flow", header, [_flow_row(*row) for row in rows]),
        *([TextTable("Motions of matched parts", parts, list(starmap(_part_row, rows)))] if report.from_poses else []),
        *interval_tables(report, _interval_rows(report, unit)),
    ]


def _interval_rows(report: MotionReport, unit: str) -> list[list[str]]:
    main, found = report.main, report.intervals
    lengths = (
        ("epe3d", f"EPE3D{unit}", main.epe3d),
        ("part_rotation", "rotation error (deg)", np.degrees(main.rotation)),
        ("part_displacement", f"displacement error{unit}", main.displacement),
    )
    lengths = lengths if report.from_poses else lengths[:1]
    rows = [[title, four_digits(value), four_digit_ends(found.get(key))] for key, title, value in lengths]
    for key, row, column in flow_keys(MAIN_TAU[report.protocol]):
        name = SHARES[column]
        share = percent(getattr(main.shares[TAUS[row]], name))
        rows.append([f"{SHARE_TITLES[name]} {TAUS[row]:g}", share, percent_ends(found.get(key))])
    return rows


def _flow_row(title: str, own: MotionMetrics) -> list[str]:
    found = [own.shares[tau] for tau in TAUS]
    values = [percent(value) for one in found for value in (one.accs, one.accr, one.outlier)]
    return [title, str(own.pairs), str(own.points), four_digits(own.epe3d), four_digits(own.still), *values]


def _part_row(title: str, own: MotionMetrics) -> list[str]:
    matched = str(own.parts - own.unmatched)
    return [title, str(own.parts), matched, four_digits(np.degrees(own.rotation)), four_digits(own.displacement)]


def motion_notes(report: MotionReport) -> list[str]:
    """Returns sentences on what was counted and how, and what was left out."""
    main = report.main
    how = (
        "over the points of 6 pairs, then over these batches, as the published code"
        if report.protocol == "release"
        else "over all points"
    )
    lines = [
        f"Split {report.split!r}, truth: {report.truth}. {counted(main.pairs, 'frame pair')} of {counted(len(report.names), 'sequence')}; "
        f"means {how}. no motion: EPE3D of predicting none.",
        "At tau: AccS error < tau or 5 %, AccR < 2 tau or 10 %, Outlier > 6 tau or 10 % of the true flow. The published "
        "tables of SAPIEN and OGC-DR take tau 0.01; the thesis's text, KITTI and Waymo 0.05. Unit of tau: "
        f"{tau_unit(report.length_unit) or 'that of the file'}.",
        *resampling_note(report.resampling, "sequences", len(report.names)),
        _DISPLACEMENT if report.from_poses else _NO_POSES,
    ]
    if report.without_truth:
        lines.append(f"Left out, frame pairs other than f -> f + 1: {report.without_truth}.")
    if main.unknown:
        lines.append(f"Left out, points without a true part (-1): {main.unknown} over all pairs.")
    return [*lines, *(left_out_note(entry, "sequence") for entry in report.left_out)]
