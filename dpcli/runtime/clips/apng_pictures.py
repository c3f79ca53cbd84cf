"""Pictures of an animated PNG laid over one another as browsers do, whatever kind of pixels they have.

FFmpeg lays some kinds only where they are opaque, and leaves black where a picture without alpha is taken away; Pillow lays one
over another as if what is below were opaque.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.runtime.clips.images import as_rgba

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
# number, width, height, left, top, delay as a fraction of seconds, afterwards, over
_CONTROL = struct.Struct(">5I2H2B")
_CLEARED, _AS_BEFORE = 1, 2  # what becomes of a picture once its time is over
_TENTHS = 100  # of a second, in a delay without a denominator


@dataclass
class _Picture:
    """Holds one picture: where it lies, what becomes of it, whether it covers what is below, and its packed rows."""

    width: int
    height: int
    left: int
    top: int
    seconds: float
    after: int
    over: bool
    rows: bytearray = field(default_factory=bytearray)


def is_animated_png(data: bytes) -> bool:
    """Returns whether the bytes of a PNG tell of pictures that follow one another."""
    return _count(data) > 0


def apng_seconds(path: Path) -> list[float]:
    """Returns how long each picture of an animated PNG lasts. Raises DataError where there are fewer than its header counts."""
    return [picture.seconds for picture in _pictures(path, path.read_bytes())]


def apng_canvases(path: Path, width: int, height: int) -> Iterator[np.ndarray]:
    """Yields what a viewer shows u8 (H,W,4) while each picture of an animated PNG lasts, not to be changed."""
    from PIL import Image

    data = path.read_bytes()
    before = [(name, body) for name, body in _until(data, b"IDAT") if name not in (b"acTL", b"fcTL")]
    canvas = Image.new("RGBA", (width, height))
    for picture in _pictures(path, data):
        box = (picture.left, picture.top, picture.left + picture.width, picture.top + picture.height)
        if box[2] > width or box[3] > height:
            raise DataError(f"{path}: a picture reaches beyond its canvas of {width} x {height}; export it again")
        with Image.open(io.BytesIO(_alone(before, picture))) as image:
            own = as_rgba(image)
        shown = canvas.copy()
        shown.paste(Image.alpha_composite(canvas.crop(box), own) if picture.over else own, box)
        yield np.asarray(shown)
        if picture.after != _AS_BEFORE:
            canvas = shown
        if picture.after == _CLEARED:
            canvas.paste((0, 0, 0, 0), box)


def _pictures(path: Path, data: bytes) -> Iterator[_Picture]:
    """Yields as many pictures as the header counts. The image that only viewers show which play nothing is none of them."""
    picture, yielded, count = None, 0, _count(data)
    for name, body in (*_chunks(data), (b"IEND", b"")):
        if name in (b"fcTL", b"IEND"):
            if picture is not None and picture.rows and yielded < count:
                yielded += 1
                yield picture
            picture = _controlled(body) if name == b"fcTL" else None
        elif picture is not None and name in (b"IDAT", b"fdAT"):
            picture.rows += body if name == b"IDAT" else body[4:]
    if yielded < count:
        raise DataError(f"{path}: holds {yielded} whole pictures of {count}; it is cut off: copy or export it again")


def _controlled(body: bytes) -> _Picture:
    _, width, height, left, top, delay, per_second, after, over = _CONTROL.unpack_from(body)
    return _Picture(width, height, left, top, delay / (per_second or _TENTHS), after, over == 1)


def _alone(before: list[tuple[bytes, bytes]], picture: _Picture) -> bytes:
    """Returns a PNG of one picture, with what the file says before all of them, such as its palette."""
    head = struct.pack(">2I", picture.width, picture.height) + before[0][1][8:]
    chunks = [(b"IHDR", head), *before[1:], (b"IDAT", bytes(picture.rows)), (b"IEND", b"")]
    return _SIGNATURE + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body)) for name, body in chunks
    )


def _count(data: bytes) -> int:
    """Returns how many pictures the header of an animated PNG counts; 0 for other files."""
    found = next((body for name, body in _until(data, b"IDAT") if name == b"acTL"), b"")
    return int.from_bytes(found[:4], "big")


def _until(data: bytes, last: bytes) -> Iterator[tuple[bytes, bytes]]:
    for name, body in _chunks(data):
        if name == last:
            return
        yield name, body


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yields name and content of the whole chunks of a PNG."""
    at = len(_SIGNATURE) if data.startswith(_SIGNATURE) else len(data)
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        if at + 12 + length > len(data):
            return
        yield data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        at += 12 + length
