"""The classification report as tables and notes."""

from __future__ import annotations

from dpcli.counted import counted
from dpcli.evaluate.choices import TOP_K
from dpcli.evaluate.classification.calibration import BINS, Calibration
from dpcli.evaluate.classification.metrics import ClassificationMetrics
from dpcli.evaluate.classification.protocol import ClassificationReport
from dpcli.evaluate.metric_titles import title_of
from dpcli.evaluate.proportions import divide
from dpcli.evaluate.results import left_out_note
from dpcli.evaluate.text_tables import TextTable, percent, percent_ends, resampling_note

MOST_CLASSES = 30  # a confusion matrix of more classes is no longer read as text
_LONGEST_NAME = 40  # of a class, in letters: its number stays beside it


def classification_tables(report: ClassificationReport) -> list[TextTable]:
    """Returns tables of the streams, the classes and, up to 30 classes, the confusion matrix of the main scores."""
    made = [_stream_table(report), *_interval_tables(report), _class_table(report)]
    if len(report.class_names) <= MOST_CLASSES:
        made.append(_confusion_matrix(report))
    return made


def classification_notes(report: ClassificationReport) -> list[str]:
    """Returns sentences on what was counted, and what was left out."""
    occur = f"{int((report.main.support > 0).sum())} of {len(report.class_names)} classes occur"
    lines = [f"{counted(report.main.samples, 'sample')} of split {report.split!r}, {occur}; truth: {report.truth}."]
    lines += resampling_note(report.resampling, "samples", report.main.samples)
    lines.append(_calibration_note(report))
    if report.accepted is not None:
        kept, right = report.accepted
        lines.append(
            f"Nothing was recognized in {counted(report.main.samples - kept, 'sample')} (the tables count them as scored); of the other"
            f" {kept} {right} are right ({percent(float(divide(right, kept)))})."
        )
    for entry in report.left_out:
        lines.append(left_out_note(entry, named="label" in entry.reason))
    return lines


def _calibration_note(report: ClassificationReport) -> str:
    """Returns a sentence that defines the calibration error, and says how much of it chance would make."""
    found = report.calibration.get(list(report.streams)[-1])
    if found is None:
        return "No calibration error: the scores are no probabilities, which `dpc classify fuse` wants, too (softmax makes some)."
    return (
        f"Calibration error: mean |share right - probability| of the best class over {BINS} bins of equal width; "
        f"{report.main.samples} perfectly calibrated samples would show {percent(found.by_chance)} on average."
    )


def _stream_table(report: ClassificationReport) -> TextTable:
    top = report.main.top_accuracy is not None
    header = [
        "stream",
        "accuracy",
        "correct",
        report.resampling.title,
        *([f"top-{TOP_K}"] if top else []),
        "balanced accuracy",
        "macro F1",
        "calibration error",
    ]
    rows = [_stream_row(name, values, report.calibration.get(name)) for name, values in report.streams.items()]
    return TextTable("Accuracy", header, rows)


def _stream_row(name: str, values: ClassificationMetrics, calibration: Calibration | None) -> list[str]:
    low, high = values.interval
    top = [] if values.top_accuracy is None else [percent(values.top_accuracy)]
    return [
        name,
        percent(values.accuracy),
        f"{values.correct}/{values.samples}",
        f"{100 * low:.1f} - {percent(high)}",
        *top,
        percent(values.balanced_accuracy),
        percent(values.macro_f1),
        percent(calibration.error) if calibration else "-",
    ]


def _interval_tables(report: ClassificationReport) -> list[TextTable]:
    """Returns bootstrap intervals of what isn't a share of the samples, and of top-k accuracy; none without resamples."""
    if not report.resampling.resamples:
        return []
    top = f"top{TOP_K}_accuracy"
    titles = {top: f"top-{TOP_K}"} if report.main.top_accuracy is not None else {}
    titles |= {key: title_of(key) for key in ("balanced_accuracy", "macro_f1", "calibration_error")}
    rows = [
        [title, *(percent_ends(own.get(key)) for own in report.intervals.values())] for key, title in titles.items()
    ]
    return [TextTable(f"{report.resampling.title}s", ["metric", *report.intervals], rows)]


def _class_table(report: ClassificationReport) -> TextTable:
    main = report.main
    rows = [
        [
            _class_title(label, name),
            percent(main.recall[label]),
            f"{main.hits[label]}/{main.support[label]}",
            percent(main.precision[label]),
            percent(main.f1[label]),
        ]
        for label, name in enumerate(report.class_names)
    ]
    return TextTable("By class", ["class", "accuracy (recall)", "correct", "precision", "F1"], rows)


def _confusion_matrix(report: ClassificationReport) -> TextTable:
    rows = [
        [_class_title(label, name), *("." if count == 0 else str(count) for count in report.main.confusion[label])]
        for label, name in enumerate(report.class_names)
    ]
    header = ["truth \\ predicted", *(str(label) for label in range(len(report.class_names)))]
    return TextTable("Confusion matrix (samples)", header, rows)


def _class_title(label: int, name: str) -> str:
    short = name if len(name) <= _LONGEST_NAME else name[: _LONGEST_NAME - 1] + "…"
    return f"{label} {short}" if name else str(label)
