"""The work of one worker process: one item, read and thinned. Imports little, because every worker waits for it."""

from __future__ import annotations

import errno
import os
from functools import lru_cache
from pathlib import Path

from dpcli.errors import DataError, reading
from dpcli.prepare.reader import Item, Reader, Sample
from dpcli.prepare.thinning import Thinning
from dpcli.regular_files import regular_files_only, why_unreadable
from dpcli.runtime.pool import at_most
from dpcli.runtime.seeds import generator

_SECONDS_A_MEGABYTE = 10.0  # of the processor


def convert_item(
    reader: Reader, thinning: Thinning, seed: int, indexed: tuple[int, Item], item_seconds: float = 0
) -> Sample:
    """Returns the sample that the reader makes of an item, with its frames thinned.

    indexed: the item's place in the index, and the item. Its randomness depends on the seed and this place alone.
    item_seconds: of processor time it may take, and ten more for each megabyte of its files, in a worker process, which
    ends then; 0: no limit. Raises DataError when the item can't be read, whatever its reader or a library below it raised.
    """
    if not item_seconds:
        return _converted(reader, thinning, seed, indexed)
    with at_most(item_seconds + _SECONDS_A_MEGABYTE * _megabytes(indexed[1].path)):
        return _converted(reader, thinning, seed, indexed)


@lru_cache(maxsize=16)  # items may share a folder
def _megabytes(path: Path) -> float:
    try:
        return _bytes(path) / 1e6
    except (OSError, ValueError):  # not there, or a name that is none; the reader will say so
        return 0.0


def _bytes(path: str | Path) -> int:
    if not os.path.isdir(path):
        return os.stat(path).st_size
    total, folders = 0, [path]
    while folders:  # which may lie deeper in one another than functions may call themselves
        with os.scandir(folders.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    folders.append(entry.path)
                else:
                    total += entry.stat(follow_symlinks=False).st_size
    return total


def _converted(reader: Reader, thinning: Thinning, seed: int, indexed: tuple[int, Item]) -> Sample:
    index, item = indexed
    if item.problem:
        raise DataError(item.problem)
    if reason := why_unreadable(item.path):
        raise DataError(f"{item.path}: {reason}; it was not opened")
    rng = generator(seed, index)
    try:
        with reading(item.path), regular_files_only():
            sample = reader.read(item, rng)
    except OSError as error:
        if error.errno in (errno.EMFILE, errno.ENFILE):  # the machine's limit, which says nothing of the sample
            raise
        # unreadable, vanished, a failing disk: this sample is bad, the others may be good
        raise DataError(f"{error.filename or item.path}: {error.strerror or error}") from None
    sample.sequence.validate_index()  # what a file or a list says of it
    sample.sequence = thinning.apply(sample.sequence, rng)  # our own code: what fails here is a bug
    return sample
