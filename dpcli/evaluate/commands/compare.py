"""`dpc evaluate compare`: compares two predictions of the same samples."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from dpcli.evaluate.bootstrap import Resampling
from dpcli.evaluate.commands.open_files import open_files
from dpcli.evaluate.compare.file_metrics import EvaluationOptions
from dpcli.evaluate.compare.paired import evaluate_compare
from dpcli.evaluate.compare.paired_tables import compare_notes, compare_tables
from dpcli.evaluate.compare.result_json import compare_json
from dpcli.evaluate.results import Result


def run_compare(
    first: str, second: str, options: EvaluationOptions, resampling: Resampling, picture: Path | None = None
) -> Result:
    """Returns the differences of two files (one may be `-`: from a pipe), and draws them where `picture` is named.

    Errors are those of `evaluate_compare`.
    """
    with ExitStack() as stack:
        paths = open_files(stack, [first, second])
        report = evaluate_compare(paths[0], paths[1], options, resampling, (first, second))
    if picture is not None:
        from dpcli.evaluate.compare.paired_picture import draw_comparison

        draw_comparison(report, picture)
    return Result(compare_json(report), compare_tables(report), compare_notes(report))
