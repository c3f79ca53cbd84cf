"""Nearest neighbors: the definition with its ties, scipy's tree, and every backend alike."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from dpcli.ops import knn, knn_reference
from tests.support.ops_helpers import BACKENDS, KINDS, SEEDS, backend, brute_knn, cloud


def assert_knn(function, query: np.ndarray, points: np.ndarray, k: int) -> None:
    """The checker: `function` (called as dpcli.ops.knn) finds what the definition does."""
    squared, index = function(torch.from_numpy(query)[None], torch.from_numpy(points)[None], k)
    assert squared.dtype == torch.float32 and index.dtype == torch.int64
    for m in range(len(query)):
        assert (squared[0, m].tolist(), index[0, m].tolist()) == brute_knn(query[m], points, k)


@pytest.mark.parametrize("name", BACKENDS)
@settings(deadline=None, max_examples=60)
@given(seed=SEEDS, kind=KINDS, count=st.integers(1, 200), rows=st.integers(1, 12), k=st.integers(1, 70))
def test_matches_the_definition(name: str, seed: int, kind: str, count: int, rows: int, k: int) -> None:
    rng = np.random.default_rng(seed)
    points = cloud(rng, count, kind=kind)
    query = np.concatenate([points[rng.integers(0, count, rows)], cloud(rng, rows, kind="grid")])
    with backend(name):
        assert_knn(knn, query, points, k)


def test_checker_rejects_broken_twins() -> None:
    rng = np.random.default_rng(0)
    points, query = cloud(rng, 100, kind="grid"), cloud(rng, 5, kind="grid")

    def last_of_ties(query: torch.Tensor, points: torch.Tensor, k: int) -> tuple[torch.Tensor, torch.Tensor]:
        squared, index = knn_reference(query, points.flip(1), k)
        return squared, points.shape[1] - 1 - index

    def rooted(query: torch.Tensor, points: torch.Tensor, k: int) -> tuple[torch.Tensor, torch.Tensor]:
        squared, index = knn_reference(query, points, k)
        return squared.sqrt(), index

    assert_knn(knn_reference, query, points, 9)
    for broken in (last_of_ties, rooted):
        with pytest.raises(AssertionError):
            assert_knn(broken, query, points, 9)


@pytest.mark.parametrize("kind", ["random", "grid", "far"])
@pytest.mark.parametrize(("count", "k"), [(33, 3), (3000, 16), (3000, 100)])
def test_kernel_equals_reference_on_many_buckets(kind: str, count: int, k: int) -> None:
    rng = np.random.default_rng(count + k)
    points, query = (torch.from_numpy(cloud(rng, 2, n, kind=kind)) for n in (count, 300))
    for ours, reference in zip(knn(query, points, k), knn_reference(query, points, k), strict=True):
        assert torch.equal(ours, reference)


@pytest.mark.parametrize("kind", ["random", "grid", "far"])
@pytest.mark.parametrize("k", [1, 9])
def test_large_clouds_equal_the_reference(kind: str, k: int) -> None:
    """The tree of large clouds keeps the ties of the definition: a fine grid has them in nearly every row."""
    rng = np.random.default_rng(k)
    points, query = (cloud(rng, 2, 16384, kind=kind) for _ in range(2))
    if kind == "grid":
        points += rng.integers(0, 12, points.shape).astype(np.float32)
    points[0, :3], query[0, :2] = points[0, 3:4], points[0, :2]  # copies
    arguments = (torch.from_numpy(query), torch.from_numpy(points), k)
    rows = torch.arange(0, 16384, 64)
    for own, other in zip(knn(*arguments), knn_reference(arguments[0][:, rows], *arguments[1:]), strict=True):
        assert torch.equal(own[:, rows], other)


def test_large_clouds_with_squares_that_overflow_or_vanish() -> None:
    points = cloud(np.random.default_rng(6), 1, 16384, kind="random")
    points[0, :2000] *= 1e30
    points[0, 2000:4000] *= 1e-25
    query, points = torch.from_numpy(points), torch.from_numpy(points.copy())
    rows = torch.arange(0, 16384, 64)
    for own, other in zip(knn(query, points, 4), knn_reference(query[:, rows], points, 4), strict=True):
        assert torch.equal(own[:, rows], other)


def test_agrees_with_scipy() -> None:
    rng = np.random.default_rng(3)
    points, query = cloud(rng, 5000, kind="random"), cloud(rng, 200, kind="random")
    squared, index = knn(torch.from_numpy(query)[None], torch.from_numpy(points)[None], 8)
    distance, theirs = cKDTree(points).query(query, 8)
    np.testing.assert_allclose(squared[0].sqrt().numpy(), distance, rtol=1e-5)
    assert (index[0].numpy() == theirs).mean() > 0.999  # float64 may order near-ties otherwise


def test_far_outliers_are_found_last() -> None:
    """Squares that overflow to infinity still count as distances, larger than all others."""
    points = cloud(np.random.default_rng(5), 70, kind="random")
    points[[3, 60]] = 1e30
    query = points[:4].copy()
    with np.errstate(over="ignore"):
        for name in BACKENDS:
            with backend(name):
                assert_knn(knn, query, points, 70)


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize(
    ("position", "value", "message"),
    [
        (0, torch.zeros(2, 3), "query must have shape"),
        (0, torch.full((1, 2, 3), float("nan")), "query holds NaN"),
        (0, torch.zeros(2, 2, 3), "one batch"),
        (1, torch.zeros(1, 0, 3), "N >= 1"),
        (2, 0, "k must"),
    ],
)
def test_rejects(name: str, position: int, value: object, message: str) -> None:
    arguments = [torch.zeros(1, 2, 3), torch.zeros(1, 5, 3), 3]
    arguments[position] = value
    with backend(name), pytest.raises(ValueError, match=message):
        knn(*arguments)
