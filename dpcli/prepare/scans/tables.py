"""Tables of many frames, as radars and lidars log them: a row is a point, a column numbers the frames."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.file_cache import cached_by_file
from dpcli.path_names import as_utf8, first_names
from dpcli.prepare.array_files.containers import SUFFIXES, made_by_dpc
from dpcli.prepare.cloud_formats.cloud import Cloud, without
from dpcli.prepare.cloud_formats.column_names import (
    ROWS_ARE_FRAMES,
    Table,
    find_frame_column,
    find_further_points,
    find_recording_columns,
)
from dpcli.prepare.cloud_formats.parquet import COLUMNAR, ParquetTable
from dpcli.prepare.cloud_formats.text_cloud import EMPTY, cloud_of_table
from dpcli.prepare.cloud_formats.text_numbers import TextTable, read_text_table
from dpcli.prepare.decode.folder_listing import named_below, walk_folders
from dpcli.prepare.named_columns import ArrayTable
from dpcli.prepare.reader import Item, Sample, natural_key
from dpcli.prepare.scans.assembling import OwnScans
from dpcli.prepare.scans.cloud_series import left_out_below, refuse_file
from dpcli.prepare.scans.frames_of_tables import JOINED, SILENT, SINGLE, Rows, frame_column, split_rows
from dpcli.prepare.scans.times_of_tables import Clock, find_clocks
from dpcli.prepare.scans.tracked_points import ROWS, identify, name_rows
from dpcli.prepare.series import is_hidden
from dpcli.prepare.wide_tables import COLUMNS, hint, read_wide
from dpcli.runtime.clips.other_files import stand_in

TABLES = (".csv", ".tsv", ".parquet", ".feather", ".arrow", ".txt", ".xyz", ".asc", ".trc")
MIXED = (
    "sequences whose frames mix the values of the column {0!r}; if it names the recordings, give --sequence-column {0}"
)
WIDE = "sequences of which one point of a row was read, {}; others were not, such as {}; " + ROWS_ARE_FRAMES
_PIECE = re.compile(r"(.*/)?(part[-.]\d+([-.].*)?|.*-\d{5}-of-\d{5})")  # as Spark, pyarrow, Dask and others name them
PIECES = (
    "{0} are called like pieces of one table; each is read as sequences of its own. If they are pieces, join them, such as by"
    " pandas.read_parquet(FOLDER).to_parquet(FILE)"
)
_LABELS = re.compile(r"action|activity|gesture", re.IGNORECASE)  # in a column's name; a label may be that of a point
LABELED = (
    "labels are not read from column {0!r}; where it tells what a sequence shows, give --labels a table name,label with a row for"
    " each sequence, whose names are like {1}"
)
_FEW = 5  # frames of one point that may be true
_OTHER_RATE = 0.05  # of a rate that was given, from which the times of a column differ by as much


@dataclass(frozen=True)
class TableSequences(OwnScans):
    """Reads one table, or those of a folder. frame_column: "" for the one whose name says it; the rest as `OwnScans`
    and `split_rows` have it.
    """

    frame_column: str = ""
    sequence_column: str = ""
    gap: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gap is not None and not self.gap > 0:
            raise UsageError(f"--gap {self.gap:g}: expected more than 0, in the numbers of the frame column")

    @property
    def fields(self) -> tuple[str, ...]:
        time, color = self._first
        return self.fields_beside(time=time, color=color)

    @cached_property
    def _paths(self) -> dict[str, Path]:
        """Returns the tables by the names of their sequences."""
        if self.raw.suffix.lower() not in SUFFIXES:
            refuse_file(self.raw, ())
        if self.raw.is_file():
            return {as_utf8(self.raw.stem): self.raw}
        if not self.raw.is_dir():
            raise DataError(
                f"{self.raw}: does not exist; expected a table ({', '.join((*TABLES, *SUFFIXES))}), or a folder of tables"
            )
        labels = self.labels.resolve() if self.labels else None
        found = [path for path in _tables_below(self.raw, TABLES) if path.resolve() != labels]
        found = found or [path for path in _tables_below(self.raw, SUFFIXES) if not made_by_dpc(path)]
        if not found:
            raise DataError(f"{self.raw}: no tables ({', '.join((*TABLES, *SUFFIXES))})")
        return named_below(self.raw, found, "table")

    @cached_property
    def _first(self) -> tuple[bool, bool]:
        """Returns whether the frames of the first good table have times, and whether it has colors."""
        for path in self._paths.values():
            try:
                loaded = _load(path, self)
            except DataError:
                continue  # a bad sample: the next one tells
            timed = all(loaded.times(part, self.fps) is not None for part in loaded.parts)
            return timed, loaded.cloud.color is not None
        return bool(self.fps), False

    def _in_folders(self) -> tuple[list[str], str]:
        return [item.name for item in self._items], "CLASS/TABLE"

    @cached_property
    def _items(self) -> list[Item]:
        items = []
        time, color = self._first
        for name, path in self._paths.items():
            try:
                parts = _load(path, self).parts
            except DataError as error:
                items.append(Item(name, path, problem=str(error)))
                continue
            for place, part in enumerate(parts):
                own = f"{name}/{as_utf8(part.name)}" if part.name else name
                extra = {"part": place, "time": time, "color": color}
                items.append(Item(own, path, extra=extra))
        return items

    def items(self) -> list[Item]:
        return self._table.apply(self._items)

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        loaded = _load(item.path, self)
        part = loaded.parts[item.extra["part"]]
        if item.extra["color"] and loaded.cloud.color is None:
            raise DataError(f"{item.path}: no colors, though the first table of all has them")
        time = loaded.times(part, self.fps)
        if item.extra["time"] and time is None:
            raise DataError(f"{item.path}: no column holds rising times, though the first table has one")
        clouds = loaded.frames(part)[:: self.stride]
        dropped = loaded.cloud.dropped
        if self.track == ROWS:
            identify(item.path, [replace(clouds[0], dropped=dropped), *clouds], ROWS, self.keep)
        if item.extra["part"]:  # the first sequence told the table's
            dropped = {what: count for what, count in dropped.items() if what != EMPTY}
        time = time[:: self.stride] if time is not None and item.extra["time"] else None
        silent = 0 if time is not None or part.joined else part.silent
        notes = {**dropped, **dict.fromkeys(part.notes, 1), JOINED: part.joined, SILENT: silent}
        sample = self._assembled(item, clouds, time, notes)
        mixed = next((name for name in loaded.recordings if loaded.mixes(part, name)), None)
        if mixed:
            sample.note({MIXED.format(mixed): 1})
        further = [] if self.track == COLUMNS else find_further_points(without(loaded.unused, self.keep))
        if further:
            sample.note({WIDE.format(", ".join(loaded.cloud.columns[:3]), ", ".join(further)): 1})
        elif len(clouds) > _FEW and all(len(cloud.points) == 1 for cloud in clouds):
            sample.note({SINGLE: 1})
        return sample

    def summary(self, items: list[Item]) -> list[str]:
        tables = len(self._paths)
        lines = [f"{counted(len(items), 'sequence')} in {counted(tables, 'table')}"]
        good = next((item for item in items if not item.problem), None)
        if good:
            loaded = _load(good.path, self)
            first = loaded.parts[0]
            used = self._first[0] and first.times(loaded.column, self.fps) is None and loaded.clock(first)
            clock = used.columns if used else ()
            unused = ", ".join(name for name in loaded.unused if name not in (*self.keep, self.track, *clock))
            lines[0] += f", frames by column {loaded.column!r}" if loaded.column else ", a frame in each row"
            if clock:
                lines[0] += f", times by column {' and '.join(map(repr, clock))}"
            lines[0] += f"; not read: {unused}" if unused else ""
            lines[0] += " (--keep-fields)" if unused and self.track != COLUMNS else ""
            told = first.times(loaded.column, None) if self.fps else None
            rate = 1 / float(np.median(np.diff(told))) if told is not None and len(told) > 1 else self.fps
            if self.fps and abs(rate / self.fps - 1) > _OTHER_RATE:
                lines.append(
                    f"--fps {self.fps:g} is not used: column {loaded.column!r} tells the times, {rate:.3g} frames a second"
                )
            labels = [] if self._table.rows else list(filter(_LABELS.search, loaded.unused))
            lines += [LABELED.format(labels[0], good.name)] if labels else []
        pieces = [name for name in self._paths if _PIECE.fullmatch(name)]
        lines += [PIECES.format(first_names(pieces, 2))] if len(pieces) > 1 else []
        read = {path.suffix.lower() for path in self._paths.values()}
        lines += left_out_below(self.raw, (*TABLES, *read))
        return lines + self._table.unnamed(items)


@dataclass(frozen=True)
class Loaded:
    """Holds a table that was read: all its points, its sequences, the frame column, columns that were not asked for, the
    times that some of these tell, and the numbered values i64 (N) of those whose names say that they tell recordings apart.
    """

    cloud: Cloud
    parts: list[Rows]
    column: str
    unused: tuple[str, ...]
    clocks: list[Clock]
    recordings: dict[str, np.ndarray]

    def mixes(self, part: Rows, name: str) -> bool:
        """Returns whether a frame of a sequence has several values of a column that tells recordings apart."""
        values, starts = self.recordings[name][part.rows], part.offsets[:-1]
        return bool((np.minimum.reduceat(values, starts) < np.maximum.reduceat(values, starts)).any())

    def times(self, part: Rows, fps: float | None) -> np.ndarray | None:
        """Returns seconds since the first frame, f64 (T): by the frame column or ``fps``, else by a clock; else None."""
        told = part.times(self.column, fps)
        clock = self.clock(part) if told is None else None
        return part.times_by(clock) if clock else told

    def clock(self, part: Rows) -> Clock | None:
        """Returns the first clock whose times rise from frame to frame of a sequence; None without one."""
        return next((one for one in self.clocks if part.times_by(one) is not None), None)

    def frames(self, part: Rows) -> list[Cloud]:
        """Returns the frames of one sequence."""
        found = [replace(self.cloud, dropped={}) for _ in part.offsets[1:]]
        for frame, start, stop in zip(found, part.offsets[:-1], part.offsets[1:]):
            frame.keep(part.rows[start:stop])
        return found


@cached_by_file(2)  # a table holds many sequences; each process reads it once
def _load(path: Path, reader: TableSequences) -> Loaded:
    if not path.stat().st_size:
        raise DataError(f"{path}: the file is empty")
    in_columns = reader.track == COLUMNS
    try:
        wide = read_wide(path) if in_columns else None
        table = wide.table if wide else open_table(path)
        told = reader.frame_column or reader.sequence_column or reader.gap or find_frame_column(table.names)
        rows_count = wide is not None and not told
        column = "" if rows_count else frame_column(table, reader.frame_column)
        cloud = wide.cloud(reader.keep) if wide else cloud_of_table(table, reader.keep)
    except DataError as error:
        raise (stand_in(path) or (error if in_columns else hint(path, error))) from None
    if isinstance(table, TextTable) and (empty := table.empty_rows):
        cloud.dropped = {**cloud.dropped, EMPTY: empty}
    if reader.track not in ("", ROWS, COLUMNS):
        cloud.track = name_rows(table, reader.track)
    apart = {*cloud.columns, column, reader.sequence_column}
    beside = table.others if isinstance(table, ArrayTable) else ()
    unused = (*(name for name in table.names if name and name not in apart), *beside)
    named = [] if reader.sequence_column else find_recording_columns(without(unused, beside))
    recordings = {name: np.unique(table.words(table.names.index(name)), return_inverse=True)[1] for name in named}
    parts = wide.rows() if rows_count else split_rows(table, column, reader.sequence_column, reader.gap)
    clocks = find_clocks(table, without(unused, beside))
    if wide:
        parts, points = [wide.spread(part) for part in parts], len(wide.trios)
        clocks = [replace(clock, seconds=np.repeat(clock.seconds, points)) for clock in clocks]
        recordings = {name: np.repeat(values, points) for name, values in recordings.items()}
    return Loaded(cloud, parts, column, unused, clocks, recordings)


def open_table(path: Path) -> Table:
    """Returns the table in a file of any format. Raises DataError where it holds none."""
    suffix = path.suffix.lower()
    return (
        ArrayTable(path) if suffix in SUFFIXES else ParquetTable(path) if suffix in COLUMNAR else read_text_table(path)
    )


def _tables_below(folder: Path, suffixes: tuple[str, ...]) -> Iterator[Path]:
    for place, folders, names in walk_folders(folder):
        folders.sort(key=natural_key)
        for name in sorted(names, key=natural_key):
            if name.lower().endswith(suffixes) and not is_hidden(name):
                yield Path(place) / name
