"""Parquet and Feather tables, by pyarrow, which is an extra: it is large, and few have such tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError, DpcError, reading
from dpcli.npy_files import require_room
from dpcli.prepare.cloud_formats.cloud import Cloud
from dpcli.prepare.cloud_formats.column_names import TypedTable, find_axes, seconds_in_brackets, words_of

COLUMNAR = (".parquet", ".feather", ".arrow")
_CELL = 8  # bytes of a number
_DAY = 86_400.0  # seconds
_QUATERNION = {"qw", "qx", "qy", "qz"}


def is_pose_table(path: Path) -> bool:
    """Returns whether the columns of a Parquet or Feather file are called quaternions and no x, y and z, as those of Argoverse 2
    beside its clouds; the rows aren't read, and False is returned where the columns can't be.
    """
    try:
        import pyarrow.ipc
        import pyarrow.parquet

        if path.suffix.lower() == ".parquet":
            names = pyarrow.parquet.read_schema(path).names
        else:
            with pyarrow.memory_map(str(path)) as file:
                names = pyarrow.ipc.open_file(file).schema.names
        return _QUATERNION <= set(names) and find_axes(names) is None
    except Exception:  # reading says what is wrong: no pyarrow, another form of Feather, damage, twice the same name
        return False


class ParquetTable(TypedTable):
    """Reads a Parquet or Feather file, whose attributes are the metadata of its schema."""

    def __init__(self, path: Path) -> None:
        try:
            import pyarrow.parquet as parquet
        except ImportError:
            raise DpcError('Parquet and Feather need pyarrow: pip install "dpc-toolkit[parquet]"') from None
        with reading(path):  # whose sentence is that of memory that ends
            try:
                if path.suffix.lower() != ".parquet":
                    self._table: Any = _read_feather(path)
                else:
                    about = parquet.read_metadata(path)
                    require_room(path, _CELL * about.num_rows * about.num_columns)
                    self._table = parquet.read_table(path)
            except (DataError, MemoryError):
                raise
            except Exception as error:  # pyarrow.ArrowInvalid, OSError on truncated footers
                kind, said = path.suffix[1:].capitalize(), " ".join(str(error).split())
                raise DataError(f"{path}: not a readable {kind} table, perhaps truncated ({said})") from None
        self._table = self._table.flatten()  # a column of structures becomes one for each of their fields
        schema = self._table.schema
        told = {field.name: _told_units(field.metadata) for field in schema} | {"": _told_units(schema.metadata)}
        units = {name: units for name, units in told.items() if units}
        super().__init__(path, self._table.column_names, units)

    def columns(self, places: Sequence[int]) -> np.ndarray:
        from pyarrow.types import is_temporal

        found = []
        for place in places:
            column = self._table.column(place)
            try:
                if is_temporal(column.type):
                    raise ValueError("times are no numbers")
                found.append(column.to_numpy().astype(np.float64))
            except (TypeError, ValueError):
                kind = "lists" if "list" in str(column.type) else f"no numbers ({column.type})"
                raise DataError(
                    f"{self.path}: column {self.names[place]!r} holds {kind}; expected a row for each point"
                ) from None
        return np.stack(found, axis=1) if found else np.zeros((self._table.num_rows, 0))

    def words(self, place: int) -> list[str]:
        return [
            "" if value is None or value != value else str(value) for value in self._table.column(place).to_pylist()
        ]

    def moments(self, place: int) -> np.ndarray | None:
        import pyarrow.types as types

        column = self._table.column(place)
        parts = _parts_of_second(column.type)
        told = self.units.get(self.names[place], "").split()[:1]
        numbers = types.is_integer(column.type) or types.is_floating(column.type)
        if numbers and told and (unit := seconds_in_brackets(" ".join(words_of(told[0])))):
            values = self.columns([place])[:, 0]
            known = values[np.isfinite(values)]
            return (values - known[0]) * unit if len(known) else None
        if not parts:
            return None
        kind = "int32" if column.type.bit_width == 32 else "int64"
        whole = column.cast(kind)
        known = whole.drop_null()
        first = known[0].as_py() if len(known) else 0
        counted = (whole.fill_null(first).to_numpy() - first) / parts
        counted = past_midnight(counted) if types.is_time(column.type) else counted
        return np.where(column.is_valid().to_numpy(), counted, np.nan)


def _told_units(metadata: Mapping[bytes, bytes] | None) -> str:
    about = metadata or {}
    return about.get(b"units", about.get(b"unit", b"")).decode("utf-8", "replace")


def past_midnight(seconds: np.ndarray) -> np.ndarray:
    """Returns times of day f64 (N), in seconds, as times that go on: where one that is new falls by more than half a day, a day
    begins.

    >>> past_midnight(np.array([86399.0, 86399.0, 0.5, 86399.0, 1.0])).tolist()
    [86399.0, 86399.0, 86400.5, 86399.0, 86401.0]
    """
    _, first, place = np.unique(seconds, return_index=True, return_inverse=True)
    order = np.argsort(first)
    days = np.zeros(len(first))
    days[order] = np.append(0, np.cumsum(np.diff(seconds[first[order]]) < -_DAY / 2))[: len(first)]
    return seconds + days[place] * _DAY


def _parts_of_second(kind: Any) -> int:
    """Returns how many units of a type of times or durations make a second; 0 of types that hold none."""
    import pyarrow.types as types

    if not (types.is_timestamp(kind) or types.is_time(kind) or types.is_duration(kind)):
        return 0
    return {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[kind.unit]


def _read_feather(path: Path) -> Any:
    """Returns the table of a Feather file (Arrow's), batch after batch, so that one that claims too much ends early."""
    import pyarrow

    with pyarrow.memory_map(str(path)) as file:
        begin = file.read(4)
        streamed = begin == b"\xff\xff\xff\xff"
        if begin == b"FEA1":
            raise DataError(f"{path}: Feather of version 1; write it again, as version 2")
        file.seek(0)
        with (pyarrow.ipc.open_stream if streamed else pyarrow.ipc.open_file)(file) as reader:
            batches, taken = [], 0
            for batch in reader if streamed else map(reader.get_batch, range(reader.num_record_batches)):
                batches.append(batch)
                taken += batch.nbytes
                require_room(path, taken)
            return pyarrow.Table.from_batches(batches, reader.schema)


def read_parquet(path: Path, keep: Sequence[str] = ()) -> Cloud:
    """Reads one cloud from a table with columns x, y and z."""
    from dpcli.prepare.cloud_formats.text_cloud import cloud_of_table, refuse_frames_of_table

    table = ParquetTable(path)
    refuse_frames_of_table(table)
    return cloud_of_table(table, keep)
