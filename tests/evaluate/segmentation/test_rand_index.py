"""Rand index and adjusted Rand index: scikit-learn's, by hand, and where they are undefined; the overlap that they count."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import adjusted_rand_score

from dpcli.evaluate.segmentation.part_overlap import overlap
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


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from([-3, -1, 0, 2, 9, 200]), st.integers(-2, 3)), max_size=30),
    st.sampled_from([np.int16, np.int32, np.int64]),
    st.booleans(),
)
def test_overlap_counts_what_a_loop_counts_for_ids_of_every_size(pairs, kind, large) -> None:
    truth, part = np.array(pairs, kind).reshape(-1, 2).T
    if large:
        part = np.where(part == 3, np.iinfo(kind).max, part)
    found = overlap(truth, part)
    ids, known = [sorted({i for i in own.tolist() if i >= 0}) for own in (truth, part)], [truth.tolist(), part.tolist()]
    assert [found.truth_ids.tolist(), found.ids.tolist()] == ids and found.ids.dtype == kind
    rows = [[own.index(i) if i >= 0 else -1 for i in one] for own, one in zip(ids, known)]
    assert [found.truth_rows.tolist(), found.columns.tolist()] == rows
    both = list(zip(*rows))
    assert found.shared.tolist() == [[both.count((g, p)) for p in range(len(ids[1]))] for g in range(len(ids[0]))]
    assert [found.truth_sizes.tolist(), found.sizes.tolist()] == [
        [r.count(i) for i in range(len(o))] for r, o in zip(rows, ids)
    ]
