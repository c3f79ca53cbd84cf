"""Sorts the rows of a table into frames of sequences: by a column of frames, one of sequences, and gaps."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Protocol

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.column_names import find_frame_column, words_of

_SECONDS = {"s": 1.0, "sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_EPOCHS = {10: 1.0, 13: 1e-3, 16: 1e-6, 18: 1e-9, 19: 1e-9}  # digits of a time since 1970 -> seconds
_TIME_WORDS = frozenset(("time", "timestamp", "stamp", "t", "timestamps", "epoch", "utc"))
SINGLE = (
    "sequences whose frames hold one point each; does the frame column tell the time of each point? (--frame-column)"
)
FELL = "sequences whose frame numbers fall on the way, put in the order of the numbers (--gap N begins a new sequence there)"
WRAPPED = "sequences whose frame numbers begin anew at 0 when their counter is full; their frames stay in their order"
_FULL = (2**8, 2**16, 2**32)  # what a counter of 8, 16 or 32 bits never reaches
_CLOCK = re.compile(
    r"(?:(\d{4})[-/](\d\d?)[-/](\d\d?)[T _]\s*)?(\d\d?):(\d\d):(\d\d)([.,]\d{1,9})?\s*(Z|UTC|[-+]\d\d:?\d\d)?",
    re.IGNORECASE,
)
_DAY = 86_400.0
JOINED = "frames whose rows were joined, as their numbers come again later (--gap N begins a new sequence there)"


class Table(Protocol):
    """Offers the columns of a table, as `text_numbers.TextTable` and `parquet.ParquetTable` do."""

    path: Path
    names: tuple[str, ...]

    def columns(self, places: list[int]) -> np.ndarray:
        """Returns some columns as numbers f64 (N,k)."""
        ...

    def words(self, place: int) -> list[str]:
        """Returns the cells of a column as text."""
        ...


@dataclass(frozen=True)
class Rows:
    """Holds one sequence of a table. name: what is added to the table's, "" where it has one only; rows: i64 (N), frame
    after frame; offsets: i64 (T+1); frames: what the frame column holds, f64 (T), None for words; clock: it holds times of
    day, here in seconds; joined: how many frames lay in several places; notes: what is odd about their numbers.
    """

    name: str
    rows: np.ndarray
    offsets: np.ndarray
    frames: np.ndarray | None
    clock: bool = False
    joined: int = 0
    notes: tuple[str, ...] = ()

    def times(self, column: str, fps: float | None) -> np.ndarray | None:
        """Returns seconds since the first frame, f64 (T): what the column tells, or its numbers by ``fps``; else None."""
        if self.frames is None:
            return np.arange(len(self.offsets) - 1) / fps if fps else None
        since = self.frames - self.frames[0]
        unit = 1.0 if self.clock else seconds_of(column, self.frames)
        if unit:
            return since * unit
        step = np.gcd.reduce(np.diff(self.frames).astype(np.int64)) if len(since) > 1 else 1
        return since / max(int(step), 1) / fps if fps else None


def seconds_of(column: str, values: np.ndarray) -> float:
    """Returns how many seconds one unit of a column is that holds times; 0 where its values f64 (T) count frames.

    >>> seconds_of("frame", np.array([1.0, 2.0])), seconds_of("t_ms", np.array([0.0, 33.0]))
    (0.0, 0.001)
    """
    words = words_of(column)
    if len(words) > 1 and words[-1] in _SECONDS:
        return _SECONDS[words[-1]]
    whole = (values == np.floor(values)).all()
    digits = {len(str(int(abs(value)))) for value in values[[0, -1]]}
    if whole and len(digits) == 1 and set(words) & _TIME_WORDS:
        return _EPOCHS.get(digits.pop(), 0.0)
    return 0.0 if whole else 1.0


@dataclass(frozen=True)
class Clock:
    """Holds the seconds f64 (N) of each row of a table, as a column told them that doesn't number the frames."""

    column: str
    seconds: np.ndarray

    def times(self, part: Rows) -> np.ndarray | None:
        """Returns seconds since the first frame, f64 (T), of a frame's earliest row; None where they don't rise."""
        starts = np.minimum.reduceat(self.seconds[part.rows], part.offsets[:-1])
        return starts - starts[0] if (np.diff(starts) > 0).all() else None


def find_clocks(table: Table, names: Sequence[str]) -> list[Clock]:
    """Returns the times that some of the columns ``names`` tell, in seconds or of a unit in the column's name."""
    found = []
    for name in names:
        if not set(words_of(name)) & _TIME_WORDS:
            continue
        try:
            values = table.columns([table.names.index(name)])[:, 0]
        except DataError:
            values, unit = np.array(clock_seconds(table.words(table.names.index(name)))), 1.0
        else:
            unit = seconds_of(name, values) if np.isfinite(values).all() else 0.0
        if unit and len(values):
            found.append(Clock(name, (values - values[0]) * unit))
    return found


def frame_column(table: Table, wanted: str) -> str:
    """Returns the name of the column of frames: the one ``wanted``, or the one whose name says it. Raises DataError."""
    known = ", ".join(table.names)[:200] or "none: it has no header"
    if wanted and wanted not in table.names:
        raise DataError(f"{table.path}: --frame-column {wanted}: no such column; found {known}")
    found = wanted or find_frame_column(table.names)
    if not found:
        raise DataError(
            f"{table.path}: which column numbers the frames? --frame-column NAME says it; found {known}."
            " A table of one frame goes into a folder of frames"
        )
    return found


def split_rows(table: Table, column: str, sequence_column: str = "", gap: float | None = None) -> list[Rows]:
    """Returns the sequences of a table in the order in which they begin.

    ``gap``: a jump of more than this in the frame column, or a fall, begins a new one. Raises DataError on a column that
    is not there, or that holds nothing in some row.
    """
    frames, numbers, clock = _frame_values(table, column)
    if gap is not None and numbers is None:
        raise DataError(f"{table.path}: --gap needs numbers in {column!r}; it holds words such as {frames[0]!r}")
    groups = _groups(table, sequence_column, len(frames))
    found = []
    for name, rows in groups:
        parts = [rows] if gap is None else _cut(frames, rows, gap)
        for k, part in enumerate(parts):
            names = [*([name] if sequence_column else []), *([f"{k:03d}"] if gap is not None else [])]
            found.append(replace(_in_frames("/".join(names), frames, numbers, part), clock=clock))
    return found


def _frame_values(table: Table, column: str) -> tuple[np.ndarray, np.ndarray | None, bool]:
    """Returns what orders the rows (numbers, or places of words in the order they first occur), the numbers, and whether
    these are seconds that the words told as dates or times of day.
    """
    place = table.names.index(column)
    try:
        values = table.columns([place])[:, 0]
    except DataError:
        words = table.words(place)
        order = {word: k for k, word in enumerate(dict.fromkeys(words))}
        if seconds := clock_seconds(list(order)):
            told = np.array([seconds[order[word]] for word in words])
            return told, told, True
        return np.array([order[word] for word in words]), None, False
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise DataError(f"{table.path}: {len(bad)} rows, the first is {bad[0] + 1}, have no number in {column!r}")
    return values, values, False


def clock_seconds(words: Sequence[str]) -> list[float]:
    """Returns the seconds of dates with times of day, or of times of day alone, which may pass midnight; [] of other words.

    >>> clock_seconds(["23:59:59.5", "00:00:00"]), clock_seconds(["a"])
    ([86399.5, 86400.0], [])
    """
    found: list[float] = []
    days = 0
    for word in words:
        match = _CLOCK.fullmatch(word.strip())
        try:
            seconds = _seconds_told(match) if match else None
        except ValueError:  # such as a month 13
            seconds = None
        if match is None or seconds is None:
            return []
        if match[1] is None:
            days += bool(found) and seconds + days * _DAY < found[-1] - _DAY / 2
        found.append(seconds + days * _DAY)
    return found


def _seconds_told(match: re.Match[str]) -> float:
    year, month, day, hour, minute, second, fraction, _ = match.groups()
    own = int(hour) * 3600 + int(minute) * 60 + int(second) + float((fraction or ".0").replace(",", "."))
    if year is None:
        return own
    return datetime(int(year), int(month), int(day), tzinfo=timezone.utc).timestamp() + own - _offset(match[8])


def _offset(zone: str | None) -> float:
    """Returns the seconds by which a zone such as ``+02:00`` is ahead."""
    if not zone or zone[0] not in "+-":
        return 0.0
    ahead = int(zone[1:3]) * 3600 + int(zone[-2:]) * 60
    return float(-ahead if zone[0] == "-" else ahead)


def _groups(table: Table, column: str, count: int) -> list[tuple[str, np.ndarray]]:
    if not column:
        return [("", np.arange(count))]
    if column not in table.names:
        known = ", ".join(table.names)[:200]
        raise DataError(f"{table.path}: --sequence-column {column}: no such column; found {known}")
    words = np.array(table.words(table.names.index(column)))
    order = dict.fromkeys(words.tolist())
    if "" in order:
        raise DataError(f"{table.path}: a row has nothing in its column {column!r}; expected the name of its sequence")
    return [(word.replace("/", "_"), np.flatnonzero(words == word)) for word in order]


def _cut(frames: np.ndarray, rows: np.ndarray, gap: float) -> list[np.ndarray]:
    steps = np.diff(frames[rows])
    return np.split(rows, np.flatnonzero((steps > gap) | (steps < 0)) + 1)


def _in_frames(name: str, frames: np.ndarray, numbers: np.ndarray | None, rows: np.ndarray) -> Rows:
    own = frames[rows]
    notes = []
    if numbers is not None and (full := _fills_counter(own)):
        own = own + full * np.cumsum(np.append(0, np.diff(own)) == 1 - full)
        notes.append(WRAPPED)
    falls = bool((np.diff(own) < 0).any())
    runs = 1 + int(np.count_nonzero(np.diff(own)))
    order = np.argsort(own, kind="stable")
    values, starts = np.unique(own[order], return_index=True)
    offsets = np.append(starts, len(rows)).astype(np.int64)
    joined = runs - len(values)
    notes += [FELL] if falls and not joined and numbers is not None else []
    return Rows(name, rows[order], offsets, None if numbers is None else values, joined=joined, notes=tuple(notes))


def _fills_counter(numbers: np.ndarray) -> int:
    """Returns how many values the counter has whose numbers f64 (N) go on at 0 after its last, and fall nowhere else; 0
    where they don't.
    """
    steps = np.diff(numbers)
    falls = steps[steps < 0]
    full = int(numbers.max(initial=0)) + 1
    return full if full in _FULL and len(falls) and (falls == 1 - full).all() else 0
