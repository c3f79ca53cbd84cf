"""What a worker process does with one item. Imports little: every worker waits for it before its first frame."""

from __future__ import annotations

from dpcli.errors import DataError
from dpcli.prepare.reader import Item, Reader, Sample
from dpcli.prepare.thinning import Thinning
from dpcli.runtime.seeds import generator


def convert_item(reader: Reader, thinning: Thinning, seed: int, indexed: tuple[int, Item]) -> Sample:
    """Read and thin one item; its randomness depends on the seed and its index alone. Runs in a worker process."""
    index, item = indexed
    if item.problem:
        raise DataError(item.problem)
    rng = generator(seed, index)
    choose = thinning.blind(rng) if getattr(reader, "chooses", False) else None
    try:
        sample = reader.read(item, rng, choose) if choose else reader.read(item, rng)
    except OSError as error:  # unreadable, vanished, a failing disk: this sample is bad, the others may be good
        raise DataError(f"{error.filename or item.path}: {error.strerror or error}") from None
    sample.sequence = thinning.apply(sample.sequence, rng)
    return sample
