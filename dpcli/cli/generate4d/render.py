"""`dpc generate4d render`: the options of drawing a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.options import Device, Force, Scene
from dpcli.cli.settings_options import options_of
from dpcli.generate4d.render_settings import CATALOG, RenderSettings
from dpcli.runtime.settings.catalog import Given

_EVERYDAY = ("path", "azimuth", "elevation", "size", "time", "color", "background", "trajectories")


@options_of(CATALOG, everyday=_EVERYDAY)
def render(
    scene: Scene,
    given: Given,
    output: Annotated[
        str | None,
        typer.Option("-o", "--output", help="A video (.mp4), animation (.gif), picture (.png) or folder of pictures."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="Write a contact sheet (.png): four sides, instants of the clip.")
    ] = None,
    cameras: Annotated[
        Path | None,
        typer.Option("--cameras", help="A views file: write one (-o FILE.h5) as its cameras see the scene."),
    ] = None,
    device: Device = "auto",
    force: Force = False,
) -> None:
    """Draw a scene from any side at any time: as a video, as pictures, as a contact sheet, or as a views file."""
    from dpcli.generate4d.commands.render import render_scene

    settings = CATALOG.resolve({"render": RenderSettings()}, given)["render"]
    render_scene(scene, output, settings, picture=picture, cameras=cameras, device=device, force=force)
