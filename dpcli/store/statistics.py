"""Files of kind `statistics`: what an evaluation counted of each sample, from which the metrics of all are made."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.store.file import (
    open_store,
    read_positions,
    read_provenance,
    read_skipped,
    read_strings,
    root_attributes,
    write_strings,
)
from dpcli.store.writing.resumable_writer import ResumableWriter
from dpcli.text_files import parse_json


class StatisticsWriter(ResumableWriter):
    """Writes one sample after the other by `write`; the file appears whole when the block ends: see `ResumableWriter`.

    The metrics that they are for, the data and the choices are told by the last entry of the provenance.
    """

    kind = "statistics"

    def __init__(self, path: str | Path, **options: Any) -> None:
        self._names: list[str] = []
        self._texts: list[str] = []
        super().__init__(path, **options)

    def write(self, name: str, values: dict[str, Any]) -> None:
        """Adds one sample: numbers, texts, lists and arrays by name; arrays come back as they were, to the bit."""
        self.write_again([name, json.dumps(_packed(values), sort_keys=True)])

    def write_again(self, given: list[Any]) -> str:
        """Writes a sample from the values that `_record` is given for it, and returns its name."""
        name, text = given
        self._names.append(name)
        self._texts.append(text)
        self._record([name, text])
        return name

    def __len__(self) -> int:
        return len(self._names)

    def __enter__(self) -> StatisticsWriter:
        return self

    def _complete(self) -> None:
        for name, texts in (("name", self._names), ("statistics", self._texts)):
            write_strings(self._file, name, texts)


class StatisticsReader:
    """Holds a `statistics` file in memory; `read` returns one sample's values. Raises DataError when it breaks the contract."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with open_store(path, ["statistics"]) as file:
            self.attributes, self.provenance = root_attributes(file), read_provenance(file)
            self.class_names = read_strings(file, "class_names")
            self.names, self._texts = read_strings(file, "name"), read_strings(file, "statistics")
            self.skipped, self.positions = read_skipped(file), read_positions(file)
        self.length_unit = str(self.attributes.get("length_unit", ""))
        if len(self.names) != len(self._texts) or not self.provenance:
            raise DataError(f"{path}: {len(self._texts)} statistics for {len(self.names)} names; evaluate again")

    def read(self, index: int) -> dict[str, Any]:
        """Returns the values of one sample, as they were written. Raises DataError when they can't be read."""
        try:
            return _unpacked(parse_json(self._texts[index], self.path))
        except (DataError, ValueError, TypeError, KeyError, RecursionError):
            raise DataError(
                f"{self.path}: the statistics of {self.names[index]!r} are damaged; evaluate again"
            ) from None

    def given(self, index: int) -> list[str]:
        """Returns sample `index` as the writer of such a file takes it again."""
        return [self.names[index], self._texts[index]]

    def close(self) -> None:
        """Does nothing: all of it is in memory."""


def _packed(value: Any) -> Any:
    """Returns `value` for JSON, whose numbers are exact for float64; an array leaves its type and shape."""
    if isinstance(value, np.ndarray):
        return {"dtype": value.dtype.str, "shape": list(value.shape), "values": value.ravel().tolist()}
    if isinstance(value, dict):
        return {key: _packed(one) for key, one in value.items()}
    return value.item() if isinstance(value, np.generic) else value


def _unpacked(value: Any) -> Any:
    if isinstance(value, dict) and value.keys() == {"dtype", "shape", "values"}:
        return np.array(value["values"], np.dtype(value["dtype"])).reshape(value["shape"])
    return {key: _unpacked(one) for key, one in value.items()} if isinstance(value, dict) else value
