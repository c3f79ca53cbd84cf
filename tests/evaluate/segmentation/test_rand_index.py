"""Rand index and adjusted Rand index: scikit-learn's, by hand, and where they are undefined."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import adjusted_rand_score

from dpcli.evaluate.segmentation.rand_index import adjusted_rand_index, rand_index


def test_rand_index_equals_another_library():
    from sklearn.metrics import rand_score

    rng = np.random.default_rng(0)
    truth, part = rng.integers(0, 4, 200), rng.integers(0, 6, 200)
    without_diagonal = (rand_index(truth, part) * 200**2 - 200) / (200 * 199)
    assert without_diagonal == pytest.approx(rand_score(truth, part), abs=1e-12)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(st.integers(-1, 4), st.integers(-1, 4)), min_size=1, max_size=40))
def test_adjusted_rand_index_is_scikit_learns(pairs: list[tuple[int, int]]) -> None:
    truth, part = np.array(pairs).T
    known = truth >= 0
    found = adjusted_rand_index(truth, part)
    if not known.any():
        assert np.isnan(found)
        return
    assert found == pytest.approx(adjusted_rand_score(truth[known], part[known]), abs=1e-12)


def test_adjusted_rand_index_by_hand() -> None:
    # Hubert & Arabie: groups of 3 and 3 against 2 and 4; ordered pairs together 6+... of 30
    truth, part = np.array([0, 0, 0, 1, 1, 1]), np.array([0, 0, 1, 1, 1, 1])
    together, rows, columns, every = 2 + 0 + 6, 6 + 6, 2 + 12, 30
    expected = rows * columns / every
    assert adjusted_rand_index(truth, part) == pytest.approx((together - expected) / (13 - expected))
    assert adjusted_rand_index(truth, 7 - part) == adjusted_rand_index(truth, part)  # names of parts don't matter


def test_points_without_a_true_part_are_taken_out() -> None:
    truth, part = np.array([0, 0, 1, 1, -1, 2]), np.array([0, 0, 1, 1, 0, 1])
    assert rand_index(truth, part, ignore_below=2) == rand_index(truth[:4], part[:4]) == 1
    assert adjusted_rand_index(np.append(truth[:4], -1), np.append(part[:4], 0)) == 1
    nothing = np.full(3, -1)
    assert np.isnan(rand_index(nothing, nothing)) and np.isnan(adjusted_rand_index(nothing, nothing))
