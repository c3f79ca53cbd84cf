"""Random generators derived from one seed and an item's index, so results don't depend on order, workers or shards."""

from __future__ import annotations

import numpy as np


def generator(seed: int, *keys: int) -> np.random.Generator:
    """A NumPy generator for `(seed, *keys)`; the same arguments always give the same stream.

    `keys` are non-negative integers such as an item's index or an epoch. 0 is a valid seed.
    """
    # SeedSequence ignores zeros at the end: the number of keys tells (seed, 1) from (seed, 1, 0)
    return np.random.default_rng(np.random.SeedSequence([int(seed), len(keys), *map(int, keys)]))


def scikit_learn_state(seed: int) -> int:
    """The `random_state` for a seed: scikit-learn takes 32 bits of it."""
    return seed % 2**32
