"""The joints report as tables, notes and the object that `--json` prints."""

from __future__ import annotations

from typing import Any

from dpcli.counted import counted
from dpcli.evaluate.joints.metrics import JointStatistics
from dpcli.evaluate.joints.protocol import METRICS, JointReport
from dpcli.evaluate.joints.visibility import VISIBLE
from dpcli.evaluate.results import class_rows_json, left_out_note, none_if_nan, report_json
from dpcli.evaluate.segmentation.part_matching import IOU_THRESHOLD
from dpcli.evaluate.segmentation.tables import class_rows, interval_tables
from dpcli.evaluate.text_tables import TextTable, four_digit_ends, four_digits, percent, percent_ends, resampling_note

_SHARES = ("type", "axis_within_5", "visible_type", "visible_axis_within_5", "edge_f1")
_NOTE = (
    "Parts are matched over all frames at IoU 0.5. A joint that connects other parts, or none, has the wrong type and no "
    "axis within 5 degrees. Axis angle, axis position (the least distance between the two axes of a hinge) and value "
    "(since frame 0, mean over the later frames): of the joints of the right type, in the coordinates of frame 0. Visible: joints "
    f"whose motion takes the child's points at least {VISIBLE:g} times the sampling distance, by the truth's poses."
)


def _titles(unit: str) -> dict[str, str]:
    of = f" ({unit})" if unit else ""
    return {
        "type": "type right",
        "axis_within_5": "axis within 5 deg",
        "visible_type": "type, visible",
        "visible_axis_within_5": "axis, visible",
        "edge_f1": "tree edges F1",
        "axis_angle": "axis angle (deg)",
        "axis_position": f"axis position{of}",
        "state_angle": "value, hinges (deg)",
        "state_length": f"value, slides{of}",
    }


def joint_tables(report: JointReport) -> list[TextTable]:
    """Returns a row for each class and for all, and a table of the intervals."""
    titles = _titles(report.length_unit)
    pairs = {label: (report.classes[label], report.counts[label]) for label in report.classes}
    rows = [
        [title, str(counts.joints), *(_shown(key, metrics[key]) for key in METRICS)]
        for title, (metrics, counts) in class_rows((report.metrics, report.total), pairs, report.class_names)
    ]
    main = TextTable("Joints", ["class", "true joints", *(titles[key] for key in METRICS)], rows)
    ends = [
        [
            titles[key],
            _shown(key, report.metrics[key]),
            (percent_ends if key in _SHARES else four_digit_ends)(report.intervals.get(key)),
        ]
        for key in METRICS
    ]
    return [main, *interval_tables(report, ends)]


def _shown(key: str, value: float) -> str:
    return percent(value) if key in _SHARES else four_digits(value)


def joint_notes(report: JointReport) -> list[str]:
    """Returns sentences on what was counted and how, and what was left out."""
    total = report.total
    return [
        f"Split {report.split!r}, truth: {report.truth}. {counted(total.joints, 'true joint')} of "
        f"{counted(len(report.names), 'sequence')}, {total.predicted} predicted, {total.edges} between the right parts.",
        f"{total.visible} true joints move visibly."
        if report.poses
        else "Which joints move visibly is unknown: the truth has no poses.",
        *resampling_note(report.resampling, "sequences", len(report.names)),
        _NOTE,
        *(left_out_note(entry, "sequence") for entry in report.left_out),
    ]


def joint_json(report: JointReport, source: str) -> dict[str, Any]:
    """Returns the report with its numbers under `metrics`, None where a number is undefined (0/0).

    source: the parts file, as it was named.
    """
    unit = report.length_unit
    rows = {label: _numbers(own) | _counts(report.counts[label]) for label, own in report.classes.items()}
    units = {**dict.fromkeys(_SHARES, "fraction"), "axis_angle": "degree", "axis_position": unit}
    return report_json(
        "joints",
        source,
        report,
        "sequences",
        protocol={
            "split": report.split,
            "truth": report.truth,
            "iou_threshold": IOU_THRESHOLD,
            "axis_within": 5,
            "visible": VISIBLE,
        },
        metrics=_numbers(report.metrics) | {"per_class": class_rows_json(rows, report.class_names)},
        units=units | {"state_angle": "degree", "state_length": unit},
        denominators={"sequences": len(report.names), **_counts(report.total)},
    )


def _numbers(metrics: dict[str, float]) -> dict[str, float | None]:
    return {key: none_if_nan(metrics[key]) for key in METRICS}


def _counts(total: JointStatistics) -> dict[str, int]:
    return {
        "true_joints": total.joints,
        "predicted_joints": total.predicted,
        "joints_between_the_right_parts": total.edges,
        "joints_of_the_right_type": total.types,
        "true_axes": total.axes,
        "visible_joints": total.visible,
        "visible_axes": total.visible_axes,
    }
