"""Decimal numbers in a text, compiled: exact where mantissa and power of ten are exact in float64 (Clinger 1990)."""

from __future__ import annotations

import numpy as np

from dpcli.ops.cpu.jit import arithmetic_kernel

_EXACT = 1 << 53  # whole numbers up to this, and powers of ten up to the 22nd, are exact in float64
_POWERS = np.array([10.0**k for k in range(23)])
_NEWLINE, _BLANK, _PLUS, _MINUS, _POINT, _ZERO, _NINE, _E = 10, 32, 43, 45, 46, 48, 57, 101
_NAN = (110, 97, 110)
_SMALL = 32  # the bit that a small letter has, and its capital hasn't


@arithmetic_kernel
def _whole_number(text: np.ndarray, at: int, limit: int) -> tuple[int, int]:
    """Returns the digits from a place on as a number, at most some above ``limit``, and where they end."""
    value = 0
    while at < len(text) and _ZERO <= text[at] <= _NINE and value <= limit:
        value = value * 10 + (text[at] - _ZERO)
        at += 1
    return value, at


@arithmetic_kernel
def _number(text: np.ndarray, start: int) -> tuple[float, int]:
    """Returns the number at a place of a text that ends with a newline, and where it ends; -1 where it isn't exact or none."""
    negative = text[start] == _MINUS
    first = start + 1 if negative or text[start] == _PLUS else start
    mantissa, at = _whole_number(text, first, _EXACT)
    digits, scale = at - first, 0
    if text[at] == _POINT:
        before = at + 1
        at = before
        while _ZERO <= text[at] <= _NINE and mantissa <= _EXACT:
            mantissa = mantissa * 10 + (text[at] - _ZERO)
            at += 1
        scale = before - at
        digits += at - before
    if digits == 0:
        named = text[first] | _SMALL == _NAN[0] and text[first + 1] | _SMALL == _NAN[1]
        return np.nan, first + 3 if named and text[first + 2] | _SMALL == _NAN[2] else -1
    if text[at] | _SMALL == _E:
        below = text[at + 1] == _MINUS
        begin = at + 2 if below or text[at + 1] == _PLUS else at + 1
        power, at = _whole_number(text, begin, 999)
        scale += -power if below else power
        if at == begin:
            return 0.0, -1
    if mantissa > _EXACT or abs(scale) > 22:
        return 0.0, -1
    value = mantissa * _POWERS[scale] if scale >= 0 else mantissa / _POWERS[-scale]
    return -value if negative else value, at


@arithmetic_kernel
def parse_rows(text: np.ndarray, sign: int, width: int, out: np.ndarray) -> int:
    """Fills ``out`` f64 (rows x width, flat) with the numbers of a text u8 that ends with four newlines.

    sign: the byte between cells, or a blank for any run of blanks. Returns how many rows were read, at most those that
    ``out`` holds; -1 where a row has more or fewer cells, or one that isn't exact this way, or is no number.
    """
    at, count, cells, signs = 0, 0, 0, 0
    while at < len(text):
        byte = text[at]
        if byte == _NEWLINE:
            if cells and (cells != width or (sign != _BLANK and signs != width - 1)):
                return -1
            if count == len(out):
                break
            cells, signs, at = 0, 0, at + 1
        elif byte == sign and sign != _BLANK:
            signs, at = signs + 1, at + 1
        elif byte <= _BLANK:
            at += 1
        elif count == len(out):
            return -1
        else:
            value, at = _number(text, at)
            if at < 0 or (text[at] > _BLANK and text[at] != sign):
                return -1
            out[count] = value
            count, cells = count + 1, cells + 1
    return count // width
