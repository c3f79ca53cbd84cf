"""PNG files of 8 or 16 bits: gray ones by kornia-rs in a third of OpenCV's time, all with their damage found and
named.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.decode.cv2_import import load_cv2

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_END = b"\0\0\0\0IEND\xaeB`\x82"
_HEADER = struct.Struct(">8s 4x 4s II B B 3x I")  # signature, type, width, height, bits, color, checksum
_COLOR = {0: "gray", 2: "RGB", 3: "palette", 4: "gray with alpha", 6: "RGB with alpha"}


@dataclass(frozen=True)
class PngHeader:
    """Holds the first chunk of a PNG: size in pixels, bits per channel, color type (0 is gray) and the chunk's
    checksum.
    """

    width: int
    height: int
    bits: int
    color: int
    checksum: int


def read_header(data: bytes) -> PngHeader | None:
    """Returns the header of a PNG's bytes, of which 33 suffice; None when they are no PNG."""
    if len(data) < _HEADER.size:
        return None
    signature, kind, *numbers = _HEADER.unpack_from(data)
    return PngHeader(*numbers) if (signature, kind) == (_SIGNATURE, b"IHDR") else None


def png_size(path: Path) -> tuple[int, int]:
    """Returns width and height of a PNG file, of which nothing is decoded. Raises DataError when it is none."""
    with open(path, "rb") as file:
        header = read_header(file.read(_HEADER.size))
    if header is None:
        raise DataError(f"{path}: not a PNG (empty, truncated, or of another kind); its size is needed for the crop")
    return header.width, header.height


def significant_bits(path: Path) -> int:
    """Returns how many of its bits a gray PNG says are significant; all of them where it doesn't, 16 where it is no PNG."""
    with open(path, "rb") as file:
        data = file.read(_HEADER.size + 4096)
    header, place = read_header(data), data.find(b"\0\0\0\1sBIT", 0, data.find(b"IDAT"))
    if header is None or header.color != 0:
        return 16
    return min(data[place + 8], header.bits) if place > 0 else header.bits


@cache
def _decoders() -> dict[int, Callable]:
    """Returns bits -> function of (bytes, (height, width), mode); none where kornia-rs is missing or of another kind."""
    try:
        from kornia_rs import io

        return {8: io.decode_image_png_u8, 16: io.decode_image_png_u16}
    except (ImportError, AttributeError):
        return {}


def decode_gray_png(data: bytes) -> np.ndarray | None:
    """Decodes the bytes of a whole gray PNG to u8 or u16 (H,W).

    Returns None for all else (another kind of file, a damaged one, no kornia-rs): OpenCV decodes that, or the caller
    says what is wrong with it.
    """
    from dpcli.runtime.clips.images import is_plausible

    header = read_header(data)
    if header is None or not data.endswith(_END) or header.color != 0 or header.bits not in _decoders():
        return None
    if data.find(b"acTL", 0, data.find(b"IDAT")) > 0:  # of an animation it would give the first frame
        return None
    # memory is taken before anything is decoded: a size that can't be true would ask for gigabytes
    if header.checksum != zlib.crc32(data[12:29]) or not is_plausible(header.width, header.height, len(data)):
        return None
    try:
        image = _decoders()[header.bits](data, (header.height, header.width), "mono")
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException:  # nothing more specific is raised; a Rust panic is no Exception
        return None
    return np.asarray(image).reshape(header.height, header.width)


def decode_picture(data: bytes, where: str | Path) -> np.ndarray | None:
    """Decodes the bytes of a PNG, or of another picture that OpenCV knows, as they are stored; None where it can't.

    Raises DataError where it is damaged in a way that OpenCV would fill in, as `check_picture` does.
    """
    image = decode_gray_png(data)
    if image is None and data:
        check_picture(data, where)
        cv2 = load_cv2()
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return image


def decode_depth_png(data: bytes, where: str, size: tuple[int, int], bits: tuple[int, ...] = (16,)) -> np.ndarray:
    """Decodes the bytes of a gray PNG to depth u8 or u16 (H,W). size: (width, height) expected; bits: allowed per
    pixel.

    Everything is checked before libpng sees it, because it fills in what a damaged file lacks, or complains on stderr
    without a name. Raises DataError that says what was found at ``where``.
    """
    if not data:
        raise DataError(f"{where}: the file is empty; expected a PNG")
    header = read_header(data)
    if header is None:
        raise DataError(f"{where}: not a PNG (starts with {data[:8]!r})")
    if (header.width, header.height) != size:
        raise DataError(f"{where}: {header.width}x{header.height} pixels; expected {size[0]}x{size[1]}")
    if header.color != 0 or header.bits not in bits:
        allowed, color = " or ".join(str(b) for b in bits), _COLOR.get(header.color, "unknown")
        raise DataError(f"{where}: {header.bits}-bit {color} PNG; expected {allowed}-bit gray depth")
    image = decode_picture(data, where)
    if image is None or image.shape != (header.height, header.width):
        raise DataError(f"{where}: a damaged PNG; copy it again")
    return image


def check_picture(data: bytes, where: str | Path) -> None:
    """Raises DataError for a picture that claims more pixels than its bytes can tell, where a PNG's chunks are not all
    there with the right checksums, the last one IEND, and of a PNG of several frames.

    OpenCV gets nothing else: it takes as much memory as a header or a damaged chunk claims.
    """
    from dpcli.runtime.clips.images import require_plausible

    if not data.startswith(_SIGNATURE):
        _check_size(data, where)
        return
    if header := read_header(data):
        require_plausible(where, header.width, header.height, len(data))
    position, view = len(_SIGNATURE), memoryview(data)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        end = position + 12 + length
        if end > len(data):
            break
        if zlib.crc32(view[position + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise DataError(f"{where}: a damaged PNG: wrong checksum at byte {position}; copy it again")
        kind = data[position + 4 : position + 8]
        if kind == b"acTL" and (frames := int.from_bytes(data[position + 8 : position + 12], "big")) > 1:
            raise DataError(f"{where}: an animated PNG of {frames} frames; expected one: save each as its own file")
        if kind == b"IEND":
            return
        position = end
    raise DataError(f"{where}: a truncated PNG: it ends after {len(data)} bytes without its end mark; copy it again")


def _check_size(data: bytes, where: str | Path) -> None:
    """Raises DataError for a picture of another kind whose size isn't plausible; of kinds that Pillow doesn't know it passes."""
    from PIL import Image

    from dpcli.runtime.clips.images import require_plausible

    try:
        with Image.open(io.BytesIO(data)) as image:
            size = image.size
    except Image.DecompressionBombError as error:
        raise DataError(f"{where}: {str(error)[:80]}; {len(data)} bytes of a file can't hold such a picture") from None
    except Exception:  # nearly anything; decoding will say that it can't be read
        return
    require_plausible(where, *size, len(data))
