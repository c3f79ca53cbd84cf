"""Files of kind `scores`: what a classifier says of each sample."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.store.file import STRING, AtomicFile, open_store, read_provenance, read_strings, root_attributes, write_root

_PACKED = {"compression": "gzip", "compression_opts": 4, "shuffle": True}


class ScoresWriter:
    """Context manager; `write` one sample after the other, the file appears whole when the block ends.

    A score row is small (C floats), so rows are kept until the end. `streams` names extra score arrays
    (such as static, dynamic) stored beside the final one.
    """

    def __init__(
        self, path: str | Path, *, class_names: Sequence[str], seed: int = 0, source: str = "",
        provenance: dict | Sequence[dict] | None = None, streams: Sequence[str] = (), force: bool = False,
    ) -> None:  # fmt: skip
        if Path(path).exists() and not force:
            raise UsageError(f"{path}: exists already; --force replaces it")
        self.class_names, self.streams = list(class_names), tuple(streams)
        self._root = {"length_unit": "", "source": source, "seed": seed}
        self.provenance = [provenance] if isinstance(provenance, dict) else list(provenance or [])
        self._rows: list[tuple] = []
        self._atomic = AtomicFile(path)

    def write(
        self,
        name: str,
        scores: np.ndarray,
        *,
        label: int = -1,
        split: str = "",
        streams: dict[str, np.ndarray] | None = None,
    ) -> None:
        """One sample: scores f32 (C); DataError unless they are finite and as many as there are classes."""
        own = streams or {}
        for key, row in (("scores", scores), *own.items()):  # a stream may be called scores, too
            if np.shape(row) != (len(self.class_names),) or not np.isfinite(row).all():
                raise DataError(
                    f"sample {name!r}: {key} {np.shape(row)} must be {len(self.class_names)} finite numbers"
                )
        if set(self.streams) != set(own):
            raise DataError(f"sample {name!r}: streams {sorted(own)}, expected {sorted(self.streams)}")
        kept = {key: np.asarray(row, np.float32) for key, row in own.items()}
        self._rows.append((name, split, int(label), np.asarray(scores, np.float32), kept))

    def __len__(self) -> int:
        return len(self._rows)

    def __enter__(self) -> ScoresWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None or not self._rows:
            self._atomic.failed(kind, error, trace)
            if kind is None:
                raise DataError(f"{self._atomic.target}: not one sample was scored; nothing was written")
            return
        try:
            self._write_all()
        except (OSError, RuntimeError) as problem:
            self._atomic.failed(type(problem), problem, None)
            raise
        self._atomic.commit()

    def _write_all(self) -> None:
        file = self._atomic.file
        write_root(file, "scores", class_names=self.class_names, provenance=self.provenance, **self._root)
        names, splits, labels, scores, streams = zip(*self._rows)
        file.create_dataset("name", data=np.array(names, dtype=object), dtype=STRING)
        file.create_dataset("split", data=np.array(splits, dtype=object), dtype=STRING)
        file.create_dataset("label", data=np.array(labels, np.int32), **_PACKED)
        file.create_dataset("scores", data=np.stack(scores))
        for stream in self.streams:
            file.create_dataset(f"streams/{stream}", data=np.stack([row[stream] for row in streams]))


class ScoresReader:
    """A `scores` file in memory: scores f32 (S,C), labels i32 (S), names, splits, class_names, streams {name: (S,C)}.

    Raises DataError when shapes disagree, a value is not finite, a name repeats, or a label is out of range.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with open_store(path, ["scores"]) as file:
            self.attributes, self.provenance = root_attributes(file), read_provenance(file)
            self.class_names = read_strings(file, "class_names")
            self.names, self.splits = read_strings(file, "name"), read_strings(file, "split")
            for key in ("scores", "label"):
                if key not in file:
                    raise DataError(f"{path}: data set {key!r} is missing; the file is incomplete, make it again")
            self.scores, self.labels = file["scores"][:], file["label"][:]
            self.streams = {key: file["streams"][key][:] for key in file.get("streams", {})}
        self._check()

    def _check(self) -> None:
        shape = (len(self.names), len(self.class_names))
        for key, value in (("scores", self.scores), *self.streams.items()):
            if value.shape != shape:
                raise DataError(f"{self.path}: {key} has shape {value.shape}, expected (samples, classes) = {shape}")
            bad = np.flatnonzero(~np.isfinite(value).all(1))
            if len(bad):
                raise DataError(f"{self.path}: {len(bad)} of {len(value)} samples with NaN or infinite {key}, the first "
                                f"{self.names[bad[0]]!r}; predict again")  # fmt: skip
        if self.labels.shape != shape[:1] or len(self.splits) != shape[0]:
            raise DataError(f"{self.path}: {len(self.labels)} labels for {shape[0]} names")
        if len(set(self.names)) != len(self.names):
            raise DataError(f"{self.path}: sample names repeat; names identify samples")
        if len(self.labels) and (self.labels.min() < -1 or self.labels.max() >= shape[1]):
            row = int(np.argmax((self.labels < -1) | (self.labels >= shape[1])))
            raise DataError(
                f"{self.path}: label {self.labels[row]} of {self.names[row]!r}; expected -1..{shape[1] - 1}"
            )
