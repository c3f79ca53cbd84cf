"""Files of kind `embedding`: a vector for each sample and stream, with a place in the plane to draw it at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.runtime.whole_file import refuse_existing
from dpcli.store.file import (
    PACKED,
    data_set,
    open_store,
    read_provenance,
    read_strings,
    root_attributes,
    write_root,
    write_strings,
)
from dpcli.store.schema import fields_of
from dpcli.store.writing.atomic_file import AtomicFile

_FIELD = fields_of("embedding")


@dataclass
class StreamEmbedding:
    """Holds features f32 (S,D); coordinates f32 (S,2), without unit; values: figures by name, such as neighbor_accuracy."""

    features: np.ndarray
    coordinates: np.ndarray
    values: dict[str, float] = field(default_factory=dict)


def write_embedding(
    path: str | Path,
    names: Sequence[str],
    labels: np.ndarray,
    splits: Sequence[str],
    streams: dict[str, StreamEmbedding],
    *,
    class_names: Sequence[str],
    source: str = "",
    seed: int = 0,
    provenance: Sequence[dict] = (),
    force: bool = False,
) -> None:
    """Writes the file whole or not at all. Raises UsageError when it exists and `force` is off, DataError on bad arrays."""
    refuse_existing(path, force)
    _check(str(path), names, labels, splits, streams)
    with AtomicFile(path) as file:
        write_root(
            file, "embedding", length_unit="", source=source, seed=seed, class_names=class_names, provenance=provenance
        )
        write_strings(file, "name", list(names))
        write_strings(file, "split", list(splits))
        file.create_dataset("label", data=np.asarray(labels, _FIELD["label"].dtype), **PACKED)
        for stream, said in streams.items():
            file.create_dataset(f"features/{stream}", data=said.features)
            file.create_dataset(f"coordinates/{stream}", data=said.coordinates).attrs.update(said.values)


def _check(
    path: str, names: Sequence[str], labels: np.ndarray, splits: Sequence[str], streams: dict[str, StreamEmbedding]
) -> None:
    if not streams:
        raise DataError(f"{path}: no stream to keep; expected at least one under features/")
    if len(set(names)) != len(names) or not len(names) == len(labels) == len(splits):
        raise DataError(
            f"{path}: {len(set(names))} different names, {len(labels)} labels, {len(splits)} splits; expected as many"
        )
    for stream, said in streams.items():
        for key, value, width in (("features", said.features, None), ("coordinates", said.coordinates, 2)):
            if value.ndim != 2 or len(value) != len(names) or (width and value.shape[1] != width):
                raise DataError(
                    f"{path}: {key}/{stream} has shape {value.shape}, expected ({len(names)}, {width or 'D'})"
                )
            if value.dtype != np.float32 or not np.isfinite(value).all():
                raise DataError(f"{path}: {key}/{stream} must be finite float32 numbers, found {value.dtype}")


class EmbeddingReader:
    """Holds an `embedding` file in memory: names, splits, labels i32 (S), class_names, streams {name: StreamEmbedding}.

    Raises DataError when shapes disagree or a value is not finite.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with open_store(path, ["embedding"]) as file:
            self.attributes, self.provenance = root_attributes(file), read_provenance(file)
            self.class_names = read_strings(file, "class_names")
            self.names, self.splits = read_strings(file, "name"), read_strings(file, "split")
            label, features, places = (data_set(file, key) for key in ("label", "features", "coordinates"))
            self.labels = label[:]
            if set(features) != set(places):
                raise DataError(f"{path}: features of {sorted(features)}, coordinates of {sorted(places)}")
            self.streams = {
                stream: StreamEmbedding(
                    features[stream][:],
                    places[stream][:],
                    {key: float(value) for key, value in places[stream].attrs.items()},
                )
                for stream in features
            }
        _check(str(path), self.names, self.labels, self.splits, self.streams)
