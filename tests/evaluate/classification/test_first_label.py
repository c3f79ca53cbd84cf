"""Labels that count from 1 beside scores that count from 0: the log asks; others pass without a word."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.evaluate.classification.protocol import evaluate_classification
from dpcli.store import ScoresWriter


@pytest.mark.parametrize("classes", [4, 12])
@pytest.mark.parametrize(
    ("step", "known", "told"),
    [
        (1, slice(0, -1), "one lower"),
        (-1, slice(1, None), "one higher"),
        (0, slice(0, -1), ""),
        (0, slice(1, None), ""),
    ],
)
def test_labels_one_class_off_are_told(tmp_path, capsys, classes, step, known, told):
    rng = np.random.default_rng(classes)
    truth = rng.choice(np.arange(classes)[known], 80)
    with ScoresWriter(tmp_path / "s.h5", class_names=[f"c{k}" for k in range(classes)]) as writer:
        for k, label in enumerate(truth):
            scores = rng.normal(size=classes)
            scores[label] += 2
            writer.write(f"v{k}", scores, label=int(label) + step, split="test")
    evaluate_classification(tmp_path / "s.h5")
    said = capsys.readouterr().err
    assert (told in said) if told else "one lower" not in said and "one higher" not in said


def test_scores_that_say_nothing_are_no_reason_to_ask(tmp_path, capsys):
    rng = np.random.default_rng(0)
    for seed in range(20):
        with ScoresWriter(tmp_path / f"{seed}.h5", class_names=[f"c{k}" for k in range(6)]) as writer:
            for k, label in enumerate(rng.integers(1, 5, 60)):
                writer.write(f"v{k}", rng.normal(size=6), label=int(label), split="test")
        evaluate_classification(tmp_path / f"{seed}.h5")
    assert "would be right" not in capsys.readouterr().err
