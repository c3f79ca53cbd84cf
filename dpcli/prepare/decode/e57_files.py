"""E57, the files of terrestrial scanners: all scans of a file in its common coordinates, by the Rust crate of that name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from dpcli.errors import DataError, DpcError
from dpcli.prepare.cloud_formats.cloud import Cloud, without

JOINED = "E57 files of several scans, which are joined as their poses say"
PLAIN = "E57 files in which some scans have colors and some have none; colors are not read"
INVALID = "points that their file marks as invalid dropped"
_COUNT = re.compile(r"<points\b[^>]*\brecordCount=[\"'](\d+)[\"']")  # of a scan's points, valid or not
_PROTOTYPE = re.compile(r"<prototype\b.*?</prototype>", re.DOTALL)  # what each record of a scan holds
_FIELD = re.compile(r"<(\w+)\s+type=\"(?:Float|ScaledInteger|Integer)\"")
_AXES = (
    *("cartesianX", "cartesianY", "cartesianZ", "cartesianInvalidState"),
    *("sphericalRange", "sphericalAzimuth", "sphericalElevation", "sphericalInvalidState"),
)
_COLORS = ("colorRed", "colorGreen", "colorBlue", "isColorInvalid")


def read_e57(path: Path, keep: Sequence[str] = ()) -> Cloud:
    """Reads the points of all scans in meters, in double precision, without those marked as invalid, and their colors.

    Raises DataError when the file is damaged, which its checksums tell, or has no scan; DpcError without the package.
    """
    if keep:
        raise DataError(f"{path}: column {keep[0]}: of E57 only points and colors are read; save it as .ply")
    library = _load_library()
    text = _called(path, library.raw_xml)
    scans = [_FIELD.findall(prototype) for prototype in _PROTOTYPE.findall(text)]
    if not scans:
        raise DataError(f"{path}: no scan in it; expected points")
    found = _called(path, library.read_points)
    colored = [set(_COLORS[:3]) <= set(fields) for fields in scans]
    colors = found.color if all(colored) and len(found.color) == len(found.points) else None
    told = {JOINED: 1} if len(scans) > 1 else {}
    told |= {PLAIN: 1} if any(colored) and colors is None else {}
    left = sum(map(int, _COUNT.findall(text))) - len(found.points)
    told |= {INVALID: left} if left > 0 else {}
    unread = without(list(dict.fromkeys(name for fields in scans for name in fields)), _AXES, _COLORS)
    return Cloud(found.points, colors, "m", unread=unread, dropped=told)


def _called(path: Path, function: Any) -> Any:
    try:
        return function(str(path))
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # a panic of Rust is no Exception
        said = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise DataError(f"{path}: not a readable E57 file, perhaps truncated ({said})") from None


def _load_library() -> ModuleType:
    try:
        import e57
    except ImportError:
        raise DpcError("reading E57 needs a package: pip install 'dpc-toolkit[e57]'") from None
    return e57
