"""`dpc generate4d render`, `export`, `view`: a fitted scene as pictures, in other formats, as a page."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.options import Device, Force, Seed

Scene = Annotated[str, typer.Argument(help="A gaussians file, or - for a pipe.")]


def render(
    scene: Scene,
    output: Annotated[
        str | None,
        typer.Option("-o", "--output", help="A video (.mp4), animation (.gif), picture (.png) or folder of pictures."),
    ] = None,
    path: Annotated[
        str, typer.Option("--path", help="The camera: turntable, orbit (also up and down), swing, fixed or reference.")
    ] = "turntable",
    azimuth: Annotated[
        float | None, typer.Option(help="Degrees; 0 is at +z, positive toward +x. Default: the reference camera's.")
    ] = None,
    elevation: Annotated[float | None, typer.Option(help="Degrees above the horizon. Default: the same.")] = None,
    radius: Annotated[float | None, typer.Option(help="Distance to the origin. Default: the same.")] = None,
    fovy: Annotated[float | None, typer.Option(help="Vertical field of view, degrees. Default: the same.")] = None,
    size: Annotated[int | None, typer.Option("--size", help="Pixels of the longer side. Default: the fit's.")] = None,
    frames: Annotated[
        int | None, typer.Option("--frames", min=1, help="Pictures. Default: whole loops of the clip, about 4 seconds.")
    ] = None,
    fps: Annotated[float | None, typer.Option("--fps", min=1, max=120, help="Pictures per second.")] = None,
    time: Annotated[
        float | None, typer.Option("--time", help="Stand still at this second. Default: the clip plays, looped.")
    ] = None,
    color: Annotated[str, typer.Option("--color", help="appearance, part, rigid (weight) or depth.")] = "appearance",
    background: Annotated[
        str, typer.Option("--background", help="white, black, r,g,b, or none: transparent, for .png and folders.")
    ] = "white",
    trajectories: Annotated[
        bool, typer.Option("--trajectories", help="Draw where control points (or Gaussians) came from.")
    ] = False,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="Write a contact sheet (.png): four sides, instants of the clip.")
    ] = None,
    columns: Annotated[int, typer.Option("--columns", min=1, max=60, help="Instants on the contact sheet.")] = 8,
    cameras: Annotated[
        Path | None,
        typer.Option("--cameras", help="A views file: write one (-o FILE.h5) as its cameras see the scene."),
    ] = None,
    device: Device = "auto",
    force: Force = False,
) -> None:
    """Draw a scene from any side at any time: as a video, as pictures, as a contact sheet, or as a views file."""
    from dpcli.generate4d.commands.output import run_render
    from dpcli.generate4d.out.camera_paths import Lens

    angles = [None if degrees is None else math.radians(degrees) for degrees in (azimuth, elevation, fovy)]
    run_render(
        scene,
        output,
        path=path,
        lens=Lens(angles[0], angles[1], radius, angles[2], size),
        color=color,
        background=background,
        trajectories=trajectories,
        frames=frames,
        fps=fps,
        time=time,
        picture=picture,
        columns=columns,
        cameras=cameras,
        device=device,
        force=force,
    )


def export(
    scene: Scene,
    output: Annotated[
        str, typer.Option("-o", "--output", help="A file, a folder for one file a frame, or - (clouds).")
    ],
    form: Annotated[
        str,
        typer.Option(
            "--as",
            help="ply or splat (canonical for a file name, every frame for a folder), ply-sequence, splat-sequence, "
            "clouds, cameras or metrics (.json).",
        ),
    ] = "ply",
    time: Annotated[
        float | None, typer.Option("--time", help="This second instead of the canonical Gaussians, for one file.")
    ] = None,
    axes: Annotated[
        str, typer.Option("--axes", help="player: x right, y down, z forward; keep: y up, as in the scene.")
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
    """Write a scene for players and other tools: 3DGS .ply, .splat, point clouds with parts, cameras, metrics."""
    from dpcli.generate4d.commands.output import run_export

    run_export(scene, output, form=form, time=time, axes=axes, least=min_opacity, points=points, seed=seed, force=force)


def view(
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="The page (.html).")],
    title: Annotated[str | None, typer.Option("--title", help="Heading. Default: what was fitted.")] = None,
    min_opacity: Annotated[float, typer.Option("--min-opacity", min=0, max=1, help="Leave fainter Gaussians out.")] = 1
    / 255,
    fps: Annotated[
        float | None,
        typer.Option("--fps", min=1, max=120, help="Frames of the clip per second. Default: its own, within 1 to 60."),
    ] = None,
    force: Force = False,
) -> None:
    """Write one HTML file that shows a scene in any browser, without server or network: turn, zoom, play, color by part."""
    from dpcli.generate4d.commands.output import run_view

    run_view(scene, output, title=title, least=min_opacity, fps=fps, force=force)
