"""`dpc generate4d fit`: the options of a fit."""

from __future__ import annotations

from typing import Annotated

import typer

from dpcli.cli.options import Device, Force, Output, Picture, Seed
from dpcli.cli.settings_options import options_of
from dpcli.generate4d.config import CATALOG, PRESETS
from dpcli.runtime.settings.catalog import Given


@options_of(CATALOG, everyday=("size", "parts", "prior", "prior_model"), presets=PRESETS, preset="quick")
def fit(
    views: Annotated[
        str, typer.Argument(help="A views file (dpc prepare video | animation | artemis), or - for a pipe.")
    ],
    output: Output,
    given: Given,
    run: Annotated[
        str | None,
        typer.Option(
            "--run", help="Folder for checkpoints, log, settings and previews. Default: OUTPUT with the suffix .fit."
        ),
    ] = None,
    picture: Picture = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
) -> None:
    """Fit a 4D scene to the pictures of a views file. Running again continues; SIGTERM saves first (exit 75)."""
    from dpcli.generate4d.commands.fit import fit_scene
    from dpcli.generate4d.config import resolve_settings

    config, supervision = resolve_settings(given)
    fit_scene(views, output, config, supervision, run=run, picture=picture, seed=seed, device=device, force=force)
