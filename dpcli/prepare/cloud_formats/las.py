"""LAS and LAZ files of laser scanners, by laspy."""

from __future__ import annotations

import re
import struct
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from dpcli.errors import DataError, reading
from dpcli.prepare.cloud_formats.cloud import Cloud, kept_columns, require_names, require_points, without
from dpcli.prepare.cloud_formats.laz_chunks import check_chunks
from dpcli.store.schema import METERS

_COLORS = ("red", "green", "blue")
WITHHELD = "points that their file marks as withheld dropped"
_ABOUT_RETURNS = (  # what every file has, and hardly anybody wants
    "return_number number_of_returns synthetic key_point withheld overlap scanner_channel scan_direction_flag"
    " edge_of_flight_line user_data scan_angle_rank scan_angle point_source_id"
).split()
_MODEL_KEY, _UNIT_KEY, _HEIGHT_UNIT_KEY = 1024, 3076, 4099  # of GeoTIFF: kind of system, linear units, those of heights
_GEOGRAPHIC = 2  # the model of longitudes and latitudes
_SIZES = struct.Struct("<HII")  # at byte 94: of the header, where the points begin, how many records lie between
_RECORD, _LATE_RECORD = 54, 60  # bytes at least of a record before the points, and of one behind them
_FINE = 1e-6  # of degrees a decimeter
_FINEST, _COARSEST = 1e-15, 1e15  # of a number of the file, in units of length
_GEO_UNITS = {9001: "m", 9002: "ft", 9003: "us-ft"}
_NAMED_FEET = {"ft": "ft", "ftUS": "us-ft"}  # as the names of reference systems end


def read_las(path: Path, keep: Sequence[str] = ()) -> Cloud:
    """Reads the points, with colors as stored: 16 bits, some of which hold bytes. Raises DataError when damaged."""
    laspy = _load_laspy()
    room = _check_sizes(path)
    with reading(path):  # whose sentence is that of memory that ends
        try:
            with laspy.open(path) as reader:
                if reader.header.are_points_compressed and reader.header.point_count:
                    check_chunks(path, reader.header)
                las = reader.read()
        except (KeyboardInterrupt, SystemExit, MemoryError, DataError):
            raise
        except BaseException as error:  # LaspyException, struct.error, LazrsError...; a panic of lazrs is no Exception
            kind = path.suffix[1:].upper()
            raise DataError(f"{path}: not a readable {kind} file, perhaps truncated ({error})") from None
    if len(las.points) != las.header.point_count:
        raise DataError(f"{path}: truncated: its header says {las.header.point_count} points, found {len(las.points)}")
    _check_scales(path, las.header.scales)
    names = list(las.point_format.dimension_names)
    color = np.stack([np.asarray(las[name]) for name in _COLORS], axis=1) if set(_COLORS) <= set(names) else None
    if color is not None and not color.any():
        color = None  # the point format has room for colors that nobody filled in
    require_names(path, names, keep)
    extra = kept_columns(path, {name: np.asarray(las[name]) for name in keep}, keep)
    unread = without(names, "XYZ", _COLORS, _ABOUT_RETURNS, keep)
    unit, heights = _units(path, las)
    points = _scaled(las)
    if not unit and _seem_degrees(las.header.scales, points):
        raise DataError(_in_degrees(path))
    if heights != unit:  # such as survey feet on the map and meters above sea
        points[:, 2] *= METERS[heights] / METERS[unit]
    cloud = Cloud(points, color, unit, extra, unread=unread, dropped=require_points(path, len(points), room))
    withheld = np.asarray(las["withheld"]).astype(bool)
    if withheld.any():
        cloud.keep(~withheld)
        cloud.dropped[WITHHELD] = int(withheld.sum())
    return cloud


def _in_degrees(path: Path) -> str:
    return (
        f"{path}: its coordinates are longitudes and latitudes in degrees; expected lengths: project them first, such as to"
        " UTM"
    )


def _check_scales(path: Path, scales: np.ndarray) -> None:
    """Raises DataError for a scale that no coordinate has: 0 puts all points into one plane, without a word."""
    for axis, scale in zip("xyz", scales):
        if not _FINEST < abs(scale) < _COARSEST:
            raise DataError(f"{path}: damaged: its header scales {axis} by {scale:g}; expected such as 0.001")


def _seem_degrees(scales: np.ndarray, points: np.ndarray) -> bool:
    """Returns whether x and y are stored far more finely than heights, and are what longitudes and latitudes can be."""
    fine = max(scales[:2]) <= _FINE and scales[2] > 100 * max(scales[:2])
    return bool(fine and len(points) and (np.abs(points[:, :2]).max(0) <= (180, 90)).all())


def _load_laspy() -> ModuleType:
    """Returns laspy without the client of web addresses that it loads where there is one: that takes four times as long."""
    hidden = not {"laspy", "requests"} & sys.modules.keys()
    if hidden:
        sys.modules["requests"] = None  # type: ignore[assignment]  # an import of it fails at once
    try:
        import laspy
    finally:
        if hidden:
            del sys.modules["requests"]
    return laspy


def _scaled(las: Any) -> np.ndarray:
    """Returns the coordinates f64 (N,3), by columns: laspy's own `xyz` makes them one by one and copies them twice."""
    points = np.empty((3, len(las.points)))
    for row, name, scale, offset in zip(points, "XYZ", las.header.scales, las.header.offsets):
        row[:] = las[name]
        row *= scale
        row += offset
    return points.T


def _check_sizes(path: Path) -> int:
    """Returns how many points a file has room for, those that its header counts where they are compressed.

    Raises DataError where the header counts more records than that: laspy would read on and on.
    """
    with path.open("rb") as file:
        head = file.read(375)
    size = path.stat().st_size
    if head[:4] != b"LASF" or len(head) < 227:
        raise DataError(f"{path}: not a readable {path.suffix[1:].upper()} file, perhaps truncated (no header)")
    header, start, records = _SIZES.unpack_from(head, 94)
    late_start, late = struct.unpack_from("<QI", head, 235) if head[25] >= 4 and len(head) >= 247 else (0, 0)
    if header + records * _RECORD > start or start > size or (late and late_start + late * _LATE_RECORD > size):
        raise DataError(
            f"{path}: truncated or damaged: its header says {records + late} records and points from byte {start} on, of"
            f" {size}"
        )
    waves = struct.unpack_from("<Q", head, 227)[0] if head[25] >= 3 and len(head) >= 235 else 0
    end = min((place for place in (late_start if late else 0, waves) if place > start), default=size)
    return _room(path, head, start, min(end, size))


def _room(path: Path, head: bytes, start: int, end: int) -> int:
    """Returns how many points lie from byte ``start`` to ``end``; of compressed ones how many the header says, by returns or not.

    head: at least 227 bytes. Raises DataError where points have no room that aren't compressed: laspy sets memory aside for
    all that are counted.
    """
    form, length, count = struct.unpack_from("<BHI", head, 104)
    returns = struct.unpack_from("<5I", head, 111)
    if head[25] >= 4 and len(head) >= 375:
        count, *returns = struct.unpack_from("<16Q", head, 247)
    said = max(count, sum(returns))
    if form & 0xC0:
        return said
    room, size = (end - start) // max(length, 1), path.stat().st_size
    if count > room:
        raise DataError(f"{path}: truncated or damaged: claims {count} points, which a file of {size} bytes can't hold")
    return room


def _units(path: Path, las: Any) -> tuple[str, str]:
    """Returns the units of the coordinates on the map and of the heights, where the file's reference system says so; "" where
    it doesn't. Raises DataError where they are degrees.
    """
    for record in [*las.header.vlrs, *(las.evlrs or [])]:
        text = getattr(record, "string", "")
        keys = {key.id: key.value_offset for key in getattr(record, "geo_keys", []) if key.tiff_tag_location == 0}
        if _is_geographic(text) or keys.get(_MODEL_KEY) == _GEOGRAPHIC:
            raise DataError(_in_degrees(path))
        found = (
            units_of_wkt(text) if text else [_GEO_UNITS.get(keys.get(key), "") for key in (_UNIT_KEY, _HEIGHT_UNIT_KEY)]
        )
        if found and found[0]:
            return found[0], found[-1] or found[0]
    texts = "|".join(text for record in las.header.vlrs for text in getattr(record, "strings", []))
    told = next((units for name in texts.split("|") if (units := units_of_name(name))), ["", ""])
    return told[0], told[-1]


def units_of_name(name: str) -> list[str]:
    """Returns the units on the map and, where it names heights, of these, of a reference system that EPSG calls so; [] of one
    without feet. It is all that tells them where a GeoTIFF gives the system by its number alone, as laspy writes it.

    >>> units_of_name("NAD83 / New York Long Island (ftUS) + NAVD88 height"), units_of_name("NAD83 / Arizona East (ft)")
    (['us-ft', 'm'], ['ft'])
    >>> units_of_name("NAD83 / UTM zone 18N"), units_of_name("NAVD88 height (ftUS)")
    ([], [])
    """
    parts = name.split(" + ")
    told = [_NAMED_FEET[found[1]] if (found := re.search(r"\((ft|ftUS)\)", part)) else "m" for part in parts]
    return told if " / " in parts[0] and set(told) != {"m"} else []


def _is_geographic(text: str) -> bool:
    """Returns whether a reference system in WKT is of longitudes and latitudes, neither projected nor cartesian.

    >>> _is_geographic('GEOGCS["WGS 84",UNIT["degree",0.0174]]'), _is_geographic('PROJCS["a",GEOGCS["b"]]')
    (True, False)
    """
    plain = text.upper().replace(" ", "")
    lengths = re.search(r"PROJ(ECTED)?(CS|CRS)\[|GEOCCS\[|CS\[CARTESIAN", plain)
    return lengths is None and re.search(r"GEOG(CS|CRS)\[|GEOD(ETIC)?CRS\[|CS\[ELLIPSOIDAL", plain) is not None


def units_of_wkt(text: str) -> list[str]:
    """Returns the unit of a reference system in WKT and that of its heights, where it has ones of their own; [] of units
    that aren't known.

    >>> units_of_wkt('PROJCS["a",GEOGCS["b",UNIT["degree",0.0174]],UNIT["US survey foot",0.304800609601219]]')
    ['us-ft']
    """
    whole = re.sub(r"\s*([\[,])\s*", r"\1", text)
    place = re.search(r"VERT(ICAL)?_?(CS|CRS)\[", whole, re.IGNORECASE)
    parts = [whole] if place is None else [whole[: place.start()], whole[place.start() :]]
    return [found for part in parts if (found := _unit_of_wkt(part))]


def _unit_of_wkt(text: str) -> str:
    found = re.findall(r'(?:LENGTH)?UNIT\["[^"]*",([-+.\deE]+)', text, re.IGNORECASE)
    sizes = {"m": 1.0, "ft": 0.3048, "us-ft": 1200 / 3937}
    known = [name for size in found for name, meters in sizes.items() if abs(float(size) - meters) < 1e-9]
    return known[-1] if known else ""
