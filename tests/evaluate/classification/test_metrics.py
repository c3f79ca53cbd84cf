"""Classification metrics against scikit-learn, hand-computed values, and themselves cut into shards."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn import metrics as reference

from dpcli.errors import DataError
from dpcli.evaluate.choices import TOP_K
from dpcli.evaluate.classification.metrics import (
    ClassificationMetrics,
    ClassificationStatistics,
    classification_compute,
    classification_metrics,
    classification_update,
    predicted_labels,
    top_hits,
)
from dpcli.evaluate.proportions import divide, mean_defined, wilson_interval


def random_case(seed: int, samples: int, classes: int, ties: bool = False) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, classes, samples)
    scores = rng.normal(size=(samples, classes)).astype(np.float32)
    scores[np.arange(samples), labels] += 1.0
    return (np.round(scores) if ties else scores), labels


def assert_agrees_with_sklearn(metrics: ClassificationMetrics, scores: np.ndarray, labels: np.ndarray) -> None:
    classes = np.arange(scores.shape[1])
    predicted = scores.argmax(1)
    present = np.union1d(labels, predicted)
    np.testing.assert_array_equal(metrics.confusion, reference.confusion_matrix(labels, predicted, labels=classes))
    precision, recall, f1, support = reference.precision_recall_fscore_support(
        labels, predicted, labels=classes, zero_division=np.nan
    )
    np.testing.assert_allclose(metrics.precision, precision, atol=1e-12)
    np.testing.assert_allclose(metrics.recall, recall, atol=1e-12)
    np.testing.assert_array_equal(metrics.support, support)
    np.testing.assert_allclose(metrics.f1[present], f1[present], atol=1e-12)
    assert metrics.accuracy == pytest.approx(reference.accuracy_score(labels, predicted), abs=1e-12)
    occurring = np.isin(predicted, labels)
    if occurring.all():  # sklearn warns about classes that are predicted but never true
        balanced = reference.balanced_accuracy_score(labels, predicted)
        assert metrics.balanced_accuracy == pytest.approx(balanced, abs=1e-12)
    macro = reference.f1_score(labels, predicted, labels=present, average="macro")
    assert metrics.macro_f1 == pytest.approx(macro, abs=1e-12)
    if scores.shape[1] > TOP_K:
        top = reference.top_k_accuracy_score(labels, scores, k=TOP_K, labels=classes)
        assert metrics.top_accuracy == pytest.approx(top, abs=1e-12)


@pytest.mark.filterwarnings("ignore:A single label")  # scikit-learn of the smallest case
@pytest.mark.parametrize(("samples", "classes"), [(1, 2), (7, 3), (40, 6), (227, 20), (500, 60), (12, 40)])
def test_metrics_equal_sklearn(samples: int, classes: int) -> None:
    scores, labels = random_case(samples, samples, classes)
    assert_agrees_with_sklearn(classification_metrics(scores, labels), scores, labels)


def broken_transposed(scores: np.ndarray, labels: np.ndarray) -> ClassificationMetrics:
    good = classification_update(scores, labels)
    return classification_compute(ClassificationStatistics(good.confusion.T, good.top_hits))


def broken_off_by_one(scores: np.ndarray, labels: np.ndarray) -> ClassificationMetrics:
    good = classification_update(scores, labels)
    return classification_compute(replace(good, top_hits=int(top_hits(scores, labels, top_k=4).sum())))


def broken_padding(scores: np.ndarray, labels: np.ndarray) -> ClassificationMetrics:
    """The last sample twice, as a sampler that pads the last batch does."""
    return classification_metrics(np.concatenate([scores, scores[-1:]]), np.concatenate([labels, labels[-1:]]))


@pytest.mark.parametrize("broken", [broken_transposed, broken_padding])
def test_the_checker_rejects_broken_twins(broken) -> None:
    scores, labels = random_case(3, 120, 8)
    with pytest.raises(AssertionError):
        assert_agrees_with_sklearn(broken(scores, labels), scores, labels)


def test_the_checker_sees_a_wrong_k() -> None:
    scores, labels = random_case(3, 120, 8)
    right, wrong = classification_metrics(scores, labels), broken_off_by_one(scores, labels)
    assert wrong.top_accuracy < right.top_accuracy


def test_by_hand() -> None:
    """Three classes; truth 0 0 0 1 1, predicted 0 0 1 1 0; class 2 neither occurs nor is predicted."""
    scores = np.eye(3, dtype=np.float32)[[0, 0, 1, 1, 0]]
    metrics = classification_metrics(scores, np.array([0, 0, 0, 1, 1]))
    assert metrics.confusion.tolist() == [[2, 1, 0], [1, 1, 0], [0, 0, 0]]
    assert (metrics.correct, metrics.samples, metrics.accuracy) == (3, 5, 0.6)
    np.testing.assert_allclose(metrics.recall, [2 / 3, 1 / 2, np.nan])
    np.testing.assert_allclose(metrics.precision, [2 / 3, 1 / 2, np.nan])
    np.testing.assert_allclose(metrics.f1, [2 / 3, 1 / 2, np.nan])
    assert metrics.balanced_accuracy == pytest.approx((2 / 3 + 1 / 2) / 2)
    assert metrics.macro_f1 == pytest.approx((2 / 3 + 1 / 2) / 2)
    assert metrics.top_accuracy is None


def test_a_class_that_occurs_but_is_never_predicted_has_f1_zero_and_no_precision() -> None:
    metrics = classification_metrics(np.eye(2, dtype=np.float32)[[0, 0]], np.array([0, 1]))
    assert math.isnan(metrics.precision[1]) and metrics.f1[1] == 0 and metrics.recall[1] == 0
    assert metrics.macro_f1 == pytest.approx((2 / 3 + 0) / 2)


def test_ties_go_to_the_lowest_label_for_the_best_and_for_the_five_best() -> None:
    flat = np.zeros((7, 7), np.float32)
    metrics = classification_metrics(flat, np.arange(7))
    assert predicted_labels(flat).tolist() == [0] * 7
    assert metrics.accuracy == pytest.approx(1 / 7)
    assert metrics.top_accuracy == pytest.approx(5 / 7)  # a rule that counts every tie as a hit would say 7/7


def test_five_best_of_five_is_no_number() -> None:
    assert classification_metrics(np.eye(5), np.arange(5)).top_accuracy is None
    assert classification_metrics(np.eye(6), np.arange(6)).top_accuracy == 1


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    samples=st.integers(1, 60),
    classes=st.integers(1, 9),
    ties=st.booleans(),
    data=st.data(),
)
def test_shards_add_up_to_the_whole(seed: int, samples: int, classes: int, ties: bool, data: st.DataObject) -> None:
    scores, labels = random_case(seed, samples, classes, ties)
    cuts = sorted(data.draw(st.sets(st.integers(1, max(samples - 1, 1)), max_size=4)))
    parts = [p for p in zip(np.split(scores, cuts), np.split(labels, cuts), strict=True) if len(p[0])]
    first, *others = [classification_update(*part) for part in parts]
    merged = sum(others, first)
    whole = classification_update(scores, labels)
    assert merged.confusion.tolist() == whole.confusion.tolist() and merged.top_hits == whole.top_hits
    assert merged.confusion.dtype == np.int64
    once, again = classification_compute(whole), classification_compute(merged)
    assert (once.accuracy, once.interval, once.top_accuracy) == (again.accuracy, again.interval, again.top_accuracy)


def test_averaging_the_accuracy_of_shards_is_not_merging() -> None:
    """Why statistics are merged: shards of 1 and 9 samples."""
    scores, labels = np.eye(2, dtype=np.float32)[[0] * 10], np.array([0] + [1] * 9)
    parts = [classification_update(scores[:1], labels[:1]), classification_update(scores[1:], labels[1:])]
    assert classification_compute(parts[0] + parts[1]).accuracy == pytest.approx(0.1)
    assert np.mean([classification_compute(part).accuracy for part in parts]) == pytest.approx(0.5)


def test_statistics_of_different_classes_do_not_add() -> None:
    two, three = classification_update(np.eye(2), np.arange(2)), classification_update(np.eye(3), np.arange(3))
    with pytest.raises(ValueError, match="2 and 3 classes"):
        two + three


@pytest.mark.parametrize(
    ("scores", "labels", "said"),
    [
        (np.zeros((0, 3)), np.zeros(0, int), "no samples"),
        (np.zeros((2, 0)), np.zeros(2, int), "no samples"),
        (np.zeros((2, 3)), np.array([0, 3]), "label 3 of sample 1 .* 0..2"),
        (np.zeros((2, 3)), np.array([-1, 0]), "label -1 of sample 0"),
        (np.array([[0, 1.0], [np.nan, 0]]), np.array([0, 1]), "1 of 2 samples .* number 1"),
        (np.array([[0, np.inf], [0, 0]]), np.array([0, 1]), "1 of 2 samples .* number 0"),
        (np.zeros((2, 3)), np.array([0]), "expected"),
        (np.zeros(3), np.array([0, 1, 2]), "expected"),
    ],
)
def test_bad_input_is_named(scores: np.ndarray, labels: np.ndarray, said: str) -> None:
    with pytest.raises(DataError, match=said):
        classification_update(scores, labels)


def test_divide_owns_the_zero() -> None:
    np.testing.assert_array_equal(divide([1, 0, 3], [2, 0, 0]), [0.5, np.nan, np.nan])
    assert math.isnan(mean_defined(np.array([np.nan]))) and mean_defined(np.array([np.nan, 1, 2])) == 1.5


@pytest.mark.parametrize(("hits", "trials"), [(0, 10), (10, 10), (193, 227), (1, 3), (500, 1000)])
def test_wilson_interval_solves_the_score_equation(hits: int, trials: int) -> None:
    """Each end p satisfies (hits / trials - p)^2 = z^2 p (1 - p) / trials."""
    for end in wilson_interval(hits, trials):
        gap2 = (hits / trials - end) ** 2
        assert gap2 == pytest.approx(1.959963984540054**2 * end * (1 - end) / trials, abs=1e-12)


def test_wilson_interval_against_scipy() -> None:
    from scipy.stats import binomtest

    for hits, trials, confidence in [(193, 227, 0.95), (3, 7, 0.95), (0, 5, 0.8), (4, 4, 0.99), (193, 227, 0.5)]:
        expected = binomtest(hits, trials).proportion_ci(confidence, method="wilson")
        found = wilson_interval(hits, trials, confidence)
        assert found == pytest.approx((expected.low, expected.high), abs=1e-9)
    assert all(math.isnan(end) for end in wilson_interval(0, 0))
