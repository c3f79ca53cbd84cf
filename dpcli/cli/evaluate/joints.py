"""`dpc evaluate joints`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.evaluate.options import FormOptions, Intersect, IntervalOptions, Split
from dpcli.cli.evaluate.output import print_result
from dpcli.cli.option_groups import with_option_groups


@with_option_groups
def joints(
    parts: Annotated[str, typer.Argument(help="Parts file with joints, from `dpc segment joints`, or - for a pipe.")],
    truth: Annotated[Path, typer.Option("--truth", help="Clouds file with the true parts and joints.")],
    *,
    split: Split = None,
    intersect: Intersect = False,
    intervals: IntervalOptions,
    output: FormOptions,
) -> None:
    """Evaluate joints: their types, the tree's edges, errors of axes (angle, position) and of values."""
    from dpcli.evaluate.commands.joints import run_joints

    print_result(run_joints(parts, truth, split=split, intersect=intersect, resampling=intervals.resampling), output)
