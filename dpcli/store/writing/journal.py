"""The record of what a writer has been given so far, in a file that survives a kill at any moment.

HDF5 can't be read again when its writer is killed in the middle. So each sample, before it counts as written, leaves a
record at the end of a plain file: length, checksum, content. Bytes that are in the unfinished HDF5 file at a known
place are not written twice: the record says where, and has a checksum of them. After a kill whatever is not whole is
cut off and the samples before it are written again, in order, into a fresh HDF5 file: the bytes are those of one whole
run. Meanwhile the old journal and the old HDF5 file stay, in case that is killed, too.
"""

from __future__ import annotations

import json
import os
import struct
import time
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DpcError
from dpcli.file_lock import open_alone
from dpcli.store.sequence import CloudSequence

Placed = tuple[np.ndarray, list[tuple[int, int]]]  # an array, (offset in the HDF5 file, bytes) of its first bytes

_MAGIC = b"dpc journal 3\n"  # another number is not read: that work starts over
_LENGTHS, _CHECK = struct.Struct("<QI"), struct.Struct("<I")  # bytes of content, of its JSON; CRC-32 of these and it
_PAGE = 4096
_SYNC_SECONDS = 10.0  # a kill loses nothing that was written; only a power cut could, and then this much
_DATA_SUFFIXES = (".new", ".alt")  # of one length, as it is said in the journal


class Journal:
    """Keeps the samples given to one writer, in the file `path`, which this process alone may hold.

    `about` describes the writer: what another one left is not continued. `data_name` is the HDF5 file beside it that
    what an earlier run left points into, "" when there is nothing of this very work; `other` is the `about` of samples
    of other work, None when there are none. To continue: `samples()`, given to a writer with a journal of its own, which
    then takes the place of this one (`replace`). Else `begin` empties it.
    Raises DpcError when another process holds the file. Layout: a magic line, then records of length, checksum, JSON and
    arrays; the first is `about` and `data_name`.
    """

    def __init__(self, path: Path, about: dict[str, Any]) -> None:
        self.path = path
        self.about = json.loads(json.dumps(about, sort_keys=True))
        self._file, self._data = open_alone(path), -1
        self.was_there = os.fstat(self._file).st_size > 0
        self._synced = time.monotonic()
        self.other: dict[str, Any] | None = None
        self.data_name = self._read_head()

    def _read_head(self) -> str:
        first, size = None, os.fstat(self._file).st_size
        if os.read(self._file, len(_MAGIC)) == _MAGIC:
            first = _read_record(self._file, size, -1)
        if not first or len(first) != 2:
            return ""
        if first[0] == self.about:
            return str(first[1])
        if os.lseek(self._file, 0, os.SEEK_CUR) < size and isinstance(first[0], dict):
            self.other = first[0]
        return ""

    def samples(self) -> Iterator[list[Any]]:
        """Yields what was appended before, in order, up to what is not whole or not as it was written; once."""
        if not self.data_name:
            return
        size = os.fstat(self._file).st_size
        try:
            data = os.open(self.path.with_name(self.data_name), os.O_RDONLY | os.O_CLOEXEC)
        except FileNotFoundError:
            data = -1
        try:
            while (record := _read_record(self._file, size, data)) is not None:
                yield record
        finally:
            if data >= 0:
                os.close(data)

    def begin(self, data: Path, number: int) -> None:
        """Empties the file, but for what describes the writer. data: its HDF5 file, `number` its open handle."""
        os.ftruncate(self._file, 0)
        os.lseek(self._file, 0, os.SEEK_SET)
        self.data_name, self._data = data.name, os.dup(number)  # to sync it even after HDF5 has closed it
        _write_all(self._file, _MAGIC)
        self.append([self.about, self.data_name])

    def append(self, values: list[Any], placed: Placed | None = None) -> None:
        """Appends one sample: what its writer was given (sequences, arrays, lists of arrays, plain values). OSError: full disk.

        placed: one of the arrays, whose first bytes are in the HDF5 file already, and where.
        """
        arrays: list[np.ndarray] = []
        text = json.dumps([_packed(value, arrays, placed) for value in values]).encode()
        parts = [text, *(memoryview(array).cast("B") for array in arrays if array.size)]
        lengths = _LENGTHS.pack(sum(len(part) for part in parts), len(text))
        check = zlib.crc32(lengths)
        for part in parts:
            check = zlib.crc32(part, check)
        for part in (lengths + _CHECK.pack(check), *parts):
            _write_all(self._file, part)
        if time.monotonic() - self._synced > _SYNC_SECONDS:
            self._sync()

    def _sync(self) -> None:
        for number in (self._data, self._file):
            if number >= 0:
                os.fdatasync(number)
        self._synced = time.monotonic()

    def replace(self, old: Journal) -> None:
        """Takes the place of `old`, all of whose samples are here; the HDF5 file it points into goes."""
        self._sync()
        os.replace(self.path, old.path)
        self.path = old.path
        self.path.with_name(old.data_name).unlink(missing_ok=True)
        old.close()

    def keep(self) -> None:
        """Closes the file, for a later run; the HDF5 file must stay, too."""
        if self._file >= 0:
            with suppress(OSError):  # a full disk: what didn't reach it fails its checksum
                self._sync()
            self.close()

    def close(self) -> None:
        """Lets go of the file."""
        for number in (self._file, self._data):
            if number >= 0:
                os.close(number)
        self._file = self._data = -1

    def discard(self) -> None:
        """Removes the file, as its work is done or has failed, with what else killed runs left."""
        if self._file >= 0:
            self.remove_others("")
            self.path.unlink(missing_ok=True)
            self.close()

    def remove_others(self, used: str) -> None:
        """Removes what killed runs left beside it, except `used`."""
        for path in _beside(self.path):
            if path.name != used:
                path.unlink(missing_ok=True)


def journal_path(target: Path) -> Path:
    """Returns the path of the journal of the writer of `target`."""
    return target.with_name(f".{target.name}.part")


def data_suffix(left: str) -> str:
    """Returns the suffix of a new unfinished HDF5 file, beside one that an earlier run `left` and that is still needed."""
    return _DATA_SUFFIXES[left.endswith(_DATA_SUFFIXES[0])]


def second_path(path: Path) -> Path:
    """Returns the path of the journal that is to take the place of the one at `path`."""
    return path.with_name(f"{path.name}.new")


def _beside(path: Path) -> list[Path]:
    """Lists what the writer with the journal `path` may have left."""
    return [second_path(path), *(path.with_suffix(suffix) for suffix in _DATA_SUFFIXES)]


def _write_all(number: int, data: bytes | memoryview) -> None:
    rest = memoryview(data)
    while len(rest):
        rest = rest[os.write(number, rest) :]


def _read_record(number: int, size: int, data: int) -> list[Any] | None:
    """Reads the next record; None at the end, and where what follows is cut short or is not what was written."""
    head = os.read(number, _LENGTHS.size + _CHECK.size)
    if len(head) < _LENGTHS.size + _CHECK.size:
        return None
    length, text_length = _LENGTHS.unpack_from(head)
    (check,) = _CHECK.unpack_from(head, _LENGTHS.size)
    if text_length > length or length > size - os.lseek(number, 0, os.SEEK_CUR):
        return None
    content = bytearray(length)
    view, filled = memoryview(content), 0
    while filled < length:
        got = os.readv(number, [view[filled:]])
        if not got:
            return None
        filled += got
    if zlib.crc32(content, zlib.crc32(head[: _LENGTHS.size])) != check:
        return None
    arrays = view[text_length:]
    taken = [0]
    try:
        return [_unpacked(value, arrays, taken, data) for value in json.loads(bytes(view[:text_length]))]
    except _Changed:
        return None


class _Changed(Exception):
    """A record points to bytes that are not there, or not as they were."""


def _checksum(array: np.ndarray) -> int:
    """Returns a checksum of a contiguous array: the sum of each page in 64-bit words, and the CRC-32 of these and of what is left.

    Several times as fast as a CRC-32 of all, and finds what is looked for: blocks that a power cut kept from the disk.
    """
    data = array.reshape(-1).view(np.uint8)
    whole = data.size - data.size % _PAGE
    sums = data[:whole].view(np.uint64).reshape(-1, _PAGE // 8).sum(axis=1)
    return zlib.crc32(data[whole:], zlib.crc32(sums))


def _packed(value: Any, arrays: list[np.ndarray], placed: Placed | None = None) -> Any:
    """Returns `value` for JSON; the arrays in it go to `arrays` and leave their type and shape."""
    if isinstance(value, CloudSequence):
        return {"sequence": {f.name: _packed(getattr(value, f.name), arrays, placed) for f in fields(value)}}
    if isinstance(value, np.ndarray):
        packed: dict[str, Any] = {"array": [value.dtype.str, list(value.shape)]}
        rest = np.ascontiguousarray(value)
        if placed and value is placed[0] and placed[1]:
            data = rest.reshape(-1).view(np.uint8)
            there = sum(length for _, length in placed[1])
            packed |= {"at": placed[1], "check": _checksum(data[:there])}
            rest = data[there:]
        arrays.append(rest)
        return packed
    if isinstance(value, (list, tuple)):
        return {"list": [_packed(one, arrays, placed) for one in value]}
    if isinstance(value, dict):
        return {"dict": {key: _packed(one, arrays, placed) for key, one in value.items()}}
    if isinstance(value, np.generic):
        return value.item()
    return value


def _unpacked(value: Any, arrays: memoryview, taken: list[int], data: int) -> Any:
    if not isinstance(value, dict):
        return value
    if "array" in value:
        (dtype, shape), start = value["array"], taken[0]
        length = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        there = _read_pieces(value["at"], value["check"], data) if "at" in value else b""
        taken[0] += length - len(there)
        rest = arrays[start : taken[0]]
        return np.frombuffer(bytearray(there) + rest if len(there) else rest, dtype).reshape(shape)
    if "list" in value:
        return [_unpacked(one, arrays, taken, data) for one in value["list"]]
    if "dict" in value:
        return {key: _unpacked(one, arrays, taken, data) for key, one in value["dict"].items()}
    if "sequence" in value:
        return CloudSequence(**{key: _unpacked(one, arrays, taken, data) for key, one in value["sequence"].items()})
    return value


def _read_pieces(pieces: list[tuple[int, int]], check: int, data: int) -> bytes:
    """Reads the bytes of the file `data` at (offset, length), joined; _Changed when they are not what they were."""
    found = b"".join(os.pread(data, length, offset) for offset, length in pieces) if data >= 0 else b""
    if len(found) != sum(length for _, length in pieces) or _checksum(np.frombuffer(found, np.uint8)) != check:
        raise _Changed
    return found


def sweep(target: Path) -> None:
    """Removes what a run killed just after it renamed its file to `target` left beside it; not what another one holds."""
    path = journal_path(target)
    if path.exists():
        try:
            journal = Journal(path, {})
        except (DpcError, OSError):
            return
        journal.discard()
