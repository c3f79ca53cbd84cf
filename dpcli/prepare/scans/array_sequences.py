"""Arrays of many clouds: one file, or each of a folder, holds one sequence or many, as (T,N,3), (N,T,3) or (B,T,N,3)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.path_names import as_utf8, first_names
from dpcli.prepare.array_files.attributes import attributes_of, told_lengths, told_units
from dpcli.prepare.array_files.axes import axes_of, check_axes, choices, coordinates_axis
from dpcli.prepare.array_files.choosing import (
    Beside,
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
from dpcli.prepare.array_files.netcdf_packing import with_gaps
from dpcli.prepare.cloud_formats.cloud import Cloud
from dpcli.prepare.cloud_formats.column_names import first_unit, note_of_units
from dpcli.prepare.decode.folder_listing import files_below, walk_folders
from dpcli.prepare.labels import LabelTable, Row, labels_of_folders, read_labels
from dpcli.prepare.reader import Item, Sample, natural_key
from dpcli.prepare.scans.assembling import Lengths, OwnScans, assemble
from dpcli.prepare.scans.cloud_series import left_out_below
from dpcli.prepare.scans.tracked_points import identify, with_track
from dpcli.prepare.series import TEXTS, evenly, is_beside, is_hidden, missing_numbers
from dpcli.prepare.times_beside import seconds_beside
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
        """Returns the optional fields that every sample has."""
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
        named = {as_utf8(path.relative_to(self.raw).with_suffix("").as_posix()): path for path in kept}
        if not named:
            asked = f" whose names fit --pattern '{self.pattern}'" if self.pattern else ""
            raise DataError(f"{self.raw}: no files of arrays ({', '.join(SUFFIXES)}){asked}")
        if len(named) < len(kept):
            shown = {*named.values()}
            twin = next(path for path in kept if path not in shown)
            raise DataError(f"{twin}: there is a file of the same name in another format; keep one of them")
        return named

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
        source: Source = item.extra["source"]
        with open_arrays(item.path) as arrays:
            beside, axes = self._beside(item.path, arrays, source)
            timed = self.fps is not None or _times(item.path, arrays, beside, axes, source) is not None
            return bool(timed), bool(beside.colors)

    def _beside(self, path: Path, arrays: Mapping[str, Any], source: Source) -> tuple[Beside, str]:
        """Returns what lies beside the array of one sequence, and the letters of its axes, "" of lists and single frames."""
        array = arrays[source.keys[0]]
        if isinstance(array, list) or len(source.keys) > 1:
            beside = beside_frames(arrays, source)
            if beside.labels and source.place is None and not self.axes:
                count = len(source.keys) if len(source.keys) > 1 else len(array)
                raise DataError(
                    f"{path}: has a number in {beside.labels!r} for each of its {count} clouds; if these are the frames of one"
                    " sequence, give --axes TNC, if each is a sample of its own, save it to a file in a folder of its own"
                )
            return beside, ""
        facts = path.stat()
        axes = self.axes or _axes(path, source.keys[0], facts.st_size, facts.st_mtime_ns)
        if not axes:
            raise DataError(_which(path, array.shape))
        beside = find_beside(arrays, source.keys[0], axes)
        if beside.labels and "B" not in axes and not self.axes:
            raise DataError(
                f"{path}: has a number in {beside.labels!r} for each of the {array.shape[axes.index('T')]} clouds of shape"
                f" {tuple(array.shape)}; if each is a sample of one frame, give --axes {axes.replace('T', 'B')}, if all are"
                f" frames of one sequence --axes {axes}"
            )
        return beside, axes

    @cached_property
    def _table(self) -> LabelTable | None:
        if self.labels:
            return read_labels(self.labels)
        if self.label_from_folder:
            return labels_of_folders(self.raw, [item.name for item in self._items], "CLASS/FILE")
        return self._labels_inside()

    def _labels_inside(self) -> LabelTable | None:
        """Returns the labels that files hold beside each sequence, or beside many, whole numbers from 0; None without them."""
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
                        beside, _ = self._beside(path, arrays, own[0].extra["source"])
                    except DataError:
                        return None
                    values = np.asarray(arrays[beside.labels][()]).reshape(-1) if beside.labels else np.zeros(0)
            if (
                len(values) != len(own)
                or (values != np.floor(values)).any()
                or values.min() < -1  # of those that nobody knows
                or values.max() > _MOST_CLASSES
            ):
                return None
            rows |= {item.name: Row(int(label), -1, "") for item, label in zip(own, values)}
        if max((row.label for row in rows.values()), default=-1) < 0:
            return None
        return LabelTable(self.raw, rows, [str(k) for k in range(max(row.label for row in rows.values()) + 1)])

    def items(self) -> list[Item]:
        """Returns the index in its final order. Raises DataError when the raw data are not what they should be."""
        time, color = self._first
        items = [
            Item(one.name, one.path, extra={**one.extra, "time": time, "color": color}, problem=one.problem)
            for one in self._items
        ]
        return self._table.apply(items) if self._table else items

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        """Returns the sample of one item. Raises DataError when its data are bad."""
        source: Source = item.extra["source"]
        with open_arrays(item.path) as arrays:
            beside, axes = self._beside(item.path, arrays, source)
            frames = _frames(item.path, arrays, source, axes)
            colors = _cut(arrays[beside.colors], axes, source.place) if beside.colors else None
            columns = {
                name: self._column(item.path, arrays, name, source, axes) for name in with_track(self.keep, self.track)
            }
            time = _times(item.path, arrays, beside, axes, source) if item.extra["time"] and not self.fps else None
            real = _real_points(item.path, arrays, beside, axes, source, frames)
            units = told_units(arrays[source.keys[0]])
            unit = first_unit(told_lengths(arrays, source.keys[0]))
            wanted = _frame_count(item.path, arrays, beside, source, len(frames))
        if item.extra["time"] and time is None:
            if not self.fps:
                raise DataError(
                    f"{item.path}: no array beside its clouds tells times that rise, though the first file has one"
                )
            time = _at_rate(source, len(frames), self.fps)
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
        sample = assemble(item, clouds, Lengths(self.scale, self.unit), color=item.extra["color"], time=time)
        sample.notes |= {MORE_FRAMES: more} if more else {}
        sample.notes |= note_of_units(["points"], {"points": units})
        sample.notes |= {UNCOUNTED: dropped} if dropped else {}
        return sample

    def _column(self, path: Path, arrays: Mapping[str, Any], name: str, source: Source, axes: str) -> np.ndarray:
        flat = tuple(length for letter, length in zip(axes, arrays[source.keys[0]].shape) if letter != "C")
        found = arrays.get(name)
        if (
            not axes
            or found is None
            or isinstance(found, list)
            or tuple(found.shape) != flat
            or found.dtype.kind not in "fiub"
        ):
            option = "--track" if name == self.track else "--keep-fields"
            raise DataError(
                f"{path}: {option} {name}: no array of one number for each point, {flat or 'as frames have'}"
            )
        array = arrays[name] if name == self.track else with_gaps(arrays[name])
        return _cut(array, axes.replace("C", ""), source.place)

    def summary(self, items: list[Item]) -> list[str]:
        """Returns lines for the log about what the index holds and lacks."""
        files = len(self._paths)
        lines = [f"{counted(len(items), 'sequence')} in {counted(files, 'file')} of arrays"]
        good = next((item for item in items if not item.problem), None)
        if good:
            lines[0] += self._how(good)
        lines += left_out_below(self.raw, SUFFIXES)
        return lines + (self._table.unnamed(items) if self._table else [])

    def _how(self, item: Item) -> str:
        """Returns how the axes of the first array are taken, and which arrays beside it are not read."""
        source: Source = item.extra["source"]
        try:
            with open_arrays(item.path) as arrays:
                _, axes = self._beside(item.path, arrays, source)
                sources = [one.extra["source"] for one in self._items if one.path == item.path and not one.problem]
                keys = dict.fromkeys(key for own in sources for key in own.keys)
                alike = [key for key in keys if axes and len(axes) == getattr(arrays[key], "ndim", 0)]
                beside = [name for key in alike for name in find_beside(arrays, key, axes).named()]
                for own in sources if not axes else ():
                    beside += [*beside_frames(arrays, own).named(), *find_times_of_groups(arrays, own)]
                if not self._first[0] or self.fps:  # what doesn't rise isn't read
                    beside = [name for name in beside if not says_times(name)]
                if self._table is None or self.labels or self.label_from_folder:
                    beside = [name for name in beside if not says_label(name)]
                if self._table is not None and source.place is None and not (self.labels or self.label_from_folder):
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


@lru_cache(maxsize=64)  # an array holds many sequences; each process looks at it once
def _axes(path: Path, key: str, _size: int, _changed: int) -> str:
    with open_arrays(path) as arrays:
        return axes_of(arrays[key])


def _refuse(path: Path, arrays: Mapping[str, Any], axes: str) -> list[Source]:
    shapes = [
        f"{name or 'an array'} {'list' if isinstance(one, list) else tuple(one.shape)}" for name, one in arrays.items()
    ]
    if tables := tables_inside(path):
        raise DataError(
            f"{path}: holds a table{f' ({first_names(tables, 5)})' if any(tables) else ''}, not an array of clouds; write it as .csv or"
            " .parquet (pandas: DataFrame.to_csv), and give --frame-column, or --track columns where a row is a frame"
        )
    dense = [one for one in arrays.values() if not isinstance(one, list)]
    flat = [one.ndim for one in dense if one.ndim >= 2 and sum(length > 1 for length in one.shape) <= 2]
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


def _which(path: Path, shape: tuple[int, ...]) -> str:
    first, *others = choices(tuple(shape))
    return (
        f"{path}: an array of shape {tuple(shape)}, whose order can't be told from its numbers; say it: --axes {first} or"
        f" {', '.join(others)} (T frames, N points, C x y z, B sequences)"
    )


def _cut(array: Any, axes: str, place: int | None) -> np.ndarray:
    """Returns the part of one sequence with frames first, (T,N) or (T,N,C): rows and columns of points one after the other."""
    values = np.asarray(array[tuple(place if letter == "B" else slice(None) for letter in axes)])
    left = axes.replace("B", "")
    rank = {"T": 0, "N": 1, "C": 2}
    values = values.transpose(sorted(range(len(left)), key=lambda axis: (rank[left[axis]], axis)))
    frames = values.shape[0] if "T" in left else 1
    return values.reshape(frames, -1, *([values.shape[-1]] if "C" in left else []))


def _frames(path: Path, arrays: Mapping[str, Any], source: Source, axes: str) -> list[np.ndarray]:
    """Returns the points of each frame, (N,3) of the file's precision."""
    if axes:
        return list(_as_points(_cut(with_gaps(arrays[source.keys[0]]), axes, source.place)))
    if len(source.keys) > 1:
        found = [np.asarray(with_gaps(arrays[key])[()]) for key in source.keys]
        return [_as_points(one) if one.size else np.zeros((0, 3), np.float32) for one in found]
    parts = arrays[source.keys[0]]
    if source.place is not None:
        own = axes_of(parts[source.place])
        if not own:
            raise DataError(_which(path, parts[source.place].shape))
        return list(_as_points(_cut(parts[source.place], own, None)))
    turned = sum(one.shape[0] == 3 and one.shape[1] != 3 for one in parts if one.size)
    by_columns = turned and all(one.shape[0] == 3 for one in parts if one.size)
    if turned and not by_columns:
        raise DataError(
            f"{path}: some of its {len(parts)} clouds are (3, points) and some (points, 3 or more); save them alike"
        )
    return [_as_points(one.T if by_columns else one) if one.size else np.zeros((0, 3), np.float32) for one in parts]


def _as_points(array: np.ndarray) -> np.ndarray:
    kind = np.float32 if array.dtype.kind == "f" and array.itemsize <= 4 else np.float64
    return array[..., :3].astype(kind)


def _of_frames(array: Any, axes: str, shape: tuple[int, ...], place: int | None) -> np.ndarray:
    """Returns the numbers (T) of one sequence's frames, of an array that has one for each frame of all, or of one sequence."""
    sides = {letter: length for letter, length in zip(axes, shape) if letter in "BT"}
    values = np.asarray(array[()]).reshape(-1)
    return (
        _cut(values.reshape(tuple(sides.values())), "".join(sides), place).reshape(-1)
        if len(values) == np.prod([*sides.values()], dtype=int)
        else values
    )


def _at_rate(source: Source, count: int, fps: float) -> np.ndarray:
    """Returns the seconds of frames, f64 (T), by their numbers where names tell them, so that what is missing leaves a gap."""
    columns = NumberColumns(source.counted)
    numbers = columns.running_numbers() if source.counted and columns.times() is None else None
    return (np.arange(count) if numbers is None else evenly(numbers)) / fps


def _times(path: Path, arrays: Mapping[str, Any], beside: Beside, axes: str, source: Source) -> np.ndarray | None:
    """Returns seconds since the first frame, f64 (T), that an array tells, or a number or an attribute of each frame, or the names
    of these; None where nothing tells times that rise.
    """
    if beside.times:
        array = arrays[beside.times]
        values = _of_frames(array, axes, arrays[source.keys[0]].shape, source.place) if axes else np.asarray(array[()])
        stop = _frame_count(path, arrays, beside, source, len(values))  # behind it may be anything
        return seconds_beside(beside.times, values[:stop], told_units(array))
    if len(source.keys) < 2:
        return None
    if names := find_times_of_groups(arrays, source):
        values = np.array([np.asarray(arrays[name][()]).item() for name in names])
        return seconds_beside(names[0], values, told_units(arrays[names[0]]))
    told = [attributes_of(arrays[key]) for key in source.keys]
    for name in filter(says_times, told[0]):
        values = [np.asarray(one.get(name, "")) for one in told]
        if all(one.size == 1 and one.dtype.kind in "uif" for one in values):
            return seconds_beside(name, np.array([one.item() for one in values]))
    return NumberColumns(source.counted).times()


def _frame_count(path: Path, arrays: Mapping[str, Any], beside: Beside, source: Source, stored: int) -> int:
    """Returns how many frames of a sequence are no padding, by the counts beside them. Raises DataError where it can't be."""
    if not beside.frames:
        return stored
    told = float(np.asarray(arrays[beside.frames][()]).reshape(-1)[source.place])
    if not 1 <= told <= stored or told != int(told):
        raise DataError(
            f"{path}: {beside.frames!r} tells {told:g} frames of a sequence that has {stored}; expected 1 to {stored}"
        )
    return int(told)


def _real_points(
    path: Path, arrays: Mapping[str, Any], beside: Beside, axes: str, source: Source, frames: list[np.ndarray]
) -> list[np.ndarray]:
    """Returns which points of each frame are no padding, by the counts or the mask beside them: bool (N) each. Raises DataError
    where a mask holds more than two values, such as the numbers of objects.
    """
    if beside.mask:
        own = axes if arrays[beside.mask].ndim == len(axes) else axes.replace("C", "")
        mask = _cut(arrays[beside.mask], own, source.place).reshape(len(frames), -1)
        if len(values := np.unique(mask)) > 2:
            raise DataError(
                f"{path}: {beside.mask!r} holds {len(values)} different numbers, expected two: points that are valid and others;"
                " call it otherwise if it is no mask"
            )
        return list(mask != 0)
    if beside.counts:
        counts = _of_frames(arrays[beside.counts], axes, arrays[source.keys[0]].shape, source.place)
        return [np.arange(len(frame)) < count for frame, count in zip(frames, counts)]
    return [np.ones(len(frame), bool) for frame in frames]
