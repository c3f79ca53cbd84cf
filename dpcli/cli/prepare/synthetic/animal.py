"""`dpc prepare synthetic animal`."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from dpcli.cli.options import Force, Jobs
from dpcli.cli.prepare.options import ClipFrames
from dpcli.cli.prepare.views.filming import FilmingOptions
from dpcli.cli.prepare.views.writing import write_views


def animal(
    options: FilmingOptions,
    motion: Annotated[
        Literal["walk", "trot", "wag", "fly", "swim"],
        typer.Option("--motion", help="Its motion: walk, trot or wag (four legs), fly (bird), swim (fish)."),
    ] = "walk",
    cycles: Annotated[
        float, typer.Option("--cycles", help="Steps, wing beats or tail strokes in the clip; 0: the motion's own.")
    ] = 0.0,
    frames: ClipFrames = 32,
    jobs: Jobs = None,
    force: Force = False,
) -> None:
    """Make and film a made-up animal that moves: shape, coat and gait by --seed, exact tracks and rigid parts.

    Needs no data.
    """
    from dpcli.prepare.synthetic.animal import animal_clip, animal_config
    from dpcli.runtime.device import cpu_count

    filming = options.filming(yaw=55.0)
    write_views(
        lambda: animal_clip(motion, frames, cycles, filming, jobs or cpu_count()),
        options.output,
        config=animal_config(motion, frames, cycles, filming),
        source="synthetic animal",
        seed=filming.seed,
        force=force,
    )
