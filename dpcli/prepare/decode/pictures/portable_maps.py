"""Checks portable maps of gray (PGM, PBM, PFM) for what OpenCV, which decodes them, would change; reads those in text."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from dpcli.errors import DataError

_HEADER = re.compile(
    rb"P5" + 3 * rb"(?:\s|#[^\r\n]*[\r\n])+(\d+)" + rb"\s"
)  # the header of a PGM in bytes, with comments


def read_portable_map(data: bytes, path: Path) -> np.ndarray | None:
    """Returns the gray levels of a PGM in text as they are written, u8 or u16 (H,W): OpenCV spreads those below 256 over all
    bytes. None of other files.

    Raises DataError of what OpenCV changes unasked or leaves out: PFM with a scale, PBM of 1 bit, all but the
    first of several PGM in one file; and of texts that end early.
    """
    if data.startswith((b"Pf", b"PF")):
        words = data[:200].split(None, 4)[:4]
        if len(words) == 4 and not re.fullmatch(rb"[-+]?1(\.0*)?", words[3]):
            raise DataError(
                f"{path}: its header gives the scale {words[3].decode('latin-1')}, by which some readers divide and others"
                " don't; save it with the scale 1 or -1"
            )
    elif header := _HEADER.match(data):
        width, height, most = map(int, header.groups())
        rest = data[header.end() + width * height * (1 + (most > 255)) :].lstrip()
        if re.match(rb"P[1-7]\s", rest):
            raise DataError(
                f"{path}: holds several pictures, one behind another; expected one: pamsplit makes a file of each"
            )
    elif data.startswith((b"P1", b"P4")):
        raise DataError(f"{path}: 1 bit a pixel, too few for depth; expected 8 or 16")
    if not data.startswith(b"P2"):
        return None
    try:
        width, height, most, *levels = map(int, re.sub(rb"#[^\r\n]*", b"", data[2:]).split())
    except ValueError:
        raise DataError(f"{path}: not a readable PGM; expected whole numbers") from None
    if len(levels) != width * height or not 0 < most < 65536 or max(levels, default=0) > most:
        raise DataError(
            f"{path}: {len(levels)} levels of {width}x{height} pixels, up to {max(levels, default=0)} of {most}: truncated or"
            " damaged"
        )
    return np.array(levels, np.uint8 if most < 256 else np.uint16).reshape(height, width)
