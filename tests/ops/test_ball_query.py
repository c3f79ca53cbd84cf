"""Space-time ball query: the definition in both orders, sorted and unsorted times, and every backend alike."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.ops import space_time_ball_query, space_time_ball_query_reference
from tests.support.ops_helpers import BACKENDS, KINDS, SEEDS, assert_ball_query, backend, brute_ball_query, cloud

ORDERS = ("first", "nearest")


def clip(seed: int, kind: str, batch: int, count: int, rows: int, frames: int, ordered: bool) -> tuple[np.ndarray, ...]:
    """points, times, centroids (half of them points), centroid times."""
    rng = np.random.default_rng(seed)
    points = cloud(rng, batch, count, kind=kind)
    times = rng.integers(0, frames, (batch, count))
    if ordered:
        times.sort(axis=1)
    chosen = rng.integers(0, count, rows)
    centroids, centroid_times = points[:, chosen].copy(), times[:, chosen].copy()
    centroids[:, rows // 2 :] = cloud(rng, batch, rows - rows // 2, kind=kind)
    return points, times, centroids, centroid_times


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("order", ORDERS)
@settings(deadline=None, max_examples=60)
@given(
    seed=SEEDS,
    kind=KINDS,
    size=st.tuples(st.integers(1, 2), st.integers(1, 300), st.integers(1, 12), st.integers(1, 6)),
    ordered=st.booleans(),
    radii=st.lists(st.sampled_from([0.0, 0.25, 0.5, 0.7, 1.5, 100.0]), max_size=4),
    k=st.integers(1, 40),
)
def test_matches_the_definition(
    name: str, order: str, seed: int, kind: str, size: tuple, ordered: bool, radii: list[float], k: int
) -> None:
    with backend(name):
        assert_ball_query(space_time_ball_query, *clip(seed, kind, *size, ordered), radii, k, order)


def test_checker_rejects_broken_twins() -> None:
    """On a grid of step 1/4, a radius of 0.5 decides between < and <=; shuffled indices show a lost order."""
    arguments = (*clip(5, "grid", 1, 200, 10, 4, False), [0.5, 0.25], 30)

    def lenient(*args, order: str):  # <= instead of <
        return space_time_ball_query_reference(*args[:4], [r * 1.0001 for r in args[4]], args[5], order=order)

    def backwards_in_time(*args, order: str):  # radii by t_j - t_i, the future ignored
        points, times, centroids, centroid_times, radii, k = args
        index, count = space_time_ball_query_reference(*args, order=order)
        late = times[0][index] > centroid_times[..., None]
        return torch.where(late, index[..., :1], index), count

    def last_hits(*args, order: str):  # descending indices
        points, times, *rest = args
        index, count = space_time_ball_query_reference(points.flip(1), times.flip(1), *rest, order=order)
        return points.shape[1] - 1 - index, count

    assert_ball_query(space_time_ball_query_reference, *arguments, "first")
    for broken in (lenient, backwards_in_time, last_hits):
        with pytest.raises(AssertionError):
            assert_ball_query(broken, *arguments, "first")
    with pytest.raises(AssertionError):  # among equal distances, too
        assert_ball_query(last_hits, *arguments, "nearest")


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("radii", [[0.5, 0.51], [0.05] * 3, [3.0, 0.0, 0.2], [10.0] * 4])
@pytest.mark.parametrize("ordered", [True, False])
def test_kernel_equals_reference_on_a_clip(order: str, radii: list[float], ordered: bool) -> None:
    arguments = [torch.from_numpy(a) for a in clip(7, "random", 2, 3000, 150, 8, ordered)]
    got = space_time_ball_query(*arguments, radii, 64, order=order)
    for ours, reference in zip(got, space_time_ball_query_reference(*arguments, radii, 64, order=order), strict=True):
        assert torch.equal(ours, reference)


@pytest.mark.parametrize("name", BACKENDS)
def test_by_hand(name: str) -> None:
    """Five points on a line in frames 0..2, a centroid at 0 in frame 1; radius 1 in its frame, 2 in the next."""
    points = torch.tensor([[[1.9, 0, 0], [2.0, 0, 0], [1.0, 0, 0], [0.9, 0, 0], [0.0, 0, 0]]])
    times = torch.tensor([[0, 0, 1, 1, 2]])
    centroid, time = torch.zeros(1, 1, 3), torch.tensor([[1]])
    with backend(name):
        index, count = space_time_ball_query(points, times, centroid, time, [1.0, 2.0], 5)
        assert (index[0, 0].tolist(), count.item()) == ([0, 3, 4, 0, 0], 3)  # 2.0 and 1.0 lie on their spheres: out
        index, count = space_time_ball_query(points, times, centroid, time, [1.0, 2.0], 5, order="nearest")
        assert (index[0, 0].tolist(), count.item()) == ([4, 3, 0, 4, 4], 3)
        index, count = space_time_ball_query(points, times, centroid, time + 9, [1.0, 2.0], 5)
        assert (index[0, 0].tolist(), count.item()) == ([0] * 5, 0)


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("order", ORDERS)
def test_batch_items_and_float_times_do_not_mix(name: str, order: str) -> None:
    points, times, centroids, centroid_times = (torch.from_numpy(a) for a in clip(9, "random", 3, 200, 20, 5, True))
    with backend(name):
        whole = space_time_ball_query(
            points, times.float(), centroids, centroid_times.double(), [0.8, 0.6], 8, order=order
        )
        for b in range(3):
            part = (a[b : b + 1] for a in (points, times, centroids, centroid_times))
            alone = space_time_ball_query(*part, torch.tensor([0.8, 0.6]), 8, order=order)
            assert torch.equal(whole[0][b], alone[0][0]) and torch.equal(whole[1][b], alone[1][0])


@pytest.mark.parametrize("name", BACKENDS)
def test_no_centroids(name: str) -> None:
    with backend(name):
        arguments = (torch.zeros(2, 5, 3), torch.zeros(2, 5), torch.zeros(2, 0, 3), torch.zeros(2, 0))
        index, count = space_time_ball_query(*arguments, [1.0], 4)
    assert index.shape == (2, 0, 4) and count.shape == (2, 0)


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize(
    ("position", "value", "message"),
    [
        (0, torch.full((1, 5, 3), float("nan")), "points holds NaN"),
        (0, torch.zeros(2, 5, 3), "one batch"),
        (0, torch.zeros(1, 0, 3), "N >= 1"),
        (1, torch.zeros(1, 4), "times must have shape"),
        (1, torch.full((1, 5), 0.5), "whole frame"),
        (2, torch.full((1, 2, 3), float("inf")), "centroids holds NaN"),
        (3, torch.tensor([[0.0, float("nan")]]), "whole frame"),
        (4, [-1.0], "radii"),
        (4, [float("nan")], "radii"),
        (4, [[1.0]], "radii"),
        (5, 0, "k must"),
    ],
)
def test_rejects(name: str, position: int, value: object, message: str) -> None:
    arguments = [torch.zeros(1, 5, 3), torch.zeros(1, 5), torch.zeros(1, 2, 3), torch.zeros(1, 2), [1.0], 3]
    arguments[position] = value
    with backend(name), pytest.raises(ValueError, match=message):
        space_time_ball_query(*arguments)


def test_rejects_an_unknown_order() -> None:
    with pytest.raises(ValueError, match="order"):
        space_time_ball_query(
            torch.zeros(1, 5, 3), torch.zeros(1, 5), torch.zeros(1, 2, 3), torch.zeros(1, 2), [1.0], 3, order="any"
        )


def brute_balanced(points, times, centroid, time, radii, k: int) -> tuple[list[int], int]:
    """One centroid's slots by the definition, frame by frame."""
    reach = len(radii) - 1
    frames = 2 * reach + 1
    shares = [k * (i + 1) // frames - k * i // frames for i in range(frames)]
    found = []
    for offset, share in zip(range(-reach, reach + 1), shares):
        alone = np.where(times == time + offset, 0, 1)  # only this frame is at distance 0
        found.append(brute_ball_query(points, alone, centroid, 0, radii[abs(offset) :][:1], share, "first"))
    own = found[reach][0]
    slots = [row if hits else [own[i % len(own)] for i in range(len(row))] for row, hits in found]
    return sum(slots, []), sum(hits for _, hits in found)


def assert_balanced(function, points, times, centroids, centroid_times, radii, k: int) -> None:
    tensors = (torch.from_numpy(np.ascontiguousarray(a)) for a in (points, times, centroids, centroid_times))
    index, count = function(*tensors, radii, k, order="balanced")
    assert index.dtype == count.dtype == torch.int64 and index.shape == (*centroids.shape[:2], k)
    for b in range(len(points)):
        for m in range(centroids.shape[1]):
            want = brute_balanced(points[b], times[b], centroids[b, m], centroid_times[b, m], radii, k)
            assert (index[b, m].tolist(), int(count[b, m])) == want


@pytest.mark.parametrize("name", BACKENDS)
@settings(deadline=None, max_examples=60)
@given(
    seed=SEEDS,
    kind=KINDS,
    size=st.tuples(st.integers(1, 2), st.integers(1, 300), st.integers(1, 12), st.integers(1, 6)),
    ordered=st.booleans(),
    radii=st.lists(st.sampled_from([0.0, 0.25, 0.5, 0.7, 1.5, 100.0]), min_size=1, max_size=3),
    extra=st.integers(0, 30),
)
def test_balanced_matches_the_definition(
    name: str, seed: int, kind: str, size: tuple, ordered: bool, radii: list[float], extra: int
) -> None:
    with backend(name):
        assert_balanced(space_time_ball_query, *clip(seed, kind, *size, ordered), radii, 2 * len(radii) - 1 + extra)


def test_balanced_checker_rejects_the_other_order() -> None:
    arguments = (*clip(5, "grid", 1, 200, 10, 4, False), [0.5, 0.25], 30)
    assert_balanced(space_time_ball_query_reference, *arguments)
    with pytest.raises(AssertionError):
        assert_balanced(lambda *a, order: space_time_ball_query_reference(*a, order="first"), *arguments)


@pytest.mark.parametrize("ordered", [True, False])
def test_balanced_kernel_equals_reference_on_a_clip(ordered: bool) -> None:
    arguments = [torch.from_numpy(a) for a in clip(7, "random", 2, 3000, 150, 8, ordered)]
    got = space_time_ball_query(*arguments, [0.5, 0.51], 64, order="balanced")
    reference = space_time_ball_query_reference(*arguments, [0.5, 0.51], 64, order="balanced")
    assert all(torch.equal(a, b) for a, b in zip(got, reference, strict=True))


def test_balanced_needs_a_slot_per_frame() -> None:
    arguments = (torch.zeros(1, 5, 3), torch.zeros(1, 5), torch.zeros(1, 2, 3), torch.zeros(1, 2), [1.0, 1.0])
    with pytest.raises(ValueError, match="per frame"):
        space_time_ball_query(*arguments, 2, order="balanced")
