"""`dpc classify train`: its options, and what it prints."""

from __future__ import annotations

from typing import Annotated

import typer

from dpcli.classify.presets import PRESETS
from dpcli.classify.settings import TRAINING
from dpcli.cli.options import Device, Force, Seed
from dpcli.cli.settings_options import options_of
from dpcli.runtime.settings.catalog import Given
from dpcli.standard_streams import printable

_EVERYDAY = ("init", "fine_tune", "frames", "points", "timing", "epochs", "batch", "lr", "validation")


@options_of(TRAINING, _EVERYDAY, presets={**PRESETS, "auto": PRESETS["quick"]}, preset="auto")
def train(
    data: Annotated[str, typer.Argument(help="A clouds file with labels and a split 'train', or - for a pipe.")],
    output: Annotated[str, typer.Option("-o", "--output", help="Folder for weights, settings, logs and curves.")],
    given: Given,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
) -> None:
    """Train both streams: static, then dynamic on the frozen static weights. Running again continues a stopped run.

    Presets: thesis and release (its text and its published code), quick (a seventh of the operations, fits a CPU), tiny
    (demo), sparse (at most 64 points a frame, as of a radar), long (quick for videos of four clips or more, whose clips
    are judged together); auto takes sparse, long or quick, whichever suits the data. The folder's settings.toml holds all
    settings; --config reads it back for an equal run.

    Several GPUs or machines: torchrun --nproc-per-node N -m dpcli classify train ...; the batch is shared among them.
    """
    from dpcli.classify.commands.train import train as run

    result = run(data, output, given, seed=seed, device=device, force=force)
    if result is None:  # not the first of several processes
        return
    typer.echo(result.weights)
    if not result.accuracy:
        typer.echo(
            "no video was held out to judge it: use `dpc classify predict` and `dpc evaluate classification` on other videos"
        )
    else:
        scores = ", ".join(f"{key} {100 * value:.1f} %" for key, value in result.accuracy.items())
        typer.echo(f"{result.videos} validation videos: {scores}")
        if result.forest is not None:
            typer.echo(f"a random forest on hand-made descriptors: {100 * result.forest:.1f} % (dpc classify baseline)")
        if result.caveat:
            typer.echo(printable(f"note: {result.caveat}"))
