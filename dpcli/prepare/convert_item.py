"""The work of one worker process: one item, read and thinned. Imports little, because every worker waits for it."""

from __future__ import annotations

from dpcli.errors import DataError, reading
from dpcli.prepare.reader import Item, Reader, Sample
from dpcli.prepare.thinning import Thinning
from dpcli.regular_files import regular_files_only, why_unreadable
from dpcli.runtime.seeds import generator


def convert_item(reader: Reader, thinning: Thinning, seed: int, indexed: tuple[int, Item]) -> Sample:
    """Returns the sample that the reader makes of an item, with its frames thinned.

    indexed: the item's place in the index, and the item. Its randomness depends on the seed and this place alone.
    Raises DataError when the item can't be read, whatever its reader or a library below it raised.
    """
    index, item = indexed
    if item.problem:
        raise DataError(item.problem)
    if reason := why_unreadable(item.path):
        raise DataError(f"{item.path}: {reason}; it was not opened")
    rng = generator(seed, index)
    try:
        with reading(item.path), regular_files_only():
            sample = reader.read(item, rng)
    except OSError as error:  # unreadable, vanished, a failing disk: this sample is bad, the others may be good
        raise DataError(f"{error.filename or item.path}: {error.strerror or error}") from None
    sample.sequence = thinning.apply(sample.sequence, rng)  # our own code: what fails here is a bug
    return sample
