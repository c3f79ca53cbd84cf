"""Sorts the rows of a table into frames of sequences: by a column of frames, one of sequences, and gaps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.column_names import find_frame_column, words_of

_SECONDS = {"s": 1.0, "sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_EPOCHS = {10: 1.0, 13: 1e-3, 16: 1e-6, 19: 1e-9}  # digits of a time since 1970 -> seconds
_TIME_WORDS = frozenset(("time", "timestamp", "stamp", "t", "timestamps", "epoch", "utc"))
SINGLE = (
    "sequences whose frames hold one point each; does the frame column tell the time of each point? (--frame-column)"
)
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
    after frame; offsets: i64 (T+1); frames: what the frame column holds, f64 (T), None for words; joined: how many frames
    lay in several places.
    """

    name: str
    rows: np.ndarray
    offsets: np.ndarray
    frames: np.ndarray | None
    joined: int = 0

    def times(self, column: str, fps: float | None) -> np.ndarray | None:
        """Returns seconds since the first frame, f64 (T): what the column tells, or its numbers by ``fps``; else None."""
        if self.frames is None:
            return np.arange(len(self.offsets) - 1) / fps if fps else None
        since = self.frames - self.frames[0]
        unit = seconds_of(column, self.frames)
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
    frames, numbers = _frame_values(table, column)
    if gap is not None and numbers is None:
        raise DataError(f"{table.path}: --gap needs numbers in {column!r}; it holds words such as {frames[0]!r}")
    groups = _groups(table, sequence_column, len(frames))
    found = []
    for name, rows in groups:
        parts = [rows] if gap is None else _cut(frames, rows, gap)
        for k, part in enumerate(parts):
            names = [*([name] if sequence_column else []), *([f"{k:03d}"] if gap is not None else [])]
            found.append(_in_frames("/".join(names), frames, numbers, part))
    return found


def _frame_values(table: Table, column: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Returns what orders the rows (numbers, or places of words in the order they first occur), and the numbers."""
    place = table.names.index(column)
    try:
        values = table.columns([place])[:, 0]
    except DataError:
        words = table.words(place)
        order = {word: k for k, word in enumerate(dict.fromkeys(words))}
        return np.array([order[word] for word in words]), None
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise DataError(f"{table.path}: {len(bad)} rows, the first is {bad[0] + 1}, have no number in {column!r}")
    return values, values


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
    runs = 1 + int(np.count_nonzero(np.diff(own)))
    order = np.argsort(own, kind="stable")
    values, starts = np.unique(own[order], return_index=True)
    offsets = np.append(starts, len(rows)).astype(np.int64)
    return Rows(name, rows[order], offsets, None if numbers is None else values, runs - len(values))
