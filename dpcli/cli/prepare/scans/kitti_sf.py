"""`dpc prepare kitti-sf`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from dpcli.cli.prepare.conversion import PublishedConversion, run_conversion
from dpcli.cli.prepare.lists import words
from dpcli.cli.prepare.options import Far, SceneCoordinates


def kitti_sf(
    raw: Annotated[Path, typer.Argument(help="Folder of training/disp_occ_0, disp_occ_1, flow_occ, instance, ...")],
    *,
    objects: Annotated[
        str,
        typer.Option("--objects", help="Classes that are objects. car,bus is what was published; it meant car,truck."),
    ] = "car,bus",
    labels: Annotated[
        Literal["instance", "obj_map"],
        typer.Option(
            "--labels", help="Images that label objects: instance, or obj_map (moving objects of all classes)."
        ),
    ] = "instance",
    far: Far = 35.0,
    coordinates: SceneCoordinates = "published",
    conversion: PublishedConversion,
) -> None:
    """Read KITTI scene flow 2015: 200 street scenes, pairs of clouds with true flow and objects."""
    from dpcli.prepare.scans.kitti_sf import KittiSceneFlow

    run_conversion(
        "kitti-sf",
        lambda: KittiSceneFlow(raw=raw, objects=words(objects), labels=labels, far=far, coordinates=coordinates),
        conversion,
        raw,
    )
