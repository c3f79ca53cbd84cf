"""Animated PNGs of every kind of pixels, written chunk by chunk, against what the specification of APNG lays over one another."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.prepare.decode.color_frames import open_frames

RED, CLEAR = [204, 0, 0, 255], [0, 0, 0, 0]
_BY_KIND = {  # color type, bits, chunks before the pictures, and how red and clear pixels are stored
    "gray": (0, 8, {b"tRNS": b"\0\x09"}, [204], [9]),
    "gray of 16 bits": (0, 16, {b"tRNS": b"\x09\0"}, [204 * 257], [0x900]),
    "colors": (2, 8, {}, [204, 0, 0], None),
    "colors of 16 bits": (2, 16, {}, [204 * 257, 0, 0], None),
    "colors of 16 bits, one of them clear": (2, 16, {b"tRNS": b"\x09" + bytes(5)}, [204 * 257, 0, 0], [0x900, 0, 0]),
    "palette": (3, 8, {b"PLTE": bytes([1, 2, 3, 204, 0, 0]), b"tRNS": b"\0"}, [1], [0]),
    "gray and alpha": (4, 8, {}, [204, 255], [7, 0]),
    "gray and alpha of 16 bits": (4, 16, {}, [204 * 257, 65535], [7, 0]),
    "colors and alpha of 16 bits": (6, 16, {}, [204 * 257, 0, 0, 65535], [7, 7, 7, 0]),
}


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def apng(kind: str, pictures: list[tuple[tuple[int, int], np.ndarray, int, int]], own_still: bool) -> bytes:
    """A PNG 6 x 4 of pictures: left and top, bool (H,W) where red, what becomes of it, whether it lies over what is below."""
    color_type, bits, before, red, clear = _BY_KIND[kind]

    def rows(where: np.ndarray) -> bytes:
        values = np.where(where[..., None], red, clear or red).astype(">u2" if bits == 16 else "u1")
        return zlib.compress(b"".join(b"\0" + row.tobytes() for row in values))

    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">2I5B", 6, 4, bits, color_type, 0, 0, 0))
    data += chunk(b"acTL", struct.pack(">2I", len(pictures), 0)) + b"".join(chunk(*one) for one in before.items())
    data += chunk(b"IDAT", rows(np.ones((4, 6), bool))) if own_still else b""
    number = 0
    for place, ((left, top), where, after, over) in enumerate(pictures):
        head = struct.pack(">5I2H2B", number, *where.shape[::-1], left, top, 1 + place, 0, after, over)
        first = not place and not own_still
        body = rows(where) if first else struct.pack(">I", number + 1) + rows(where)
        data += chunk(b"fcTL", head) + chunk(b"IDAT" if first else b"fdAT", body)
        number += 1 if first else 2
    return data + chunk(b"IEND", b"")


@pytest.mark.parametrize("kind", _BY_KIND)
@pytest.mark.parametrize("own_still", [False, True])
def test_pictures_of_every_kind_of_pixels_are_laid_as_browsers_do(tmp_path, kind, own_still):
    """Browsers clear what a picture covered, whether or not its pixels have alpha; FFmpeg leaves black, or refuses."""
    whole, part = np.ones((4, 6), bool), np.array([[True, False], [True, True]])
    laid = [((0, 0), whole, 0, 0), ((1, 1), part, 1, 1), ((4, 0), part, 2, 0), ((0, 0), part, 0, 1)]
    (tmp_path / "a.png").write_bytes(apng(kind, laid, own_still))
    frames = open_frames(tmp_path / "a.png")
    read = list(frames.read(range(4)))
    sees_through, hole = _BY_KIND[kind][4] is not None, whole.copy()
    hole[1:3, 1:3] = False
    third, fourth = hole.copy(), hole.copy()
    third[0, 5], fourth[0:2, 0:2] = not sees_through, hole[0:2, 0:2] | part
    fourth[1, 1] |= not sees_through
    for found, opaque in zip(read, (whole, whole, third, fourth), strict=True):
        np.testing.assert_array_equal(found[..., 3], 255 * opaque)
        assert (found[opaque][:, 0] == 204).all()
    np.testing.assert_allclose(
        frames.times, np.cumsum([0, 0.1, 0.02, 0.03])
    )  # a hundredth alone is a tenth to browsers


def test_what_is_cut_off_or_lies_outside_is_refused(tmp_path):
    laid = [((0, 0), np.ones((4, 6), bool), 0, 0), ((5, 0), np.ones((2, 2), bool), 0, 0)]
    (tmp_path / "a.png").write_bytes(data := apng("colors", laid, False))
    with pytest.raises(DataError, match="a picture reaches beyond its canvas of 6 x 4"):
        open_frames(tmp_path / "a.png")
    (tmp_path / "b.png").write_bytes(data[:-30])
    with pytest.raises(DataError, match="holds 1 whole pictures of 2; it is cut off"):
        open_frames(tmp_path / "b.png")
