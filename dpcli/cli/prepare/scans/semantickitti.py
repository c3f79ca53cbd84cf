"""`dpc prepare semantickitti`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from dpcli.cli.prepare.conversion import PublishedConversion, run_conversion
from dpcli.cli.prepare.lists import words
from dpcli.cli.prepare.options import Far, Near, SceneCoordinates


def semantickitti(
    raw: Annotated[
        Path, typer.Argument(help="Folder of dataset/sequences/00 ..., each velodyne/, labels/, calib.txt.")
    ],
    *,
    group: Annotated[
        Literal["all", "without-08", "only-08"],
        typer.Option("--group", help="Drives to read: all (00 to 10), without-08 (training) or only-08 (validation)."),
    ] = "all",
    frames: Annotated[int, typer.Option("--frames", min=1, help="Successive scans that are one sample.")] = 1,
    align: Annotated[
        bool, typer.Option("--align", help="Move a sample's scans to the camera of its first, by poses.txt.")
    ] = False,
    objects: Annotated[str, typer.Option("--objects", help="Classes whose instances are objects.")] = "car,truck",
    near: Near = 2.0,
    far: Far = 35.0,
    coordinates: SceneCoordinates = "published",
    conversion: PublishedConversion,
) -> None:
    """Read SemanticKITTI: Velodyne scans of 11 drives, objects are the labeled instances."""
    from dpcli.prepare.scans.kitti_files import View
    from dpcli.prepare.scans.semantickitti import SemanticKitti

    run_conversion(
        "semantickitti",
        lambda: SemanticKitti(
            raw=raw,
            group=group,
            frames=frames,
            align=align,
            objects=words(objects),
            view=View(near, far),
            coordinates=coordinates,
        ),
        conversion,
        raw,
    )
