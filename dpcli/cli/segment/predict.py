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
from dpcli.counted import counted
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
    scene: Annotated[
        bool,
        typer.Option(
            "--scene", help="Find what moves on its own in lidar scans of streets: the same as --method scene."
        ),
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
    """Find the part of every point, consistent over all frames, each part's rigid motion, and the flow between frames."""
    chosen = _choose_method(given, model, fast, scene)
    settings = PredictSettings(**CATALOG.resolve(PredictSettings()._asdict(), chosen))
    settings.refuse_unread(chosen.values)
    from dpcli.segment.commands.predict import Drawings, predict_file, told_of_scenes

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
        typer.echo(f"{output}: parts of {counted(sequences, 'sequence')}")
        for line in told_of_scenes(output) if settings.classical.method == "scene" else ():
            typer.echo(line)


def _choose_method(given: Given, model: str | None, fast: bool, scene: bool) -> Given:
    """Returns what was given with the method that `--model`, `--fast` or `--scene` ask for, unless one is named."""
    asked = [("--fast", "network")] * fast + [("--scene", "scene")] * scene
    named = given.values.get("method")
    for flag, method in asked:
        other = f"--method {named}" if named not in (None, method) else "--scene" if len(asked) > 1 else ""
        if other:
            raise UsageError(f"{flag}: it means --method {method}, but {other} was given; leave one out")
    if named is not None or (model is None and not asked):
        return given
    return replace(given, flags={**given.flags, "method": asked[0][1] if asked else "network"})
