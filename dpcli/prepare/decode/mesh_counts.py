"""Counts in the headers of mesh files against their rows; trimesh takes what is there, and nothing at all of a cut STL."""

from __future__ import annotations

import re
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.ply import read_header
from dpcli.runtime.progress import log

_STL_HEAD, _STL_FACE = 84, 50  # bytes
_SOLID = rb"(?i)\s*solid"
_SAID: set[str] = set()
_MARK = b"\xef\xbb\xbf"  # of UTF-8, before the first line


def require_counts(path: Path) -> None:
    """Raises DataError where an OFF, STL or PLY file holds fewer or more rows than its header counts, or lacks its end mark.

    Other formats count nothing (OBJ), or their reader does it (glTF, binary PLY, DAE).
    """
    check = _CHECKS.get(path.suffix.lower())
    if check is not None:
        check(path)


def mesh_source(path: Path) -> dict[str, Any]:
    """Returns what trimesh loads of a mesh file: its path, or the bytes of an OBJ without the mark that hides its first line,
    and those of a binary STL without what lies behind its triangles.
    """
    if path.suffix.lower() == ".stl" and (end := _end_of_stl(data := path.read_bytes())):
        return {"file_obj": BytesIO(data[:end]), "file_type": "stl"}
    with path.open("rb") as file:
        if path.suffix.lower() != ".obj" or file.read(len(_MARK)) != _MARK:
            return {"file_obj": path}
        return {"file_obj": BytesIO(file.read()), "file_type": "obj"}


def _compare(path: Path, what: str, declared: int, found: int) -> None:
    if found != declared:
        how = "truncated" if found < declared else "damaged"
        raise DataError(f"{path}: {how}: its header counts {declared} {what}, it holds {found}; copy it again")


def _require_corners(path: Path, row: bytes) -> None:
    """Raises DataError where the last row, which begins with its number of corners, is cut."""
    words = row.split()
    if words and words[0].isdigit() and len(words) <= int(words[0]):
        raise DataError(
            f"{path}: truncated: its last face has {len(words) - 1} of its {int(words[0])} corners; copy it again"
        )


def _check_off(path: Path) -> None:
    lines = (line.split(b"#")[0].strip() for line in path.read_bytes().splitlines())
    rows = [line for line in lines if line]
    head = re.match(rb"[A-Z4n]*OFF\s*(.*)", rows[0]) if rows else None
    if head is None or b"BINARY" in head[1]:
        return
    counts, rows = (head[1], rows[1:]) if head[1] else (b"".join(rows[1:2]), rows[2:])
    numbers = counts.split()[:2]
    if len(numbers) == 2 and all(number.isdigit() for number in numbers):
        _compare(path, "vertices and faces", sum(map(int, numbers)), len(rows))
        if numbers[1].strip(b"0"):
            _require_corners(path, rows[-1])


def _check_stl(path: Path) -> None:
    data = path.read_bytes()
    count = int.from_bytes(data[_STL_HEAD - 4 : _STL_HEAD], "little")
    if len(data) in (0, _STL_HEAD + count * _STL_FACE):
        return
    if end := _end_of_stl(data):
        with log.each_once(_SAID):
            log.warn(f"{path}: {len(data) - end} bytes behind its {count} triangles were passed over")
    elif _is_binary(data):
        _compare(path, "triangles", count, (len(data) - _STL_HEAD) // _STL_FACE)
        _compare(path, "bytes", _STL_HEAD + count * _STL_FACE, len(data))
    elif re.match(_SOLID, data) and not re.search(rb"(?i)\bendsolid\b[^\n]*\s*\Z", data):
        raise DataError(f"{path}: truncated: it doesn't end with endsolid; copy it again")
    elif not re.match(_SOLID, data):
        raise DataError(
            f"{path}: truncated: its header alone has {_STL_HEAD} bytes, it holds {len(data)}; copy it again"
        )


def _is_binary(data: bytes) -> bool:
    return len(data) >= _STL_HEAD and (not re.match(_SOLID, data) or b"\0" in data)


def _end_of_stl(data: bytes) -> int:
    """Returns where the triangles of a binary STL end, if something lies behind that is no triangle: zeros, or bytes that
    make no whole number of them; else 0. Whole triangles behind are a count that is wrong.
    """
    end = _STL_HEAD + int.from_bytes(data[_STL_HEAD - 4 : _STL_HEAD], "little") * _STL_FACE
    behind = data[end:] if _is_binary(data) else b""
    return end if _STL_HEAD < end and behind and (len(behind) % _STL_FACE or not any(behind)) else 0


def _check_ply(path: Path) -> None:
    with path.open("rb") as file:
        order, elements = read_header(path, file)
        if not order:
            rows = [line for line in file if line.strip()]
            _compare(path, "rows", sum(element.count for element in elements if element.properties), len(rows))
            if rows and elements[-1].properties[:1] and not elements[-1].properties[0][1]:
                _require_corners(path, rows[-1])


_CHECKS: dict[str, Callable[[Path], None]] = {".off": _check_off, ".stl": _check_stl, ".ply": _check_ply}
