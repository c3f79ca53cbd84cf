"""Runs of one experiment as a table and notes."""

from __future__ import annotations

from dpcli.counted import counted
from dpcli.evaluate.compare.runs import RunsReport
from dpcli.evaluate.metric_titles import metric_title
from dpcli.evaluate.text_tables import TextTable, number_ends, number_text


def runs_tables(report: RunsReport) -> list[TextTable]:
    """Returns one row for each run, then mean, standard deviation and interval."""
    keys, units = list(report.units), report.units
    header = ["run", *(metric_title(key, units[key]) for key in keys)]
    rows = [[run.title, *(number_text(run.metrics[key], units[key]) for key in keys)] for run in report.runs]
    spreads = report.spreads
    rows += [
        [f"mean of {len(report.runs)}", *(number_text(spreads[key].mean, units[key]) for key in keys)],
        ["± sd", *(number_text(spreads[key].sd, units[key]) for key in keys)],
        [
            f"{100 * report.confidence:.4g} % interval",
            *(number_ends(spreads[key].interval, units[key]) for key in keys),
        ],
    ]
    return [TextTable(f"{report.task.capitalize()} of {counted(len(report.runs), 'run')}", header, rows)]


def runs_notes(report: RunsReport) -> list[str]:
    """Returns sentences on what a run is, and what the spread says."""
    lines = [f"{run.title}: {run.source}" for run in report.runs]
    lines += report.notes
    number_of = counted(report.number, report.kind.removesuffix("s")) if report.number else "the same samples"
    if len(report.runs) == 1:
        lines.append(f"On {number_of}. One run only: its spread is undefined.")
    else:
        degrees = counted(len(report.runs) - 1, "degree")
        lines.append(
            f"All on {number_of}. sd over runs (n - 1 in the denominator); interval of the mean: Student's t, "
            f"{degrees} of freedom. It says what other runs would give on these samples."
        )
    lines += [
        f"{metric_title(key, '')}: undefined in some runs, so without a mean."
        for key in report.units
        if any(run.metrics[key] is None for run in report.runs)
    ]
    return lines
