"""`dpc segment train`."""

from __future__ import annotations

import typer

from dpcli.cli.options import Device, Force, Seed
from dpcli.cli.segment.options import RunOutput, TrainingData
from dpcli.cli.settings_options import options_of
from dpcli.runtime.settings.catalog import Given
from dpcli.segment.training.settings import CATALOG, PRESETS, TrainSettings

EVERYDAY = ("init", "flow", "supervised", "epochs", "batch", "lr", "points", "validation")


@options_of(CATALOG, EVERYDAY, presets=PRESETS, preset="compact")
def train(
    data: TrainingData, output: RunOutput, given: Given, seed: Seed = 0, device: Device = "auto", force: Force = False
) -> None:
    """Train a part network on pairs of frames; no labels are read unless --supervised. Running again continues."""
    settings = TrainSettings(**CATALOG.resolve(PRESETS[str(given.preset)], given))
    settings.refuse_unread()
    from dpcli.segment.commands.train import train_part_network

    typer.echo(train_part_network(data, output, settings, seed=seed, device=device, force=force))
