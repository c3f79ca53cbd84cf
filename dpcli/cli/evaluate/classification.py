"""`dpc evaluate classification`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.evaluate.options import Intersect, IntervalOptions, PictureOptions, Split
from dpcli.cli.evaluate.output import print_result
from dpcli.cli.option_groups import with_option_groups


@with_option_groups
def classification(
    scores: Annotated[str, typer.Argument(help="Scores file that `dpc classify predict` wrote, or - for a pipe.")],
    *,
    truth: Annotated[
        Path | None,
        typer.Option("--truth", help="Clouds file with the true labels. Default: the labels in the scores file."),
    ] = None,
    split: Split = None,
    intersect: Intersect = False,
    intervals: IntervalOptions,
    output: PictureOptions,
) -> None:
    """Evaluate a scores file: accuracy with its interval, per class and per stream, and the confusion matrix."""
    from dpcli.evaluate.commands.classification import run_classification

    result = run_classification(
        scores, truth, split, intersect=intersect, resampling=intervals.resampling, picture=output.picture
    )
    print_result(result, output)
