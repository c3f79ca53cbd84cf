"""Clouds files that merge and split read: what their indices say, and readers of which only a few are open."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dpcli.errors import DataError
from dpcli.path_names import first_names
from dpcli.runtime.machines.shards import Shard, shard_of
from dpcli.runtime.progress import log
from dpcli.store import CloudSequence, CloudsReader
from dpcli.store.file import file_kind
from dpcli.store.schema import fields_of, find_field
from dpcli.store.sequence import OF_PARTS

_OPEN = 64  # files held open at a time; shards are read in turn, and there may be a thousand


@dataclass(kw_only=True)
class Source:
    """Holds what the index of one file says; its points stay on the disk.

    made_by: the reader's name. others: its data sets that no sample is made of. parts: how many its poses and joints
    have. prefix: what goes before its samples' names in the joined file.
    """

    path: Path
    class_names: list[str]
    length_unit: str
    seed: int = 0
    made_by: str = ""
    names: list[str] = field(default_factory=list)
    labels: list[int] = field(default_factory=list)
    fields: tuple[str, ...] = ()
    provenance: list[dict[str, Any]] = field(default_factory=list)
    skipped: list[tuple[str, str]] = field(default_factory=list)
    shard: Shard | None = None
    others: list[str] = field(default_factory=list)
    parts: int = 0
    prefix: str = ""

    def sample_name(self, index: int) -> str:
        """Returns the sample's name in the joined file."""
        return self.prefix + self.names[index]

    def warn_of_others(self) -> None:
        """Tells which data sets of the file are not copied with its samples, such as those that people added."""
        if self.others:
            log.warn(f"{self.path}: left out, no data sets of a clouds file's samples: {first_names(self.others)}")


def read_source(path: Path) -> Source:
    """Returns the index of a clouds file. Raises DataError when it is none."""
    if file_kind(path) != "clouds":
        raise DataError(
            f"{path}: holds {file_kind(path)}; merge and split take clouds files, as dpc prepare makes them"
        )
    with CloudsReader(path) as reader:
        root = reader.attributes
        known = {field.name: field for field in fields_of("clouds").values() if not field.group}
        found = shard_of(reader.provenance[-1]) if reader.provenance else None
        return Source(
            path=path,
            class_names=reader.class_names,
            length_unit=reader.length_unit,
            seed=int(root.get("seed", 0)),
            made_by=str(root.get("source", "")),
            names=list(reader.names),
            labels=reader.labels.tolist(),
            fields=reader.fields,
            provenance=reader.provenance,
            skipped=reader.skipped,
            shard=found[0] if found else None,
            others=[name for name in reader.file if find_field(known, name) is None],
            parts=max(
                (n for key in OF_PARTS.keys() & set(reader.fields) for n in reader.file[key].shape[1:2]), default=0
            ),
        )


class OpenFiles:
    """Keeps readers by path, only the latest used of them open."""

    def __init__(self) -> None:
        self._readers: OrderedDict[Path, CloudsReader] = OrderedDict()

    def read(self, path: Path, index: int) -> CloudSequence:
        """Returns one sequence of a file, which is opened when it isn't."""
        if path not in self._readers:
            self._readers[path] = CloudsReader(path)
        self._readers.move_to_end(path)
        sequence = self._readers[path].read(index)
        while len(self._readers) > _OPEN:
            self._readers.popitem(last=False)[1].close()
        return sequence

    def close(self) -> None:
        """Closes all files."""
        for reader in self._readers.values():
            reader.close()
