"""PCD files of the Point Cloud Library, versions 0.5 to 0.7: text, binary and compressed, every type it offers."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.cloud import Cloud, cloud_of_columns, require_points
from dpcli.prepare.cloud_formats.column_names import unit_of_comments
from dpcli.prepare.cloud_formats.text_numbers import TextTable

_DATA = ("ascii", "binary", "binary_compressed")
_TYPES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_MOST_BYTES = 1 << 32  # of a compressed cloud, unpacked
POSED = "frames with a sensor pose (VIEWPOINT of PCD), which is not applied: points stay in the axes they are stored in"
BLACK = "texts (PCD) whose colors are all 0, as some writers round them; save them as binary"


@dataclass(frozen=True)
class Header:
    """Holds field names (columns of several counts have numbers behind theirs), the row's type, points and data.

    counts: numbers of each field. posed: whether it tells where the sensor stood, other than at the origin of the points.
    unit: as comments tell it.
    """

    kind: np.dtype
    counts: tuple[int, ...]
    points: int
    data: str
    length: int
    lines: int
    posed: bool = False
    unit: str = ""


def read_pcd(path: Path, keep: Sequence[str] = ()) -> Cloud:
    """Reads the points. Raises DataError when the header contradicts itself, or the data end early."""
    data = path.read_bytes()
    header = _read_header(path, data)
    body = memoryview(data)[header.length :]
    beyond: dict[str, int] = {}
    if header.data == "ascii":
        columns, beyond = _read_text(path, bytes(body), header)
    elif header.data == "binary":
        beyond = require_points(path, header.points, len(body) // header.kind.itemsize)
        rows = np.frombuffer(body, header.kind, header.points)
        columns = {name: rows[name] for name in header.kind.names or ()}
    else:
        columns = _read_compressed(path, body, header)
    shown = {name: column for name, column in columns.items() if not name.startswith("_")}  # padding
    posed = {POSED: 1} if header.posed else {}
    cloud = cloud_of_columns(path, shown, keep)
    return replace(cloud, dropped=beyond | posed, unit=cloud.unit or header.unit)


def _read_header(path: Path, data: bytes) -> Header:
    said: dict[str, list[str]] = {}
    start = 3 if data.startswith(b"\xef\xbb\xbf") else 0
    lines, comments = 0, []
    while "DATA" not in said:
        end = data.find(b"\n", start, start + 65536)
        if end < 0 or lines > 100:
            raise DataError(f"{path}: not a PCD point cloud: no number of points in its header")
        line = data[start:end].decode("latin-1").strip()
        words = line.split()
        if line.startswith("#"):
            comments.append(line)
        elif words:
            said[words[0].upper()] = words[1:]
        start, lines = end + 1, lines + 1
    points = _points(path, said)
    form = said["DATA"][0].lower() if said["DATA"] else ""
    if form not in _DATA:
        raise DataError(f"{path}: DATA {form}; expected {', '.join(_DATA)}")
    posed, unit = _posed(said.get("VIEWPOINT", [])), unit_of_comments(comments)
    return Header(*_row_type(path, said), points, form, start, lines, posed, unit)


def _points(path: Path, said: dict[str, list[str]]) -> int:
    """Returns how many points a header says. Raises DataError where it doesn't, or WIDTH x HEIGHT and POINTS differ."""
    numbers = {key: said[key][0] for key in ("WIDTH", "HEIGHT", "POINTS") if said.get(key)}
    if not all(number.isdecimal() for number in numbers.values()) or not numbers.keys() & {"WIDTH", "POINTS"}:
        raise DataError(f"{path}: not a PCD point cloud: no number of points in its header")
    size = int(numbers["WIDTH"]) * int(numbers.get("HEIGHT", 1)) if "WIDTH" in numbers else None
    points = int(numbers.get("POINTS", size or 0))
    if size not in (None, points):
        raise DataError(
            f"{path}: its header says {points} points and WIDTH x HEIGHT of {size}; damaged, write it again"
        )
    return points


def _posed(words: list[str]) -> bool:
    """Returns whether a VIEWPOINT (x y z, quaternion w x y z) is more than the identity; PCL's loaders don't apply it either."""
    try:
        x, y, z, _, i, j, k = (float(word) for word in words)
    except ValueError:
        return False
    return any((x, y, z, i, j, k))


def _row_type(path: Path, said: dict[str, list[str]]) -> tuple[np.dtype, tuple[int, ...]]:
    names = said.get("FIELDS") or said.get("COLUMNS") or []
    sizes, types = said.get("SIZE", ["4"] * len(names)), said.get("TYPE", ["F"] * len(names))
    counts = said.get("COUNT", ["1"] * len(names))
    if not names or not len(names) == len(sizes) == len(types) == len(counts):
        raise DataError(f"{path}: FIELDS, SIZE, TYPE and COUNT of its header have different lengths")
    row, taken = [], set()
    for place, (name, size, kind, count) in enumerate(zip(names, sizes, types, counts)):
        if kind.upper() not in _TYPES or not size.isdecimal() or int(size) not in _TYPES[kind.upper()]:
            raise DataError(f"{path}: field {name} has TYPE {kind} SIZE {size}, which PCD doesn't know")
        if not count.isdecimal() or not 0 < int(count) < 65536:
            raise DataError(f"{path}: field {name} has COUNT {count}; expected 1 or more")
        for part in range(int(count)):
            own = name if int(count) == 1 and name != "_" else f"{name}_{place}_{part}"
            if own in taken:
                raise DataError(f"{path}: field {name} is there twice")
            taken.add(own)
            row.append((own, f"<{kind.lower()}{size}"))
    return np.dtype(row), tuple(map(int, counts))


def _read_text(path: Path, body: bytes, header: Header) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Returns the columns, and how many points lie behind them, as `require_points` does."""
    names = header.kind.names or ()
    lines = body.decode("latin-1").replace("\r\n", "\n")
    table = TextTable(path, tuple(names), lines, header.lines + 1, limit=header.points)
    values = table.columns(range(len(names)))
    beyond = require_points(path, header.points, table.rows if len(values) == header.points else len(values))
    columns, black = {}, {}
    for k, name in enumerate(names):
        kind, column = header.kind[name], values[:, k]
        whole = kind.kind == "f" or (np.isfinite(column).all() and (column == np.floor(column)).all())
        # whole numbers, as some write them, or a color whose bytes are no number, which a text can't hold
        odd = (column >= 1) | (np.isnan(column) & np.isfinite(values).any(1))
        packed = name in ("rgb", "rgba") and kind.kind == "f" and odd.any()
        black = {BLACK: 1} if name == "rgb" and kind.kind == "f" and len(column) and not column.any() else black
        columns[name] = column if packed or not whole else column.astype(kind)
    return columns, beyond | table.cut | black


def _read_compressed(path: Path, body: memoryview, header: Header) -> dict[str, np.ndarray]:
    """Returns the columns of fields that lie one after the other in one block packed by LZF, all numbers of a point together."""
    if len(body) < 8:
        require_points(path, header.points + 1, 0)
    packed, size = struct.unpack("<II", body[:8])
    if size != header.points * header.kind.itemsize or size > _MOST_BYTES:
        raise DataError(
            f"{path}: {size} bytes for {header.points} points of {header.kind.itemsize}; truncated or damaged"
        )
    if len(body) < 8 + packed:
        raise DataError(f"{path}: truncated: {len(body) - 8} of its {packed} compressed bytes are left")
    raw = _unpack_lzf(path, bytes(body[8 : 8 + packed]), size) if size else b""
    columns: dict[str, np.ndarray] = {}
    names, start = header.kind.names or (), 0
    for count in header.counts:
        own = names[len(columns) : len(columns) + count]
        block = np.frombuffer(raw, header.kind[own[0]], header.points * count, start)
        columns |= dict(zip(own, block.reshape(-1, count).T))
        start += block.nbytes
    return columns


def _unpack_lzf(path: Path, packed: bytes, size: int) -> bytes:
    """Returns bytes that LZF packed. HDF5 files may be packed by it, too: h5py, which brings it, unpacks a chunk."""
    import h5py

    with h5py.File("lzf", "w", driver="core", backing_store=False) as file:
        chunk = file.create_dataset("chunk", (size,), np.uint8, chunks=(size,), compression="lzf")
        chunk.id.write_direct_chunk((0,), packed)
        try:
            return chunk[:].tobytes()
        except OSError:
            raise DataError(f"{path}: its compressed points are damaged; copy it again") from None
