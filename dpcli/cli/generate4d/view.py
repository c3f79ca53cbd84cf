"""`dpc generate4d view`: the options of writing a scene as a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.options import Force, Scene


def view(
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="The page (.html).")],
    clip: Annotated[
        Path | None,
        typer.Option("--input", help="The clip that was fitted (.h5), whose pictures are shown beside the scene."),
    ] = None,
    title: Annotated[str | None, typer.Option("--title", help="Heading. Default: the name of what was fitted.")] = None,
    min_opacity: Annotated[
        float, typer.Option("--min-opacity", min=0, max=1, show_default="1/255", help="Leave fainter Gaussians out.")
    ] = 1 / 255,
    fps: Annotated[
        float | None,
        typer.Option(
            "--fps", min=1, max=120, help="Frames of the clip per second. Default: its own rate, within 1 to 60."
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Write one HTML file that shows a scene in any browser, without server or network: turn, zoom, play, color by part."""
    from dpcli.generate4d.commands.view import view_scene

    view_scene(scene, output, clip=clip, title=title, min_opacity=min_opacity, fps=fps, force=force)
