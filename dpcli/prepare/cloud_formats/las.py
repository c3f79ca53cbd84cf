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

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.cloud import Cloud, kept_columns

_COLORS = ("red", "green", "blue")
_UNIT_KEY = 3076  # of GeoTIFF: linear units of a projected system
_SIZES = struct.Struct("<HII")  # at byte 94: of the header, where the points begin, how many records lie between
_RECORD, _LATE_RECORD = 54, 60  # bytes at least of a record before the points, and of one behind them
_GEO_UNITS = {9001: "m", 9002: "ft", 9003: "us-ft"}


def read_las(path: Path, keep: Sequence[str] = ()) -> Cloud:
    """Reads the points, with colors as stored: 16 bits, some of which hold bytes. Raises DataError when damaged."""
    laspy = _load_laspy()
    _check_sizes(path)
    try:
        las = laspy.read(path)
    except Exception as error:  # laspy.errors.LaspyException, struct.error, ValueError, lazrs.LazrsError
        kind = path.suffix[1:].upper()
        raise DataError(f"{path}: not a readable {kind} file, perhaps truncated ({error})") from None
    if len(las.points) != las.header.point_count:
        raise DataError(f"{path}: truncated: its header says {las.header.point_count} points, found {len(las.points)}")
    names = list(las.point_format.dimension_names)
    color = np.stack([np.asarray(las[name]) for name in _COLORS], axis=1) if set(_COLORS) <= set(names) else None
    if color is not None and not color.any():
        color = None  # the point format has room for colors that nobody filled in
    extra = kept_columns(path, {name: np.asarray(las[name]) for name in names if name in keep}, keep) if keep else {}
    return Cloud(_scaled(las), color, _unit(las), extra)


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


def _check_sizes(path: Path) -> None:
    """Raises DataError where the header counts more records than the file has room for: laspy would read on and on."""
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
    _check_points(path, head, start, size)


def _check_points(path: Path, head: bytes, start: int, size: int) -> None:
    """Raises DataError where the points, or the chunks of compressed ones, that a file counts have no room in it.

    head: at least 227 bytes. The parsers set memory aside for all of them, and the compressed one ends the process.
    """
    form, length, count = struct.unpack_from("<BHI", head, 104)
    if head[25] >= 4 and len(head) >= 255:
        count = struct.unpack_from("<Q", head, 247)[0]
    what, room = "points", (size - start) // max(length, 1)
    if form & 0xC0:  # compressed: the first 8 bytes say where the table of chunks lies, whose second number counts them
        with path.open("rb") as file:
            file.seek(start)
            file.seek(min(int.from_bytes(file.read(8), "little"), size))
            table = file.read(8)
        what, room, count = "chunks of points", size, int.from_bytes(table[4:], "little")
    if count > room:
        raise DataError(f"{path}: truncated or damaged: claims {count} {what}, which a file of {size} bytes can't hold")


def _unit(las: Any) -> str:
    """Returns the unit of the coordinates, where the file's reference system says so; "" where it doesn't."""
    for record in [*las.header.vlrs, *(las.evlrs or [])]:
        text = getattr(record, "string", "")
        if text and (found := _unit_of_wkt(text)):
            return found
        for key in getattr(record, "geo_keys", []):
            if key.id == _UNIT_KEY and key.tiff_tag_location == 0:
                return _GEO_UNITS.get(key.value_offset, "")
    return ""


def _unit_of_wkt(text: str) -> str:
    """Returns the unit of a reference system in WKT: the last one that is a length.

    >>> _unit_of_wkt('PROJCS["a",GEOGCS["b",UNIT["degree",0.0174]],UNIT["US survey foot",0.304800609601219]]')
    'us-ft'
    """
    units = re.findall(r'(?:LENGTH)?UNIT\["([^"]*)",\s*([-+.\deE]+)', text)
    sizes = {"m": 1.0, "ft": 0.3048, "us-ft": 1200 / 3937}
    found = [name for _, size in units for name, meters in sizes.items() if abs(float(size) - meters) < 1e-9]
    return found[0] if found else ""
