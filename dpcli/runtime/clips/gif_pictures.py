"""Pictures of a GIF laid over one another as browsers do: what no picture covers can be seen through.

Pillow fills such places with a background color that the file names, which no browser shows.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dpcli.errors import DataError

_PACKED = 4096  # pixels that a byte of GIF's LZW can't exceed: a code of 12 bits stands for fewer
_SMALL = 1 << 20  # pixels of a canvas that may be mostly empty
_EXTENSION, _CONTROL, _PICTURE, _END = 0x21, 0xF9, 0x2C, 0x3B
_CLEARED, _AS_BEFORE = 2, 3  # what becomes of a picture once its time is over


def check_canvas(path: Path, pixels: int, size: int) -> None:
    """Raises DataError for a canvas that `size` bytes of a GIF can't fill: each frame is laid out at that size."""
    if pixels > _PACKED * size + _SMALL:
        raise DataError(
            f"{path}: its canvas claims {pixels} pixels, a file of {size} bytes can't hold them; export it again"
        )


def gif_canvases(path: Path, width: int, height: int) -> Iterator[np.ndarray]:
    """Yields what a viewer shows u8 (H,W,4) while each picture of a GIF lasts, not to be changed."""
    from PIL import Image

    canvas = np.zeros((height, width, 4), np.uint8)
    for left, top, after, alone in _pictures(data := path.read_bytes()):
        check_canvas(path, int.from_bytes(alone[6:8], "little") * int.from_bytes(alone[8:10], "little"), len(data))
        with Image.open(io.BytesIO(alone)) as image:
            picture = np.asarray(image.convert("RGBA"))
        shown = canvas.copy()
        place = shown[top : top + picture.shape[0], left : left + picture.shape[1]]
        picture = picture[: place.shape[0], : place.shape[1]]
        place[:] = np.where(picture[..., 3:] > 0, picture, place)
        yield shown
        if after != _AS_BEFORE:
            canvas = shown.copy()
        if after == _CLEARED:
            canvas[top : top + picture.shape[0], left : left + picture.shape[1]] = 0


def _pictures(data: bytes) -> Iterator[tuple[int, int, int, bytes]]:
    """Yields left and top of each picture, what becomes of it afterwards, and a GIF that holds it alone."""
    at, control = 13 + _palette(data[10]), b""
    palette = data[10:at]
    while at < len(data) and data[at] != _END:
        start = at
        if data[at] == _EXTENSION:
            at = _behind_blocks(data, at + 2)
            control = data[start:at] if data[start + 1] == _CONTROL else control
        elif data[at] == _PICTURE:
            left, top, width, height, flags = struct.unpack_from("<4HB", data, at + 1)
            at = _behind_blocks(data, at + 11 + _palette(flags))
            size, body = struct.pack("<2H", width, height), data[start + 9 : at]
            alone = b"".join((b"GIF89a", size, palette, control, b",\0\0\0\0", size, body, b";"))
            yield left, top, control[3] >> 2 & 7 if control else 0, alone
            control = b""
        else:
            at += 1  # readers pass over bytes between blocks


def _palette(flags: int) -> int:
    """Returns the bytes of the color table that flags tell of."""
    return 6 << (flags & 7) if flags & 0x80 else 0


def _behind_blocks(data: bytes, at: int) -> int:
    """Returns the place behind the blocks of data that begin at `at`, each after a byte of its length, up to an empty one."""
    while at < len(data) and data[at]:
        at += 1 + data[at]
    return at + 1
