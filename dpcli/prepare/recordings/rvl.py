"""Depth packed by RVL (Wilson, "Fast lossless depth image compression", 2017), as image_transport's compressedDepth has it."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.ops.cpu.jit import arithmetic_kernel
from dpcli.runtime.clips.images import require_plausible

_SIZE = struct.Struct("<ii")  # columns and rows, before the words
_HALF = 8  # nibbles of a word
_LONGEST = 11  # nibbles of a number of 32 bits, three in each


def unpack_rvl(path: Path, data: bytes) -> np.ndarray:
    """Returns the picture u16 (H,W) of its size and packed words. Raises DataError where they hold less, or no 16 bits."""
    width, height = _SIZE.unpack_from(data) if len(data) >= _SIZE.size else (0, 0)
    if width <= 0 or height <= 0:
        raise DataError(f"{path}: depth packed by RVL says a size of {width}x{height}; it is damaged")
    require_plausible(path, width, height, len(data))
    packed = data[_SIZE.size :]
    words = np.frombuffer(packed[: len(packed) // 4 * 4], "<u4").astype(np.int64)
    pixels = np.zeros(width * height, np.uint16)
    if not _unpack(words, pixels):
        raise DataError(f"{path}: depth packed by RVL ends early, or holds no numbers of 16 bits; it is damaged")
    return pixels.reshape(height, width)


@arithmetic_kernel
def _number(words: np.ndarray, at: int) -> tuple[int, int]:
    """Returns the number that begins at a nibble, three bits in each, the lowest first, and where it ends; -1 for none."""
    value = 0
    for place in range(_LONGEST):
        if at >= _HALF * len(words):
            return -1, at
        nibble = words[at // _HALF] >> (4 * (_HALF - 1 - at % _HALF)) & 15
        at += 1
        value |= (nibble & 7) << (3 * place)
        if nibble < 8:
            return value, at
    return -1, at


@arithmetic_kernel
def _unpack(words: np.ndarray, pixels: np.ndarray) -> bool:
    """Writes pixels (N): runs of zeros, then of differences from the last one that isn't 0. Returns whether all are there."""
    at = done = last = 0
    while done < len(pixels):
        zeros, at = _number(words, at)
        filled, at = _number(words, at)
        if zeros < 0 or filled < 0 or zeros + filled == 0 or done + zeros + filled > len(pixels):
            return False
        done += zeros
        for _ in range(filled):
            step, at = _number(words, at)
            last += step >> 1 if step & 1 == 0 else -(step >> 1) - 1
            if step < 0 or not 0 <= last < 65536:
                return False
            pixels[done] = last
            done += 1
    return True
