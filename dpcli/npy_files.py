"""NumPy's array files of others, mapped rather than read, so that what their headers claim is checked against their length."""

from __future__ import annotations

import errno
import io
import zipfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import BinaryIO

import numpy as np

from dpcli.errors import DataError, reading

ROOM, PACKED_AT_MOST = 100 << 20, 50  # bytes that any file may unpack to; and times its size beyond them


def require_room(path: Path, claimed: int) -> None:
    """Raises DataError where packed arrays claim far more bytes than clouds and depth do, which pack a few times smaller."""
    held = path.stat().st_size
    if claimed > ROOM + PACKED_AT_MOST * held:
        raise DataError(f"{path}: claims {claimed} bytes of arrays; a file of {held} bytes can't hold such clouds")


@contextmanager
def open_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """Opens a ZIP, as a `.npz` is. Raises DataError where two members have one name, since only the last would be read;
    BadZipFile and what else zipfile raises of a damaged one pass.
    """
    with zipfile.ZipFile(path) as archive:
        require_distinct(path, archive.namelist())
        yield archive


def require_distinct(path: object, names: Sequence[str]) -> None:
    """Raises DataError where a ZIP has two members of one name."""
    if len(set(names)) < len(names):
        twice = next(name for name, count in Counter(names).items() if count > 1)
        raise DataError(
            f"{path}: two members of the archive are named {twice!r}; unpack it, keep one of them and pack it again"
        )


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Returns the arrays of a `.npz` by name; other files in the archive are passed over, and an array of objects, a pickle that
    may hold anything, stays without axes and values, so that it can be named.

    Raises DataError when the file is damaged, or an array has other bytes than its header says.
    """
    with reading(path), open_archive(path) as archive:
        require_room(path, sum(info.file_size for info in archive.infolist()))
        members = [info for info in archive.infolist() if info.filename.endswith(".npy")]
        arrays = {}
        for one in members:
            data = archive.read(one)
            is_pickle = read_header(io.BytesIO(data))[2].hasobject
            arrays[one.filename[: -len(".npy")]] = np.empty((), object) if is_pickle else read_member(path, data)
        return arrays


def read_header(stream: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Returns the shape of an array, whether it is in Fortran's order, and its type, from the head of a `.npy`.

    The stream stands behind the head then. A damaged one raises nearly anything.
    """
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    return read(stream)


def read_member(path: Path, data: bytes) -> np.ndarray:
    """Returns the array that the bytes of a `.npy` describe. Raises DataError where its header claims another size."""
    stream = io.BytesIO(data)
    shape, _, dtype = read_header(stream)
    claimed, held = prod(shape) * dtype.itemsize, len(data) - stream.tell()
    if not dtype.hasobject and (claimed != held or min(shape, default=0) < 0):
        raise DataError(
            f"{path}: an array claims shape {str(shape)[:60]} of {dtype.itemsize} bytes each and has {held} bytes; damaged"
        )
    return np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)


def map_npy(path: Path) -> np.ndarray:
    """Returns the array in a `.npy`, mapped read-only.

    Raises DataError when it is damaged, needs a pickle, or has bytes behind the array: several arrays may lie in one file, of
    which only the first would be read. FileNotFoundError passes.
    """
    try:
        try:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        except OSError as error:
            if error.errno != errno.ENODEV:
                raise
            # some network file systems share no maps; of a private one what is written stays in memory
            array = np.load(path, mmap_mode="c", allow_pickle=False)
    except FileNotFoundError:
        raise
    except Exception as error:  # ValueError, EOFError, tokenize.TokenError, SyntaxError... of damaged headers
        said = (
            "it needs a pickle, which isn't loaded" if "pickle" in str(error) else (str(error).splitlines() or [""])[0]
        )
        raise DataError(
            f"{path}: not a readable .npy array, perhaps truncated ({said or type(error).__name__})"
        ) from None
    if not isinstance(array, np.memmap):
        raise DataError(f"{path}: not a readable .npy array (an archive)")
    behind = path.stat().st_size - array.offset - array.nbytes
    if behind:
        raise DataError(
            f"{path}: {behind} bytes follow the array of shape {array.shape} that its header declares: several arrays in one"
            " file, or damaged; save each array as its own file"
        )
    return array
