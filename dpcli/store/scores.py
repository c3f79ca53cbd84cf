"""Files of kind `scores`: a classifier's output for each sample."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.store.file import (
    PACKED,
    data_set,
    open_store,
    read_positions,
    read_provenance,
    read_skipped,
    read_strings,
    root_attributes,
    write_strings,
)
from dpcli.store.schema import fields_of
from dpcli.store.writing.resumable_writer import ResumableWriter

_FIELD = fields_of("scores")


class ScoresWriter(ResumableWriter):
    """Writes one sample after the other by `write`, as a context manager; the file appears whole when the block ends.

    A score row is small (C floats), so rows are kept in memory until the end, as floats alone, and with `resume=True` in
    the journal, too: see `ResumableWriter`, whose options it takes. `streams` names extra score arrays (such as static,
    dynamic) stored beside the final one; `rejects`: the file says of each sample whether nothing was recognized.
    """

    kind = "scores"

    def __init__(self, path: str | Path, *, streams: Sequence[str] = (), rejects: bool = False, **options: Any) -> None:
        self.streams, self.rejects = tuple(streams), rejects
        self._names: list[str] = []
        self._known: set[str] = set()  # the same, to find one again
        self._splits: list[str] = []
        self._labels = array("i")
        self._rejected = array("B")
        self._rows = [array("f") for _ in range(1 + len(self.streams))]  # of the scores, then of each stream
        check_class_names(path, options.get("class_names", ()))
        if wrong := [name for name in self.streams if not name or "/" in name or name == "."]:
            raise DataError(f"{path}: a stream called {wrong[0]!r}; HDF5 needs a name without a slash")
        super().__init__(path, **options)

    def write(
        self,
        name: str,
        scores: np.ndarray,
        *,
        label: int = -1,
        split: str = "",
        streams: dict[str, np.ndarray] | None = None,
        rejected: bool = False,
    ) -> None:
        """Adds one sample: scores f32 (C), and whether nothing was recognized, which a file that `rejects` keeps.

        Raises DataError unless scores are finite and as many as there are classes, the label is one of these or -1, and
        the name is new.
        """
        own = streams or {}
        if "\0" in name + split:
            raise DataError(f"sample {name!r}: the name or the split {split!r} holds NUL, expected texts")
        if name in self._known:
            raise DataError(f"sample {name!r}: the name appears twice; names identify samples")
        if not -1 <= label < len(self.class_names):
            raise DataError(
                f"sample {name!r}: label {label}, expected -1 (unknown) or 0 to {len(self.class_names) - 1}"
            )
        with np.errstate(over="ignore"):  # what float32 can't hold is infinite, and told below
            main, *others = (np.asarray(row, _FIELD["scores"].dtype) for row in (scores, *own.values()))
        for key, row in zip(("scores", *own), (main, *others)):  # a stream may be called scores, too
            if row.shape != (len(self.class_names),) or not np.isfinite(row).all():
                raise DataError(f"sample {name!r}: {key} {row.shape} must be {len(self.class_names)} finite numbers")
        if set(self.streams) != set(own):
            raise DataError(f"sample {name!r}: streams {sorted(own)}, expected {sorted(self.streams)}")
        by_stream = dict(zip(own, others))
        single = [by_stream[key] for key in self.streams]
        self._known.add(name)
        self._names.append(name)
        self._splits.append(split)
        self._labels.append(int(label))
        self._rejected.append(bool(rejected))
        for rows, row in zip(self._rows, (main, *single)):
            rows.frombytes(row.tobytes())
        self._record([name, split, int(label), main, single, bool(rejected)])

    def __len__(self) -> int:
        return len(self._names)

    def __enter__(self) -> ScoresWriter:
        return self

    def _about(self) -> dict[str, Any]:
        return super()._about() | {"streams": list(self.streams), "rejects": self.rejects}

    def write_again(self, given: list[Any]) -> str:
        """Writes a sample from the values that `_record` is given for it, and returns its name."""
        name, split, label, scores, single, rejected = given
        self.write(name, scores, label=label, split=split, streams=dict(zip(self.streams, single)), rejected=rejected)
        return name

    def _complete(self) -> None:
        if not self._names and self.positions is None:
            raise DataError(f"{self.path}: not one sample was scored; nothing was written")
        file = self._file
        write_strings(file, "name", self._names)
        write_strings(file, "split", self._splits)
        file.create_dataset("label", data=np.array(self._labels, _FIELD["label"].dtype), **PACKED)
        if self.rejects:
            file.create_dataset("rejected", data=np.array(self._rejected, _FIELD["rejected"].dtype), **PACKED)
        for name, rows in zip(("scores", *(f"streams/{stream}" for stream in self.streams)), self._rows):
            table = np.frombuffer(rows, _FIELD["scores"].dtype) if rows else np.zeros(0, _FIELD["scores"].dtype)
            file.create_dataset(name, data=table.reshape(len(self._names), len(self.class_names)))


class ScoresReader:
    """Holds a `scores` file in memory: scores f32 (S,C), labels i32 (S), names, splits, class_names, streams {name: (S,C)},
    rejected bool (S), None where nothing was asked to be.

    Raises DataError when shapes disagree, a value is not finite, a name repeats, or a label is out of range.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with open_store(path, ["scores"]) as file:
            self.attributes, self.provenance = root_attributes(file), read_provenance(file)
            self.class_names = read_strings(file, "class_names")
            self.names, self.splits = read_strings(file, "name"), read_strings(file, "split")
            self.scores, self.labels = (data_set(file, key)[:] for key in ("scores", "label"))
            self.streams = {key: file["streams"][key][:] for key in file.get("streams", {})}
            self.rejected = file["rejected"][:].astype(bool) if "rejected" in file else None
            self.skipped, self.positions = read_skipped(file), read_positions(file)
            self._check()

    @property
    def stream_names(self) -> tuple[str, ...]:
        """Returns the streams in the order in which the network has them: static, dynamic, others by name."""
        return tuple(sorted(self.streams, key=lambda name: (name != "static", name != "dynamic", name)))

    def given(self, index: int) -> list[Any]:
        """Returns sample `index` as the writer of such a file takes it again."""
        single = [self.streams[name][index] for name in self.stream_names]
        rejected = self.rejected is not None and bool(self.rejected[index])
        return [self.names[index], self.splits[index], int(self.labels[index]), self.scores[index], single, rejected]

    def close(self) -> None:
        """Does nothing: all of it is in memory."""

    def _check(self) -> None:
        shape = (len(self.names), len(self.class_names))
        for key, value in (("scores", self.scores), *self.streams.items()):
            if value.shape != shape:
                raise DataError(f"{self.path}: {key} has shape {value.shape}, expected (samples, classes) = {shape}")
            bad = np.flatnonzero(~np.isfinite(value).all(1))
            if len(bad):
                raise DataError(
                    f"{self.path}: {len(bad)} of {len(value)} samples with NaN or infinite {key}, the first "
                    f"{self.names[bad[0]]!r}; predict again"
                )
        if self.rejected is not None and self.rejected.shape != shape[:1]:
            raise DataError(f"{self.path}: rejected has shape {self.rejected.shape}, expected {shape[:1]}")
        if self.labels.shape != shape[:1] or len(self.splits) != shape[0]:
            raise DataError(f"{self.path}: {len(self.labels)} labels for {shape[0]} names")
        check_class_names(self.path, self.class_names)
        if len(set(self.names)) != len(self.names):
            raise DataError(f"{self.path}: sample names repeat; names identify samples")
        if len(self.labels) and (self.labels.min() < -1 or self.labels.max() >= shape[1]):
            row = int(np.argmax((self.labels < -1) | (self.labels >= shape[1])))
            raise DataError(
                f"{self.path}: label {self.labels[row]} of {self.names[row]!r}; expected -1..{shape[1] - 1}"
            )


def check_class_names(path: str | Path, class_names: Sequence[str]) -> None:
    """Raises DataError where two classes have one name; several may have none."""
    twice = sorted(name for name, count in Counter(class_names).items() if name and count > 1)
    if twice:
        raise DataError(
            f"{path}: {len(twice)} class names repeat, such as {twice[0]!r}; each class needs a name of its own"
        )
