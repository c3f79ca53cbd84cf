"""`dpc evaluate report`: puts many results on one page, or into one document."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dpcli.evaluate.report import arrange, collect, report_html, report_latex, report_markdown
from dpcli.evaluate.report.thesis_tables import choose_tables

WRITERS = {"html": report_html, "markdown": report_markdown, "latex": report_latex}


@dataclass(frozen=True)
class ReportText:
    """Holds the text of a report, of how many results it is, and results that were given twice, in words."""

    text: str
    results: int
    duplicates: list[str]


def run_report(
    results: Sequence[str],
    form: str,
    *,
    truth: Path | None,
    split: str | None,
    beside: Sequence[str],
    title: str,
    pictures: bool,
) -> ReportText:
    """Returns the report of all results; form: html, markdown or latex. beside: ids of the thesis's tables.

    Errors are those of `collect` and `arrange`.
    """
    choose_tables(beside, [])  # a wrong name is said before the work
    collected = collect(results, truth, split=split, pictures=pictures and form == "html")
    made = arrange(collected, title=title, beside=beside)
    return ReportText(WRITERS[form](made), len(made.sections), collected.duplicates)
