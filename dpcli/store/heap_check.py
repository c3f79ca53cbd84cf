"""A check of HDF5's heaps of texts before libhdf5 reads them: at one damage it loops forever, where no signal reaches it."""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

from dpcli.errors import DataError
from dpcli.file_cache import cached_by_file, file_state

_MAGIC, _HEAP = b"\x89HDF\r\n\x1a\n", b"GCOL\x01\0\0\0"  # of version 1, the only one
_OBJECT = struct.Struct("<HHIQ")  # number, references, nothing, bytes; those follow, up to a multiple of 8
_HEAD, _STEP = 16, 8
_USER_BLOCKS = (0, 512, 1024, 2048)  # where HDF5 may begin; MATLAB's files have a block of text before
_LOOKED_AT = 1 << 26  # bytes at either end of a larger file: there are its attributes and its names

_made_here: set[tuple[int, int, int] | None] = set()


def check_heaps(path: Path) -> None:
    """Raises DataError where a heap's free space takes no bytes, which libhdf5 would pass over without an end, or a heap
    claims more than the file has.

    Also where lengths are not of 8 bytes each, as all of ours and nearly all others are, since heaps would lie otherwise.
    Files that are not HDF5 pass: opening them fails with a message. Files of more than 128 MiB are searched at both ends only. A
    file that did not change is searched once.
    """
    if file_state(path) not in _made_here:
        _check_once(path)


def trust_heaps(path: Path) -> None:
    """Notes that this process made the file as it is now: it is searched when another process, or a change, comes by."""
    _made_here.add(file_state(path))


@cached_by_file(256)
def _check_once(path: Path) -> None:
    with open(path, "rb") as file:
        start = file.read(_USER_BLOCKS[-1] + 16)
        heads = (start[at : at + 16] for at in _USER_BLOCKS)
        head = next((one for one in heads if one[:8] == _MAGIC and len(one) == 16), b"")
        if not head:
            return
        widths = head[13:15] if head[8] < 2 else head[9:11]
        if widths != b"\x08\x08":
            raise DataError(f"{path}: the HDF5 file is damaged (lengths of {widths[1]} bytes); make or copy it again")
        # private, as some network file systems share no maps
        with mmap.mmap(file.fileno(), 0, flags=mmap.MAP_PRIVATE, prot=mmap.PROT_READ) as data:
            large = len(data) > 2 * _LOOKED_AT
            for start, end in [(0, _LOOKED_AT), (len(data) - _LOOKED_AT, len(data))] if large else [(0, len(data))]:
                place = data.find(_HEAP, start, end)
                while place >= 0:
                    _check_heap(path, data, place)
                    place = data.find(_HEAP, place + 1, end)


def _check_heap(path: Path, data: mmap.mmap, place: int) -> None:
    """Goes from object to object as libhdf5 does; what leads out of the heap it finds by itself, but allocates a heap first."""
    end = place + int.from_bytes(data[place + 8 : place + 16], "little")
    if end > len(data):
        raise DataError(
            f"{path}: the HDF5 file is damaged (its heap of texts at byte {place} claims {end - place} bytes, a file of"
            f" {len(data)} bytes can't hold them); make or copy it again"
        )
    at = place + _HEAD
    while at + _OBJECT.size <= min(end, len(data)):
        number, _, _, size = _OBJECT.unpack_from(data, at)
        if number == 0 and size == 0:
            raise DataError(
                f"{path}: the HDF5 file is damaged (its heap of texts at byte {place}); make or copy it again"
            )
        at += size if number == 0 else _OBJECT.size + -(-size // _STEP) * _STEP
