"""`dpc evaluate runs`."""

from __future__ import annotations

from typing import Annotated

import typer

from dpcli.cli.evaluate.comparison_options import ComparisonOptions
from dpcli.cli.evaluate.options import Confidence, FormOptions
from dpcli.cli.evaluate.output import print_result
from dpcli.cli.option_groups import with_option_groups
from dpcli.errors import UsageError


@with_option_groups
def runs(
    files: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE",
            help="Scores, parts or gaussians files, videos, or files of what `dpc evaluate ... --json` printed.",
        ),
    ],
    *,
    comparison: ComparisonOptions,
    confidence: Confidence = 0.95,
    output: FormOptions,
) -> None:
    """Evaluate several runs (seeds) in the same way: a row each, mean, standard deviation, t interval of the mean."""
    if not 0 < confidence < 1:
        raise UsageError(f"--confidence {confidence:g}: expected a share between 0 and 1, such as 0.95")
    from dpcli.evaluate.commands.runs import run_runs

    print_result(run_runs(files, comparison.options(), confidence), output)
