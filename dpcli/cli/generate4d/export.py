"""`dpc generate4d export`: the options of writing a scene for other programs."""

from __future__ import annotations

from typing import Annotated

import typer

from dpcli.cli.options import Force, Scene, Seed
from dpcli.generate4d.out.formats import Axes, Format


def export(
    scene: Scene,
    output: Annotated[
        str, typer.Option("-o", "--output", help="A file, a folder for one file per frame, or - (clouds).")
    ],
    form: Annotated[
        Format,
        typer.Option(
            "--as",
            help="Format: ply, splat, compressed.ply or spz (the canonical Gaussians for a file name, every frame for a "
            "folder), ply-sequence, splat-sequence (every frame), clouds (points with parts), cameras or metrics (.json).",
        ),
    ] = "ply",
    time: Annotated[
        float | None,
        typer.Option("--time", help="Write the Gaussians at this second into one file, instead of the canonical ones."),
    ] = None,
    axes: Annotated[
        Axes,
        typer.Option(
            "--axes", help="player: x right, y down, z forward; keep: y up, as in the scene. spz is always y up."
        ),
    ] = "player",
    min_opacity: Annotated[
        float | None,
        typer.Option("--min-opacity", min=0, max=1, help="Leave fainter Gaussians out. Default: 0; 0.3 for clouds."),
    ] = None,
    points: Annotated[
        int | None, typer.Option("--points", min=1, help="Most points of a frame, for clouds. Default: all.")
    ] = None,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Write a scene for players and other tools: 3DGS .ply, .splat, .spz, point clouds with parts, cameras, metrics."""
    from dpcli.generate4d.commands.export import export_scene

    export_scene(
        scene, output, form=form, time=time, axes=axes, min_opacity=min_opacity, points=points, seed=seed, force=force
    )
