"""`dpc evaluate compare`."""

from __future__ import annotations

from typing import Annotated

import typer

from dpcli.cli.evaluate.comparison_options import ComparisonOptions
from dpcli.cli.evaluate.options import Intersect, IntervalOptions, PictureOptions
from dpcli.cli.evaluate.output import print_result
from dpcli.cli.option_groups import with_option_groups


@with_option_groups
def compare(
    first: Annotated[
        str, typer.Argument(metavar="A", help="Scores file, parts file, gaussians file or video; - for a pipe.")
    ],
    second: Annotated[str, typer.Argument(metavar="B", help="Another prediction of the same samples.")],
    *,
    comparison: ComparisonOptions,
    intersect: Intersect = False,
    intervals: IntervalOptions,
    output: PictureOptions,
) -> None:
    """Compare two predictions of the same samples: differences with paired intervals, p values, and what changed most."""
    from dpcli.evaluate.commands.compare import run_compare

    options = comparison.options(intersect=intersect)
    print_result(run_compare(first, second, options, intervals.resampling, picture=output.picture), output)
