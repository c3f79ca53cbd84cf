"""Clouds files that merge and split read."""

from __future__ import annotations

from pathlib import Path

from dpcli.errors import DataError
from dpcli.path_names import first_names
from dpcli.runtime.progress import log
from dpcli.store import CloudsReader
from dpcli.store.file import file_kind
from dpcli.store.schema import fields_of, find_field


def open_source(path: Path) -> CloudsReader:
    """Returns the reader of a clouds file, which opens the file again for its samples. Raises DataError when it is none."""
    kind = file_kind(path)
    if kind != "clouds":
        raise DataError(f"{path}: holds {kind}; merge and split take clouds files, as dpc prepare makes them")
    return CloudsReader(path)


def warn_of_others(reader: CloudsReader) -> None:
    """Tells which data sets of a file are not copied with its samples, such as those that people added."""
    known = {field.name: field for field in fields_of("clouds").values() if not field.group}
    with reader:
        others = [name for name in reader.file if find_field(known, name) is None]
    if others:
        log.warn(f"{reader.path}: left out, no data sets of a clouds file's samples: {first_names(others)}")
