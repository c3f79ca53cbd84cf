"""Frechet distance and its statistics, against closed forms, scipy and hand-made numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import sqrtm

from dpcli.errors import DataError
from dpcli.evaluate.video.frechet.distance import (
    ROOTS,
    FeatureStatistics,
    feature_merge,
    feature_update,
    frechet_distance,
    single_video_distance,
)
from dpcli.runtime.seeds import generator


def axes(lengths: np.ndarray, center: np.ndarray, turn: np.ndarray | None = None) -> np.ndarray:
    """2 D samples center +- length e_i: covariance diag(2 length^2 / (2 D - 1)), turned."""
    rows = np.concatenate([np.diag(lengths), -np.diag(lengths)])
    return (rows if turn is None else rows @ turn) + center


@pytest.mark.parametrize("root", ROOTS)
@pytest.mark.parametrize("turned", [False, True])
def test_closed_form_of_commuting_covariances(root: str, turned: bool):
    rng = generator(0, 1)
    lengths, others = rng.uniform(0.5, 3, (2, 6))
    turn = np.linalg.qr(rng.standard_normal((6, 6)))[0] if turned else None
    shift = rng.standard_normal(6)
    a, b = feature_update(axes(lengths, shift, turn)), feature_update(axes(others, np.zeros(6), turn))
    expected = (shift**2).sum() + 2 / 11 * ((lengths - others) ** 2).sum()
    assert frechet_distance(a, b, root=root) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("root", ROOTS)
def test_hand_made_numbers(root: str):
    # means 1 and 5, variances (ddof 1) 2 and 8: 16 + 2 + 8 - 2 * 4; with ddof 0 it would be 17
    a, b = feature_update(np.array([[0.0], [2.0]])), feature_update(np.array([[3.0], [7.0]]))
    assert frechet_distance(a, b, root=root) == pytest.approx(18.0, abs=1e-12)


@pytest.mark.parametrize("root", ROOTS)
@pytest.mark.parametrize("samples", [9, 40])
def test_equals_scipy_on_plain_covariances(root: str, samples: int):
    rng = generator(0, 2, samples)
    x, y = (
        rng.standard_normal((samples, 7)) * 2 + 3,
        rng.standard_normal((samples + 3, 7)) @ rng.standard_normal((7, 7)),
    )
    s, t = np.cov(x, rowvar=False), np.cov(y, rowvar=False)
    expected = np.square(x.mean(0) - y.mean(0)).sum() + np.trace(s + t - 2 * sqrtm(s @ t).real)
    assert frechet_distance(feature_update(x), feature_update(y), root=root) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("root", ROOTS)
def test_symmetric_and_zero_for_equal_sets(root: str):
    rng = generator(0, 3)
    a, b = (feature_update(rng.standard_normal((30, 8)) * scale) for scale in (1, 2))
    assert frechet_distance(a, b, root=root) == pytest.approx(frechet_distance(b, a, root=root), rel=1e-9)
    assert 0 <= frechet_distance(a, a, root=root) < 1e-6


def test_rank_deficient_covariances_are_exact():
    rng = generator(0, 4)
    rows = rng.standard_normal((5, 60)) * 10
    a = feature_update(rows)
    spread = np.square(rows - rows.mean(0)).sum() / 4
    assert 0 <= frechet_distance(a, a) < 1e-9
    assert frechet_distance(a, feature_update(3 * (rows - rows.mean(0)) + rows.mean(0))) == pytest.approx(4 * spread)
    here, there = np.zeros((5, 60)), np.zeros((5, 60))  # in subspaces at right angles the shared term is nothing
    here[:, :20], there[:, 20:40] = rows[:, :20], rows[:, 20:40]
    apart = np.square(here.mean(0) - there.mean(0)).sum() + np.trace(np.cov(here.T) + np.cov(there.T))
    assert frechet_distance(feature_update(here), feature_update(there)) == pytest.approx(apart, rel=1e-12)


@pytest.mark.parametrize("root", ["scipy", "svd"])
def test_published_roots_come_close_at_low_rank(root: str):
    rng = generator(0, 5)
    a, b = (feature_update(rng.standard_normal((6, 30)) + shift) for shift in (0, 0.5))
    assert frechet_distance(a, b, root=root) == pytest.approx(frechet_distance(a, b), rel=1e-3)


@settings(max_examples=40, deadline=None)
@given(cuts=st.lists(st.integers(0, 25), max_size=5), seed=st.integers(0, 99))
def test_any_cut_merges_to_the_same(cuts: list[int], seed: int):
    rows = generator(0, 6, seed).standard_normal((25, 4)) * 3 + 7
    pieces = np.split(rows, sorted(cuts))
    merged = feature_merge([feature_update(piece) for piece in pieces])
    streamed = None
    for piece in pieces:
        streamed = feature_update(piece, streamed)
    for found in (merged, streamed):
        assert found.samples == 25
        assert len(found.rows) <= 4  # what is kept doesn't grow
        np.testing.assert_allclose(found.mean, rows.mean(0), rtol=1e-12)
        np.testing.assert_allclose(found.covariance, np.cov(rows, rowvar=False), rtol=1e-10, atol=1e-12)


def test_jitter_steps_in_where_scipys_root_is_not_finite(monkeypatch: pytest.MonkeyPatch):
    asked = []

    def failing(matrix: np.ndarray) -> np.ndarray:
        asked.append(matrix)
        return np.full_like(matrix, np.inf) if len(asked) == 1 else sqrtm(matrix)

    monkeypatch.setattr("scipy.linalg.sqrtm", failing)
    a, b = (feature_update(axes(np.full(3, length), np.zeros(3))) for length in (1.0, 2.0))
    assert frechet_distance(a, b, root="scipy") == pytest.approx(3 * 2 / 5, abs=1e-5)
    np.testing.assert_allclose(asked[1], (np.diag(a.covariance) + 1e-6) * (np.diag(b.covariance) + 1e-6) * np.eye(3))
    monkeypatch.setattr("scipy.linalg.sqrtm", lambda matrix: np.full_like(matrix, np.nan))
    with pytest.raises(DataError, match="no finite square root"):
        frechet_distance(a, b, root="scipy")


def test_factor_is_one_of_the_covariance_in_both_forms():
    rows = generator(0, 7).standard_normal((12, 8))
    for count in (6, 12):  # kept, and summed up
        found = feature_update(rows[:count])
        np.testing.assert_allclose(found.factor().T @ found.factor(), np.cov(rows[:count].T), atol=1e-12)


def test_one_sample_is_refused_and_says_what_to_do():
    one, two = feature_update(np.ones((1, 5))), feature_update(np.arange(10.0).reshape(2, 5))
    with pytest.raises(DataError, match=r"1 sample .* at least 2.*closed form .*consistent4d"):
        frechet_distance(one, two)
    assert frechet_distance(one, two, single="mean") == pytest.approx(np.square(1 - np.arange(2.5, 7.5)).sum())
    two_alone = frechet_distance(two, two, single="mean")  # the rule is for single samples only
    assert two_alone == pytest.approx(0, abs=1e-9)


def test_what_is_no_feature_is_refused():
    rows = np.ones((3, 4))
    rows[1, 2] = np.nan
    with pytest.raises(DataError, match="1 of 3 samples are NaN or infinite, the first is sample 1"):
        feature_update(rows)
    with pytest.raises(DataError, match="4 and of 5 values"):
        frechet_distance(feature_update(np.ones((3, 4))), feature_update(np.ones((3, 5))))
    with pytest.raises(DataError, match="4 and of 5 values"):
        feature_update(np.ones((3, 4))) + feature_update(np.ones((3, 5)))
    with pytest.raises(DataError, match="no features"):
        feature_merge([])
    with pytest.raises(DataError, match="no features"):
        FeatureStatistics(np.zeros((0, 4))).mean  # noqa: B018
    with pytest.raises(ValueError, match="root"):
        frechet_distance(feature_update(np.eye(3)), feature_update(np.eye(3)), root="cholesky")
    with pytest.raises(ValueError, match="shape"):
        feature_update(np.ones(4))


def test_one_video_against_one_by_hand():
    # |f - g|^2 = 1 + 1, std f = sqrt 2, std g = 0
    assert single_video_distance(np.array([0.0, 2.0]), np.array([1.0, 1.0])) == pytest.approx(4.0)


def test_one_video_against_one_is_numpys_old_reading():
    """A row of 400 logits as 400 observations of one variable: what np.cov made of (1,400) before numpy 2.2."""
    f, g = generator(0, 8).standard_normal((2, 400)) * [[2.0], [3.0]]
    s, t = np.cov(f), np.cov(g)
    expected = np.square(f - g).sum() + s + t - 2 * np.sqrt(s * t)
    assert single_video_distance(f, g) == pytest.approx(expected, rel=1e-12)
    assert single_video_distance(f, f) == 0
    with pytest.raises(DataError, match="NaN"):
        single_video_distance(np.full(400, np.nan), g)
    with pytest.raises(ValueError, match="400 and 399"):
        single_video_distance(f, g[1:])
