"""Reading a `clouds` file: validated once, then only the frames asked for."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, reading
from dpcli.store.file import (
    data_set,
    open_store,
    read_positions,
    read_provenance,
    read_skipped,
    read_strings,
    root_attributes,
)
from dpcli.store.schema import KEPT
from dpcli.store.sequence import NO_LENGTHS, OF_PARTS, POINT_FIELDS, CloudSequence, are_lengths

OPTIONAL = ("time", *POINT_FIELDS, *OF_PARTS)
_OF_FRAMES = ("time", *OF_PARTS)


class CloudsReader:
    """Reads the sequences of a `clouds` (or `parts`) file lazily.

    The index (names, labels, offsets) is read and checked on opening: a few dozen bytes a sample. The HDF5 handles are
    opened on first use in each process and never pickled, so a DataLoader may hand the reader to its workers. Those of
    data sets are kept: finding one again for each sequence takes longer than reading it.
    Raises DataError when the file is not what the contract says.
    """

    kinds: tuple[str, ...] = ("clouds", "parts")
    cache = 1 << 20  # bytes of chunks that HDF5 keeps of each data set; less where many files are open at a time

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._file: h5py.File | None = None
        self._process = 0  # that opened the handles; after a fork the child opens its own
        self._sets: dict[str, h5py.Dataset] = {}
        with open_store(self.path, self.kinds) as file:
            self._load_index(file)

    def _load_index(self, file: h5py.File) -> None:
        self.attributes = root_attributes(file)
        self.provenance = read_provenance(file)
        self.skipped, self.positions = read_skipped(file), read_positions(file)
        self.class_names = read_strings(file, "class_names", optional=True)
        self.length_unit = str(file.attrs.get("length_unit", ""))
        self.names, self.splits = read_strings(file, "name"), read_strings(file, "split")
        self.labels, self.subjects, self.cameras = (self._column(file, key) for key in ("label", "subject", "camera"))
        self.num_points = len(data_set(file, "points"))
        self._sequence_offsets = self._offsets(file, "sequence_offsets", None)
        frames = int(self._sequence_offsets[-1])
        self._frame_offsets = self._offsets(file, "frame_offsets", self.num_points)
        if frames != len(self._frame_offsets) - 1:
            raise DataError(
                f"{self.path}: sequence_offsets end at {frames}, but there are {len(self._frame_offsets) - 1} frames"
            )
        if not len(self.names) == len(self.splits) == len(self._sequence_offsets) - 1:
            raise DataError(
                f"{self.path}: {counted(len(self.names), 'name')} for {counted(len(self._sequence_offsets) - 1, 'sequence')}"
            )
        if len(set(self.names)) != len(self.names):
            twice = Counter(self.names).most_common(1)[0][0]
            raise DataError(
                f"{self.path}: the name {twice!r} occurs twice; names identify samples, make the file again"
            )
        if self.class_names and len(self.labels) and self.labels.max() >= len(self.class_names):
            worst = int(self.labels.argmax())
            raise DataError(
                f"{self.path}: label {self.labels[worst]} of {self.names[worst]!r}, but {counted(len(self.class_names), 'class')}"
            )
        if "class_names" not in file and (self.labels >= 0).any():
            raise DataError(
                f"{self.path}: data set 'class_names' is missing, though samples have labels; make it again"
            )
        self.shifts = self._read_shifts(file)
        self.fields = (*(key for key in OPTIONAL if key in file), *(key for key in file if key.startswith(KEPT)))
        for key in self.fields:
            rows = frames if key in _OF_FRAMES else self.num_points
            if len(file[key]) != rows:
                raise DataError(f"{self.path}: {key} has {len(file[key])} rows, expected {rows}")

    def _read_shifts(self, file: h5py.File) -> np.ndarray:
        """Returns what was taken off the original coordinates of each sequence, f64 (S,3); zeros where nothing was."""
        if "shift" not in file:
            return np.zeros((len(self.names), 3))
        shifts = data_set(file, "shift")[:]
        if len(shifts) != len(self.names) or not np.isfinite(shifts).all():
            raise DataError(
                f"{self.path}: shift has {len(shifts)} rows, expected {len(self.names)} of 3 finite numbers"
            )
        return shifts

    def _column(self, file: h5py.File, name: str) -> np.ndarray:
        column = data_set(file, name)[:]
        if len(column) != len(self.names):
            raise DataError(f"{self.path}: {name} has {len(column)} rows for {len(self.names)} names")
        if column.min(initial=-1) < -1:
            worst = int(column.argmin())
            raise DataError(
                f"{self.path}: {name} {column[worst]} of {self.names[worst]!r}, expected -1 (unknown) or 0, 1, ..."
            )
        return column

    def _offsets(self, file: h5py.File, name: str, end: int | None) -> np.ndarray:
        offsets = data_set(file, name)[:]
        if len(offsets) == 0 or offsets[0] != 0 or np.any(np.diff(offsets) < 0):
            raise DataError(f"{self.path}: {name} must start at 0 and never fall")
        if end is not None and offsets[-1] != end:
            raise DataError(f"{self.path}: {name} ends at {offsets[-1]}, but there are {end} points")
        return offsets

    def __len__(self) -> int:
        return len(self.names)

    @property
    def frame_counts(self) -> np.ndarray:
        """Counts the frames of each sequence, i64 (S)."""
        return np.diff(self._sequence_offsets)

    @property
    def frame_sizes(self) -> np.ndarray:
        """Counts the points of each frame, i64 (F)."""
        return np.diff(self._frame_offsets)

    @property
    def point_counts(self) -> np.ndarray:
        """Counts the points of each sequence, i64 (S)."""
        return np.diff(self._frame_offsets[self._sequence_offsets])

    def frame_intervals(self) -> np.ndarray:
        """Returns the seconds from each frame to the next of the same sequence, f64; none where the file has no times."""
        if "time" not in self.fields:
            return np.zeros(0)
        steps, last = np.diff(self._set("time")[:]), self._sequence_offsets[1:-1] - 1
        return np.delete(steps, last[(last >= 0) & (last < len(steps))])

    def times(self, index: int) -> np.ndarray | None:
        """Returns when the frames of sequence `index` were taken, f64 (T), without its points; None where the file doesn't say."""
        if "time" not in self.fields:
            return None
        return self._set("time")[int(self._sequence_offsets[index]) : int(self._sequence_offsets[index + 1])]

    @property
    def file(self) -> h5py.File:
        """Opens the file in this process unless it is open, and returns the handle."""
        if self._file is None or self._process != os.getpid() or not self._file.id.valid:
            self._sets = {}
            self._file, self._process = open_store(self.path, self.kinds, self.cache), os.getpid()
        return self._file

    def _set(self, name: str) -> h5py.Dataset:
        """Returns a data set of the file, found once in each process."""
        file = self.file
        if name not in self._sets:
            self._sets[name] = file[name]
        return self._sets[name]

    def read(
        self, index: int, frames: slice | Sequence[int] | None = None, fields: Sequence[str] | None = None
    ) -> CloudSequence:
        """Returns sequence `index`, or only some of its frames (repeats allowed), with all optional fields or those named.

        Touches only what it needs: one contiguous read from the first to the last frame asked for.
        Raises DataError when a value is NaN or infinite, or the file is damaged there.
        """
        with reading(self.path):
            return self._read(index, frames, fields)

    def _read(self, index: int, frames: slice | Sequence[int] | None, fields: Sequence[str] | None) -> CloudSequence:
        first = int(self._sequence_offsets[index])
        count = int(self._sequence_offsets[index + 1]) - first
        if isinstance(frames, Sequence):
            wanted = np.asarray(frames)
        else:
            wanted = np.arange(count)[slice(None) if frames is None else frames]
        if len(wanted) == 0 or wanted.min() < 0 or wanted.max() >= count:
            raise DataError(
                f"{self.path}: frames {frames} of {self.names[index]!r}, which has {counted(count, 'frame')}"
            )
        low, high = int(wanted.min()), int(wanted.max()) + 1
        offsets = self._frame_offsets[first + low : first + high + 1]
        span = slice(int(offsets[0]), int(offsets[-1]))
        picks = None if len(wanted) == high - low and (np.diff(wanted) == 1).all() else wanted - low
        sizes = np.diff(offsets) if picks is None else np.diff(offsets)[picks]
        values = {}
        for key in ("points", *(self.fields if fields is None else fields)):
            if key in _OF_FRAMES:
                values[key] = self._set(key)[first + low : first + high][wanted - low]
            else:
                values[key] = _pick(self._set(key)[span], offsets - offsets[0], picks)
        if not are_lengths(values["points"]):
            raise DataError(f"{self.path}: {self.names[index]!r} has coordinates of {NO_LENGTHS}; make the file again")
        shift = self.shifts[index]
        made = CloudSequence(
            self.names[index],
            values.pop("points"),
            np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
            self.splits[index],
            int(self.labels[index]),
            int(self.subjects[index]),
            int(self.cameras[index]),
            shift=shift if shift.any() else None,
            extra={key: values.pop(key) for key in [key for key in values if key.startswith(KEPT)]},
            **values,
        )
        try:
            made.validate_values()
        except DataError as error:
            raise DataError(f"{self.path}: {error}") from None
        return made

    def given(self, index: int) -> list:
        """Returns sequence `index` as the writer of such a file takes it again."""
        return [self.read(index)]

    def close(self) -> None:
        """Closes the handle of this process; the next read opens the file again."""
        if self._file is not None and self._process == os.getpid():
            self._file.close()
        self._file, self._sets = None, {}

    def __enter__(self) -> CloudsReader:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def __getstate__(self) -> dict:
        return {**self.__dict__, "_file": None, "_sets": {}}


def _pick(values: np.ndarray, offsets: np.ndarray, picks: np.ndarray | None) -> np.ndarray:
    """Returns the rows of the frames `picks`, in that order."""
    if picks is None:
        return values
    return np.concatenate([values[offsets[t] : offsets[t + 1]] for t in picks])
