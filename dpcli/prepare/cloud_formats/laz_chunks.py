"""The sizes inside a LAZ file, compared with the file before its parser sets memory aside for them."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from dpcli.errors import DataError

_POINTWISE, _LAYERED = 1, 3  # compressors: one stream without chunks; chunks whose fields lie one behind the other
_VARIABLE = 0xFFFFFFFF  # size of chunks that each say their own
_DENSEST = 1024  # points a byte at most; equal ones reach 134
_ROOM = 64 << 20  # bytes of a chunk's points that any file may claim
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # by kind of item: point, colors, colors and infrared, wave packet
_EXTRA_BYTES = 14  # a kind of item with a layer for each of its bytes


def check_chunks(path: Path, header: Any) -> None:
    """Raises DataError where a LAZ file can't hold the points, chunks or layers that it claims.

    header: laspy's. The parser sets memory aside for each of these numbers, writes zeros into it, and ends the process where
    there isn't as much.
    """
    record = next((one.record_data for one in header.vlrs if type(one).__name__ == "LasZipVlr"), b"")
    if len(record) < 34:
        raise DataError(f"{path}: damaged: says that its points are compressed, but not how")
    compressor, chunk_points = struct.unpack_from("<H10xI", record)
    items = [struct.unpack_from("<HH", record, at) for at in range(34, len(record) - 5, 6)]
    items = items[: struct.unpack_from("<H", record, 32)[0]]
    length = sum(size for _, size in items)
    if length != header.point_format.size:
        raise DataError(
            f"{path}: damaged: its points have {header.point_format.size} bytes, but {length} where they are compressed"
        )
    points, size = header.point_count, path.stat().st_size
    _require(path, points <= _DENSEST * size, f"{points} points", size)
    if compressor == _POINTWISE:
        return
    if chunk_points != _VARIABLE and chunk_points > points:
        _require(path, chunk_points * length <= _ROOM, f"{chunk_points} points in each of its chunks", size)
    with path.open("rb") as file:
        chunks = _chunk_table(path, file, header.offset_to_point_data, record, size)
        if chunk_points == _VARIABLE:
            for found, room in chunks:
                _require(path, found <= _DENSEST * room, f"a chunk of {found} points", room, "chunk")
        have = sum(found for found, _ in chunks)
        _require(path, points <= have, f"{points} points", size, f"file with chunks for {have} and")
        if compressor == _LAYERED:
            _check_layers(path, file, header.offset_to_point_data + 8, [room for _, room in chunks], items)


def _require(path: Path, fits: bool, what: str, size: int, where: str = "file") -> None:
    if not fits:
        raise DataError(f"{path}: truncated or damaged: claims {what}, which a {where} of {size} bytes can't hold")


def _chunk_table(path: Path, file: BinaryIO, start: int, record: bytes, size: int) -> list[tuple[int, int]]:
    """Returns the points and bytes of each chunk. The table's place is in the first bytes of the points, or, of a file that
    was written in one go, in the last of all.
    """
    import lazrs

    for place in (start, size - 8):
        file.seek(max(place, 0))
        table = int.from_bytes(file.read(8), "little", signed=True)
        if table > start:
            break
    if not start < table <= size - 8:
        raise DataError(f"{path}: truncated or damaged: its table of chunks would be at byte {table} of {size}")
    file.seek(table + 4)
    count = int.from_bytes(file.read(4), "little")
    _require(path, count <= size // 8, f"{count} chunks of points", size)  # each has one point as it is
    file.seek(start)
    chunks = lazrs.read_chunk_table(file, lazrs.LazVlr(record))
    room = sum(length for _, length in chunks)
    _require(path, start + 8 + room <= size, f"chunks of {room} bytes", size)
    return chunks


def _check_layers(path: Path, file: BinaryIO, start: int, chunks: list[int], items: list[tuple[int, int]]) -> None:
    first = sum(size for _, size in items)
    layers = sum(size if kind == _EXTRA_BYTES else _LAYERS.get(kind, 0) for kind, size in items)
    for place, room in _places(start, chunks):
        file.seek(place + first + 4)
        sizes = file.read(4 * layers)
        claimed = first + 4 + sum(struct.unpack(f"<{layers}I", sizes)) if len(sizes) == 4 * layers else room + 1
        _require(path, claimed + len(sizes) <= room, f"layers of {claimed} bytes", room, "chunk")


def _places(start: int, chunks: list[int]) -> Iterator[tuple[int, int]]:
    for room in chunks:
        yield start, room
        start += room
