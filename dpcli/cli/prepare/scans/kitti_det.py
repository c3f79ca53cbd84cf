"""`dpc prepare kitti-det`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.prepare.conversion import PublishedConversion, run_conversion
from dpcli.cli.prepare.lists import words
from dpcli.cli.prepare.options import Far, Near, SceneCoordinates


def kitti_det(
    raw: Annotated[
        Path, typer.Argument(help="Folder of training/velodyne, label_2, calib (and image_2 for its size).")
    ],
    *,
    lists: Annotated[
        Path | None, typer.Option("--lists", help="Folder of train.txt and val.txt. Default: RAW/ImageSets.")
    ] = None,
    objects: Annotated[
        str, typer.Option("--objects", help="Types of boxes that are objects, such as Car,Van,Truck.")
    ] = "Car",
    near: Near = 2.0,
    far: Far = 35.0,
    coordinates: SceneCoordinates = "published",
    conversion: PublishedConversion,
) -> None:
    """Read KITTI 3D detection: 7,481 Velodyne scans, objects are the points in the labeled boxes."""
    from dpcli.prepare.scans.kitti_det import KittiDetection
    from dpcli.prepare.scans.kitti_files import View

    run_conversion(
        "kitti-det",
        lambda: KittiDetection(
            raw=raw, lists=lists, objects=words(objects), view=View(near, far), coordinates=coordinates
        ),
        conversion,
        raw,
    )
