"""`dpc evaluate segments`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.evaluate.options import FormOptions, Intersect, IntervalOptions
from dpcli.cli.evaluate.output import print_result
from dpcli.cli.option_groups import with_option_groups


@with_option_groups
def segments(
    predicted: Annotated[
        str, typer.Argument(help="Table that `dpc classify predict --segments` wrote, .csv or .json, or - for a pipe.")
    ],
    *,
    truth: Annotated[
        Path,
        typer.Option("--truth", help="Table of the true segments: recording,start,end,class; end: one past the last."),
    ],
    intersect: Intersect = False,
    intervals: IntervalOptions,
    output: FormOptions,
) -> None:
    """Evaluate recordings cut into actions: frame accuracy, edit score, F1 at 10, 25 and 50 % overlap."""
    from dpcli.evaluate.commands.segments import run_segments

    print_result(run_segments(predicted, truth, intersect=intersect, resampling=intervals.resampling), output)
