"""Colors of any range to bytes, by looking at all frames of a sequence: one dark frame alone doesn't tell its range."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dpcli.errors import DataError

_BYTE, _WORD = 255, 65535
_ABOUT_ONE, _SURELY_BYTES = 1.001, 16.0  # fractions may be rounded; from the second on fractions of bytes are bytes
_SURELY_WORDS = 1023  # numbers without a type that are less above 255 are an error in the file


def as_bytes(frames: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Returns colors u8 (N,3) of frames (N,3) of one range.

    Bytes stay. Sixteen bits lose the lower eight, unless no value is above 255: then they held bytes. Fractions from 0
    to 1 are spread over 0 to 255. Raises DataError of values that fit none of these.
    """
    kinds = {frame.dtype for frame in frames}
    if kinds <= {np.dtype(np.uint8)}:
        return list(frames)
    filled = [frame for frame in frames if frame.size]
    low = min((float(frame.min()) for frame in filled), default=0.0)  # NaN spreads through min and max
    high = max((float(frame.max()) for frame in filled), default=0.0)
    if not all(np.isfinite(frame).all() for frame in filled) or low < 0 or high > _WORD:
        raise _unknown(low, high)
    floats = any(kind.kind == "f" for kind in kinds)
    if floats and high <= _ABOUT_ONE:
        return [np.rint(np.minimum(frame.astype(np.float64), 1) * _BYTE).astype(np.uint8) for frame in frames]
    if floats and high < _SURELY_BYTES and any((frame != np.floor(frame)).any() for frame in filled):
        raise _unknown(low, high)  # brighter than white, or bytes of a scene that is nearly black
    if floats and any(frame.max() <= _ABOUT_ONE and (frame != np.floor(frame)).any() for frame in filled):
        raise DataError(f"colors from 0 to 1 in some frames and to {high:g} in others; expected one range")
    if high <= _BYTE:
        return [np.rint(frame).astype(np.uint8) for frame in frames]
    if kinds <= {np.dtype(np.uint16)} or high > _SURELY_WORDS:
        return [(frame.astype(np.int64) >> 8).astype(np.uint8) for frame in frames]
    raise _unknown(low, high)


def _unknown(low: float, high: float) -> DataError:
    return DataError(f"colors from {low:g} to {high:g}; expected 0 to 255, fractions from 0 to 1, or 16 bits")
