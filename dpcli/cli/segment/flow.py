"""`dpc segment flow`."""

from __future__ import annotations

import typer

from dpcli.cli.options import Device, Force, Seed
from dpcli.cli.segment.options import RunOutput, TrainingData
from dpcli.cli.settings_options import options_of
from dpcli.runtime.settings.catalog import Given
from dpcli.segment.flow.config import CATALOG, PRESETS


@options_of(CATALOG, ("steps", "batch"), presets=PRESETS, preset="compact")
def flow(
    data: TrainingData, output: RunOutput, given: Given, seed: Seed = 0, device: Device = "auto", force: Force = False
) -> None:
    """Train a scene-flow estimator without labels (Chamfer distance and smoothness), for --flow of train and predict."""
    settings = CATALOG.resolve(PRESETS[str(given.preset)], given)
    from dpcli.segment.commands.flow import train_flow_estimator

    typer.echo(train_flow_estimator(data, output, **settings, seed=seed, device=device, force=force))
