"""`dpc prepare artemis`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.options import Force, Seed
from dpcli.cli.prepare.conversion import print_check
from dpcli.cli.prepare.lists import whole_numbers
from dpcli.cli.prepare.options import BadFrame, Border, Check, FileOrPipe, FramesAtMost, PictureSize
from dpcli.cli.prepare.views.writing import write_views


@dataclass(frozen=True)
class AnimalOptions:
    """Holds the options that say which frames, cameras and points are taken of an animal."""

    motion: Annotated[str, typer.Option("--motion", help="Name of the motion; without it the motions are listed.")] = ""
    frames: FramesAtMost = 32
    size: PictureSize = 512
    border: Border = 0.2
    reference: Annotated[
        int | None, typer.Option("--reference", min=0, help="Camera of the input view. Default: the lowest number.")
    ] = None
    cameras: Annotated[
        str,
        typer.Option("--cameras", help="Test cameras, such as 1,7,13. Default: nearest to azimuths 15,-75,105,195."),
    ] = ""
    train_cameras: Annotated[str, typer.Option("--train-cameras", help="Further cameras to fit to, such as 2,8.")] = ""
    tracks: Annotated[
        int,
        typer.Option("--tracks", min=0, max=1_000_000, help="Points of the volume tracked as ground truth; 0: none."),
    ] = 4096
    fps: Annotated[float, typer.Option("--fps", help="Frames per second.")] = 30.0
    on_error: BadFrame = "stop"


def artemis(
    animal: Annotated[Path, typer.Argument(help="Folder of an animal: img/, bones/, CamPose.inf, Intrinsic.inf, ...")],
    chosen: AnimalOptions,
    output: FileOrPipe = "",
    check: Check = False,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Read ARTEMIS (DFA): animals filmed by 36 cameras, with bones and skinned voxels as ground truth."""
    if check:
        from dpcli.prepare.views.views_check import ArtemisIndex

        print_check("artemis", animal, lambda: ArtemisIndex(animal, chosen.motion))
        return
    from dpcli.prepare.views.artemis import ArtemisOptions, artemis_clip, artemis_config

    numbers = {
        "cameras": whole_numbers(chosen.cameras, "--cameras"),
        "train_cameras": whole_numbers(chosen.train_cameras, "--train-cameras"),
    }
    options = ArtemisOptions(**{**vars(chosen), **numbers}, seed=seed)
    config = artemis_config(animal, options)
    write_views(lambda: artemis_clip(animal, options), output, config=config, source="artemis", seed=seed, force=force)
