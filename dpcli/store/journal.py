"""What a writer has been given so far, in a file that survives a kill at any moment.

HDF5 can't be read again when its writer is killed in the middle. So each sample goes, before it counts as written, to
the end of a plain file as well: length, checksum, content. After a kill whatever is not whole at its end is cut off
and the samples before it are written again, in order, into a fresh HDF5 file: the bytes are those of one whole run.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import struct
import time
import zlib
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DpcError
from dpcli.store.sequence import CloudSequence

_MAGIC = b"dpc journal 1\n"
_LENGTHS, _CHECK = struct.Struct("<QI"), struct.Struct("<I")  # bytes of content, of its JSON; CRC-32 of these and it
_SYNC_SECONDS = 10.0  # a kill loses nothing that was written; only a power cut could, and then this much
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS)


class Journal:
    """The samples given to one writer, in the file `path`, which this process alone may hold.

    `samples()` first, to read what an earlier run left and come to its end; then `append`. `about` describes the
    writer: what another one left is not continued. `begin_again` drops what was there. DpcError when another process
    holds the file. Layout: a magic line, then records of length, checksum, JSON and arrays; the first is `about`.
    """

    def __init__(self, path: Path, about: dict[str, Any]) -> None:
        self.path = path
        self.about = json.loads(json.dumps(about, sort_keys=True))
        self._file = _open_alone(path)
        self.was_there = os.fstat(self._file).st_size > 0
        self._synced = time.monotonic()

    def samples(self) -> Iterator[list[Any]]:
        """What was appended before, in order; afterwards the file ends where the last whole record ends."""
        size = os.fstat(self._file).st_size
        os.lseek(self._file, 0, os.SEEK_SET)
        first = _read_record(self._file, size) if os.read(self._file, len(_MAGIC)) == _MAGIC else None
        if first is None or first != [self.about]:
            self.begin_again()
            return
        end = os.lseek(self._file, 0, os.SEEK_CUR)
        while (record := _read_record(self._file, size)) is not None:
            end = os.lseek(self._file, 0, os.SEEK_CUR)
            yield record
        os.ftruncate(self._file, end)
        os.lseek(self._file, end, os.SEEK_SET)

    def begin_again(self) -> None:
        """Empty, but for what describes the writer."""
        os.ftruncate(self._file, 0)
        os.lseek(self._file, 0, os.SEEK_SET)
        _write_all(self._file, _MAGIC)
        self.append([self.about])

    def append(self, values: list[Any]) -> None:
        """One sample: what its writer was given (sequences, arrays, lists of arrays, plain values). OSError: full disk."""
        arrays: list[np.ndarray] = []
        text = json.dumps([_packed(value, arrays) for value in values]).encode()
        parts = [text, *(memoryview(array).cast("B") for array in arrays if array.size)]
        lengths = _LENGTHS.pack(sum(len(part) for part in parts), len(text))
        check = zlib.crc32(lengths)
        for part in parts:
            check = zlib.crc32(part, check)
        for part in (lengths + _CHECK.pack(check), *parts):
            _write_all(self._file, part)
        if time.monotonic() - self._synced > _SYNC_SECONDS:
            os.fdatasync(self._file)
            self._synced = time.monotonic()

    def keep(self) -> None:
        """Close, for a later run."""
        if self._file >= 0:
            os.fdatasync(self._file)
            os.close(self._file)
            self._file = -1

    def discard(self) -> None:
        """Remove, as its work is done or has failed."""
        if self._file >= 0:
            self.path.unlink(missing_ok=True)
            os.close(self._file)
            self._file = -1


def _open_alone(path: Path) -> int:
    """Open and lock; again if another process finished and removed the file in between."""
    while True:
        number = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EACCES):
                os.close(number)
                raise DpcError(f"{path}: cannot write (another dpc is writing it)") from None
            if error.errno not in _NO_LOCKS:
                os.close(number)
                raise
        if path.exists() and os.path.samestat(os.fstat(number), os.stat(path)):
            return number
        os.close(number)


def _write_all(number: int, data: bytes | memoryview) -> None:
    rest = memoryview(data)
    while len(rest):
        rest = rest[os.write(number, rest) :]


def _read_record(number: int, size: int) -> list[Any] | None:
    """The next record; None at the end, and where what follows is cut short or is not what was written."""
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
    return [_unpacked(value, arrays, taken) for value in json.loads(bytes(view[:text_length]))]


def _packed(value: Any, arrays: list[np.ndarray]) -> Any:
    """`value` for JSON; the arrays in it go to `arrays` and leave their type and shape."""
    if isinstance(value, CloudSequence):
        return {"sequence": {f.name: _packed(getattr(value, f.name), arrays) for f in fields(value)}}
    if isinstance(value, np.ndarray):
        arrays.append(np.ascontiguousarray(value))
        return {"array": [value.dtype.str, list(value.shape)]}
    if isinstance(value, (list, tuple)):
        return {"list": [_packed(one, arrays) for one in value]}
    if isinstance(value, np.generic):
        return value.item()
    return value


def _unpacked(value: Any, data: memoryview, taken: list[int]) -> Any:
    if not isinstance(value, dict):
        return value
    if "array" in value:
        (dtype, shape), start = value["array"], taken[0]
        count = int(np.prod(shape, dtype=np.int64))
        taken[0] += count * np.dtype(dtype).itemsize
        return np.frombuffer(data[start : taken[0]], dtype).reshape(shape)
    if "list" in value:
        return [_unpacked(one, data, taken) for one in value["list"]]
    if "sequence" in value:
        return CloudSequence(**{key: _unpacked(one, data, taken) for key, one in value["sequence"].items()})
    return value


def sweep(target: Path) -> None:
    """Remove what a run killed just after it renamed its file to `target` left beside it; not what another one holds."""
    path = target.with_name(f".{target.name}.part")
    if path.exists():
        try:
            number = _open_alone(path)
        except (DpcError, OSError):
            return
        path.unlink(missing_ok=True)
        target.with_name(f".{target.name}.new").unlink(missing_ok=True)
        os.close(number)
