"""A comparison as tables and notes."""

from __future__ import annotations

from dpcli.counted import counted
from dpcli.evaluate.choices import LOWER_IS_BETTER
from dpcli.evaluate.compare.paired import Change, CompareReport, Paired
from dpcli.evaluate.metric_titles import metric_title
from dpcli.evaluate.results import left_out_note
from dpcli.evaluate.text_tables import TextTable, number_ends, number_text, p_value_text

_LOWER = " \N{DOWNWARDS ARROW}"  # lower is better


def compare_tables(report: CompareReport) -> list[TextTable]:
    """Returns for each task a table of the metrics, and one of the samples that changed most."""
    made = []
    for part in report.parts:
        header = ["metric", "A", "B", "A - B", report.resampling.title, "p"]
        header += ["A better", "B better", "equal", "Wilcoxon p"]
        rows = [_change_row(key, change) for key, change in part.changes.items()]
        of = counted(len(part.names), part.kind.removesuffix("s"))
        made.append(TextTable(f"{part.task.capitalize()}: A against B, {of}", header, rows))
        if part.changed:
            made.append(_changed(part))
    return made


def _change_row(key: str, own: Change) -> list[str]:
    counts = ["-" if count is None else str(count) for count in (own.a_better, own.b_better, own.ties)]
    title = metric_title(key, own.unit) + (_LOWER if key in LOWER_IS_BETTER else "")
    return [
        title,
        number_text(own.a, own.unit),
        number_text(own.b, own.unit),
        number_text(own.difference, own.unit, signed=True),
        number_ends(own.interval, own.unit, signed=True),
        p_value_text(own.p),
        *counts,
        p_value_text(own.wilcoxon_p),
    ]


def _changed(part: Paired) -> TextTable:
    unit = part.changes[part.changed_by].unit
    title = metric_title(part.changed_by, unit)
    rows = [
        [name, number_text(a, unit), number_text(b, unit), number_text(a - b, unit, signed=True)]
        for name, a, b in part.changed
    ]
    return TextTable(f"Changed most, by {title}", [part.kind, "A", "B", "A - B"], rows)


def compare_notes(report: CompareReport) -> list[str]:
    """Returns sentences on what was compared and how, McNemar's test, and what was left out."""
    first, resampling = report.parts[0], report.resampling
    lines = [f"A: {report.sources[0]}", f"B: {report.sources[1]}", *report.notes]
    if report.options.truth:
        lines.append(f"Truth: {report.options.truth}. Protocol {report.options.protocol}.")
    if len(first.names) < 2:
        lines.append(f"One of these {first.kind} only: intervals and p are undefined.")
    elif resampling.resamples:
        lines.append(
            f"Interval, p (two-sided): paired bootstrap, {resampling.resamples} resamples of the {len(first.names)} {first.kind}, "
            f"seed {resampling.seed}. They say what other {first.kind} would give, not another training. "
            f"Wilcoxon: signed ranks of single {first.kind}. No correction for looking at several metrics."
        )
    if any(key in LOWER_IS_BETTER for part in report.parts for key in part.changes):
        lines.append(f"{_LOWER.strip()}: lower is better.")
    for part in report.parts:
        if part.mcnemar is not None:
            own = part.mcnemar
            lines.append(
                f"Right in A only: {own.only_a}, in B only: {own.only_b}; McNemar's exact test: p {p_value_text(own.p)}."
            )
        notes = [left_out_note(entry, part.kind.removesuffix("s")) for entry in part.left_out]
        lines += [note for note in notes if note not in lines]  # segmentation and motion leave out the same
    return lines
