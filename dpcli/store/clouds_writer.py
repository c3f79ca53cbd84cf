"""Writing a `clouds` file, one sample in memory at a time."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.store.file import PACKED, STRING
from dpcli.store.schema import KEPT, fields_of
from dpcli.store.sequence import OF_PARTS, POINT_FIELDS, CloudSequence
from dpcli.store.writing.journal import Placed
from dpcli.store.writing.resumable_writer import ResumableWriter
from dpcli.store.writing.whole_chunks import PlainChunks, chunk_writer

COMPRESSIONS = ("none", "lzf", "gzip")
POINTS_PER_CHUNK = 16384  # 192 KiB of xyz: inside HDF5's advice of 10 KiB to 1 MiB, few chunks per sequence
_FIELD = fields_of("clouds")
_PER_SAMPLE = {
    name: STRING if field.kind == "str" else field.dtype
    for name, field in _FIELD.items()
    if field.shape == ("S",) and not field.optional
}
_INDEX = ("frame_offsets", "sequence_offsets", "time", *_PER_SAMPLE)  # small: written at once, at the end
_FIELDS = ("time", *POINT_FIELDS, *OF_PARTS)  # the order in which they are made, however they are named: equal bytes
_FLUSH_BYTES = 32 << 20  # a full disk is noticed while it can still be told; closing can't say it


class CloudsWriter(ResumableWriter):
    """Writes sequences to `path`, as a context manager; `ResumableWriter` says what it leaves when it is stopped.

    A file that was continued has the bytes it would have had. The journal is small beside uncompressed points, as large as
    the samples of a compressed file.
    `fields` names the optional ones the samples carry (time, color, part, track, scene_flow, pose, joint, and kept columns,
    `field_NAME`); a shift is written where a sample has one. options: those of `ResumableWriter`.

    >>> from dpcli.store import CloudSequence, CloudsReader
    >>> with CloudsWriter("two.h5", class_names=["wave"]) as writer:
    ...     for name in ("a", "b"):
    ...         writer.write(CloudSequence.from_frames(name, [np.zeros((5, 3)), np.ones((2, 3))], label=0))
    >>> with CloudsReader("two.h5") as reader:
    ...     reader.names, reader.frame_counts.tolist(), reader.read(1, frames=[1]).points.shape
    (['a', 'b'], [2, 2], (2, 3))
    """

    kind = "clouds"
    types = _FIELD

    def __init__(
        self,
        path: str | Path,
        *,
        length_unit: str = "m",
        fields: Sequence[str] = (),
        compression: str = "none",
        **options: Any,
    ) -> None:
        if compression not in COMPRESSIONS:
            raise UsageError(f"--compression {compression}: expected one of {', '.join(COMPRESSIONS)}")
        kept = sorted(name for name in set(fields) if name.startswith(KEPT))
        unknown = set(fields) - {*_FIELDS, *kept}
        if unknown:
            raise UsageError(f"unknown field {min(unknown)!r}; expected {', '.join(_FIELDS)}")
        self.fields, self.compression = (*(n for n in _FIELDS if n in fields), *kept), compression
        self._names: set[str] = set()
        self._frames = self._points = self._unflushed = 0
        self._shifts: list[np.ndarray | None] = []
        self._index: dict[str, list | array] = {name: _empty_column(name) for name in _INDEX}
        self._data: dict[str, h5py.Dataset] = {}
        self._chunks: PlainChunks | None = None
        self._placed: Placed | None = None
        super().__init__(path, length_unit=length_unit, **options)

    def _create(self) -> None:
        file = self._file
        self._create_floats("points", 3)
        if self.compression == "none":
            self._chunks = chunk_writer(file["points"])
        for name in ("frame_offsets", "sequence_offsets"):
            file.create_dataset(name, data=np.zeros(1, _FIELD[name].dtype), maxshape=(None,), chunks=(4096,), **PACKED)
        for name, dtype in _PER_SAMPLE.items():
            file.create_dataset(
                name, (0,), dtype, maxshape=(None,), chunks=(1024,), **({} if dtype is STRING else PACKED)
            )
        for name in self.fields:
            self._create_field(file, name)

    def _create_floats(self, name: str, width: int) -> None:
        """Makes a data set of f32 (rows, width), uncompressed unless --compression says otherwise."""
        filters = {} if self.compression == "none" else {"compression": self.compression, "shuffle": True}
        rows = max(1, POINTS_PER_CHUNK * 3 // width)
        self._file.create_dataset(
            name, (0, width), self.types[name].dtype, maxshape=(None, width), chunks=(rows, width), **filters
        )

    def _create_field(self, file: h5py.File, name: str) -> None:
        if name == "time":
            file.create_dataset(name, (0,), _FIELD[name].dtype, maxshape=(None,), chunks=(4096,), **PACKED)
        elif name in POINT_FIELDS or name.startswith(KEPT):
            dtype, shape = POINT_FIELDS.get(name, (np.float32, ()))
            chunks = (POINTS_PER_CHUNK, *shape)
            file.create_dataset(name, (0, *shape), dtype, maxshape=(None, *shape), chunks=chunks, **PACKED)
        # pose and joint are created with the first sample, which tells the number of parts

    def write(self, sequence: CloudSequence) -> None:
        """Appends one sample. Raises DataError when it is malformed, lacks a declared field, or repeats a name."""
        self._check(sequence)
        self._append_sequence(sequence)
        self._note(sequence)

    def _note(self, sequence: CloudSequence, *said: Any) -> None:
        """Makes the sample count as written; `said`: what else `write` was given."""
        self._record([sequence, *said], self._placed)
        self._placed = None
        self._names.add(sequence.name)

    def write_again(self, given: list[Any]) -> str:
        """Writes a sample from the values that `_record` is given for it, and returns its name."""
        self.write(*given)
        return given[0].name

    def _check(self, sequence: CloudSequence) -> None:
        sequence.validate(len(self.class_names))
        if sequence.name in self._names:
            raise DataError(f"sample {sequence.name!r}: the name appears twice; names identify samples")
        missing = [name for name in self.fields if sequence.value(name) is None]
        if missing:
            raise DataError(f"sample {sequence.name!r}: no {', '.join(missing)}, though the other samples have it")
        for name in OF_PARTS.keys() & self._data.keys():
            own, others = getattr(sequence, name).shape[1], self._data[name].shape[1]
            if own != others:
                raise DataError(
                    f"sample {sequence.name!r}: {name} has {own} parts, earlier samples have {others}; pad to the largest"
                )

    def _append_sequence(self, sequence: CloudSequence) -> None:
        self._append("points", sequence.points)
        for name in self.fields:
            self._append(name, sequence.value(name))
        self._append("frame_offsets", sequence.frame_offsets[1:] + self._points)
        self._append("sequence_offsets", [self._frames + sequence.num_frames])
        for name in _PER_SAMPLE:
            self._append(name, [getattr(sequence, name)])
        self._shifts.append(sequence.shift)
        self._points += len(sequence.points)
        self._frames += sequence.num_frames

    def _append(self, name: str, values: np.ndarray | list) -> None:
        if name in self._index:
            column = self._index[name]
            if isinstance(column, array):
                column.frombytes(np.asarray(values, _FIELD[name].dtype).tobytes())
            else:
                column.extend(values)
            return
        if name in OF_PARTS and name not in self._file:
            shape = values.shape[1:]
            self._file.create_dataset(
                name, (0, *shape), _FIELD[name].dtype, maxshape=(None, *shape), chunks=(64, *shape), **PACKED
            )
        if name == "points" and self._chunks:
            self._placed = self._chunks.append(values)
        else:
            self._extend(name, values)
        self._unflushed += getattr(values, "nbytes", 0)
        if self._unflushed > _FLUSH_BYTES:
            self._atomic.flush()
            self._unflushed = 0

    def _extend(self, name: str, values: np.ndarray | list | array) -> None:
        if name not in self._data:  # kept open: closing would write its unfinished chunk, each time
            self._data[name] = self._file[name]
        data = self._data[name]
        start = len(data)
        data.resize(start + len(values), axis=0)
        data[start:] = values

    def __len__(self) -> int:
        return len(self._names)

    def __enter__(self) -> CloudsWriter:
        return self

    def _complete(self) -> None:
        if not len(self) and self.positions is None:
            raise DataError(f"{self.path}: not one good sample to write; nothing was written")
        if self._chunks:
            self._chunks.finish()
        for name, values in self._index.items():
            if values:
                self._extend(name, values)
        self._write_shifts()

    def _write_shifts(self) -> None:
        """Writes the samples' shifts, f64 (S,3), zero where one has none; nothing where none has, as in most files."""
        rows = [np.zeros(3) if shift is None else np.asarray(shift, np.float64) for shift in self._shifts]
        if np.any(rows):
            self._file.create_dataset("shift", data=np.array(rows))


def _empty_column(name: str) -> list | array:
    """Returns what holds a column of the index until the end: numbers as bytes, as there may be millions of samples."""
    return [] if _FIELD[name].kind == "str" else array(_FIELD[name].dtype.char)
