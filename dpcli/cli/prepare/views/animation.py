"""`dpc prepare animation`."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.options import Force, Jobs, Json
from dpcli.cli.prepare.conversion import require_output
from dpcli.cli.prepare.options import ClipFrames
from dpcli.cli.prepare.views.filming import FilmingOptions
from dpcli.cli.prepare.views.writing import write_views
from dpcli.errors import UsageError


def animation(
    model: Annotated[Path, typer.Argument(help="A .glb or .gltf with an animation: skinned, morphing or of nodes.")],
    options: FilmingOptions,
    clip: Annotated[
        str | None,
        typer.Option("--clip", help="Name or number of the animation, such as Walk or 2. Default: the first."),
    ] = None,
    all_clips: Annotated[
        bool, typer.Option("--all-clips", help="Every animation, each into a file of its own: OUT_Walk.h5, ...")
    ] = False,
    list_: Annotated[bool, typer.Option("--list", help="Print the clips and their seconds; write nothing.")] = False,
    json_: Json = False,
    frames: ClipFrames = 32,
    jobs: Jobs = None,
    force: Force = False,
) -> None:
    """Film an animated 3D model: pictures with alpha, true tracks of surface points and rigid parts (bones).

    The object is scaled to radius 0.75 around the origin over the whole clip; the cameras stand at distance 2.
    """
    from dpcli.prepare.meshes.animation import animation_clip, animation_config, clip_outputs, list_clips
    from dpcli.runtime.device import cpu_count

    if list_:
        _print_clips(list_clips(model), json_)
        return
    filming = options.filming(yaw=0.0)
    if all_clips and clip is not None:
        raise UsageError(f"--all-clips and --clip {clip}: choose one of both")
    if all_clips and options.output == "-":
        raise UsageError("--all-clips writes a file for each clip; -o - is one: name a file, such as -o views.h5")
    require_output(options.output)
    for name, output in clip_outputs(model, options.output) if all_clips else [(clip, options.output)]:
        write_views(
            partial(animation_clip, model, name, frames, filming, jobs or cpu_count()),
            output,
            config=animation_config(model, name, frames, filming),
            source="animation",
            seed=filming.seed,
            force=force,
        )


def _print_clips(clips: list[tuple[str, float | None]], as_json: bool) -> None:
    if as_json:
        rows = [{"name": name, "seconds": None if time is None else round(time, 6)} for name, time in clips]
        typer.echo(json.dumps({"clips": rows}))
        return
    for number, (name, time) in enumerate(clips):
        typer.echo(f"{number:3}  {'      -' if time is None else f'{time:7.2f}'} s  {name}")
