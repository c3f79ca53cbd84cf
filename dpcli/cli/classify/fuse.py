"""`dpc classify fuse`: its options, and what it prints."""

from __future__ import annotations

from typing import Annotated

import typer

from dpcli.cli.options import Force, Output
from dpcli.counted import counted


def fuse(
    scores: Annotated[
        list[str],
        typer.Argument(
            help="Scores files of the same videos, or one file whose streams are averaged anew; one may be - for a pipe."
        ),
    ],
    output: Output,
    weights: Annotated[
        str | None,
        typer.Option(
            "--weights",
            help="One per file, with commas, as 0.7,0.3; or by name, as static=0.3,dynamic=0.7. Default: equal weights.",
        ),
    ] = None,
    weights_from: Annotated[
        str | None,
        typer.Option(
            "--weights-from",
            help="Scores of other, labeled videos by the same models, one for each fused file, with "
            "commas between: the weights with the greatest likelihood on them.",
        ),
    ] = None,
    mean: Annotated[
        str, typer.Option(help="arithmetic (thesis), or geometric: mean of logits, as in the published code.")
    ] = "arithmetic",
    force: Force = False,
) -> None:
    """Average the scores of several models, such as one on points and one on flow; each is kept as a stream."""
    from dpcli.classify.commands.fuse import fuse as run

    result = run(scores, output, weights=weights, weights_from=weights_from, mean=mean, force=force)
    if result.complete:
        typer.echo(f"{output}: complete")
    elif output != "-":
        shares = ", ".join(f"{name} {weight:.3g}" for name, weight in result.weights.items())
        kind = "mean" if mean == "arithmetic" else f"{mean} mean"
        unequal = f", weights {shares}" if len(set(result.weights.values())) > 1 else ""
        typer.echo(f"{output}: {kind} of {len(result.weights)} scores of {counted(result.videos, 'video')}{unequal}")
