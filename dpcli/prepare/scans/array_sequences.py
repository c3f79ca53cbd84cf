"""Arrays of many clouds: one file, or each of a folder, holds one sequence or many, as (T,N,3), (N,T,3) or (B,T,N,3)."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.path_names import as_utf8, first_names
from dpcli.prepare.array_files.attributes import told_lengths, told_units
from dpcli.prepare.array_files.axes import check_axes, coordinates_axis
from dpcli.prepare.array_files.choosing import (
    Source,
    beside_frames,
    find_beside,
    find_labels,
    find_sources,
    find_times_of_groups,
    says_label,
    says_times,
)
from dpcli.prepare.array_files.containers import SUFFIXES, made_by_dpc, open_arrays, others_inside, tables_inside
from dpcli.prepare.array_files.frame_borders import frames_beside, rows_of_axes
from dpcli.prepare.array_files.stored_sequence import StoredSequence, stored_sequence
from dpcli.prepare.cloud_formats.cloud import Cloud
from dpcli.prepare.cloud_formats.column_names import first_unit, note_of_units
from dpcli.prepare.decode.folder_listing import files_below, named_below, walk_folders
from dpcli.prepare.labels import LabelTable, Row
from dpcli.prepare.reader import Item, Sample, natural_key
from dpcli.prepare.scans.assembling import OwnScans
from dpcli.prepare.scans.cloud_series import left_out_below
from dpcli.prepare.scans.tracked_points import identify, with_track
from dpcli.prepare.series import TEXTS, is_beside, is_hidden, missing_numbers
from dpcli.runtime.clips.name_numbers import NumberColumns

MORE_FRAMES = "frames behind the counts of their files dropped"
UNCOUNTED = "points behind the counts, or outside the masks, of their files dropped"
_MOST_CLASSES = 10_000
_LOOKED_AT = 20  # files of a folder, of which the first good one tells


def holds_sequences(raw: Path, others: tuple[str, ...]) -> bool:
    """Returns whether a path is a file of arrays, or a folder whose first one holds a sequence or more and that has no clouds
    in other formats, whose suffixes are ``others``.
    """
    if raw.is_file():
        return raw.suffix.lower() in SUFFIXES
    if not raw.is_dir():
        return False
    apart = tuple(suffix for suffix in others if suffix not in (*SUFFIXES, *TEXTS))
    arrays = []
    for folder, _, names in walk_folders(raw):  # frames are many: no path is made of each
        shown = [name for name in names if not is_hidden(name)]
        if any(name.lower().endswith(apart) for name in shown):
            return False
        arrays += [os.path.join(folder, name) for name in shown if _is_array(name)]
    for path in map(Path, sorted(arrays)[:_LOOKED_AT]):
        try:
            if not made_by_dpc(path):
                with open_arrays(path) as opened:
                    return bool(find_sources(opened))
        except (DataError, OSError):
            continue  # a bad sample: the next one tells
    return False


def _is_array(name: str) -> bool:
    return name.lower().endswith(SUFFIXES) and not is_beside(name)


@dataclass(frozen=True)
class ArraySequences(OwnScans):
    """Reads arrays of many clouds. axes: their letters, as `axes.check_axes` has them, "" where shapes and values tell; the
    rest as `OwnScans` has it.
    """

    axes: str = ""
    pattern: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "axes", check_axes(self.axes))

    @property
    def fields(self) -> tuple[str, ...]:
        time, color = self._first
        return self.fields_beside(time=time, color=color)

    @cached_property
    def _paths(self) -> dict[str, Path]:
        """Returns the files by the names of their sequences."""
        if self.raw.is_file():
            return {as_utf8(self.raw.stem): self.raw}
        if not self.raw.is_dir():
            raise DataError(
                f"{self.raw}: does not exist; expected a file of arrays ({', '.join(SUFFIXES)}), or a folder of them"
            )
        files = [path for path in files_below(self.raw) if _is_array(path.name) and self._is_wanted(path.name)]
        kept = sorted(
            (path for path in files if not made_by_dpc(path)),
            key=lambda path: natural_key(path.relative_to(self.raw).as_posix()),
        )
        if not kept:
            asked = f" whose names fit --pattern '{self.pattern}'" if self.pattern else ""
            raise DataError(f"{self.raw}: no files of arrays ({', '.join(SUFFIXES)}){asked}")
        return named_below(self.raw, kept, "file")

    def _is_wanted(self, name: str) -> bool:
        return not self.pattern or fnmatchcase(name, self.pattern)

    @cached_property
    def _items(self) -> list[Item]:
        items: list[Item] = []
        for name, path in self._paths.items():
            try:
                with open_arrays(path) as arrays:
                    sources = find_sources(arrays, self.axes) or _refuse(path, arrays, self.axes)
                    labels = find_labels(arrays, sources)
            except DataError as error:
                items.append(Item(name, path, problem=str(error)))
                continue
            items += [
                Item(f"{name}/{as_utf8(own.name)}" if own.name else name, path, extra={"source": own, "label": label})
                for own, label in zip(sources, labels)
            ]
        return items

    @cached_property
    def _first(self) -> tuple[bool, bool]:
        """Returns whether the first good sequence has times, and whether it has colors."""
        for item in self._items:
            if not item.problem:
                try:
                    return self._told(item)
                except DataError:
                    continue  # a bad sample: the next one tells
        return self.fps is not None, False

    def _told(self, item: Item) -> tuple[bool, bool]:
        with open_arrays(item.path) as arrays:
            stored = self._stored(item, arrays)
            return self.fps is not None or stored.times() is not None, bool(stored.beside.colors)

    def _stored(self, item: Item, arrays: Mapping[str, Any]) -> StoredSequence:
        return stored_sequence(item.path, arrays, item.extra["source"], self.axes)

    def _in_folders(self) -> tuple[list[str], str]:
        return [item.name for item in self._items], "CLASS/FILE"

    @cached_property
    def _table(self) -> LabelTable:
        return super()._table if self.labels or self.label_from_folder else self._labels_inside()

    def _labels_inside(self) -> LabelTable:
        """Returns the labels that files hold beside each sequence, or beside many, whole numbers from 0; no rows without them."""
        rows: dict[str, Row] = {}
        good: dict[Path, list[Item]] = {}
        for item in self._items:
            if not item.problem:
                good.setdefault(item.path, []).append(item)
        for path, own in good.items():
            values = np.array([item.extra["label"] for item in own if item.extra["label"] is not None])
            if own[0].extra["source"].place is not None:
                with open_arrays(path) as arrays:
                    try:
                        labels = self._stored(own[0], arrays).beside.labels
                    except DataError:
                        return LabelTable()
                    values = np.asarray(arrays[labels][()]).reshape(-1) if labels else np.zeros(0)
            if (
                len(values) != len(own)
                or (values != np.floor(values)).any()
                or values.min() < -1  # of those that nobody knows
                or values.max() > _MOST_CLASSES
            ):
                return LabelTable()
            rows |= {item.name: Row(int(label), -1, "") for item, label in zip(own, values)}
        if max((row.label for row in rows.values()), default=-1) < 0:
            return LabelTable()
        return LabelTable(self.raw, rows, [str(k) for k in range(max(row.label for row in rows.values()) + 1)])

    def items(self) -> list[Item]:
        time, color = self._first
        told = {"time": time, "color": color}
        return self._table.apply([replace(one, extra={**one.extra, **told}) for one in self._items])

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        with open_arrays(item.path) as arrays:
            stored = self._stored(item, arrays)
            frames, colors = stored.frames(), stored.colors()
            columns = {name: self._column(stored, name) for name in with_track(self.keep, self.track)}
            time = stored.times() if item.extra["time"] and not self.fps else None
            real, wanted = stored.real_points(frames), stored.frame_count(len(frames))
            units, unit = told_units(stored.array), first_unit(told_lengths(arrays, stored.key))
        if item.extra["time"] and self.fps:
            time = stored.times_at(self.fps, len(frames))
        elif item.extra["time"] and time is None:
            raise DataError(
                f"{item.path}: no array beside its clouds tells times that rise, though the first file has one"
            )
        if item.extra["color"] and colors is None:
            raise DataError(f"{item.path}: no colors beside its clouds, though the first file has them")
        clouds = [
            Cloud(
                frame,
                None if colors is None else colors[t],
                unit,
                extra={name: values[t] for name, values in columns.items()},
            )
            for t, frame in enumerate(frames)
        ]
        identify(item.path, clouds, self.track, self.keep)
        more, kept = len(clouds) - wanted, slice(0, wanted, self.stride)
        clouds, real = clouds[kept], real[kept]
        dropped = sum(int(np.count_nonzero(~own)) for own in real)
        for cloud, own in zip(clouds, real):
            cloud.keep(own)
        time = None if time is None else time[kept]
        notes = {MORE_FRAMES: more, **note_of_units(["points"], {"points": units}), UNCOUNTED: dropped}
        return self._assembled(item, clouds, time, notes)

    def _column(self, stored: StoredSequence, name: str) -> np.ndarray:
        is_track = name == self.track
        return stored.column(name, "--track" if is_track else "--keep-fields", gaps=not is_track)

    def summary(self, items: list[Item]) -> list[str]:
        files = len(self._paths)
        lines = [f"{counted(len(items), 'sequence')} in {counted(files, 'file')} of arrays"]
        good = next((item for item in items if not item.problem), None)
        if good:
            lines[0] += self._how(good)
        lines += left_out_below(self.raw, SUFFIXES)
        return lines + self._table.unnamed(items)

    def _how(self, item: Item) -> str:
        """Returns how the axes of the first array are taken, and which arrays beside it are not read."""
        source: Source = item.extra["source"]
        try:
            with open_arrays(item.path) as arrays:
                axes = self._stored(item, arrays).axes
                sources = [one.extra["source"] for one in self._items if one.path == item.path and not one.problem]
                keys = dict.fromkeys(key for own in sources for key in own.keys)
                alike = [key for key in keys if axes and len(axes) == getattr(arrays[key], "ndim", 0)]
                beside = [name for key in alike for name in find_beside(arrays, key, axes).named()]
                for own in sources if not axes else ():
                    beside += [*beside_frames(arrays, own).named(), *find_times_of_groups(arrays, own)]
                if not self._first[0] or self.fps:  # what doesn't rise isn't read
                    beside = [name for name in beside if not says_times(name)]
                labels_inside = self._table.rows and not (self.labels or self.label_from_folder)
                if not labels_inside:
                    beside = [name for name in beside if not says_label(name)]
                if labels_inside and source.place is None:
                    groups = {own.group for own in sources}
                    beside += [name for name in arrays if says_label(name) and name.rpartition("/")[0] in groups]
                used = {*keys, *beside, *with_track(self.keep, self.track)}
                unread = [name for name in arrays if name not in used] + others_inside(item.path, arrays)
                texts = getattr(arrays, "texts", {})
                unread = [name for name in unread if not first_unit([texts.get(name, "")])]
                first = arrays[source.keys[0]]
                shape = tuple(first.shape) if axes else ()
                shapes = [one.shape for one in first if one.size] if isinstance(first, list) else [first.shape]
        except DataError:
            return ""
        told = [own[place] for own in shapes if (place := coordinates_axis(own)) is not None]
        columns = shape[axes.index("C")] if axes else max(told, default=3)
        said = f"; shape {shape} taken as --axes {axes}" if axes and not self.axes else ""
        said += f"; {source.keys[0]} to {source.keys[-1]} taken as its frames" if len(source.keys) > 1 else ""
        missing = missing_numbers(NumberColumns(source.counted).running_numbers()) if source.counted else []
        said += f", without {first_names(missing, 5)}" if missing else ""
        said += f"; of each point the first 3 of {columns} numbers are read" if 3 < columns else ""
        return said + (f"; not read: {first_names(unread, 8)}" if unread else "")


def _refuse(path: Path, arrays: Mapping[str, Any], axes: str) -> list[Source]:
    shapes = [
        f"{name or 'an array'} {'list' if isinstance(one, list) else tuple(one.shape)}" for name, one in arrays.items()
    ]
    if tables := tables_inside(path):
        raise DataError(
            f"{path}: holds a table{f' ({first_names(tables, 5)})' if any(tables) else ''}, not an array of clouds; write it as .csv or"
            " .parquet (pandas: DataFrame.to_csv), and give --frame-column, or --track columns where a row is a frame"
        )
    plain = {name: one for name, one in arrays.items() if not isinstance(one, list)}
    totals = [one.shape[0] for one in plain.values() if one.ndim == 2 and one.shape[1] >= 3]
    totals += [math.prod(one.shape) for name, one in plain.items() if name.rpartition("/")[2] in ("x", "X")]
    advice = "" if axes else rows_of_axes(arrays, timed=False) or frames_beside(arrays, totals)
    if advice:
        raise DataError(f"{path}: {advice}")
    flat = [one.ndim for one in plain.values() if one.ndim >= 2 and sum(length > 1 for length in one.shape) <= 2]
    if flat and not axes:
        raise DataError(
            f"{path}: one cloud, or none, in {first_names(shapes, 5)}; expected (frames, points, 3), or a folder whose files are the"
            f" frames{'; --axes, such as TNC, makes a sequence of one frame of it' if max(flat) == 3 else ''}"
        )
    wanted = (
        f"{len(axes)} axes (--axes {axes})" if axes else "shape (frames, points, 3) or (sequences, frames, points, 3)"
    )
    others = "" if shapes else first_names(others_inside(path, arrays), 3)
    held = first_names(shapes, 5) or f"no arrays of numbers{f', but {others}' if others else ''}"
    raise DataError(f"{path}: holds {held}; expected an array of {wanted}")
