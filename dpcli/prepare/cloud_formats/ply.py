"""PLY files (Turk 1994): text, little- or big-endian, properties of any type in any order, elements in any order."""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.cloud import Cloud, cloud_of_columns, require_points
from dpcli.prepare.cloud_formats.column_names import unit_of_comments
from dpcli.prepare.cloud_formats.gaussians import unpack_supersplat
from dpcli.prepare.cloud_formats.text_numbers import TextTable

_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2"},
    **{"uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "long": "i8", "int64": "i8"},
    **{"ulong": "u8", "uint64": "u8", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_LENGTHS = dict(zip("i1 u1 i2 u2 i4 u4 i8 u8 f4 f8".split(), "bBhHiIqQfd"))  # how struct calls them
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_HEADER_BYTES = 1 << 20
_LINE_END = 2  # bytes that some writers add at the end


@dataclass
class Element:
    """Holds what a header says of one element; ``properties`` are names and numpy types, of lists the type is "".

    lists: of each list the numpy types of its length and of its numbers, by name.
    """

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    lists: dict[str, tuple[str, str]] = field(default_factory=dict)

    @property
    def has_lists(self) -> bool:
        """Returns whether its rows have no common length."""
        return any(not kind for _, kind in self.properties)

    def layout(self, order: str) -> list[tuple[struct.Struct | None, int, int]]:
        """Returns of each property how a list's length lies in a file (None of a number), the bytes of a number, and how many a
        list has at least.
        """
        parts: list[tuple[struct.Struct | None, int, int]] = []
        for name, kind in self.properties:
            length, numbers = self.lists.get(name, ("u1", "i4"))
            corners = self.name == "face" and name.startswith("vertex_ind")  # range grids have empty lists
            form = None if kind else struct.Struct(order + _LENGTHS[length])
            parts.append((form, np.dtype(kind or numbers).itemsize, int(corners)))
        return parts


def read_ply(path: Path, keep: Sequence[str] = ()) -> Cloud:
    """Reads the vertices, or the Gaussians that SuperSplat packed.

    Raises DataError when they end early, or hold what their types can't.
    """
    with path.open("rb") as file:
        order, elements = read_header(path, file)
        unit = _unit(file)
        place = next((k for k, element in enumerate(elements) if element.name in ("vertex", "point")), None)
        if place is None:
            raise DataError(f"{path}: no element vertex in its header; expected a point cloud or a mesh")
        vertex, before, behind = elements[place], elements[:place], elements[place + 1 :]
        if (
            order
            and [element.name for element in before] == ["chunk"]
            and ("packed_position", "u4") in vertex.properties
        ):
            chunks, rows = (_read_binary(path, file, order, element, [])[0] for element in (before[0], vertex))
            return unpack_supersplat(path, chunks, rows, keep)
        if order and (vertex.has_lists or any(element.has_lists for element in before)):
            cloud = cloud_of_columns(path, _read_with_lists(path, vertex), keep)
            return replace(cloud, unread=cloud.unread + tuple(vertex.lists), unit=cloud.unit or unit)
        if order:
            columns, rest = _read_binary(path, file, order, vertex, before)
        else:
            columns, rest = _read_text(path, file, vertex, before, behind)
        if order and behind:
            _require_elements(path, file, order, behind)
            rest = {}
    cloud = cloud_of_columns(path, columns, keep)
    return replace(cloud, dropped=rest, unit=cloud.unit or unit)


def read_header(path: Path, file: BinaryIO) -> tuple[str, list[Element]]:
    """Returns the byte order ("" for text) and the elements; the file stands behind the header."""
    head = file.read(_HEADER_BYTES)
    mark = 3 if head.startswith(b"\xef\xbb\xbf") else 0
    found = re.search(rb"[\r\n]end_header[ \t]*", head)  # a line of its own: comments may mention it
    if head[mark : mark + 3] != b"ply" or found is None:
        raise DataError(f"{path}: not a PLY point cloud: no number of points in its header")
    end, after = found.start(), found.end()
    after += 2 if head[after : after + 2] == b"\r\n" else 1
    order, elements = None, []
    for line in head[mark:end].decode("latin-1").splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            order = _ORDERS.get(words[1])
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal():
            elements.append(Element(words[1], int(words[2])))
        elif words[:1] == ["property"] and elements and len(words) >= 3:
            elements[-1].properties.append((words[-1], _property_type(path, words)))
            if words[1] == "list" and len(words) == 5:
                elements[-1].lists[words[-1]] = tuple(
                    _property_type(path, ["", word, words[-1]]) for word in words[2:4]
                )
    if order is None:
        raise DataError(
            f"{path}: its header names no format; expected ascii, binary_little_endian or binary_big_endian"
        )
    file.seek(after)
    return order, elements


def _unit(file: BinaryIO) -> str:
    """Returns the unit that comments of the header tell, which ends where the file stands."""
    end = file.tell()
    file.seek(0)
    lines = file.read(end).decode("latin-1").splitlines()
    return unit_of_comments([line for line in lines if line.startswith(("comment", "obj_info"))])


def _property_type(path: Path, words: list[str]) -> str:
    kind = _TYPES.get(words[1].lower(), "")
    if not kind and words[1] != "list":
        raise DataError(f"{path}: property {words[-1]} has the type {words[1]}, which PLY doesn't know")
    return kind


def _read_binary(
    path: Path, file: BinaryIO, order: str, vertex: Element, before: list[Element]
) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Returns the columns, and how many points lie behind them, as `require_points` does; the file stands behind the rows."""
    skipped = sum(element.count * sum(np.dtype(kind).itemsize for _, kind in element.properties) for element in before)
    names = _unique_names(path, vertex)
    kind = np.dtype([(name, order + kind) for name, (_, kind) in zip(names, vertex.properties)])
    start = file.tell() + skipped
    found = max(path.stat().st_size - start, 0) // kind.itemsize if kind.itemsize else 0
    rest = require_points(path, vertex.count, found)
    file.seek(start)
    rows = np.fromfile(file, kind, vertex.count)
    return {name: rows[name] for name in names}, rest


def _require_elements(path: Path, file: BinaryIO, order: str, elements: list[Element]) -> None:
    """Raises DataError unless the elements behind the points fill the file: else the number of points is wrong, too."""
    start, data = file.tell(), memoryview(file.read())
    at = 0
    for element in elements:
        rows, layout = element.count, element.layout(order)
        if rows and (size := _row_size(data, at, layout)) and _are_alike(data[at:], size, rows, layout):
            at, rows = at + rows * size, 0
        while rows and at <= len(data):
            at, rows = at + _row_size(data, at, layout), rows - 1
    if at > len(data) or len(data) - at > _LINE_END:
        raise DataError(
            f"{path}: {start + len(data)} bytes, but its header's counts take {start + at}{' or more' * (at > len(data))}:"
            " truncated or damaged; copy it again"
        )


def _row_size(data: memoryview, start: int, layout: list[tuple[struct.Struct | None, int, int]]) -> int:
    """Returns the bytes of a row that begins at byte ``start``; more than there are where a list has no room or no corner."""
    at = start
    for length, size, least in layout:
        if length is None:
            at += size
            continue
        if at + length.size > len(data):
            return len(data) + 1
        count = int(length.unpack_from(data, at)[0])
        if count < least:
            return len(data) + 1
        at += length.size + count * size
    return at - start


def _are_alike(data: memoryview, size: int, rows: int, layout: list[tuple[struct.Struct | None, int, int]]) -> bool:
    """Returns whether all rows are as long as the first, ``size`` bytes, because their lists have as many numbers."""
    if rows * size > len(data):
        return all(length is None for length, _, _ in layout)
    table, at = np.frombuffer(data, np.uint8, rows * size).reshape(rows, size), 0
    for length, number, _ in layout:
        if length is None:
            at += number
            continue
        if (table[:, at : at + length.size] != table[0, at : at + length.size]).any():
            return False
        at += length.size + int(length.unpack_from(data, at)[0]) * number
    return True


def _read_text(
    path: Path, file: BinaryIO, vertex: Element, before: list[Element], behind: list[Element]
) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    names = _unique_names(path, vertex)
    head = file.tell()
    body = file.read().decode("latin-1").replace("\r\n", "\n").replace("\r", "\n")
    file.seek(0)
    first = len(file.read(head).splitlines()) + 1
    skipped = sum(element.count for element in before)
    if skipped:
        rows = [(k, line) for k, line in enumerate(body.split("\n")) if line.strip()][skipped : skipped + 1]
        body = body.split("\n", rows[0][0])[-1] if rows else ""
        first += rows[0][0] if rows else 0
    if vertex.has_lists:
        raise DataError(f"{path}: its vertices hold lists; expected one number for each property")
    table = TextTable(path, tuple(names), body, first, limit=vertex.count)
    values = table.columns(range(len(names)))
    others = sum(element.count for element in behind)
    found = max(table.rows - others, 0) if len(values) == vertex.count else len(values)
    rest = require_points(path, vertex.count, found)
    if rest and others:
        raise DataError(
            f"{path}: {table.rows} rows, but its header counts {vertex.count + others}; damaged, copy it again"
        )
    columns = {
        name: _typed(path, name, values[:, k], np.dtype(kind))
        for k, (name, (_, kind)) in enumerate(zip(names, vertex.properties))
    }
    return columns, rest | table.cut


def _typed(path: Path, name: str, values: np.ndarray, kind: np.dtype) -> np.ndarray:
    """Returns numbers in the type that the header says. Raises DataError at the first vertex that doesn't fit it."""
    if kind.kind == "f":
        return values.astype(kind)
    ends = np.iinfo(kind)
    bad = np.flatnonzero(~((values >= ends.min) & (values <= ends.max)) | (values != np.floor(values)))
    if len(bad):
        raise DataError(
            f"{path}: {name} of vertex {bad[0]} is {values[bad[0]]:g}; its type holds whole numbers from {ends.min} to"
            f" {ends.max}"
        )
    return values.astype(kind)


def _read_with_lists(path: Path, vertex: Element) -> dict[str, np.ndarray]:
    """Returns the columns of vertices in or behind lists, whose rows must be read one by one."""
    import plyfile

    try:
        data = plyfile.PlyData.read(str(path))[vertex.name].data
    except Exception as error:  # plyfile.PlyParseError, ValueError, MemoryError of damaged counts
        raise DataError(f"{path}: truncated or damaged ({error})") from None
    return {name: np.asarray(data[name]) for name, kind in vertex.properties if kind}


def _unique_names(path: Path, vertex: Element) -> list[str]:
    names = [name for name, _ in vertex.properties]
    if len(set(names)) != len(names):
        raise DataError(f"{path}: a property is there twice: {', '.join(names)}"[:200])
    return names
