"""`dpc generate4d fit`: the options of a fit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from dpcli.cli.option_groups import with_option_groups
from dpcli.cli.options import Device, Force, Picture, Seed
from dpcli.cli.settings_options import options_of
from dpcli.cli.spread_options import SpreadClips
from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.generate4d.config import CATALOG, PRESETS, resolve_settings, unread_settings
from dpcli.runtime.progress import log
from dpcli.runtime.settings.catalog import Given


@with_option_groups
@options_of(CATALOG, everyday=("size", "parts", "prior", "prior_model"), presets=PRESETS, preset="quick")
def fit(
    views: Annotated[
        list[str],
        typer.Argument(help="Views files (dpc prepare video | animation | artemis), one or many, or - for a pipe."),
    ],
    output: Annotated[
        str, typer.Option("-o", "--output", help="File to write, or - for a pipe; of many clips the folder.")
    ],
    *,
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
    spread: SpreadClips,
    force: Force = False,
) -> None:
    """Fit a 4D scene to the pictures of each views file. Running again continues; SIGTERM saves first (exit 75)."""
    config, supervision = resolve_settings(given)
    for line in unread_settings(given, config, supervision):
        log.warn(line)
    many = len(views) > 1 or output.endswith("/") or Path(output).is_dir()
    if many:
        if run is not None or picture is not None:
            raise UsageError("--run and --picture are for one clip; several have a folder NAME.fit each, with previews")
        _fit_many(views, Path(output), config, supervision, seed=seed, device=device, force=force, spread=spread.spread)
        return
    if spread != SpreadClips():
        raise UsageError("--jobs, --shard and --dask spread many clips; one is fitted as a whole")
    from dpcli.generate4d.commands.fit import fit_scene

    fit_scene(views[0], output, config, supervision, run=run, picture=picture, seed=seed, device=device, force=force)


def _fit_many(views: list[str], folder: Path, *settings: Any, **options: Any) -> None:
    from dpcli.generate4d.commands.fit_clips import fit_clips

    fitted = fit_clips(views, folder, *settings, **options)
    typer.echo(f"{folder}: {counted(len(fitted.scenes), 'scene')}")
    if fitted.failed:
        named = "; ".join(f"{views}: {reason}" for views, reason in fitted.failed[:5])
        raise DataError(f"no scene of {counted(len(fitted.failed), 'clip')}: {named}")
