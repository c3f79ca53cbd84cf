"""Reads what a TIFF tells about its numbers, of which OpenCV, which decodes it, changes some unasked or leaves some out."""

from __future__ import annotations

import struct
from pathlib import Path

from dpcli.errors import DataError

_KINDS = {1: "B", 3: "H", 4: "I", 16: "Q"}  # of whole numbers, by how TIFF calls them
_MOST = 8  # numbers of a tag that are read; there are as many bits as channels
BITS, COMPRESSION, PHOTOMETRIC, ORIENTATION, CHANNELS, PLANES, PREDICTOR, EXTRA = 258, 259, 262, 274, 277, 284, 317, 338
_NONE, _LZW, _JPEG, _DEFLATE, _PACKBITS = 1, 5, 7, (8, 32946), 32773
_DIFFERENCES = (_LZW, *_DEFLATE)  # the packings for which TIFF defines a predictor
_GRAY = (0, 1)  # white is 0, black is 0
UNREAD = (
    "a TIFF that is damaged, or whose compression or type of number isn't read; save it uncompressed or with LZW"
    " or deflate, in whole numbers of 16 or 32 bits or float32"
)


def read_tags(data: bytes) -> dict[int, tuple[int, ...]]:
    """Returns the whole numbers that the first page of a TIFF tells about itself, by tag; none of other files.

    Only the first few numbers of each tag are read.
    """
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None or len(data) < 16:
        return {}
    version = struct.unpack_from(order + "H", data, 2)[0]
    if version not in (42, 43):  # the latter of more than 4 GB
        return {}
    big = version == 43
    count_of, entry_of, offset_of = (f"{order}{one}" for one in (("Q", "HHQ", "Q") if big else ("H", "HHI", "I")))
    inline = 8 if big else 4
    start = struct.unpack_from(offset_of, data, 8 if big else 4)[0]
    found: dict[int, tuple[int, ...]] = {}
    try:
        position = start + struct.calcsize(count_of)
        for _ in range(struct.unpack_from(count_of, data, start)[0]):
            tag, kind, count = struct.unpack_from(entry_of, data, position)
            value = position + struct.calcsize(entry_of)
            position = value + inline
            if kind in _KINDS:
                form = f"{order}{min(count, _MOST)}{_KINDS[kind]}"
                apart = count * struct.calcsize(order + _KINDS[kind]) > inline
                found[tag] = struct.unpack_from(
                    form, data, struct.unpack_from(offset_of, data, value)[0] if apart else value
                )
    except struct.error:  # cut short
        pass
    return {tag: numbers for tag, numbers in found.items() if numbers}


def require_unchanged(data: bytes, path: Path) -> int:
    """Returns by how many bits OpenCV shifts the numbers of a TIFF up, 0 of other files.

    Raises DataError where it would change them otherwise, or leave channels out.
    """
    tags = read_tags(data)
    if not tags:
        return 0
    bits, packing = tags.get(BITS, (1,)), tags.get(COMPRESSION, (_NONE,))[0]
    channels, planes = tags.get(CHANNELS, (1,))[0], tags.get(PLANES, (1,))[0]
    read = packing in (_NONE, _PACKBITS, *_DIFFERENCES) or (packing == _JPEG and bits[0] == 8)
    if not read or (tags.get(PREDICTOR, (1,))[0] != 1 and packing not in _DIFFERENCES):
        raise DataError(f"{path}: {UNREAD}")
    if bits[0] < 8:
        raise DataError(f"{path}: {bits[0]} bits a pixel, too few for depth; expected 8 or more")
    with_alpha = channels == 2 and planes == 1 and bits[0] == 8 and tags.get(EXTRA, (0,))[0] > 0
    if channels > 1 and not with_alpha and tags.get(PHOTOMETRIC, (1,))[0] in _GRAY:
        raise DataError(f"{path}: holds {channels} channels of gray; expected one of depth: save it without the others")
    return 16 - bits[0] if 8 < bits[0] < 16 else 0
