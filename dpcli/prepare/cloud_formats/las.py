"""LAS and LAZ files of laser scanners, by laspy."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.cloud import Cloud, kept_columns

_COLORS = ("red", "green", "blue")
_UNIT_KEY = 3076  # of GeoTIFF: linear units of a projected system
_GEO_UNITS = {9001: "m", 9002: "ft", 9003: "us-ft"}


def read_las(path: Path, keep: Sequence[str] = ()) -> Cloud:
    """Reads the points, with colors as stored: 16 bits, some of which hold bytes. Raises DataError when damaged."""
    import laspy

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
    extra = kept_columns(path, {name: np.asarray(las[name]) for name in names if not keep or name in keep}, keep)
    return Cloud(np.asarray(las.xyz, np.float64), color, _unit(las), extra)


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
