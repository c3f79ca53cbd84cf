"""The files that comparisons and runs are tested with, and the commands."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.support.evaluating import evaluate
from tests.support.parts_helpers import CHAIN, perfect, truth_sequence, write_parts, write_truth
from tests.support.scores_helpers import write_scores


@pytest.fixture(scope="session")
def run() -> Callable[..., str]:
    """`dpc evaluate` with these words; it prints, or the test gets what it raises."""
    return lambda *words: evaluate(*words, raising=True).stdout


@pytest.fixture(scope="module")
def scores(tmp_path_factory) -> dict[str, Path]:
    """good: 5 wrong of 60; close: 7 wrong, two of them others'; shuffled: labels at random."""
    folder = tmp_path_factory.mktemp("scores")
    shuffled = {int(i) for i in np.random.default_rng(0).choice(60, 40, replace=False)}
    return {
        "good": write_scores(folder / "good.h5", {0, 1, 2, 3, 4}, seed=0),
        "close": write_scores(folder / "close.h5", {0, 1, 2, 10, 11, 12, 13}, seed=1),
        "shuffled": write_scores(folder / "shuffled.h5", shuffled, seed=2),
    }


@pytest.fixture(scope="module")
def parts(tmp_path_factory) -> dict[str, Path]:
    """Eight sequences, predicted rightly, and by a twin whose part ids are shuffled and whose flow is noisy."""
    folder = tmp_path_factory.mktemp("parts")
    truths = [truth_sequence(f"s{i}", seed=i, label=i % 2) for i in range(8)]
    rng = np.random.default_rng(0)

    def predicted(noise: float, shuffle: float, only: slice = slice(None)) -> list[tuple]:
        made = []
        for truth in truths[only]:
            sequence, probability, pairs, motion, flow = perfect(truth, 4)
            moved = rng.random(len(sequence.part)) < shuffle
            sequence.part[moved] = rng.permutation(sequence.part[moved])
            flow = [one + rng.normal(scale=noise, size=one.shape).astype(np.float32) for one in flow]
            made.append((sequence, probability, pairs, motion, flow))
        return made

    backward = [perfect(truth, 4, pairs=CHAIN[:2]) for truth in truths]
    return {
        "truth": write_truth(folder / "truth.h5", truths),
        "good": write_parts(folder / "good.h5", predicted(0.01, 0.1)),
        "twin": write_parts(folder / "twin.h5", predicted(0.1, 1.0)),
        "fewer": write_parts(folder / "fewer.h5", predicted(0.02, 0.2, slice(2, 8))),
        "pairs": write_parts(folder / "pairs.h5", backward),
    }
