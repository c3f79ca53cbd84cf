"""Tables in files of arrays: structured arrays, HDF5's compound types (PyTables, pandas), and equally long arrays side by side."""

from __future__ import annotations

import math
import pickletools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.file_cache import cached_by_file
from dpcli.path_names import first_names
from dpcli.prepare.array_files.attributes import told_beside, told_units
from dpcli.prepare.array_files.choosing import POINT_KEYS, find_sources, says_times
from dpcli.prepare.array_files.containers import SUFFIXES, made_by_dpc, open_arrays, read_tables
from dpcli.prepare.array_files.netcdf_packing import with_gaps
from dpcli.prepare.cloud_formats.column_names import (
    TypedTable,
    find_axes,
    find_colors,
    find_frame_column,
    find_trios,
    first_unit,
)
from dpcli.prepare.scans.times_of_tables import seconds_of

Columns = dict[str, np.ndarray]
Found = tuple[Columns, dict[str, str], tuple[str, ...]]  # columns, units of some, names of what lies beside them


class ArrayTable(TypedTable):
    """Reads the table in a file of arrays. by_name: the columns as stored. others: the names of arrays beside it that are no columns.

    Raises DataError where the file holds no table, or several.
    """

    def __init__(self, path: Path) -> None:
        found = _tables_of(path)
        if len(found) != 1:
            others = [f"{name} of {first_names(list(columns), 5)}" for name, (columns, _) in read_tables(path).items()]
            beside = f" ({first_names(others, 2)})" if others else ""
            told = (
                f"several tables ({first_names(list(found), 5)})"
                if found
                else f"no table of columns x, y and z{beside}"
            )
            raise DataError(
                f"{path}: holds {told}; expected one: write it as .csv or .parquet (pandas: DataFrame.to_csv)"
            )
        ((self.by_name, units, self.others),) = found.values()
        super().__init__(path, tuple(self.by_name), units)

    def columns(self, places: Sequence[int]) -> np.ndarray:
        chosen = [self.by_name[self.names[place]] for place in places]
        for place, column in zip(places, chosen):
            if column.dtype.kind not in "uifb":
                raise DataError(f"{self.path}: column {self.names[place]!r} holds no numbers ({column.dtype})")
        rows = len(next(iter(self.by_name.values())))
        return np.stack([column.astype(np.float64) for column in chosen], axis=1) if chosen else np.zeros((rows, 0))

    def words(self, place: int) -> list[str]:
        cells = self.by_name[self.names[place]].tolist()
        return [one.decode("utf-8", "replace") if isinstance(one, bytes) else str(one) for one in cells]

    def moments(self, place: int) -> np.ndarray | None:
        name = self.names[place]
        column = self.by_name[name]
        if column.dtype.kind in "mM" and len(column):
            since = column.astype(f"{column.dtype.str[1]}8[ns]")
            known = ~np.isnat(since)
            first = since[known][0] if known.any() else since[0]
            return np.where(known, (since - first) / np.timedelta64(1, "s"), np.nan)
        told = self.units.get(name, "").split()[:1]
        unit = seconds_of(f"t [{told[0]}]", column[:1]) if told and column.dtype.kind in "uif" and len(column) else 0.0
        column = column.astype(np.int64) if column.dtype.kind in "ui" else column  # whose differences don't wrap around
        return (column - column[0]).astype(np.float64) * unit if unit else None


def holds_table(path: Path) -> bool:
    """Returns whether a file of arrays holds points in the rows of a table, one of whose columns may number the frames, and no
    array of clouds.
    """
    if not path.is_file() or path.suffix.lower() not in SUFFIXES or made_by_dpc(path):
        return False
    try:
        with open_arrays(path) as arrays:
            if find_sources(arrays):
                return False
    except (DataError, OSError):  # reading says so
        return False
    try:
        return len(_tables_of(path)) == 1
    except DataError:  # of a filter that is missing
        return True


@cached_by_file(1)  # which is asked for again when the table is opened
def _tables_of(path: Path) -> dict[str, Found]:
    """Returns the tables of points in a file by name: their columns (N each), what attributes say of the units of some, and
    what lies beside them.

    Equally long arrays that lie side by side are one where a name says which of them numbers the frames.
    """
    found = {}
    for name, (table, kinds) in read_tables(path).items():
        columns = _columns_of(table, kinds)
        found |= {name: (columns, {"": str(kinds.get("units", ""))}, ())} if _are_points(columns) else {}
    return found or _side_by_side(path)


def _columns_of(table: Mapping[str, np.ndarray], kinds: Mapping[str, Any]) -> Columns:
    """Returns the columns of one table; those of several numbers a row by the names that pandas tells, or numbered."""
    found: Columns = {}
    for name, values in table.items():
        values = values.reshape(len(values), int(np.prod(values.shape[1:])))
        names = _names_of_block(kinds.get(f"{name}_kind")) if name.startswith("values_block_") else [name]
        if len(names) != values.shape[1]:
            names = _spread(name, values.shape[1])
        if "datetime64" in str(kinds.get(f"{name}_dtype", "")) and values.dtype.kind == "i":
            values = values.astype("M8[ns]")
        found |= dict(zip(names, values.T))
    return found


def _spread(name: str, count: int) -> list[str]:
    if name.lower() in POINT_KEYS and count >= len("xyz"):
        return [*"xyz", *(f"{name}:{place}" for place in range(3, count))]
    return [f"{name}:{place}" for place in range(count)]


def _names_of_block(pickled: Any) -> list[str]:
    """Returns the texts in a pickled list of names, which is taken apart and not loaded; [] of anything else."""
    try:
        return [argument for code, argument, _ in pickletools.genops(bytes(pickled)) if "UNICODE" in code.name]
    except (TypeError, ValueError, UnicodeDecodeError):
        return []


def _are_points(columns: Columns) -> bool:
    try:
        return find_axes(list(columns)) is not None or len(find_trios(list(columns))) > 1  # several points in a row
    except DataError:  # reading says which are several
        return True


def _side_by_side(path: Path) -> dict[str, Found]:
    """Returns the tables of arrays (N), or (N,3 and more) called points, that lie in one group of a file; with a time for each
    row where an array has one for each frame.
    """
    with open_arrays(path) as arrays:
        groups: dict[str, dict[str, Any]] = {}
        for name, one in arrays.items():
            group, _, own = name.rpartition("/")
            if not isinstance(one, list) and one.dtype.kind in "uifb":
                sides = [length for length in one.shape if length != 1]
                if len(sides) == 1 or (len(sides) == 2 and own.lower() in POINT_KEYS and 3 <= one.shape[1] <= 10):
                    groups.setdefault(group, {})[own] = one
        found = {}
        for group, own in groups.items():
            frames = find_frame_column(list(own))
            rows = max(own[frames].shape) if frames else 0
            alike = {name: one for name, one in own.items() if rows and rows in (one.shape[0], math.prod(one.shape))}
            plain = {list(alike)[place] for place in find_colors(list(alike))}  # which have no gaps
            shown = {name: one if name in plain else with_gaps(one) for name, one in alike.items()}
            columns = _columns_of({name: np.asarray(one[()]).reshape(rows, -1) for name, one in shown.items()}, {})
            if columns and _are_points(columns):
                times = _times_of_frames(own, columns[frames])
                columns |= times
                told = {name: told_units(own[name]) for name in (*alike, *times)}
                told |= {axis: units for name, units in told.items() if name.lower() in POINT_KEYS for axis in "xyz"}
                told[""] = first_unit(told_beside(arrays, f"{group}/{next(iter(alike))}".lstrip("/")))
                others = tuple(name for name in own if name not in alike and name not in times)
                found[group] = (columns, {name: units for name, units in told.items() if units}, others)
    return found


def _times_of_frames(arrays: Mapping[str, Any], frames: np.ndarray) -> Columns:
    """Returns the times (N) of rows that an array tells with one for each frame; {} without one, or where the frames' numbers
    (N) fall, so that their order isn't sure.
    """
    if not len(frames) or (frames[1:] < frames[:-1]).any():
        return {}
    known, own = np.unique(frames, return_inverse=True)
    named = [
        name for name, one in arrays.items() if says_times(name) and math.prod(one.shape) == len(known) < len(frames)
    ]
    return {name: np.asarray(arrays[name][()]).reshape(-1)[own] for name in named}
