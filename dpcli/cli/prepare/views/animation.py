"""`dpc prepare animation`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.options import Force, Jobs, Json
from dpcli.cli.prepare.options import ClipFrames
from dpcli.cli.prepare.views.filming import FilmingOptions
from dpcli.cli.prepare.views.writing import write_views


def animation(
    model: Annotated[Path, typer.Argument(help="A .glb or .gltf with an animation: skinned, morphing or of nodes.")],
    options: FilmingOptions,
    clip: Annotated[
        str | None, typer.Option("--clip", help="Name of the animation, such as Walk. Default: the first.")
    ] = None,
    list_: Annotated[bool, typer.Option("--list", help="Print the clips and their seconds; write nothing.")] = False,
    json_: Json = False,
    frames: ClipFrames = 32,
    jobs: Jobs = None,
    force: Force = False,
) -> None:
    """Films an animated 3D model: pictures with alpha, true tracks of surface points and rigid parts (bones).

    The object is scaled to radius 0.75 around the origin over the whole clip; the cameras stand at distance 2.
    """
    from dpcli.prepare.meshes.animation import animation_clip, animation_config, list_clips
    from dpcli.runtime.device import cpu_count

    if list_:
        _print_clips(list_clips(model), json_)
        return
    filming = options.filming(yaw=0.0)
    write_views(
        lambda: animation_clip(model, clip, frames, filming, jobs or cpu_count()),
        options.output,
        config=animation_config(model, clip, frames, filming),
        source="animation",
        seed=filming.seed,
        force=force,
    )


def _print_clips(clips: list[tuple[str, float]], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps({"clips": [{"name": name, "seconds": round(seconds, 6)} for name, seconds in clips]}))
        return
    for name, seconds in clips:
        typer.echo(f"{seconds:7.2f} s  {name}")
