"""Comparisons and runs as tables and notes, and a comparison as a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.evaluate.bootstrap import Interval
from dpcli.evaluate.classification.protocol import LeftOut
from dpcli.evaluate.classification.tables import TextTable
from dpcli.evaluate.compare.paired import Change, CompareReport, Paired
from dpcli.evaluate.compare.runs import RunsReport
from dpcli.evaluate.compare.sample_metrics import LOWER_IS_BETTER

_NAMES_SHOWN = 10
_LOWER = " \N{DOWNWARDS ARROW}"  # lower is better
_TITLES = {
    "ap": "AP",
    "pq": "PQ",
    "f1": "F1",
    "pre": "Pre",
    "rec": "Rec",
    "miou": "mIoU",
    "ri": "RI",
    "epe3d": "EPE3D",
    "accs": "AccS",
    "accr": "AccR",
    "macro_f1": "macro F1",
    "psnr": "PSNR",
    "ssim": "SSIM",
}


def metric_title(key: str, unit: str) -> str:
    """A metric as tables call it, with its unit; fractions are shown in percent."""
    name = _TITLES.get(key, key.replace("_", " "))
    shown = "%" if unit == "fraction" else unit
    return f"{name} ({shown})" if shown and shown != "1" else name


def number(value: float | None, unit: str = "", *, signed: bool = False) -> str:
    """`0.8512` of a fraction -> `85.1`; other units to four digits; `-` for an undefined number."""
    if value is None or np.isnan(value):
        return "-"
    sign = "+" if signed else ""
    return f"{100 * value:{sign}.1f}" if unit == "fraction" else f"{value:{sign}.4g}"


def ends(own: Interval, unit: str) -> str:
    """`-1.2 to +3.4`; `-` where undefined."""
    if not own.defined:
        return "-"
    return f"{number(own.low, unit, signed=True)} to {number(own.high, unit, signed=True)}"


def p_value(value: float | None) -> str:
    """Three digits, never as certain as 0."""
    if value is None or np.isnan(value):
        return "-"
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def compare_tables(report: CompareReport) -> list[TextTable]:
    """For each task the metrics, and the samples that changed most."""
    made = []
    for part in report.parts:
        interval = f"{100 * report.resampling.confidence:.4g} % interval"
        header = ["metric", "A", "B", "A - B", interval, "p", "A better", "B better", "equal", "Wilcoxon p"]
        rows = [_change_row(key, change) for key, change in part.changes.items()]
        made.append(TextTable(f"{part.task.capitalize()}: A against B, {len(part.names)} {part.kind}", header, rows))
        if part.changed:
            made.append(_changed(part))
    return made


def _change_row(key: str, own: Change) -> list[str]:
    counts = ["-" if count is None else str(count) for count in (own.a_better, own.b_better, own.ties)]
    title = metric_title(key, own.unit) + (_LOWER if key in LOWER_IS_BETTER else "")
    return [
        title,
        number(own.a, own.unit),
        number(own.b, own.unit),
        number(own.difference, own.unit, signed=True),
        ends(own.interval, own.unit),
        p_value(own.p),
        *counts,
        p_value(own.wilcoxon_p),
    ]


def _changed(part: Paired) -> TextTable:
    unit = part.changes[part.changed_by].unit
    title = metric_title(part.changed_by, unit)
    rows = [[name, number(a, unit), number(b, unit), number(a - b, unit, signed=True)] for name, a, b in part.changed]
    return TextTable(f"Changed most, by {title}", [part.kind, "A", "B", "A - B"], rows)


def compare_notes(report: CompareReport) -> list[str]:
    """What was compared and how, McNemar's test, and what was left out."""
    first, resampling = report.parts[0], report.resampling
    lines = [f"A: {report.sources[0]}", f"B: {report.sources[1]}", *report.notes]
    if report.question.truth:
        lines.append(f"Truth: {report.question.truth}. Protocol {report.question.protocol}.")
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
                f"Right in A only: {own.only_a}, in B only: {own.only_b}; McNemar's exact test: p {p_value(own.p)}."
            )
        lines += left_out_lines(part.left_out, part.kind)
    return lines


def left_out_lines(entries: list[LeftOut], kind: str) -> list[str]:
    """One line for each reason, with a few names."""
    lines = []
    for entry in entries:
        shown = ", ".join(entry.names[:_NAMES_SHOWN]) + (", ..." if len(entry.names) > _NAMES_SHOWN else "")
        lines.append(f"Left out, {entry.reason}: {len(entry.names)} {kind} ({shown}).")
    return lines


def runs_tables(report: RunsReport) -> list[TextTable]:
    """One row for each run, then mean, standard deviation and interval."""
    keys, units = list(report.units), report.units
    header = ["run", *(metric_title(key, units[key]) for key in keys)]
    rows = [[run.title, *(number(run.metrics[key], units[key]) for key in keys)] for run in report.runs]
    spreads = report.spreads
    rows += [
        [f"mean of {len(report.runs)}", *(number(spreads[key].mean, units[key]) for key in keys)],
        ["± sd", *(number(spreads[key].sd, units[key]) for key in keys)],
        [
            f"{100 * report.confidence:.4g} % interval",
            *(_plain_ends(spreads[key].interval, units[key]) for key in keys),
        ],
    ]
    return [TextTable(f"{report.task.capitalize()} of {len(report.runs)} runs", header, rows)]


def _plain_ends(own: Interval, unit: str) -> str:
    return f"{number(own.low, unit)} - {number(own.high, unit)}" if own.defined else "-"


def runs_notes(report: RunsReport) -> list[str]:
    """What a run is, and what the spread says."""
    lines = [f"{run.title}: {run.source}" for run in report.runs]
    number_of = f"{report.number} {report.kind}" if report.number else "the same samples"
    lines.append(
        f"All on {number_of}. sd over runs (n - 1 in the denominator); interval of the mean: Student's t, "
        f"{len(report.runs) - 1} degrees of freedom. It says what other runs would give on these samples."
    )
    if len(report.runs) == 1:
        lines.append("One run only: its spread is undefined.")
    lines += [
        f"{metric_title(key, '')}: undefined in some runs, so without a mean."
        for key in report.units
        if any(run.metrics[key] is None for run in report.runs)
    ]
    return lines


def compare_picture(report: CompareReport, path: Path) -> None:
    """Differences with their intervals, one panel for each unit, and each sample in A against the same in B."""
    from matplotlib.figure import Figure

    rows = {key: own for part in report.parts for key, own in part.changes.items()}
    panels = [
        {key: own for key, own in rows.items() if own.unit == unit}
        for unit in dict.fromkeys(own.unit for own in rows.values())
    ]
    part = report.parts[0]
    figure = Figure(figsize=(4 * (len(panels) + 1), 1.8 + 0.45 * max(5, *map(len, panels))), layout="constrained")
    axes = figure.subplots(1, len(panels) + 1, squeeze=False)[0]
    for place, group in zip(axes, panels, strict=False):
        _differences_panel(place, group)
    _samples_panel(axes[-1], part)
    figure.suptitle(f"A: {report.sources[0]}\nB: {report.sources[1]}", fontsize=9, parse_math=False)
    figure.savefig(path, dpi=150)


def _differences_panel(axes, group: dict[str, Change]) -> None:
    for row, (key, own) in enumerate(group.items()):
        scale = 100 if own.unit == "fraction" else 1
        if own.interval.defined:
            axes.plot([scale * own.interval.low, scale * own.interval.high], [row, row], color="#4c72b0", linewidth=2)
        if not np.isnan(own.difference):
            axes.plot([scale * own.difference], [row], "o", color="#1b2a41", label=key)
    axes.set_yticks(range(len(group)), [metric_title(key, own.unit) for key, own in group.items()], parse_math=False)
    axes.axvline(0, color="#888888", linewidth=0.8)
    axes.set_ylim(len(group) - 0.5, -0.5)
    axes.set_xlabel("A - B")


def _samples_panel(axes, part: Paired) -> None:
    if not part.changed_by:
        axes.set_axis_off()
        return
    a, b = part.values
    scale = 100 if part.changes[part.changed_by].unit == "fraction" else 1
    if part.mcnemar is not None:  # only right or wrong: counts say more than points on top of each other
        both = [[int(((a == i) & (b == j)).sum()) for j in (1, 0)] for i in (1, 0)]
        axes.imshow(both, cmap="Blues", vmax=2 * max(map(max, both)))  # dark text stays legible
        for i, row in enumerate(both):
            for j, count in enumerate(row):
                axes.text(j, i, str(count), ha="center", va="center")
        axes.set_xticks([0, 1], ["B right", "B wrong"])
        axes.set_yticks([0, 1], ["A right", "A wrong"])
        return
    axes.plot(scale * b, scale * a, ".", color="#4c72b0")
    defined = scale * np.concatenate([a, b])
    low, high = np.nanmin(defined), np.nanmax(defined)
    axes.plot([low, high], [low, high], color="#888888", linewidth=0.8)
    title = metric_title(part.changed_by, part.changes[part.changed_by].unit)
    axes.set_xlabel(f"B: {title} of each of the {part.kind}", parse_math=False)
    axes.set_ylabel("A")
