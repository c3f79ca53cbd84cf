"""Sorts the rows of a table into frames of sequences: by a column of frames, one of sequences, and gaps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.column_names import Table, find_frame_column
from dpcli.prepare.reader import natural_key
from dpcli.prepare.scans.times_of_tables import (
    SHORTEST,
    Clock,
    calendar_seconds,
    clock_seconds,
    seconds_and_parts,
    seconds_of,
    unit_by_rate,
)
from dpcli.runtime.clips.name_numbers import NumberColumns, parse_name

SINGLE = (
    "sequences whose frames hold one point each; does the frame column tell the time of each point? (--frame-column)"
)
FELL = "sequences whose frame numbers fall on the way, put in the order of the numbers (--gap N begins a new sequence there)"
WRAPPED = "sequences whose frame numbers begin anew at 0 when their counter is full; their frames stay in their order"
ROUNDED = "sequences whose frame column seems rounded by float32, which makes one frame of several; save it in float64"
_SPARSE = 2**30
_EXACT = 2**53  # up to here every whole number is a float64
_FULL = (2**8, 2**16, 2**32)  # what a counter of 8, 16 or 32 bits never reaches
SILENT = "frame numbers without a row, as of frames in which nothing was seen; their neighbors follow each other (--fps keeps the times)"
JOINED = "frames whose rows were joined, as their numbers come again later (--gap N begins a new sequence there)"


@dataclass(frozen=True)
class Rows:
    """Holds one sequence of a table. name: what is added to the table's, "" where it has one only; rows: i64 (N), frame
    after frame; offsets: i64 (T+1); frames: what the frame column holds, f64 or i64 (T), None for words; clock: it holds times, here
    in seconds; joined: how many frames lay in several places; notes: what is odd about their numbers.
    """

    name: str
    rows: np.ndarray
    offsets: np.ndarray
    frames: np.ndarray | None
    clock: bool = False
    joined: int = 0
    notes: tuple[str, ...] = ()

    @property
    def silent(self) -> int:
        """Returns how many numbers are missing between those of the frames, where most of these are one step apart; else 0."""
        numbers = self.frames
        if numbers is None or self.clock or len(numbers) < 3 or (numbers != np.floor(numbers)).any():
            return 0
        steps = np.diff(numbers).astype(np.int64)
        step = int(np.gcd.reduce(steps))
        return int((steps // step - 1).sum()) if step and 2 * np.count_nonzero(steps == step) > len(steps) else 0

    def times(self, column: str, fps: float | None) -> np.ndarray | None:
        """Returns seconds since the first frame, f64 (T): what the column tells, or its numbers by ``fps``; else None."""
        if self.frames is None:
            return np.arange(len(self.offsets) - 1) / fps if fps else None
        since = self.frames - self.frames[0]
        unit = 1.0 if self.clock else seconds_of(column, self.frames)
        if unit:
            told = _rising(since * unit)
            return told if told is not None or not fps else np.arange(len(since)) / fps
        if fps and (unit := unit_by_rate(column, self.frames, fps)):
            return since * unit
        if not fps:
            return None
        if (since != np.floor(since)).any():  # times in a unit that isn't known
            return np.arange(len(since)) / fps
        step = np.gcd.reduce(np.diff(self.frames).astype(np.int64)) if len(since) > 1 else 1
        return since / max(int(step), 1) / fps

    def times_by(self, clock: Clock) -> np.ndarray | None:
        """Returns seconds since the first frame, f64 (T), of a frame's earliest row by a clock; None where they don't rise."""
        starts = np.minimum.reduceat(clock.seconds[self.rows], self.offsets[:-1])
        return _rising(starts - starts[0])


def _rising(seconds: np.ndarray) -> np.ndarray | None:
    """Returns times of frames that rise, f64 (T), by steps that no sensor falls short of; None of others."""
    steps = np.diff(seconds)
    return seconds if not len(steps) or (steps.min() > 0 and np.sort(steps)[len(steps) // 2] >= SHORTEST) else None


def frame_column(table: Table, wanted: str) -> str:
    """Returns the name of the column of frames: the one ``wanted``, or the one whose name says it. Raises DataError."""
    known = ", ".join(table.names)[:200] or "none: it has no header"
    if wanted and wanted not in table.names:
        raise DataError(
            f"{table.path}: --frame-column {wanted}: no such column; found {known}{_in_folders(table, wanted)}"
        )
    found = wanted or find_frame_column(table.names)
    if not found:
        raise DataError(
            f"{table.path}: which column numbers the frames? give --frame-column NAME; found {known}."
            " Put a table of a single frame into a folder of frames"
        )
    return found


def split_rows(table: Table, column: str, sequence_column: str = "", gap: float | None = None) -> list[Rows]:
    """Returns the sequences of a table in the order in which they begin.

    ``gap``: a jump of more than this in the frame column, or a fall, begins a new one. Raises DataError on a column that
    is not there, or that holds nothing in some row.
    """
    frames, numbers, clock = _frame_values(table, column)
    if not len(frames):
        raise DataError(f"{table.path}: a table without rows; expected numbers in columns")
    if gap is not None and numbers is None:
        word = table.words(table.names.index(column))[0]
        raise DataError(f"{table.path}: --gap needs numbers in {column!r}; it holds words such as {word!r}")
    groups = _groups(table, sequence_column, len(frames))
    found = []
    for name, rows in groups:
        parts = [rows] if gap is None else _cut(frames, rows, gap)
        for k, part in enumerate(parts):
            names = [*([name] if sequence_column else []), *([f"{k:03d}"] if gap is not None else [])]
            found.append(replace(_in_frames("/".join(names), frames, numbers, part), clock=clock))
    return found


def _frame_values(table: Table, column: str) -> tuple[np.ndarray, np.ndarray | None, bool]:
    """Returns what orders the rows (numbers, or places of words), the numbers, and whether these are seconds, as columns of
    times, dates and times of day tell them.
    """
    place = table.names.index(column)
    moments = table.moments(place)
    if moments is None and (clock := seconds_and_parts(table, column)):
        moments = clock.seconds
    if moments is None:
        try:
            values = table.columns([place])[:, 0]
        except DataError:
            words = table.words(place)
            if 2 * sum(word.isdecimal() for word in words) > len(words):
                raise  # such as of a row of means below the others
            return _values_of_words(table, column, words)
    else:
        values = moments
    _require_all(table, column, np.isfinite(values))
    if moments is None and (told := calendar_seconds(column, values, partial(table.words, place))) is not None:
        values = moments = told
    if moments is None and len(values) and np.abs(values).max() >= _EXACT:
        values = _exact(table.words(place), values)
    return values, values, moments is not None


def _values_of_words(table: Table, column: str, words: list[str]) -> tuple[np.ndarray, np.ndarray | None, bool]:
    """Returns what `_frame_values` does of a column of words: dates are in the order of time, other words in that in which
    they come, unless that is the alphabet's: then their numbers count.
    """
    _require_all(table, column, np.array([word != "" for word in words]))
    order = list(dict.fromkeys(words))
    if seconds := clock_seconds(order):
        moments = dict(zip(order, seconds))
        told = np.array([moments[word] for word in words])
        return told, told, True
    names = [parse_name(word) for word in order]
    if order == sorted(order) and len({name.shape for name in names}) == 1 and len(NumberColumns(names).varying()) == 1:
        order.sort(key=natural_key)  # one number counts them
    places = {word: k for k, word in enumerate(order)}
    return np.array([places[word] for word in words]), None, False


def _require_all(table: Table, column: str, filled: np.ndarray) -> None:
    bad = np.flatnonzero(~filled)
    if len(bad):
        raise DataError(
            f"{table.path}: {counted(len(bad), 'row')} without a number in {column!r}, the first is {bad[0] + 1}"
        )


def _exact(words: list[str], values: np.ndarray) -> np.ndarray:
    """Returns whole numbers as they are written, i64 (N): beyond 2^53 floats are the same for several of them. Others stay
    the floats ``values``.
    """
    try:
        numbers = [int(word) for word in words]
        least = min(numbers) if max(numbers) >= 2**63 else 0
        return np.array([number - least for number in numbers], np.int64)
    except (ValueError, OverflowError):
        return values


def _in_folders(table: Table, column: str) -> str:
    """Returns what to do where the folders of a divided table name the values of a column, as in ``frame=3/part-0.parquet``."""
    told = next((part for part in table.path.parts if part.startswith(f"{column}=")), "")
    joined = "pandas.read_parquet(FOLDER).to_parquet(FILE)"
    return f". Its folder {told} tells it: join the pieces into one table, such as by {joined}" if told else ""


def _groups(table: Table, column: str, count: int) -> list[tuple[str, np.ndarray]]:
    if not column:
        return [("", np.arange(count))]
    if column not in table.names:
        known = ", ".join(table.names)[:200]
        raise DataError(
            f"{table.path}: --sequence-column {column}: no such column; found {known}{_in_folders(table, column)}"
        )
    words, first, group = np.unique(table.words(table.names.index(column)), return_index=True, return_inverse=True)
    if "" in words:
        raise DataError(f"{table.path}: a row has nothing in its column {column!r}; expected the name of its sequence")
    rows = np.split(np.argsort(group, kind="stable"), np.cumsum(np.bincount(group))[:-1])
    return [(str(words[place]).replace("/", "_"), rows[place]) for place in np.argsort(first)]


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
    notes += [ROUNDED] if numbers is not None and _are_rounded(values) else []
    notes += [FELL] if falls and not joined and numbers is not None else []
    return Rows(name, rows[order], offsets, None if numbers is None else values, joined=joined, notes=tuple(notes))


def _are_rounded(numbers: np.ndarray) -> bool:
    """Returns whether large numbers (T) are all such as float32 has, whose neighbors there are 128 or more apart."""
    with np.errstate(over="ignore", invalid="ignore"):
        single = numbers.astype(np.float32).astype(numbers.dtype)  # whole numbers stay exact where they are compared
        return bool(len(numbers) and abs(numbers[-1]) >= _SPARSE and (single == numbers).all())


def _fills_counter(numbers: np.ndarray) -> int:
    """Returns how many values the counter has whose numbers f64 (N) go on at 0 after its last, and fall nowhere else; 0
    where they don't.
    """
    steps = np.diff(numbers)
    falls = steps[steps < 0]
    full = int(numbers.max(initial=0)) + 1
    return full if full in _FULL and len(falls) and (falls == 1 - full).all() else 0
