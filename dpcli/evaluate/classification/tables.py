"""The classification report as text: tables for a terminal, or markdown for a document."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TextIO

import numpy as np

from dpcli.evaluate.bootstrap import Interval, Resampling
from dpcli.evaluate.classification.metrics import ClassificationMetrics
from dpcli.evaluate.classification.protocol import ClassificationReport
from dpcli.standard_streams import printable

MOST_CLASSES = 30  # a confusion matrix of more classes is no longer read as text
_UNDEFINED = "-"
_PIPE_WIDTH = 250  # columns when nobody's terminal sets a limit
_NAMES_SHOWN = 10


@dataclass
class TextTable:
    """Header and rows of text; the first column is aligned to the left, the others to the right."""

    title: str
    header: list[str]
    rows: list[list[str]]

    def __post_init__(self) -> None:  # names of classes and files are among them
        self.header = [printable(cell) for cell in self.header]
        self.rows = [[printable(cell) for cell in row] for row in self.rows]

    @property
    def width(self) -> int:
        """Columns of text it takes in a terminal."""
        cells = zip(self.header, *self.rows, strict=True)
        return sum(max(len(cell) for cell in column) + 2 for column in cells)


def percent(share: float | None) -> str:
    """`0.8512` -> `85.1 %`; `-` for an undefined share."""
    return _UNDEFINED if share is None or np.isnan(share) else f"{100 * share:.1f} %"


def percent_ends(own: Interval | None) -> str:
    """`83.1 - 87.0 %`; `-` where there is no interval or an undefined one."""
    return f"{100 * own.low:.1f} - {percent(own.high)}" if own is not None and own.defined else _UNDEFINED


def resampling_note(resampling: Resampling, of: str, number: int) -> list[str]:
    """How the intervals were found, as a list of one line, or of none where there are none."""
    if not resampling.resamples:
        return []
    if number < 2:
        return [f"Intervals: undefined; there is one of these {of} only, and nothing says how another would differ."]
    return [
        f"Intervals: {100 * resampling.confidence:.4g} %, bootstrap (BCa, {resampling.resamples} resamples of the "
        f"{number} {of}, seed {resampling.seed}): what other {of} of this kind would give, not another training."
    ]


def tables(report: ClassificationReport) -> list[TextTable]:
    """Streams, classes and, up to 30 classes, the confusion matrix of the main scores."""
    made = [_streams(report), *_intervals(report), _classes(report)]
    if len(report.class_names) <= MOST_CLASSES:
        made.append(_confusion(report))
    return made


def notes(report: ClassificationReport) -> list[str]:
    """What was counted, and what was left out."""
    occur = f"{int((report.main.support > 0).sum())} of {len(report.class_names)} classes occur"
    lines = [f"{report.main.samples} samples of split {report.split!r}, {occur}; truth: {report.truth}."]
    lines += resampling_note(report.resampling, "samples", report.main.samples)
    for entry in report.left_out:
        shown = ", ".join(entry.names[:_NAMES_SHOWN]) + (", ..." if len(entry.names) > _NAMES_SHOWN else "")
        named = f" ({shown})" if "label" in entry.reason else ""
        lines.append(f"Left out, {entry.reason}: {len(entry.names)}{named}.")
    return lines


def _streams(report: ClassificationReport) -> TextTable:
    top = report.main.top_accuracy is not None
    interval = f"{100 * report.resampling.confidence:.4g} % interval"
    header = [
        "stream",
        "accuracy",
        "correct",
        interval,
        *([f"top-{report.main.top_k}"] if top else []),
        "balanced accuracy",
        "macro F1",
    ]
    return TextTable("Accuracy", header, [_stream_row(name, values) for name, values in report.streams.items()])


def _stream_row(name: str, values: ClassificationMetrics) -> list[str]:
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
    ]


def _intervals(report: ClassificationReport) -> list[TextTable]:
    """Bootstrap intervals of what isn't a share of the samples, and of top-k accuracy; none without resamples."""
    if not report.resampling.resamples:
        return []
    top = f"top{report.main.top_k}_accuracy"
    titles = {top: f"top-{report.main.top_k}", "balanced_accuracy": "balanced accuracy", "macro_f1": "macro F1"}
    if report.main.top_accuracy is None:
        titles.pop(top)
    rows = [
        [title, *(percent_ends(own.get(key)) for own in report.intervals.values())] for key, title in titles.items()
    ]
    return [TextTable(f"{100 * report.resampling.confidence:.4g} % intervals", ["metric", *report.intervals], rows)]


def _classes(report: ClassificationReport) -> TextTable:
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


def _confusion(report: ClassificationReport) -> TextTable:
    rows = [
        [_class_title(label, name), *("." if count == 0 else str(count) for count in report.main.confusion[label])]
        for label, name in enumerate(report.class_names)
    ]
    header = ["truth \\ predicted", *(str(label) for label in range(len(report.class_names)))]
    return TextTable("Confusion matrix (samples)", header, rows)


def _class_title(label: int, name: str) -> str:
    return f"{label} {name}" if name else str(label)


def print_report(report: ClassificationReport, stream: TextIO) -> None:
    """Write the tables to a terminal, or plainly to a file; a matrix wider than the terminal is replaced by a hint."""
    print_tables(tables(report), notes(report), stream)


def print_tables(made: list[TextTable], lines: list[str], stream: TextIO) -> None:
    """Write tables, then lines of text, as `print_report`."""
    from rich.console import Console

    console = Console(file=stream, highlight=False, width=None if stream.isatty() else _PIPE_WIDTH)
    for table in made:
        if table.width > console.width:
            console.print(f"{table.title}: {table.width} columns wide; widen the terminal, or use --picture.\n")
        else:
            console.print(_rich(table), "")
    for line in lines:
        console.print(printable(line), markup=False)


def _rich(table: TextTable):
    from rich import box
    from rich.table import Table
    from rich.text import Text

    made = Table(
        title=Text(table.title),
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1),
        pad_edge=False,
        title_style="bold",
        show_edge=False,
    )
    for position, name in enumerate(table.header):
        made.add_column(Text(name), justify="left" if position == 0 else "right", no_wrap=True)
    for row in table.rows:
        made.add_row(*(Text(cell) for cell in row))
    return made


def markdown(report: ClassificationReport) -> str:
    """The same tables for a document."""
    return markdown_tables(tables(report), notes(report))


def markdown_tables(made: list[TextTable], lines: list[str]) -> str:
    """Tables, then lines of text, for a document."""
    return "\n\n".join([*(f"**{table.title}**\n\n{_markdown_table(table)}" for table in made), *map(printable, lines)])


def _markdown_table(table: TextTable) -> str:
    lines = [table.header, ["---", *["---:"] * (len(table.header) - 1)], *table.rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
