"""`dpc classify baseline`: its options, and what it prints."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated

import typer

from dpcli.cli.options import Force, Json, Seed
from dpcli.counted import counted


def baseline(
    data: Annotated[str, typer.Argument(help="A clouds file with labels, or - for a pipe.")],
    output: Annotated[
        str | None, typer.Option("-o", "--output", help="Scores file to write, for `evaluate`, or - for a pipe.")
    ] = None,
    seed: Seed = 0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Train and score a random forest in seconds, as a baseline for networks; it sees quantiles of position, motion and kept columns."""
    from dpcli.classify.commands.baseline import baseline as run

    result = run(data, output=output, seed=seed, force=force)
    if as_json:
        typer.echo(json.dumps({**asdict(result), "accuracy": result.accuracy}), err=output == "-")
        return
    typer.echo(
        f"forest: {100 * result.accuracy:.1f} % ({result.right} of {counted(result.judged, 'video')}, {counted(result.classes, 'class')};"
        f" learned from {result.learned}); these are {result.seen}",
        err=output == "-",
    )
