"""`dpc prepare ogc-dr | ogc-drsv | kitti-sf | kitti-det | semantickitti`: scenes of several moving objects."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from dpcli.cli.options import Seed
from dpcli.errors import UsageError

_Raw = Annotated[Path | None, typer.Argument(help="Folder of data/ and its lists, as released.", show_default=False)]
_Meshes = Annotated[
    Path | None, typer.Option("--generate", help="Make new rooms instead, from the meshes in this folder or below.")
]
_Coordinates = Annotated[
    str, typer.Option("--coordinates", help="published: x left, y up, z forward. camera: x right, y down, z forward.")
]
_Far = Annotated[float, typer.Option("--far", help="Drop what is farther from the camera, meters.")]
_Near = Annotated[float, typer.Option("--near", help="Drop what is not this far ahead of the scanner, meters.")]


def register(app: typer.Typer, reads: Callable[..., Callable[..., Any]]) -> None:
    """Add the commands to `dpc prepare`; ``reads``: its way to make a command of a function that returns a Reader."""
    reads(app, "ogc-dr", more=_rooms)(ogc_dr)
    reads(app, "ogc-drsv", more=_rooms)(ogc_drsv)
    reads(app, "kitti-sf", more=_sampled)(kitti_sf)
    reads(app, "kitti-det", more=_sampled)(kitti_det)
    reads(app, "semantickitti", more=_sampled)(semantickitti)


def _sampled(
    points: Annotated[
        int, typer.Option("--points", min=0, help="At most this many points per frame; 0 keeps all.")
    ] = 8192,
    sampling: Annotated[str, typer.Option("--sampling", help="How --points chooses: random, fps or voxel.")] = "fps",
) -> None:
    """The published number of points; the conversion itself applies these."""


def _rooms(
    points: Annotated[
        int, typer.Option("--points", min=0, help="Per frame. Default: all of the released, 2048 of new rooms.")
    ] = 0,
    sampling: Annotated[
        str, typer.Option("--sampling", help="Of the released: random, fps or voxel. New rooms are always fps.")
    ] = "fps",
    objects: Annotated[str, typer.Option("--objects", help="Of new rooms: numbers of objects, 2 to 8.")] = "8,7,6,5,4",
    rooms: Annotated[int, typer.Option("--rooms", min=1, help="New rooms of each number of objects.")] = 1000,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Of new rooms.")] = 4,
    up: Annotated[str, typer.Option("--up", help="Axis that points up in the meshes: y (ShapeNet) or z.")] = "y",
    fractions: Annotated[
        str, typer.Option("--fractions", help="Of new rooms: train,validation,test.")
    ] = "0.75,0.05,0.2",
) -> None:
    """The options of generated rooms."""


def ogc_dr(articulation: dict[str, Any], raw: _Raw = None, generate: _Meshes = None, seed: Seed = 0) -> Any:
    """OGC-DR: rooms of 4 to 8 objects, each moving rigidly over 4 frames; as released, or new from any meshes."""
    return _ogc(raw, generate, seed, "full", articulation)


def ogc_drsv(articulation: dict[str, Any], raw: _Raw = None, generate: _Meshes = None, seed: Seed = 0) -> Any:
    """OGC-DRSV: OGC-DR's rooms as one depth camera sees them; as released, or new from any meshes."""
    return _ogc(raw, generate, seed, "single", articulation)


def _ogc(raw: Path | None, generate: Path | None, seed: int, view: str, options: dict[str, Any]) -> Any:
    if (raw is None) == (generate is None):
        given = "both were given" if raw else "neither was given"
        raise UsageError(f"a folder of the released rooms, or --generate MESHES: {given}; expected one of them")
    if raw is not None:
        from dpcli.prepare.scans.ogc import OgcRooms

        return OgcRooms(raw)
    from dpcli.prepare.articulated.object_splits import SplitRule
    from dpcli.prepare.articulated.ogc_rooms import POINTS, GeneratedRooms, RoomOptions

    try:
        counts = tuple(int(word) for word in _words(options["objects"]))
        shares = tuple(float(word) for word in _words(options["fractions"]))
    except ValueError:
        raise UsageError(
            "--objects, --fractions: expected numbers with commas, such as 8,7,6 and 0.75,0.05,0.2"
        ) from None
    rooms = RoomOptions(counts, options["rooms"], options["frames"], view, options["points"] or POINTS, options["up"])
    return GeneratedRooms(generate, rooms, SplitRule(fractions=shares), seed)


def kitti_sf(
    articulation: dict[str, Any],
    raw: Annotated[Path, typer.Argument(help="Folder of training/disp_occ_0, disp_occ_1, flow_occ, instance, ...")],
    objects: Annotated[
        str,
        typer.Option("--objects", help="Classes that are objects. car,bus is what was published; it meant car,truck."),
    ] = "car,bus",
    labels: Annotated[
        str, typer.Option("--labels", help="Images that say so: instance, or obj_map (moving objects, all classes).")
    ] = "instance",
    far: _Far = 35.0,
    coordinates: _Coordinates = "published",
) -> Any:
    """KITTI scene flow 2015: 200 street scenes, pairs of clouds with true flow and objects."""
    from dpcli.prepare.scans.kitti_sf import KittiSceneFlow

    return KittiSceneFlow(raw, _words(objects), labels, far, coordinates)


def kitti_det(
    articulation: dict[str, Any],
    raw: Annotated[
        Path, typer.Argument(help="Folder of training/velodyne, label_2, calib (and image_2 for its size).")
    ],
    lists: Annotated[
        Path | None, typer.Option("--lists", help="Folder of train.txt and val.txt. Default: RAW/ImageSets.")
    ] = None,
    objects: Annotated[
        str, typer.Option("--objects", help="Types of boxes that are objects, as Car,Van,Truck.")
    ] = "Car",
    near: _Near = 2.0,
    far: _Far = 35.0,
    coordinates: _Coordinates = "published",
) -> Any:
    """KITTI 3D detection: 7,481 Velodyne scans, objects are what the labeled boxes hold."""
    from dpcli.prepare.scans.kitti_det import KittiDetection
    from dpcli.prepare.scans.kitti_files import View

    return KittiDetection(raw, lists, _words(objects), View(near, far), coordinates)


def semantickitti(
    articulation: dict[str, Any],
    raw: Annotated[
        Path, typer.Argument(help="Folder of dataset/sequences/00 ..., each velodyne/, labels/, calib.txt.")
    ],
    group: Annotated[str, typer.Option("--group", help="Sequences: all (00 to 10), without-08 or only-08.")] = "all",
    frames: Annotated[int, typer.Option("--frames", min=1, help="Successive scans that are one sample.")] = 1,
    align: Annotated[
        bool, typer.Option("--align", help="Move a sample's scans to the camera of its first, by poses.txt.")
    ] = False,
    objects: Annotated[str, typer.Option("--objects", help="Classes whose instances are objects.")] = "car,truck",
    near: _Near = 2.0,
    far: _Far = 35.0,
    coordinates: _Coordinates = "published",
) -> Any:
    """SemanticKITTI: Velodyne scans of 11 drives, objects are the labeled instances."""
    from dpcli.prepare.scans.kitti_files import View
    from dpcli.prepare.scans.semantickitti import SemanticKitti

    return SemanticKitti(raw, group, frames, align, _words(objects), View(near, far), coordinates)


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(",") if word.strip())
