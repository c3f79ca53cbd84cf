"""Temperature and threshold: recovered where they are known, kept in bounds where little is known, refused where absent."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.classify.confidence import NOTE, Confidence, choose_confidence, fit_confidence, stored_confidence
from dpcli.errors import UsageError


def case(seed: int, sharpness: float, count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities, sharpened, whose labels were drawn before that."""
    rng = np.random.default_rng(seed)
    true = rng.dirichlet(np.full(5, 0.5), count)
    labels = np.array([rng.choice(5, p=row) for row in true])
    powers = np.maximum(true, 1e-9) ** sharpness
    return powers / powers.sum(1, keepdims=True), labels


@pytest.mark.parametrize("sharpness", [0.5, 1.0, 2.5])
def test_the_temperature_undoes_what_sharpened_the_probabilities(sharpness):
    scores, labels = case(0, sharpness)
    found = fit_confidence(scores, labels, np.zeros((0, 5)), "")
    assert found.temperature == pytest.approx(sharpness, rel=0.08)
    assert (found.of(scores).argmax(1) == scores.argmax(1)).all()


def test_a_few_videos_that_are_all_right_do_not_make_it_certain():
    scores = np.full((3, 2), [0.7, 0.3])
    found = fit_confidence(scores, np.zeros(3, int), np.zeros((0, 2)), "")
    assert 0.4 < found.temperature < 1


def test_the_threshold_rejects_what_stands_still_unless_actions_would_go():
    rng = np.random.default_rng(0)
    sure, labels = np.column_stack([p := rng.uniform(0.8, 0.99, 200), 1 - p]), np.zeros(200, int)
    idle = np.column_stack([p := rng.uniform(0.5, 0.6, 100), 1 - p])
    found = fit_confidence(sure, labels, idle, "")
    assert found.rejected_still >= 0.93 and found.kept == 1.0
    hopeless = fit_confidence(sure, labels, np.full((100, 2), [0.995, 0.005]), "")
    assert hopeless.kept >= 0.95 and hopeless.rejected_still == 0.0


def test_notes_bring_it_back_and_old_weights_have_none():
    own = Confidence(0.6, 0.4, 12, 0.9, 0.8, "here")
    assert stored_confidence({NOTE: own.notes()}) == own
    assert stored_confidence({}) is None
    assert choose_confidence({}, None, "m") == Confidence()
    assert choose_confidence({NOTE: own.notes()}, "auto", "m") == own
    assert choose_confidence({NOTE: own.notes()}, "0.7", "m").threshold == 0.7
    assert choose_confidence({NOTE: own.notes()}, "0.7", "m").temperature == 0.6


@pytest.mark.parametrize(
    "given, told", [("auto", "no threshold of its own"), ("2", "0 to 1"), ("x", "0 to 1"), ("nan", "0 to 1")]
)
def test_a_threshold_that_is_none_is_refused(given, told):
    with pytest.raises(UsageError, match=told):
        choose_confidence({}, given, "m")
