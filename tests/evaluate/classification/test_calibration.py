"""Calibration error against a loop over the definition, known gaps, and scores that are no probabilities."""

from __future__ import annotations

import json

import numpy as np
import pytest
from sklearn.calibration import calibration_curve

from dpcli.evaluate.classification.calibration import are_probabilities, calibrate, calibration_weighted
from dpcli.store import ScoresWriter
from tests.support.evaluating import evaluate


def case(seed: int, samples: int = 300, classes: int = 4) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    scores = rng.dirichlet(np.full(classes, 0.5), samples)
    labels = np.array([rng.choice(classes, p=row) for row in scores])
    return scores, labels


def by_definition(scores: np.ndarray, labels: np.ndarray) -> float:
    """The error, bin by bin, of intervals open below and closed above."""
    total = 0.0
    for k in range(15):
        inside = [i for i, row in enumerate(scores) if k / 15 < max(row) <= (k + 1) / 15]
        if inside:
            right = sum(int(np.argmax(scores[i])) == labels[i] for i in inside) / len(inside)
            total += len(inside) * abs(right - sum(max(scores[i]) for i in inside) / len(inside))
    return total / len(scores)


@pytest.mark.parametrize("seed", range(5))
def test_the_error_is_its_definition(seed):
    scores, labels = case(seed)
    found = calibrate(scores, labels)
    assert found.error == pytest.approx(by_definition(scores, labels), abs=1e-12)
    shares, means = calibration_curve(scores.argmax(1) == labels, scores.max(1), n_bins=15)  # of bins that hold samples
    assert found.accuracy[found.samples > 0] == pytest.approx(shares, abs=1e-12)
    assert found.confidence[found.samples > 0] == pytest.approx(means, abs=1e-12)
    assert np.isnan(found.accuracy[found.samples == 0]).all() and np.isnan(found.confidence[found.samples == 0]).all()


@pytest.mark.parametrize("seed", range(3))
def test_counts_are_repeated_samples(seed):
    scores, labels = case(seed, samples=40)
    counts = np.random.default_rng(seed).integers(0, 4, 40)
    repeated = calibrate(np.repeat(scores, counts, axis=0), np.repeat(labels, counts)).error
    found = calibration_weighted(scores, labels)(counts[None].astype(float))["calibration_error"]
    assert found == pytest.approx([repeated], abs=1e-12)


def test_a_calibrated_classifier_shows_what_chance_makes_and_an_overconfident_one_its_gap():
    scores, labels = case(0, samples=4000)
    found = calibrate(scores, labels)
    assert found.error < 1.5 * found.by_chance
    sure = scores**3 / (scores**3).sum(1, keepdims=True)
    worse = calibrate(sure, labels)
    gap = sure.max(1).mean() - (sure.argmax(1) == labels).mean()  # overconfident in every bin
    assert worse.error == pytest.approx(gap, abs=0.02) and worse.error > 5 * worse.by_chance


def test_bins_hold_all_samples_with_both_ends_inside():
    scores = np.array([[1.0, 0.0], [0.5, 0.5], [14 / 15, 1 / 15]])
    found = calibrate(scores, np.array([0, 1, 0]))
    assert found.samples.sum() == 3 and found.samples[14] == 1 and found.samples[13] == 1 and found.samples[7] == 1


@pytest.mark.parametrize("scores", [[[2.0, -1.0]], [[0.4, 0.4]], [[3.0, 1.0]]])
def test_scores_that_are_no_probabilities_have_no_error(scores):
    assert not are_probabilities(np.array(scores))
    assert calibrate(np.array(scores), np.array([0])) is None


@pytest.mark.parametrize("probabilities", [True, False])
def test_the_command_tells_it_in_every_form(tmp_path, probabilities):
    path, (scores, labels) = tmp_path / "s.h5", case(3, samples=50)
    with ScoresWriter(path, class_names=["a", "b", "c", "d"]) as writer:
        for i, (row, label) in enumerate(zip(scores, labels)):
            writer.write(f"v{i}", row if probabilities else 7 * row, label=int(label), split="test")

    def run(*words):
        return evaluate("classification", path, *words)

    found = json.loads(run("--json").stdout)
    text = run("--picture", str(tmp_path / "p.png"), "--resamples", "200").stdout
    assert (tmp_path / "p.png").stat().st_size > 10_000
    if probabilities:
        assert found["metrics"]["calibration_error"] == pytest.approx(
            by_definition(scores.astype("f4"), labels), abs=1e-6
        )
        low, high = found["intervals"]["metrics"]["calibration_error"]
        assert low < high and sum(found["metrics"]["reliability"]["samples"]) == 50
        assert "Calibration error: mean" in text
    else:
        assert found["metrics"]["calibration_error"] is None and found["metrics"]["reliability"] is None
        assert "the scores are no probabilities" in text
