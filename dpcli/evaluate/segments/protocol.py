"""The protocol for segments: which recordings count, against which truth, and the report as tables, notes and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import NO_INTERVALS, Resampling, values_of_all
from dpcli.evaluate.metric_titles import title_of
from dpcli.evaluate.results import LeftOut, Report, left_out, left_out_note, list_names, none_if_nan, report_json
from dpcli.evaluate.segments.metrics import METRICS, OVERLAPS, RecordingCounts, count_recording, segments_weighted
from dpcli.evaluate.segments.truth_check import check_classes, doubts_of_frames
from dpcli.evaluate.text_tables import TextTable, percent, percent_ends, resampling_note
from dpcli.runtime.progress import log
from dpcli.store.tables.segments import Segments

_NOTE = (
    "Frame accuracy: frames with the right class, or rightly with nothing. Edit score: 1 - Levenshtein distance of the orders "
    "of actions / the longer one. F1@k: a segment is right when it overlaps a true one of its class by k % of their union; "
    "neighbors of one class are one segment, nothing is no segment (Lea et al. 2017)."
)


@dataclass(kw_only=True)
class SegmentsReport(Report):
    """Holds the metrics (0..1, NaN = undefined) of some recordings, and the counts of each."""

    counts: list[RecordingCounts]
    metrics: dict[str, float]


def evaluate_segments(
    predicted: Segments, true: Segments, truth: str, *, intersect: bool = False, resampling: Resampling = NO_INTERVALS
) -> SegmentsReport:
    """Returns the metrics of the recordings that both have. truth: the true table as it was named.

    Raises DataError where one side lacks a recording, unless `intersect`, or where no class of the prediction is in the truth.
    """
    names = [name for name in true.recordings if name in predicted.recordings]
    others = _one_sided(predicted, true, names, truth, intersect)
    check_classes(predicted, true, names, truth)
    for doubt in doubts_of_frames(predicted, true, names):
        log.warn(f"{truth}: {doubt}")
    counts = [count_recording(predicted.recordings[name], true.recordings[name]) for name in names]
    metric = segments_weighted(counts)
    return SegmentsReport(
        names=names,
        counts=counts,
        metrics=values_of_all(metric, len(counts)),
        truth=truth,
        resampling=resampling,
        intervals=resampling.intervals(metric, len(counts)),
        left_out=others,
        provenance=predicted.provenance,
    )


def _one_sided(predicted: Segments, true: Segments, names: Sequence[str], truth: str, intersect: bool) -> list[LeftOut]:
    unknown = [name for name in predicted.recordings if name not in true.recordings]
    missing = [name for name in true.recordings if name not in predicted.recordings]
    if not names:
        raise DataError(f"{truth}: no recording of this name: {list_names(unknown)}; it has {list_names(missing)}")
    if (unknown or missing) and not intersect:
        side, lacking = ("the truth lacks", unknown) if unknown else ("the prediction lacks", missing)
        empty = "where nothing happens in one, a row with an empty class says so; " if unknown else ""
        raise DataError(
            f"{truth}: {side} {list_names(lacking)}; {empty}--intersect evaluates the recordings that both have"
        )
    return left_out({"the truth doesn't have": unknown, "not predicted": missing})


def segments_tables(report: SegmentsReport) -> list[TextTable]:
    """Returns a table of the metrics of all recordings, and one with a row for each."""
    rows = [[title_of(key), percent(report.metrics[key]), percent_ends(report.intervals.get(key))] for key in METRICS]
    single = [[name, *_row(one)] for name, one in zip(report.names, report.counts)]
    header = ["recording", "frames", "true segments", "predicted", *(title_of(key) for key in METRICS)]
    return [
        TextTable("Segments", ["metric", "value", report.resampling.title], rows),
        TextTable("By recording", header, single),
    ]


def _row(one: RecordingCounts) -> list[str]:
    values = values_of_all(segments_weighted([one]), 1)
    return [str(one.frames), str(one.true), str(one.predicted), *(percent(values[key]) for key in METRICS)]


def segments_notes(report: SegmentsReport) -> list[str]:
    """Returns sentences on what was counted and how, and what was left out."""
    true, said = (sum(getattr(one, key) for one in report.counts) for key in ("true", "predicted"))
    frames = sum(one.frames for one in report.counts)
    return [
        f"{counted(len(report.names), 'recording')}, {counted(frames, 'frame')}, {counted(true, 'true segment')} and {said} "
        f"predicted ones; truth: {report.truth}.",
        *resampling_note(report.resampling, "recordings", len(report.names)),
        _NOTE,
        *(left_out_note(entry, "recording") for entry in report.left_out),
    ]


def segments_json(report: SegmentsReport, source: str) -> dict[str, Any]:
    """Returns the report as `--json` prints it. source: the predicted table, as it was named."""
    counts = report.counts
    rows = [
        {"name": name, "frames": one.frames, "right": one.right, "true": one.true, "predicted": one.predicted}
        for name, one in zip(report.names, counts)
    ]
    return report_json(
        "segments",
        source,
        report,
        "recordings",
        protocol={"truth": report.truth, "overlaps": list(OVERLAPS), "definition": _NOTE},
        metrics={key: none_if_nan(report.metrics[key]) for key in METRICS} | {"per_recording": rows},
        units=dict.fromkeys(METRICS, "fraction"),
        denominators={
            "recordings": len(counts),
            "frames": sum(one.frames for one in counts),
            "true_segments": sum(one.true for one in counts),
            "predicted_segments": sum(one.predicted for one in counts),
        },
    )
