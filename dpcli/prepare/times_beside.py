"""Times of frames that lie beside them: in a text, a row each, as KITTI has them, or in an array of the same file."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.prepare.scans.times_of_tables import clock_seconds, seconds_of
from dpcli.prepare.series import Series, TimesBeside
from dpcli.text_files import decode_text

_STEMS = ("times", "timestamps", "time_stamps", "timestamp", "time")
_SUFFIXES = (".txt", ".csv")
_MOST = 1 << 26  # bytes of such a text


def with_times(series: Series, root: Path) -> Series:
    """Returns the series with the times in ``times.txt``, ``timestamps.txt`` or the like in its folder, or in the one above.

    Nothing above ``root`` is read. A row holds seconds, or date and time of day. There are as many rows as frames, or, where
    frames are missing, one for each number from 0 or 1 to the last frame's. A text that doesn't fit is named among what is left
    out, with the reason. Times in the names of the frames themselves come first.
    """
    if len(series.names) < 2 or series.times() is not None:
        return series
    folders = [series.folder] if series.folder == root else [series.folder, series.folder.parent]
    for path in (folder / f"{stem}{suffix}" for folder in folders for stem in _STEMS for suffix in _SUFFIXES):
        if path.name in series.names or not path.is_file() or path.stat().st_size > _MOST:
            continue
        others = tuple(one for one in series.left_out if one != path.name)
        seconds = _seconds(path)
        times = _of_frames(seconds, series)
        if times is not None:
            return replace(series, beside=TimesBeside(path, times), left_out=others)
        told = (
            f"{counted(len(seconds), 'time')} for {counted(len(series.names), 'frame')}" if len(seconds) else "no times"
        )
        return replace(series, left_out=(*others, f"{path.name} ({told})"))
    return series


def seconds_beside(name: str, values: np.ndarray, units: str = "") -> np.ndarray | None:
    """Returns seconds since the first, f64 (T), of numbers that an array beside frames holds, in the unit that its name or its
    attribute ``units`` says; None where they don't rise, or the unit isn't known.
    """
    values = np.asarray(values).reshape(-1)
    if values.dtype.kind == "M":
        since = (values - values[:1]) / np.timedelta64(1, "s")
    else:
        values, name = values.astype(np.float64), f"time {name.rpartition('/')[2]}"  # whatever else it is called
        if not np.isfinite(values).all():
            return None
        unit = re.match(r"[^\W\d]+", units)
        since = values - values[:1]
        since *= seconds_of(f"{name} [{unit[0]}]" if unit else name, values) if len(values) else 1
    return since if len(since) < 2 or (np.diff(since) > 0).all() else None


def _seconds(path: Path) -> np.ndarray:
    """Returns the times of all rows in seconds, f64; none where a row holds something else, or they don't rise."""
    try:
        lines = [line.strip() for line in decode_text(path).split("\n")]
    except (DataError, OSError):  # it is named as one without times
        return np.zeros(0)
    rows = [line for line in lines if line and not line.startswith("#")]
    column = rows.pop(0) if rows and not any(letter.isdigit() for letter in rows[0]) else "time"
    try:
        values = np.array([float(row) for row in rows])
    except ValueError:
        seconds = np.array(clock_seconds(rows))
    else:
        known = len(values) > 1 and np.isfinite(values).all()
        seconds = values * seconds_of(column, values) if known else values[:0]
    return seconds if (np.diff(seconds) > 0).all() else seconds[:0]


def _of_frames(seconds: np.ndarray, series: Series) -> np.ndarray | None:
    """Returns the times of the frames since the first one, f64 (F), from those of the rows; None where they don't fit."""
    rows, numbers = np.arange(len(series.names)), series.numbers()
    if len(seconds) != len(rows):
        if numbers is None or numbers[-1] not in (len(seconds) - 1, len(seconds)):
            return None
        rows = numbers - (numbers[-1] == len(seconds))
    return seconds[rows] - seconds[rows[0]] if rows[0] >= 0 else None
