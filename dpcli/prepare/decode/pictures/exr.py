"""Depth in OpenEXR files, as renderers write it. OpenEXR is an extra."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.runtime.clips.images import require_plausible

_NO_DEPTH = re.compile("mist|denois", re.IGNORECASE)  # layers of Blender that have a Z, too


def read_exr(path: Path) -> tuple[np.ndarray, str]:
    """Reads one frame (H,W) f32 or u32 of an ``.exr``, and the name of its channel: the only one, the one called Z or depth, or
    several equal ones, as gray in three; of several parts those of all, and beside others no alpha, nor the Z of a normal, a place
    or mist.

    The frame is the whole picture (the display window), 0 where the file holds no pixels of it. Raises DataError when it can't be
    read, holds colors, or OpenEXR is not installed.
    """
    try:
        import OpenEXR
    except ImportError:
        raise DataError(f"{path}: OpenEXR is needed to read it; pip install 'dpc-toolkit[exr]'") from None
    try:
        headers = OpenEXR.File(str(path), True, True).parts
        for part in headers:
            for window in (part.header["dataWindow"], part.header["displayWindow"]):
                width, height = (int(b) - int(a) + 1 for a, b in zip(*window))
                require_plausible(path, width, height, path.stat().st_size)
        parts = OpenEXR.File(str(path), True).parts
        if len(parts) < len(headers):  # the library leaves out what it can't decode
            raise ValueError
        channels = {
            f"{part.name()}.{name}" if len(parts) > 1 else name: (channel.pixels, part.header)
            for part in parts
            for name, channel in part.channels.items()
        }
    except DataError:
        raise
    except Exception:  # RuntimeError, and of a file that lost its end ValueError
        raise DataError(f"{path}: not a readable OpenEXR image (empty, truncated, or of another kind)") from None
    opaque = [name for name in channels if name.rpartition(".")[2] != "A"] or list(channels)
    chosen = [name for name in opaque if _says_depth(name) and not _is_of_vector(name, channels)] or opaque
    first, header = channels[chosen[0]]
    if first.dtype.kind not in "uf":
        raise DataError(f"{path}: holds deep pixels, many depths in each; expected one depth a pixel: render it flat")
    if any(not np.array_equal(first, channels[name][0]) for name in chosen[1:]):
        raise DataError(f"{path}: holds channels {', '.join(sorted(channels))}; expected one called Z or depth")
    frame = _in_picture(first, header["dataWindow"], header["displayWindow"])
    return frame.astype(np.float32) if frame.dtype == np.float16 else frame, chosen[0]


def _says_depth(name: str) -> bool:
    if _NO_DEPTH.search(name):
        return False
    return name.rpartition(".")[2].lower() in ("z", "depth") or "depth" in name.lower()


def _is_of_vector(name: str, names: Iterable[str]) -> bool:
    """Returns whether a channel is the Z of three, such as those of a normal or of a place in the world."""
    layer, dot, last = name.lower().rpartition(".")
    return last == "z" and {f"{layer}{dot}x", f"{layer}{dot}y"} <= {one.lower() for one in names}


def _in_picture(pixels: np.ndarray, data: tuple, display: tuple) -> np.ndarray:
    """Returns the pixels of a data window where they belong in the display window, to which the camera's numbers refer; what
    lies outside of it is no part of the picture. Windows: the first and the last (x, y).
    """
    (left, top), (right, bottom) = ([int(one) for one in corner] for corner in display)
    x, y = (int(own) - int(first) for own, first in zip(data[0], display[0]))
    height, width = bottom - top + 1, right - left + 1
    if (x, y) == (0, 0) and pixels.shape == (height, width):
        return pixels
    frame = np.zeros((height, width), pixels.dtype)
    inside = pixels[max(-y, 0) : max(height - y, 0), max(-x, 0) : max(width - x, 0)]
    rows, columns = inside.shape
    frame[max(y, 0) : max(y, 0) + rows, max(x, 0) : max(x, 0) + columns] = inside
    return frame
