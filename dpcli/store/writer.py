"""Writing a `clouds` file, one sample in memory at a time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import h5py
import numpy as np

from dpcli.errors import DataError, Stopped, UsageError
from dpcli.store.file import STRING, AtomicFile, open_store, read_provenance, write_root, write_skipped
from dpcli.store.sequence import POINT_FIELDS, CloudSequence

if TYPE_CHECKING:
    from dpcli.store.reader import CloudsReader

COMPRESSIONS = ("none", "lzf", "gzip")
POINTS_PER_CHUNK = 16384  # 192 KiB of xyz: inside HDF5's advice of 10 KiB to 1 MiB, few chunks per sequence
PACKED = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
_PER_SAMPLE = {"name": STRING, "split": STRING, "label": np.int32, "subject": np.int32, "camera": np.int32}


class CloudsWriter:
    """Context manager that writes sequences to `path`, through a part file renamed when whole.

    Leaving the block without an exception finishes the file; an exception removes the part, except that with
    `resume=True` a stop (Stopped, KeyboardInterrupt) keeps it, and the next writer with the same provenance continues:
    `written_names` lists what is already there. `fields` names the optional ones the samples carry
    (time, color, part, track, pose). `skipped`, set before the block ends: (name, reason) of samples left out, kept in
    the file. Raises UsageError when `path` exists and `force` is off.
    """

    kind = "clouds"

    def __init__(
        self,
        path: str | Path,
        *,
        class_names: Sequence[str] = (),
        length_unit: str = "m",
        source: str = "",
        seed: int = 0,
        fields: Sequence[str] = (),
        compression: str = "none",
        provenance: dict | Sequence[dict] | None = None,
        force: bool = False,
        resume: bool = False,
    ) -> None:
        if Path(path).exists() and not force:
            raise UsageError(f"{path}: exists already; --force replaces it")
        if compression not in COMPRESSIONS:
            raise UsageError(f"--compression {compression}: expected one of {', '.join(COMPRESSIONS)}")
        self.path, self.class_names, self.resume = Path(path), list(class_names), resume
        self.fields, self.compression = tuple(fields), compression
        self.provenance = [provenance] if isinstance(provenance, dict) else list(provenance or [])
        self._root = {"length_unit": length_unit, "source": source, "seed": seed}
        self.skipped: list[tuple[str, str]] = []
        self.written_names: list[str] = self._resumable() if resume and not force else []
        self.resumed = bool(self.written_names)
        self._atomic = AtomicFile(self.path, "r+" if self.resumed else "w")
        self._file = self._atomic.file
        if not self.resumed:
            self._create()
        self._names = set(self.written_names)

    def _resumable(self) -> list[str]:
        """Names in a part file left by an earlier run of the same configuration; none when it can't be continued."""
        part = self.path.with_name(f".{self.path.name}.part")
        if not part.exists():
            return []
        try:
            with open_store(part, [self.kind]) as file:
                return list(file["name"].asstr()[:]) if self._same_configuration(file) else []
        except (DataError, OSError, KeyError):
            return []

    def _same_configuration(self, file: h5py.File) -> bool:
        return read_provenance(file) == self.provenance

    def _create(self) -> None:
        file = self._file
        write_root(file, self.kind, class_names=self.class_names, provenance=self.provenance, **self._root)
        self._create_floats("points", 3)
        for name in ("frame_offsets", "sequence_offsets"):
            file.create_dataset(name, data=np.zeros(1, np.int64), maxshape=(None,), chunks=(4096,), **PACKED)
        for name, dtype in _PER_SAMPLE.items():
            file.create_dataset(
                name, (0,), dtype, maxshape=(None,), chunks=(1024,), **({} if dtype is STRING else PACKED)
            )
        for name in self.fields:
            self._create_field(file, name)

    def _create_floats(self, name: str, width: int) -> None:
        """A data set of f32 (rows, width), uncompressed unless --compression says otherwise."""
        filters = {} if self.compression == "none" else {"compression": self.compression, "shuffle": True}
        rows = max(1, POINTS_PER_CHUNK * 3 // width)
        self._file.create_dataset(name, (0, width), np.float32, maxshape=(None, width), chunks=(rows, width), **filters)

    def _create_field(self, file: h5py.File, name: str) -> None:
        if name == "time":
            file.create_dataset(name, (0,), np.float64, maxshape=(None,), chunks=(4096,), **PACKED)
        elif name in POINT_FIELDS:
            dtype, shape = POINT_FIELDS[name]
            chunks = (POINTS_PER_CHUNK, *shape)
            file.create_dataset(name, (0, *shape), dtype, maxshape=(None, *shape), chunks=chunks, **PACKED)
        elif name != "pose":  # created with the first sample, which tells the number of parts
            raise UsageError(f"unknown field {name!r}; expected time, pose, {', '.join(POINT_FIELDS)}")

    def write(self, sequence: CloudSequence) -> None:
        """Append one sample. DataError when it is malformed, lacks a declared field, or repeats a name."""
        self._check(sequence)
        self._append_sequence(sequence)
        self._names.add(sequence.name)

    def _check(self, sequence: CloudSequence) -> None:
        sequence.validate(len(self.class_names))
        if sequence.name in self._names:
            raise DataError(f"sample {sequence.name!r}: the name appears twice; names identify samples")
        missing = [name for name in self.fields if getattr(sequence, name) is None]
        if missing:
            raise DataError(f"sample {sequence.name!r}: no {', '.join(missing)}, though the other samples have it")
        if "pose" in self.fields and "pose" in self._file:
            own, others = sequence.pose.shape[1], self._file["pose"].shape[1]
            if own != others:
                raise DataError(f"sample {sequence.name!r}: pose has {own} parts, earlier samples have {others}; "
                                "pad to the largest")  # fmt: skip

    def _append_sequence(self, sequence: CloudSequence) -> None:
        points, frames = len(self._file["points"]), len(self._file["frame_offsets"]) - 1
        self._append("points", sequence.points)
        for name in self.fields:
            self._append(name, getattr(sequence, name))
        self._append("frame_offsets", sequence.frame_offsets[1:] + points)
        self._append("sequence_offsets", np.array([frames + sequence.num_frames]))
        for name in _PER_SAMPLE:
            self._append(name, [getattr(sequence, name)])

    def _append(self, name: str, values: np.ndarray | list) -> None:
        if name == "pose" and name not in self._file:
            shape = values.shape[1:]
            self._file.create_dataset(
                name, (0, *shape), np.float64, maxshape=(None, *shape), chunks=(64, *shape), **PACKED
            )
        data = self._file[name]
        start = len(data)
        data.resize(start + len(values), axis=0)
        data[start:] = values
        data.flush()  # as its closing would do, which can't say that the disk is full

    def __len__(self) -> int:
        return len(self._names)

    def __enter__(self) -> CloudsWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._finish()
        elif self.resume and issubclass(kind, (Stopped, KeyboardInterrupt)) and len(self):
            self._drop_half_sample()
            self._atomic.suspend()
        else:
            self._atomic.failed(kind, error, trace)

    def _drop_half_sample(self) -> None:
        """Ctrl-C may come in the middle of a sample; what was appended of it would shift those that follow."""
        for name, rows in self._whole_rows().items():
            if name in self._file and len(self._file[name]) != rows:
                self._file[name].resize(rows, axis=0)

    def _whole_rows(self) -> dict[str, int]:
        """Rows of each data set after the samples that are whole."""
        samples = len(self)
        frames = int(self._file["sequence_offsets"][samples])
        points = int(self._file["frame_offsets"][frames])
        rows = {"sequence_offsets": samples + 1, "frame_offsets": frames + 1, "points": points}
        rows |= {name: frames if name in ("time", "pose") else points for name in self.fields}
        return rows | dict.fromkeys(_PER_SAMPLE, samples)

    def _finish(self) -> None:
        if not len(self):
            self._atomic.discard()
            raise DataError(f"{self.path}: not one good sample to write; nothing was written")
        if (
            self.resumed
        ):  # a file that was closed and reopened has another layout: copy, so that equal work gives equal bytes
            self._repack()
        try:
            write_skipped(self._file, self.skipped)
        except BaseException as error:
            self._atomic.failed(type(error), error, None)
            raise
        self._atomic.commit()

    def _repack(self) -> None:
        self._file.close()
        whole = self._atomic.part.with_name(f".{self.path.name}.resumed.part")
        self._atomic.part.replace(whole)
        self._atomic = AtomicFile(self.path, "w")
        self._file, names = self._atomic.file, self._names
        self._names = set()
        try:
            self._create()
            with self._reader(whole) as reader:
                for index in range(len(names)):
                    self._copy(reader, index)
        except BaseException as error:
            self._atomic.failed(type(error), error, None)
            raise
        finally:
            whole.unlink(missing_ok=True)

    def _reader(self, path: Path) -> CloudsReader:
        from dpcli.store.reader import CloudsReader

        return CloudsReader(path)

    def _copy(self, reader: CloudsReader, index: int) -> None:
        self.write(reader.read(index))
