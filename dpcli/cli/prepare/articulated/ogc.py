"""`dpc prepare ogc-dr` and `dpc prepare ogc-drsv`: one recipe of rooms, seen whole or by one camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from dpcli.cli.prepare.conversion import ConversionOptions, run_conversion
from dpcli.cli.prepare.lists import three_shares, whole_numbers
from dpcli.errors import UsageError

if TYPE_CHECKING:
    from dpcli.prepare.articulated.ogc_rooms import GeneratedRooms

_Raw = Annotated[Path | None, typer.Argument(help="Folder of data/ and its lists, as released.", show_default=False)]
_Meshes = Annotated[
    Path | None, typer.Option("--generate", help="Make new rooms instead, from the meshes in this folder or below.")
]


@dataclass(frozen=True)
class RoomConversion(ConversionOptions):
    """Holds the options of every conversion, with the number of points that the published rooms have."""

    points: Annotated[
        int, typer.Option("--points", min=0, help="Points per frame. Default: all in released rooms, 2048 in new ones.")
    ] = 0
    sampling: Annotated[
        Literal["random", "fps", "voxel"],
        typer.Option("--sampling", help="How --points chooses in released rooms; new rooms always use fps."),
    ] = "fps"


@dataclass(frozen=True)
class NewRoomOptions:
    """Holds the options that new rooms have and released ones ignore."""

    objects: Annotated[str, typer.Option("--objects", help="Numbers of objects in new rooms, each from 2 to 8.")] = (
        "8,7,6,5,4"
    )
    rooms: Annotated[int, typer.Option("--rooms", min=1, max=100_000, help="New rooms of each number of objects.")] = (
        1000
    )
    frames: Annotated[int, typer.Option("--frames", min=1, max=10_000, help="Frames of new rooms.")] = 4
    up: Annotated[
        Literal["y", "z"], typer.Option("--up", help="Axis that points up in the meshes: y (ShapeNet) or z.")
    ] = "y"
    fractions: Annotated[str, typer.Option("--fractions", help="Shares train,validation,test of new rooms.")] = (
        "0.75,0.05,0.2"
    )


def ogc_dr(raw: _Raw = None, generate: _Meshes = None, *, rooms: NewRoomOptions, conversion: RoomConversion) -> None:
    """Read OGC-DR: rooms of 4 to 8 objects, each moving rigidly over 4 frames; as released, or new from any meshes."""
    _convert_rooms("ogc-dr", raw, generate, rooms, conversion, "full")


def ogc_drsv(raw: _Raw = None, generate: _Meshes = None, *, rooms: NewRoomOptions, conversion: RoomConversion) -> None:
    """Read OGC-DRSV: OGC-DR's rooms as one depth camera sees them; as released, or new from any meshes."""
    _convert_rooms("ogc-drsv", raw, generate, rooms, conversion, "single")


def _convert_rooms(
    name: str, raw: Path | None, meshes: Path | None, rooms: NewRoomOptions, conversion: RoomConversion, view: str
) -> None:
    def make_reader() -> Any:
        if (raw is None) == (meshes is None):
            given = "both were given" if raw else "neither was given"
            raise UsageError(f"a folder of the released rooms, or --generate MESHES: {given}; expected one of them")
        if raw is None:
            return _new_rooms(meshes, rooms, conversion, view)
        from dpcli.prepare.articulated.ogc import OgcRooms

        return OgcRooms(raw)

    run_conversion(name, make_reader, conversion, raw or meshes)


def _new_rooms(meshes: Path, rooms: NewRoomOptions, conversion: RoomConversion, view: str) -> GeneratedRooms:
    from dpcli.prepare.articulated.object_splits import SplitRule
    from dpcli.prepare.articulated.ogc_rooms import POINTS, GeneratedRooms, RoomOptions

    options = RoomOptions(
        objects=whole_numbers(rooms.objects, "--objects"),
        rooms=rooms.rooms,
        frames=rooms.frames,
        view=view,
        points=conversion.points or POINTS,
        up=rooms.up,
    )
    return GeneratedRooms(
        meshes=meshes, options=options, split=SplitRule(fractions=three_shares(rooms.fractions)), seed=conversion.seed
    )
