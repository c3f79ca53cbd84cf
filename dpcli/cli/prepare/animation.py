"""`dpc prepare animation` and `dpc prepare synthetic animal`: animated meshes filmed by virtual cameras."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from dpcli.cli.options import Force, Jobs, Json, Seed
from dpcli.cli.prepare.views import write_views
from dpcli.errors import UsageError

_Output = Annotated[str, typer.Option("-o", "--output", help="File to write, or - for a pipe.")]
_Frames = Annotated[int, typer.Option("--frames", min=1, help="Evenly spaced over the clip.")]


def register(app: typer.Typer, synthetic: typer.Typer) -> None:
    """Add the commands to `dpc prepare` and `dpc prepare synthetic`."""
    app.command("animation")(_with_filming(animation))
    synthetic.command("animal")(_with_filming(animal))


def _filming(
    size: Annotated[int, typer.Option("--size", min=16, max=4096, help="Side of the square pictures, pixels.")] = 512,
    azimuths: Annotated[
        str, typer.Option("--azimuths", help="Of the test views, degrees; the input view stands at 0.")
    ] = "15,-75,105,195",
    train_azimuths: Annotated[str, typer.Option("--train-azimuths", help="Of further views, to fit to.")] = "",
    elevation: Annotated[float, typer.Option("--elevation", help="Of all cameras, degrees, up = +.")] = 0.0,
    yaw: Annotated[
        float | None,
        typer.Option("--yaw", help="Turns the object about the upright, degrees; 0 faces the input camera."),
    ] = None,
    travel: Annotated[
        bool, typer.Option("--travel/--no-travel", help="Keep where it goes; without, it stays as on a treadmill.")
    ] = True,
    samples: Annotated[int, typer.Option("--samples", min=1, max=8, help="N x N rays per pixel.")] = 2,
    shading: Annotated[float, typer.Option("--shading", help="0 plain colors .. 1 full light and shade.")] = 0.5,
    tracks: Annotated[int, typer.Option("--tracks", min=0, help="Surface points of ground truth; 0: none.")] = 4096,
    part_tolerance: Annotated[
        float,
        typer.Option(
            "--part-tolerance", help="Bones that differ less than this from their parent are one part; radii."
        ),
    ] = 0.01,
    min_part: Annotated[
        float, typer.Option("--min-part", help="Parts of a smaller share of the points join another.")
    ] = 0.01,
    seed: Seed = 0,
) -> None:
    """The options of all that is filmed; the fields of Filming."""


def _with_filming(command: Callable[..., None]) -> Callable[..., None]:
    """The command with the options of `_filming` too; they reach it as the dict ``filming``."""
    own = {k: p for k, p in inspect.signature(command, eval_str=True).parameters.items() if k != "filming"}
    extra = inspect.signature(_filming, eval_str=True).parameters

    def run(**options: Any) -> None:
        command(**{key: options[key] for key in own}, filming={key: options[key] for key in extra})

    ordered = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in (*own.values(), *extra.values())]
    run.__signature__ = inspect.Signature(ordered)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in ordered}
    run.__doc__ = command.__doc__
    return run


def animation(
    filming: dict[str, Any],
    model: Annotated[Path, typer.Argument(help="A .glb or .gltf with an animation: skinned, morphing or of nodes.")],
    output: _Output = "",
    clip: Annotated[str | None, typer.Option("--clip", help="Which animation, as Walk. Default: the first.")] = None,
    list_: Annotated[bool, typer.Option("--list", help="Print the clips and their seconds; write nothing.")] = False,
    json_: Json = False,
    frames: _Frames = 32,
    jobs: Jobs = None,
    force: Force = False,
) -> None:
    """An animated 3D model, filmed: pictures with alpha, true tracks of surface points and rigid parts (bones).

    The object is scaled to radius 0.75 around the origin over the whole clip; the cameras stand at distance 2.
    """
    from dpcli.prepare.meshes.animation import animation_clip, animation_config, list_clips

    if list_:
        _print_clips(list_clips(model), json_)
        return
    camera = _options(filming, output, yaw=0.0)
    config = animation_config(model, clip, frames, camera)
    write_views(
        lambda: animation_clip(model, clip, frames, camera, _processes(jobs)),
        output,
        config=config,
        source="animation",
        seed=camera.seed,
        force=force,
    )


def animal(
    filming: dict[str, Any],
    output: _Output = "",
    motion: Annotated[
        str, typer.Option("--motion", help="walk, trot or wag (four legs), fly (bird), swim (fish).")
    ] = "walk",
    cycles: Annotated[float, typer.Option("--cycles", help="Steps, wing beats or tail strokes in the clip.")] = 0.0,
    frames: _Frames = 32,
    jobs: Jobs = None,
    force: Force = False,
) -> None:
    """A made-up animal that moves, filmed: shape, coat and gait by --seed, exact tracks and rigid parts. Needs no data."""
    from dpcli.prepare.synthetic.animal import animal_clip, animal_config

    camera = _options(filming, output, yaw=55.0)
    config = animal_config(motion, frames, cycles, camera)
    write_views(
        lambda: animal_clip(motion, frames, cycles, camera, _processes(jobs)),
        output,
        config=config,
        source="synthetic animal",
        seed=camera.seed,
        force=force,
    )


def _options(values: dict[str, Any], output: str, yaw: float) -> Any:
    from dpcli.prepare.meshes.filming import Filming

    if not output:
        raise UsageError("-o/--output is missing: the file to write, or - for a pipe")
    azimuths = {key: _degrees(values[key], f"--{key.replace('_', '-')}") for key in ("azimuths", "train_azimuths")}
    rest = {key: value for key, value in values.items() if key not in (*azimuths, "yaw")}
    turned = yaw if values["yaw"] is None else values["yaw"]
    return Filming(test_azimuths=azimuths["azimuths"], train_azimuths=azimuths["train_azimuths"], yaw=turned, **rest)


def _degrees(text: str, option: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in text.split(",") if word.strip())
    except ValueError:
        raise UsageError(f"{option} {text}: expected degrees with commas, such as 15,-75") from None


def _processes(jobs: int | None) -> int:
    from dpcli.runtime.device import cpu_count

    return jobs or cpu_count()


def _print_clips(clips: list[tuple[str, float]], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps({"clips": [{"name": name, "seconds": round(seconds, 6)} for name, seconds in clips]}))
        return
    for name, seconds in clips:
        typer.echo(f"{seconds:7.2f} s  {name}")
