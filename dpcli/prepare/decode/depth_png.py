"""Depth images as gray PNG bytes: whole, of the right size and depth, or an error that names them."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.decode.depth_files import load_cv2
from dpcli.prepare.decode.gray_png import decode_gray_png

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_COLOR = {0: "gray", 2: "RGB", 3: "palette", 4: "gray with alpha", 6: "RGB with alpha"}


def decode_depth_png(data: bytes, where: str, size: tuple[int, int], bits: tuple[int, ...] = (16,)) -> np.ndarray:
    """The bytes of a gray PNG -> depth u8 or u16 (H,W). size: (width, height) expected; bits: allowed per pixel.

    Everything is checked before libpng sees it, because it fills in what a damaged file lacks, or complains on
    stderr without a name. DataError says what was found at ``where``.
    """
    width, height, depth, color = _header(data, where)
    if (width, height) != size:
        raise DataError(f"{where}: {width}x{height} pixels; expected {size[0]}x{size[1]}")
    if color != 0 or depth not in bits:
        allowed = " or ".join(str(b) for b in bits)
        raise DataError(f"{where}: {depth}-bit {_COLOR.get(color, 'unknown')} PNG; expected {allowed}-bit gray depth")
    image = decode_gray_png(data)
    if image is None:
        _check_chunks(data, where)
        cv2 = load_cv2()
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.shape != (height, width):
        raise DataError(f"{where}: a damaged PNG; copy it again")
    return image


def _header(data: bytes, where: str) -> tuple[int, int, int, int]:
    """Width, height, bits and color type."""
    if not data:
        raise DataError(f"{where}: the file is empty; expected a PNG")
    if not data.startswith(_SIGNATURE) or data[12:16] != b"IHDR" or len(data) < 33:
        raise DataError(f"{where}: not a PNG (starts with {data[:8]!r})")
    return struct.unpack_from(">IIBB", data, 16)


def _check_chunks(data: bytes, where: str) -> None:
    """DataError unless every chunk is there with its right checksum, the last one being IEND."""
    position, view = 8, memoryview(data)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        end = position + 12 + length
        if end > len(data):
            break
        if zlib.crc32(view[position + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise DataError(f"{where}: a damaged PNG: wrong checksum at byte {position}; copy it again")
        if data[position + 4 : position + 8] == b"IEND":
            return
        position = end
    raise DataError(f"{where}: a truncated PNG: it ends after {len(data)} bytes without its end mark; copy it again")


def leads_out(path: Path, root: Path) -> str:
    """Where a link takes ``path`` outside ``root``, "" when it stays inside (or is no link at all)."""
    target = os.path.realpath(path)
    inside = os.path.realpath(root)
    return "" if target == inside or target.startswith(inside.rstrip(os.sep) + os.sep) else target


def folder_files(folder: Path, root: Path, suffix: str) -> Iterator[tuple[str, Path]]:
    """(name, path) of the files in a folder that end in ``suffix``, unsorted; DataError at a link out of ``root``."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if not entry.name.lower().endswith(suffix):
                continue
            if entry.is_symlink() and (target := leads_out(Path(entry.path), root)):
                raise DataError(f"{entry.path}: a link that leads out of the data, to {target}; copy the file here")
            yield entry.name, Path(entry.path)
