"""`dpc classify profile`: its options, and what it prints."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from dpcli.classify.settings import NETWORK, NETWORK_PRESETS
from dpcli.cli.options import Device, Json
from dpcli.cli.settings_options import options_of
from dpcli.runtime.settings.catalog import Given


@options_of(NETWORK, ("backbone", "variant", "frames", "points"), presets=NETWORK_PRESETS, preset="thesis")
def profile(
    given: Given,
    model: Annotated[
        str | None, typer.Option("--model", help="A trained model. Default: an untrained one of --preset.")
    ] = None,
    classes: Annotated[int, typer.Option("--classes", help="Number of classes.")] = 20,
    steps: Annotated[
        bool, typer.Option("--steps", help="Also clips/s of training and inference, and where the time goes.")
    ] = False,
    device: Device = "auto",
    json_output: Json = False,
) -> None:
    """Show parameters and operations (true counts, and by the papers' way of counting), latency and peak memory."""
    from dpcli.classify.commands.profile import profile as run
    from dpcli.classify.network_cost import render

    result = run(model, given, classes, steps, device)
    typer.echo(json.dumps(result) if json_output else render(result))
