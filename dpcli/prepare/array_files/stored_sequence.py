"""One sequence of clouds as it lies in an open file of arrays: its frames, and the times, colors and columns beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.file_cache import cached_by_file
from dpcli.prepare.array_files.attributes import attributes_of, told_units
from dpcli.prepare.array_files.axes import axes_of, choices
from dpcli.prepare.array_files.choosing import (
    Beside,
    Source,
    beside_frames,
    find_beside,
    find_times_of_groups,
    says_times,
)
from dpcli.prepare.array_files.containers import open_arrays
from dpcli.prepare.array_files.netcdf_packing import with_gaps
from dpcli.prepare.series import evenly
from dpcli.prepare.times_beside import seconds_beside
from dpcli.runtime.clips.name_numbers import NumberColumns


@dataclass(frozen=True)
class StoredSequence:
    """Holds where a sequence lies among the arrays of an open file, and what lies beside it.

    axes: a letter for each axis of its array, "" of a list of arrays, and of arrays that each are a frame. Whatever it returns
    has frames first, of the sequence alone.
    """

    path: Path
    arrays: Mapping[str, Any]
    source: Source
    axes: str
    beside: Beside

    @property
    def key(self) -> str:
        """Returns the name of its array, of several the first."""
        return self.source.keys[0]

    @property
    def array(self) -> Any:
        """Returns its array, of several the first."""
        return self.arrays[self.key]

    def frames(self) -> list[np.ndarray]:
        """Returns the points of each frame, (N,3) of the file's precision."""
        if self.axes:
            return list(_as_points(self._cut(with_gaps(self.array), self.axes)))
        if len(self.source.keys) > 1:
            found = [np.asarray(with_gaps(self.arrays[key])[()]) for key in self.source.keys]
            return [_as_points(one) if one.size else np.zeros((0, 3), np.float32) for one in found]
        parts = self.array
        if self.source.place is not None:
            one = parts[self.source.place]
            own = axes_of(one)
            if not own:
                raise DataError(_which(self.path, one.shape))
            return list(_as_points(_cut(one, own, None)))
        turned = sum(one.shape[0] == 3 and one.shape[1] != 3 for one in parts if one.size)
        by_columns = turned and all(one.shape[0] == 3 for one in parts if one.size)
        if turned and not by_columns:
            raise DataError(
                f"{self.path}: some of its {len(parts)} clouds are (3, points) and some (points, 3 or more); save them alike"
            )
        return [_as_points(one.T if by_columns else one) if one.size else np.zeros((0, 3), np.float32) for one in parts]

    def colors(self) -> np.ndarray | None:
        """Returns the colors of the frames (T,N,C), None without them."""
        return self._cut(self.arrays[self.beside.colors], self.axes) if self.beside.colors else None

    def column(self, name: str, option: str, *, gaps: bool) -> np.ndarray:
        """Returns an array of one number for each point (T,N), with NaN for ``gaps`` where whole numbers are missing. Raises
        DataError where there is none of this name; option: by which somebody asked for it.
        """
        flat = tuple(length for letter, length in zip(self.axes, self.array.shape) if letter != "C")
        found = self.arrays.get(name)
        fits = self.axes and found is not None and not isinstance(found, list) and tuple(found.shape) == flat
        if not fits or found.dtype.kind not in "fiub":
            raise DataError(
                f"{self.path}: {option} {name}: no array of one number for each point, {flat or 'as frames have'}"
            )
        return self._cut(with_gaps(found) if gaps else found, self.axes.replace("C", ""))

    def times(self) -> np.ndarray | None:
        """Returns seconds since the first frame, f64 (T), that an array tells, or a number or an attribute of each frame, or the
        names of these; None where nothing tells times that rise.
        """
        if self.beside.times:
            array = self.arrays[self.beside.times]
            values = self._of_frames(array) if self.axes else np.asarray(array[()])
            stop = self.frame_count(len(values))  # behind it may be anything
            return seconds_beside(self.beside.times, values[:stop], told_units(array))
        if len(self.source.keys) < 2:
            return None
        if names := find_times_of_groups(self.arrays, self.source):
            values = np.array([np.asarray(self.arrays[name][()]).item() for name in names])
            return seconds_beside(names[0], values, told_units(self.arrays[names[0]]))
        told = [attributes_of(self.arrays[key]) for key in self.source.keys]
        for name in filter(says_times, told[0]):
            values = [np.asarray(one.get(name, "")) for one in told]
            if all(one.size == 1 and one.dtype.kind in "uif" for one in values):
                return seconds_beside(name, np.array([one.item() for one in values]))
        return NumberColumns(self.source.counted).times()

    def times_at(self, fps: float, count: int) -> np.ndarray:
        """Returns the seconds of so many frames at a rate, f64 (T), by their numbers where names tell them, so that what is
        missing leaves a gap.
        """
        columns = NumberColumns(self.source.counted)
        numbers = columns.running_numbers() if self.source.counted and columns.times() is None else None
        return (np.arange(count) if numbers is None else evenly(numbers)) / fps

    def frame_count(self, stored: int) -> int:
        """Returns how many of the frames ``stored`` are no padding, by the counts beside them. Raises DataError where it can't be."""
        if not self.beside.frames:
            return stored
        told = float(np.asarray(self.arrays[self.beside.frames][()]).reshape(-1)[self.source.place])
        if not 1 <= told <= stored or told != int(told):
            raise DataError(
                f"{self.path}: {self.beside.frames!r} tells {told:g} frames of a sequence that has {stored}; expected 1 to {stored}"
            )
        return int(told)

    def real_points(self, frames: list[np.ndarray]) -> list[np.ndarray]:
        """Returns which points of each frame are no padding, by the counts or the mask beside them: bool (N) each. Raises DataError
        where a mask holds more than two values, such as the numbers of objects.
        """
        if self.beside.mask:
            mask = self.arrays[self.beside.mask]
            own = self.axes if mask.ndim == len(self.axes) else self.axes.replace("C", "")
            values = self._cut(mask, own).reshape(len(frames), -1)
            if (kinds := len(np.unique(values))) > 2:
                raise DataError(
                    f"{self.path}: {self.beside.mask!r} holds {kinds} different numbers, expected two: points that are valid and"
                    " others; call it otherwise if it is no mask"
                )
            return list(values != 0)
        if self.beside.counts:
            counts = self._of_frames(self.arrays[self.beside.counts])
            return [np.arange(len(frame)) < count for frame, count in zip(frames, counts)]
        return [np.ones(len(frame), bool) for frame in frames]

    def _cut(self, array: Any, axes: str) -> np.ndarray:
        return _cut(array, axes, self.source.place)

    def _of_frames(self, array: Any) -> np.ndarray:
        """Returns the numbers (T) of the frames, of an array that has one for each frame of all sequences, or of one."""
        sides = {letter: length for letter, length in zip(self.axes, self.array.shape) if letter in "BT"}
        values = np.asarray(array[()]).reshape(-1)
        if len(values) != np.prod([*sides.values()], dtype=int):
            return values
        return self._cut(values.reshape(tuple(sides.values())), "".join(sides)).reshape(-1)


def stored_sequence(path: Path, arrays: Mapping[str, Any], source: Source, asked: str = "") -> StoredSequence:
    """Returns a sequence among the arrays of an open file. asked: its axes as the user says them, "" where values tell.

    Raises DataError where these leave a choice, or where labels beside the clouds make them samples rather than frames.
    """
    array = arrays[source.keys[0]]
    if isinstance(array, list) or len(source.keys) > 1:
        beside = beside_frames(arrays, source)
        if beside.labels and source.place is None and not asked:
            count = len(source.keys) if len(source.keys) > 1 else len(array)
            raise DataError(
                f"{path}: has a number in {beside.labels!r} for each of its {count} clouds; if these are the frames of one"
                " sequence, give --axes TNC, if each is a sample of its own, save it to a file in a folder of its own"
            )
        return StoredSequence(path, arrays, source, "", beside)
    axes = asked or _axes(path, source.keys[0])
    if not axes:
        raise DataError(_which(path, array.shape))
    beside = find_beside(arrays, source.keys[0], axes)
    if beside.labels and "B" not in axes and not asked:
        raise DataError(
            f"{path}: has a number in {beside.labels!r} for each of the {array.shape[axes.index('T')]} clouds of shape"
            f" {tuple(array.shape)}; if each is a sample of one frame, give --axes {axes.replace('T', 'B')}, if all are"
            f" frames of one sequence --axes {axes}"
        )
    return StoredSequence(path, arrays, source, axes, beside)


@cached_by_file(64)  # an array holds many sequences; each process looks at it once
def _axes(path: Path, key: str) -> str:
    with open_arrays(path) as arrays:
        return axes_of(arrays[key])


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


def _as_points(array: np.ndarray) -> np.ndarray:
    kind = np.float32 if array.dtype.kind == "f" and array.itemsize <= 4 else np.float64
    return array[..., :3].astype(kind)
