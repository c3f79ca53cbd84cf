"""Tables whose rows are the frames and whose columns, in threes, are the points, as motion capture and trackers write them."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.array_files.containers import SUFFIXES
from dpcli.prepare.cloud_formats.cloud import Cloud
from dpcli.prepare.cloud_formats.column_names import (
    ROWS_ARE_FRAMES,
    Table,
    TypedTable,
    note_of_units,
    one_unit,
    unit_of,
    unit_of_attributes,
    words_of,
)
from dpcli.prepare.cloud_formats.parquet import COLUMNAR, ParquetTable
from dpcli.prepare.cloud_formats.text_numbers import TextTable, delimiter_of, names_in, seconds_by_name
from dpcli.prepare.named_columns import ArrayTable
from dpcli.prepare.scans.frames_of_tables import Rows
from dpcli.text_files import decode_text

COLUMNS = "columns"
_LOOKED_AT = 30  # lines among which the names are looked for
_UNIT = re.compile(r"(length[ _]?)?units?:?", re.IGNORECASE)
_COUNT = re.compile(r"NumFrames|Total Exported Frames", re.IGNORECASE)
MISSING = "frames missing that the head of their table counts; is the copy whole?"
_NO_PLACES = frozenset(  # words of columns in threes that are no place of a point
    "velocity velocities vel speed acceleration accelerations acc accel gyro gyroscope gyr magnetometer mag imu jerk"
    " rotation rotations rot quaternion quaternions quat orientation orientations euler angle angles angular linear"
    " force forces moment moments torque torques power normal normals direction dir gaze scale size dimensions std"
    " stdev sigma var variance cov err error rms rmse uncertainty confidence residual".split()
)


@dataclass(frozen=True)
class WideTable:
    """Holds a table and which of its columns are points. trios: the places of x, y and z of each, i64 (M,3); unit: of the
    coordinates, "" where nothing tells it; missing: how many rows fewer there are than the lines above the names count.
    """

    table: Table
    trios: np.ndarray
    unit: str
    missing: int = 0

    def cloud(self, keep: Sequence[str]) -> Cloud:
        """Returns the points of all rows, M after M, with the place of each in its row as its identity."""
        if keep:
            raise DataError(f"{self.table.path}: --keep-fields {keep[0]}: columns of rows, not of points; leave it out")
        values = self.table.columns(self.trios.ravel().tolist())
        names = tuple(self.table.names[place] for place in self.trios.ravel())
        identities = np.tile(np.arange(len(self.trios)), len(values))
        dropped = {MISSING: self.missing} if self.missing else {}
        dropped |= note_of_units(names, self.table.units) if isinstance(self.table, TypedTable) else {}
        points = values.reshape(-1, 3)
        return Cloud(points, unit=self.unit, columns=names, dropped=dropped, track=identities)

    def rows(self) -> list[Rows]:
        """Returns the one sequence of a table without a column of frames: its rows as they come."""
        count = len(self.table.columns([int(self.trios[0, 0])]))
        return [Rows("", np.arange(count), np.arange(count + 1), None)]

    def spread(self, part: Rows) -> Rows:
        """Returns a sequence of rows as one of points. Raises DataError where a frame has several rows."""
        points = len(self.trios)
        if len(part.rows) != len(part.offsets) - 1:
            raise DataError(
                f"{self.table.path}: --track columns: {len(part.rows)} rows for {len(part.offsets) - 1} frames; expected one row"
                " for each frame of a sequence (--sequence-column tells sequences apart)"
            )
        rows = (part.rows[:, None] * points + np.arange(points)).reshape(-1)
        return replace(part, rows=rows, offsets=part.offsets * points)


def read_wide(path: Path) -> WideTable:
    """Reads a table whose rows are frames: several lines of names above one another, and one of units, are read, too.

    Raises DataError where fewer than two points are found in its columns.
    """
    if path.suffix.lower() in (*COLUMNAR, *SUFFIXES):
        columnar = ParquetTable(path) if path.suffix.lower() in COLUMNAR else ArrayTable(path)
        return _checked(path, columnar, [[name] for name in columnar.names], "")
    lines = decode_text(path).split("\n")
    head = [names_in(line.strip(" \r\0"), None) for line in lines[:_LOOKED_AT]]
    for number, names in enumerate(head):
        if len(_trios([[name] for name in names])) < 2:
            continue
        above = _of_columns(head[:number])
        width = max(map(len, (*above, names)))  # the lowest cell of the last column may be empty
        told = [[row[place] if place < len(row) else "" for row in (*above, names)] for place in range(width)]
        named = _named(told)
        unit, start = _unit_above(head[:number]), number + 1
        while start < len(lines) and not lines[start].strip():
            start += 1
        below = names_in(lines[start].strip(" \r\0"), None) if start < len(lines) else []
        seconds: tuple[tuple[str, float], ...] = ()
        if units := {unit_of(f"x {word}") for word in below if word} - {""}:
            unit, start, seconds = one_unit(units), start + 1, seconds_by_name(named, below)
        body = "\n".join(lines[start:])
        delimiter = delimiter_of(body.split("\n", 1)[0].strip(" \r"))
        table = TextTable(path, named, body, start + 1, delimiter, seconds=seconds)
        counts = [int(word) for word in _told_above(head[:number], _COUNT) if word.isdecimal()]
        return replace(_checked(path, table, told, unit), missing=max(max(counts, default=0) - table.rows, 0))
    raise DataError(f"{path}: --track columns: no columns of several points, such as hip_x, hip_y, hip_z, knee_x, ...")


def hint(path: Path, error: DataError) -> DataError:
    """Returns an error of a table that was read with a point in each row, which says so where its rows may be frames instead."""
    try:
        read_wide(path)
    except (DataError, OSError):
        return error
    return error if ROWS_ARE_FRAMES in str(error) else DataError(f"{error}; {ROWS_ARE_FRAMES}")


def _checked(path: Path, table: Table, told: list[list[str]], unit: str) -> WideTable:
    trios = _trios(told)
    if len(trios) < 2:
        raise DataError(f"{path}: --track columns: {len(trios)} points in the columns; expected two or more")
    if isinstance(table, TextTable) and not table.first_rows(1):
        raise DataError(f"{path}: a header, but no rows; expected numbers in columns")
    own = one_unit({unit_of(table.names[place]) for trio in trios for place in trio})
    if isinstance(table, TypedTable):
        unit = unit_of_attributes(path, [table.names[place] for trio in trios for place in trio], table.units)
    return WideTable(table, np.array(trios), own or unit)


def _trios(told: list[list[str]]) -> list[tuple[int, int, int]]:
    """Returns the places of x, y and z of every point. told: the names of each column, the lowest last.

    Of columns called alike the first x goes with the first y and z. Columns of velocities, angles and the like are no points,
    nor are three beside a w below the same names: a quaternion.

    >>> _trios([["frame"], ["a_x"], ["a_y"], ["a_z"], ["rot", "x"], ["", "y"], ["", "z"]])
    [(1, 2, 3)]
    >>> _trios([*([name, axis] for name, axes in (("Rotation", "XYZW"), ("Position", "XYZ")) for axis in axes)])  # Motive's
    [(4, 5, 6)]
    """
    places: dict[tuple[str, ...], dict[str, list[int]]] = defaultdict(lambda: defaultdict(list))
    for place, names in enumerate(told):
        words = words_of(names[-1]) if names else []
        axes = [word for word in words if word in ("x", "y", "z", "w")]
        if len(axes) == 1:
            places[tuple(word for word in words if word != axes[0])][axes[0]].append(place)
    found = []
    for axes in places.values():
        beside = [(last, place) for place in axes.get("w", []) for last in (place - 1, place + 3) if last < len(told)]
        turns = {last for last, place in beside if told[last][:-1] == told[place][:-1]}
        if len({len(axes.get(axis, [])) for axis in "xyz"}) == 1:
            found += [trio for trio in zip(axes["x"], axes["y"], axes["z"]) if trio[2] not in turns]
    words = [{word for place in trio for name in told[place] for word in words_of(name)} for trio in found]
    return sorted(trio for trio, own in zip(found, words) if not own & _NO_PLACES)


def _named(told: list[list[str]]) -> tuple[str, ...]:
    """Returns the lowest name of each column, with those above it where several columns have the same."""
    filled = [[word for word in words if word] for words in told]
    counts = Counter(words[-1] for words in filled if words)
    return tuple(" ".join(words if words and counts[words[-1]] > 1 else words[-1:]) for words in filled)


def _of_columns(head: list[list[str]]) -> list[list[str]]:
    """Returns those of the lines above the names that tell of the columns: behind the last empty line, and not of the unit."""
    start = max((number + 1 for number, row in enumerate(head) if not any(row)), default=0)
    return [row for row in head[start:] if len(row) > 2 and not any(map(_UNIT.fullmatch, row))]


def _unit_above(head: list[list[str]]) -> str:
    """Returns the unit that the lines above the names tell; "" where they tell none."""
    return next((unit for word in _told_above(head, _UNIT) if (unit := unit_of(f"x {word}"))), "")


def _told_above(head: list[list[str]], what: re.Pattern[str]) -> list[str]:
    """Returns the cells behind and below those of the lines above the names that say ``what`` they tell, as ``Length Units``."""
    found = []
    for row, below in zip(head, [*head[1:], []]):
        for place in (place for place, cell in enumerate(row) if what.fullmatch(cell)):
            found += [*row[place + 1 : place + 2], *below[place : place + 1]]
    return found
