"""Farthest point sampling: the definition, ties, and every backend alike."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.ops import fps, fps_numpy, fps_reference
from dpcli.ops.cpu.sampling_without_torch import _fps_plain
from tests.support.ops_helpers import BACKENDS, KINDS, SEEDS, assert_fps, backend, cloud


@pytest.mark.parametrize("name", BACKENDS)
@settings(deadline=None, max_examples=60)
@given(seed=SEEDS, kind=KINDS, count=st.integers(1, 90), samples=st.integers(1, 110), start=st.integers(0, 89))
def test_matches_the_definition(name: str, seed: int, kind: str, count: int, samples: int, start: int) -> None:
    points = cloud(np.random.default_rng(seed), count, kind=kind)
    with backend(name):
        assert_fps(fps, points, samples, start % count)
    assert (
        fps_numpy(points, samples, start=start % count).tolist() == _fps_plain(points, samples, start % count).tolist()
    )


def test_checker_rejects_broken_twins() -> None:
    points = cloud(np.random.default_rng(0), 80, kind="grid")

    def last_of_ties(points: torch.Tensor, num_samples: int, *, start: int) -> torch.Tensor:
        count = points.shape[1]
        return count - 1 - fps_reference(points.flip(1), num_samples, start=count - 1 - start)

    def wrong_norm(points: torch.Tensor, num_samples: int, *, start: int) -> torch.Tensor:
        return fps_reference(points * torch.tensor([1.0, 1.0, 0.5]), num_samples, start=start)

    assert_fps(fps_reference, points, 20)
    for broken in (last_of_ties, wrong_norm):
        with pytest.raises(AssertionError):
            assert_fps(broken, points, 20)


@pytest.mark.parametrize("kind", ["random", "grid", "far"])
@pytest.mark.parametrize("count", [31, 32, 33, 2048, 9000])
def test_kernel_equals_reference_on_many_buckets(kind: str, count: int) -> None:
    points = torch.from_numpy(cloud(np.random.default_rng(count), 2, count, kind=kind))
    assert torch.equal(fps(points, count // 4), fps_reference(points, count // 4))


def test_kernel_survives_extreme_spread() -> None:
    """One point 1e12 away puts all others in one Morton cell; squares of 1e30 overflow to infinity."""
    rng = np.random.default_rng(1)
    for far in (1e12, 1e30):
        points = cloud(rng, 500, kind="random")
        points[77] = far
        assert_fps(fps, points, 40)


@pytest.mark.parametrize("name", BACKENDS)
def test_more_samples_than_points_repeat_the_sequence(name: str) -> None:
    points = torch.from_numpy(cloud(np.random.default_rng(3), 1, 7, kind="random"))
    with backend(name):
        index = fps(points, 17)[0]
    assert sorted(index[:7].tolist()) == list(range(7))
    assert torch.equal(index[7:14], index[:7]) and torch.equal(index[14:], index[:3])


@pytest.mark.parametrize("name", BACKENDS)
def test_duplicates_only_repeat_index_zero(name: str) -> None:
    points = torch.ones(1, 50, 3)
    with backend(name):
        assert fps(points, 5, start=3)[0].tolist() == [3, 0, 0, 0, 0]


@pytest.mark.parametrize("name", BACKENDS)
def test_accepts_views_doubles_and_gradients(name: str) -> None:
    base = torch.randn(2, 3, 60, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    with backend(name):
        assert torch.equal(
            fps(base.transpose(1, 2), 9), fps_reference(base.detach().float().transpose(1, 2).contiguous(), 9)
        )
        assert fps(torch.zeros(0, 5, 3), 2).shape == (0, 2)


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(points=torch.zeros(5, 3)), "shape"),
        (dict(points=torch.zeros(1, 5, 2)), "shape"),
        (dict(points=torch.zeros(1, 0, 3)), "hold no point"),
        (dict(points=torch.zeros(1, 5, 3, dtype=torch.int64)), "floating"),
        (dict(points=torch.tensor([[[0.0, float("nan"), 0.0]]])), "NaN"),
        (dict(points=torch.tensor([[[0.0, float("inf"), 0.0]]])), "NaN"),
        (dict(num_samples=0), "num_samples"),
        (dict(start=5), "start"),
        (dict(start=-1), "start"),
    ],
)
def test_rejects(name: str, change: dict, message: str) -> None:
    with backend(name), pytest.raises(ValueError, match=message):
        fps(**{"points": torch.zeros(1, 5, 3), "num_samples": 2, **change})


@pytest.mark.parametrize(
    ("points", "samples", "start"),
    [
        (np.zeros((0, 3)), 1, 0),
        (np.zeros((4, 2)), 1, 0),
        (np.full((4, 3), np.nan), 1, 0),
        (np.zeros((4, 3)), 0, 0),
        (np.zeros((4, 3)), 1, 4),
    ],
)
def test_numpy_entry_rejects(points: np.ndarray, samples: int, start: int) -> None:
    with pytest.raises(ValueError):
        fps_numpy(points, samples, start=start)
