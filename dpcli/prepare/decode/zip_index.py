"""Big ZIP archives read in place: which folders they hold, in seconds for millions of entries, and a folder's files.

`zipfile` makes a Python object of every entry (10 s and 500 MB for a million), in every process that opens the archive.
Here the central directory is scanned as an array, and a folder is remembered as the byte range of its entries alone.
Field names and sizes follow PKWARE's APPNOTE 6.3, sections 4.3.7 to 4.3.16.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from dpcli.errors import DataError

_ENTRY = struct.Struct("<4s6H3I5H2I")  # central directory entry, 46 bytes before its name
_LOCAL = struct.Struct("<4s5H3I2H")  # the header in front of a file's own bytes
_END = struct.Struct("<4s4H2IH")
_END64 = struct.Struct("<4sQ2H2I4Q")
_SAME = np.r_[0:4, 28:34]  # the columns that make rows of one size: the signature and the three lengths
_WINDOW = 1 << 16
_MOST_BYTES = 1 << 26  # of one unpacked file; a depth frame takes half a megabyte


@dataclass(frozen=True)
class Directory:
    """Where the central directory lies: bytes ``start`` to ``start + size``; ``shift`` bytes precede the archive."""

    start: int
    size: int
    shift: int


def find_directory(file: BinaryIO, path: Path) -> Directory:
    """Locate the central directory, ZIP64 or not; DataError when the archive is cut short or a part of a split one."""
    length = file.seek(0, 2)
    tail_start = max(0, length - (1 << 16) - _END.size)
    file.seek(tail_start)
    tail = file.read()
    at = _end_record(tail)
    if at < 0:
        raise DataError(f"{path}: no ZIP, or cut short: its directory, the end of the file, is missing; copy it again")
    _, disk, _, _, _, size, offset, _ = _END.unpack_from(tail, at)
    end = tail_start + at
    if 0xFFFFFFFF in (size, offset) or tail[max(0, at - 20) : at - 16] == b"PK\x06\x07":
        end, size, offset = _zip64(file, path, tail[max(0, at - 20) : at])
    elif disk:
        raise DataError(f"{path}: the last part of a split archive; join the parts first (zip -s 0)")
    shift = end - size - offset
    if shift < 0:
        raise DataError(f"{path}: cut short or damaged: its directory says more bytes than there are; copy it again")
    return Directory(end - size, size, shift)


def _end_record(tail: bytes) -> int:
    """Where the end record begins: the last one whose comment reaches just to the end of the file; -1 without one."""
    at = tail.rfind(b"PK\x05\x06")
    while at >= 0 and at + _END.size + int.from_bytes(tail[at + 20 : at + 22], "little") != len(tail):
        at = tail.rfind(b"PK\x05\x06", 0, at + 3)
    return at


def _zip64(file: BinaryIO, path: Path, locator: bytes) -> tuple[int, int, int]:
    """Where the ZIP64 end record lies, and the size and offset of the directory that it tells."""
    if len(locator) == 20 and locator.startswith(b"PK\x06\x07"):
        end = int.from_bytes(locator[8:16], "little")
        file.seek(end)
        record = file.read(_END64.size)
        if len(record) == _END64.size and record.startswith(b"PK\x06\x06"):
            *_, size, offset = _END64.unpack(record)
            return end, size, offset
    raise DataError(f"{path}: a damaged ZIP64 directory; copy it again")


def folders(path: Path) -> tuple[dict[str, list[tuple[int, int]]], int]:
    """Every folder that directly holds files -> byte ranges of its entries in the archive; and the archive's shift.

    Names as stored, forward slashes, "" for the top. DataError when the archive is damaged.
    """
    with open(path, "rb") as file:
        directory = find_directory(file, path)
        file.seek(directory.start)
        buffer = np.frombuffer(file.read(directory.size), np.uint8)
    starts: list[tuple[int, bytes]] = []
    for position, size, rows in _blocks(buffer, path):
        length = int(rows[0, 28]) | int(rows[0, 29]) << 8
        for first, folder in _changes(rows[:, _ENTRY.size : _ENTRY.size + length]):
            starts.append((directory.start + position + first * size, folder))
    ends = [start for start, _ in starts[1:]] + [directory.start + directory.size]
    found: dict[bytes, list[tuple[int, int]]] = {}
    for (start, folder), stop in zip(starts, ends, strict=True):
        ranges = found.setdefault(folder, [])
        if ranges and ranges[-1][1] == start:
            start = ranges.pop()[0]
        ranges.append((start, stop))
    return {folder.decode("utf-8", "replace"): ranges for folder, ranges in found.items()}, directory.shift


def _blocks(buffer: np.ndarray, path: Path) -> Iterator[tuple[int, int, np.ndarray]]:
    """Runs of entries of equal size: position, size, rows u8 (R,size)."""
    position = 0
    while position < len(buffer):
        head = bytes(buffer[position : position + _ENTRY.size])
        if len(head) < _ENTRY.size or head[:4] != b"PK\x01\x02":
            raise DataError(f"{path}: the ZIP's directory is damaged at its byte {position}; copy it again")
        size = _ENTRY.size + sum(struct.unpack_from("<3H", head, 28))
        if position + size > len(buffer):
            raise DataError(f"{path}: the ZIP's directory ends in the middle of an entry; copy it again")
        window, count = 8, 1
        while count < _WINDOW:
            rest = buffer[position + count * size :]
            rows = rest[: min(window, len(rest) // size) * size].reshape(-1, size)
            same = (rows[:, _SAME] == buffer[position + _SAME]).all(1)
            equal = len(same) if same.all() else int(same.argmin())
            count += equal
            if equal < window:
                break
            window *= 4
        yield position, size, buffer[position : position + count * size].reshape(count, size)
        position += count * size


def _changes(names: np.ndarray) -> Iterator[tuple[int, bytes]]:
    """names u8 (R,L): the rows at which another folder begins, and that folder."""
    length = names.shape[1]
    backwards = names[:, ::-1] == ord("/")
    slash = np.where(backwards.any(1), length - 1 - backwards.argmax(1), -1)
    different = names[1:] != names[:-1]
    first = np.where(different.any(1), different.argmax(1), length)
    begins = np.append(True, (first <= slash[1:]) | (slash[1:] != slash[:-1]))
    for row in np.flatnonzero(begins):
        yield int(row), names[row, : max(slash[row], 0)].tobytes()


def file_names(path: Path, ranges: list[tuple[int, int]]) -> list[str]:
    """Base names of the files whose entries lie in these ranges, in the directory's order."""
    with open(path, "rb") as file:
        return [name.rpartition("/")[2] for name, _, _ in _entries(file, path, ranges)]


def read_files(path: Path, ranges: list[tuple[int, int]], shift: int) -> Iterator[tuple[str, bytes]]:
    """(base name, content) of the files whose entries lie in these ranges, in the directory's order.

    DataError when an entry or its data are damaged, encrypted, or packed by a method other than stored or deflated.
    """
    with open(path, "rb") as file:
        for name, fields, extra in _entries(file, path, ranges):
            yield name.rpartition("/")[2], _content(file, f"{path}/{name}", fields, extra, shift)


def _entries(file: BinaryIO, path: Path, ranges: list[tuple[int, int]]) -> Iterator[tuple[str, tuple, bytes]]:
    """Name, fields of the entry, extra field; without the entries of folders."""
    for start, stop in ranges:
        file.seek(start)
        entries = file.read(stop - start)
        position = 0
        while position + _ENTRY.size <= len(entries):
            fields = _ENTRY.unpack_from(entries, position)
            if fields[0] != b"PK\x01\x02":
                raise DataError(f"{path}: changed while it was being read; start again when it is whole")
            name_length, extra_length, comment_length = fields[10:13]
            begin = position + _ENTRY.size
            end = begin + name_length
            name = entries[begin:end].decode("utf-8", "replace")
            if not name.endswith("/"):
                yield name, fields, entries[end : end + extra_length]
            position = end + extra_length + comment_length


def _content(file: BinaryIO, where: str, fields: tuple, extra: bytes, shift: int) -> bytes:
    flags, method, crc, packed, size, offset = *fields[3:5], *fields[7:10], fields[-1]
    size, packed, offset = _large(extra, size, packed, offset)
    if flags & 1:
        raise DataError(f"{where}: encrypted; unpack the archive with its password first")
    if method not in (0, 8):
        raise DataError(
            f"{where}: packed by ZIP method {method}; expected stored or deflated: unpack the archive first"
        )
    if max(size, packed) > _MOST_BYTES:
        raise DataError(f"{where}: takes {max(size, packed)} bytes; expected less than {_MOST_BYTES}")
    file.seek(offset + shift)
    header = file.read(_LOCAL.size)
    if len(header) < _LOCAL.size or not header.startswith(b"PK\x03\x04"):
        raise DataError(f"{where}: its data are not where the ZIP's directory says; the archive is damaged")
    file.seek(sum(struct.unpack_from("<2H", header, 26)), 1)
    data = file.read(packed)
    if method == 8:
        data = _inflate(data, size, where)
    if len(data) != size or zlib.crc32(data) != crc:
        raise DataError(f"{where}: damaged inside the ZIP (wrong checksum); copy the archive again")
    return data


def _large(extra: bytes, size: int, packed: int, offset: int) -> tuple[int, int, int]:
    """The ZIP64 values, in the extra field 1, of those that didn't fit 32 bits."""
    values, position = [size, packed, offset], 0
    while position + 4 <= len(extra):
        kind, length = struct.unpack_from("<2H", extra, position)
        if kind == 1:
            large = iter(struct.unpack_from(f"<{min(length, len(extra) - position - 4) // 8}Q", extra, position + 4))
            values = [next(large, v) if v == 0xFFFFFFFF else v for v in values]
        position += 4 + length
    return values[0], values[1], values[2]


def _inflate(data: bytes, size: int, where: str) -> bytes:
    unpack = zlib.decompressobj(-15)
    try:
        return unpack.decompress(data, size + 1)  # never more than it says, whatever the data are
    except zlib.error as error:
        raise DataError(f"{where}: damaged inside the ZIP ({error}); copy the archive again") from None
