"""Texts of nothing but numbers, as most programs write them, parsed whole: several times as fast as row by row."""

from __future__ import annotations

import warnings

import numpy as np

_STRANGE = "\"'#/%_()xXpP"  # quotes, comments, and what some parsers take for numbers
_NEWLINE = 10
_LARGE = 1 << 18  # bytes from which on loading the compiled parser pays


def parse_plain(body: str, width: int, delimiter: str | None, limit: int | None = None) -> np.ndarray | None:
    """Returns rows of ``width`` numbers, f64 (N,width); None of a text where a row has more, fewer or other cells.

    delimiter: None for blanks. limit: rows that are read at most. Commas that don't delimit are decimal signs.
    """
    if any(sign in body for sign in _STRANGE) or (delimiter is not None and " " in body):
        return None
    if delimiter != "," and "," in body:
        if "." in body:
            return None
        body = body.replace(",", ".")
    try:
        data = np.frombuffer(body.encode("ascii") + b"\n", np.uint8)
    except UnicodeEncodeError:
        return None
    if len(data) > _LARGE and (values := _parse_compiled(data, width, delimiter, limit)) is not None:
        return values
    stop = _end_of_rows(data, width, delimiter, limit)
    if stop is None:
        return None
    text = data[:stop].tobytes().decode("ascii")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # NumPy only warns of what it can't read to its end
            values = np.fromstring(text.replace(delimiter, " ") if delimiter else text, np.float64, sep=" ")
    except (ValueError, DeprecationWarning):
        return None
    return values.reshape(-1, width) if values.size % width == 0 else None


def _parse_compiled(data: np.ndarray, width: int, delimiter: str | None, limit: int | None) -> np.ndarray | None:
    """Returns what the compiled parser reads of a text u8 (bytes); None where it isn't sure."""
    from dpcli.prepare.cloud_formats.number_kernel import parse_rows

    lines = int(np.count_nonzero(data == _NEWLINE))
    out = np.empty(width * (lines if limit is None else min(lines, limit)))
    ended = np.concatenate([data, np.full(3, _NEWLINE, np.uint8)])
    rows = parse_rows(ended, ord(delimiter or " "), width, out)
    return out[: rows * width].reshape(-1, width) if rows > 0 else None


def _end_of_rows(data: np.ndarray, width: int, delimiter: str | None, limit: int | None) -> int | None:
    """Returns where the wanted rows end in a text u8 (bytes); None unless each has as many cells as columns."""
    ends = np.flatnonzero(data == _NEWLINE)
    between = (data <= 32) | (data == ord(delimiter)) if delimiter else data <= 32
    starts = ~between
    starts[1:] &= between[:-1]
    cells = np.diff(np.searchsorted(np.flatnonzero(starts), ends), prepend=0)
    kept = np.flatnonzero(cells)[:limit]
    if not len(kept) or (cells[kept] != width).any():
        return None
    if delimiter:
        signs = np.diff(np.searchsorted(np.flatnonzero(data == ord(delimiter)), ends), prepend=0)
        if (signs[kept] != width - 1).any():
            return None
    return int(ends[kept[-1]]) + 1
