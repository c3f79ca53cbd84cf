"""`dpc evaluate runs`: evaluates several runs of one experiment."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack

from dpcli.evaluate.commands.open_files import open_files
from dpcli.evaluate.compare.file_metrics import EvaluationOptions
from dpcli.evaluate.compare.result_json import runs_json
from dpcli.evaluate.compare.runs import evaluate_runs
from dpcli.evaluate.compare.runs_tables import runs_notes, runs_tables
from dpcli.evaluate.results import Result
from dpcli.store.pipes import refuse_repeats


def run_runs(files: Sequence[str], options: EvaluationOptions, confidence: float) -> Result:
    """Returns the metrics of each file (one may be `-`: from a pipe), their mean, deviation and t interval.

    Errors are those of `evaluate_runs`, and UsageError where a file is named twice.
    """
    refuse_repeats(files)  # a run that counts twice makes the spread too small
    with ExitStack() as stack:
        report = evaluate_runs(open_files(stack, files), options, confidence, files)
    return Result(runs_json(report), runs_tables(report), runs_notes(report))
