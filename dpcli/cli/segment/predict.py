"""`dpc segment predict`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.option_groups import with_option_groups
from dpcli.cli.options import Device, Force, Output, Picture, Seed
from dpcli.cli.settings_options import options_of
from dpcli.cli.spread_options import SpreadOptions
from dpcli.errors import UsageError
from dpcli.runtime.settings.catalog import Given
from dpcli.segment.prediction_settings import CATALOG, PredictSettings

EVERYDAY = ("method", "parts", "flow", "pairs", "points", "split")


@with_option_groups
@options_of(CATALOG, EVERYDAY)
def predict(
    data: Annotated[str, typer.Argument(help="A clouds file, or - for a pipe.")],
    output: Output,
    *,
    model: Annotated[
        str | None,
        typer.Option(
            "--model", help="A trained part network to use: file, training folder or shipped name (--method network)."
        ),
    ] = None,
    fast: Annotated[
        bool, typer.Option("--fast", help="Use the shipped network, frame by frame: the same as --method network.")
    ] = False,
    given: Given,
    picture: Picture = None,
    turntable: Annotated[
        Path | None, typer.Option("--turntable", help="Write an animation (.gif) of the first object to this file.")
    ] = None,
    ply: Annotated[
        Path | None, typer.Option("--ply", help="Write every frame as a colored .ply into this folder.")
    ] = None,
    seed: Seed = 0,
    device: Device = "auto",
    spread: SpreadOptions,
    force: Force = False,
) -> None:
    """Find the parts of every point, the same through all frames, each part's rigid motion, and the flow between frames."""
    settings = PredictSettings(**CATALOG.resolve(PredictSettings()._asdict(), _choose_network(given, model, fast)))
    from dpcli.segment.commands.predict import Drawings, predict_file

    drawings = Drawings(picture, turntable, ply)
    sequences = predict_file(
        data,
        output,
        settings,
        model=model,
        drawings=drawings,
        seed=seed,
        device=device,
        force=force,
        spread=spread.spread,
    )
    if output != "-":
        typer.echo(f"{output}: parts of {sequences} sequences")


def _choose_network(given: Given, model: str | None, fast: bool) -> Given:
    """Returns what was given with the method network where `--model` or `--fast` ask for it and no method is named."""
    named = given.values.get("method", "network")
    if fast and named != "network":
        raise UsageError(f"--fast: it means --method network, but --method {named} was given; leave one out")
    if (model is None and not fast) or "method" in given.values:
        return given
    return replace(given, flags={**given.flags, "method": "network"})
