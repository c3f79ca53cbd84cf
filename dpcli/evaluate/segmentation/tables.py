"""The segmentation report as tables and notes, and rows by class, which the motion report shares."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dpcli.counted import counted
from dpcli.evaluate.metric_titles import title_of
from dpcli.evaluate.results import left_out_note
from dpcli.evaluate.segmentation.metrics import SegmentationMetrics
from dpcli.evaluate.segmentation.protocol import FIXES, SegmentationReport
from dpcli.evaluate.segmentation.result_json import segmentation_scores
from dpcli.evaluate.text_tables import TextTable, percent, percent_ends, resampling_note


def class_rows(main: Any, classes: Mapping[int, Any], names: list[str]) -> list[tuple[str, Any]]:
    """Returns (title, metrics) of each label, when there is more than one, and of all sequences."""
    named = [(f"{label} {names[label] if label < len(names) else ''}".strip(), own) for label, own in classes.items()]
    return [*(named if len(named) > 1 else []), ("all", main)]


def interval_tables(report: Any, rows: list[list[str]]) -> list[TextTable]:
    """Returns a table of (metric, value, interval) over all sequences, as a list of one; none for a report without intervals."""
    header = ["metric", "value", report.resampling.title]
    return [TextTable("All sequences", header, rows)] if report.intervals else []


def segmentation_tables(report: SegmentationReport) -> list[TextTable]:
    """Returns one row for each class and for all, in percent, and a table of the intervals."""
    values = segmentation_scores(report.main)
    header = ["class", "sequences", "frames", "true parts", "predicted", "found"]
    rows = [_segmentation_row(*row) for row in class_rows(report.main, report.classes, report.class_names)]
    main = TextTable("Parts (AP, PQ, F1, precision, recall at IoU 0.5)", [*header, *map(title_of, values)], rows)
    return [
        main,
        *interval_tables(
            report,
            [[title_of(key), percent(value), percent_ends(report.intervals.get(key))] for key, value in values.items()],
        ),
    ]


def _segmentation_row(title: str, own: SegmentationMetrics) -> list[str]:
    counts = (own.objects, own.frames, own.truth_parts, own.predictions, own.true_positives)
    return [title, *map(str, counts), *(percent(value) for value in segmentation_scores(own).values())]


def segmentation_notes(report: SegmentationReport) -> list[str]:
    """Returns sentences on what was counted and how, and what was left out."""
    main = report.main
    lines = [
        f"Split {report.split!r}, truth: {report.truth}. AP, PQ, F1, precision, recall: {main.true_positives} found of "
        f"{counted(main.truth_parts, 'true part')}, {counted(main.predictions, 'prediction')}, pooled over "
        f"{counted(main.frames, 'frame')}; mIoU, Rand index, plain and adjusted: mean over the frames of "
        f"each of {counted(main.objects, 'sequence')}, then over these.",
        *resampling_note(report.resampling, "sequences", len(report.names)),
        *_protocol_notes(report.protocol),
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
    return [*lines, *(left_out_note(entry, "sequence") for entry in report.left_out)]


def _protocol_notes(protocol: str) -> list[str]:
    if protocol == "release":
        return ["Protocol release: as the published code computes them, quirks included."]
    return ["Protocol dpc, unlike the published code (--protocol release):", *(f"- {fix};" for fix in FIXES)]
