"""What the tests of dpcli.ops share: written-out brute force in numpy, clouds rich in ties, checkers, backends."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from hypothesis import strategies as st

BACKENDS = ("torch", "numba")


@contextmanager
def backend(name: str) -> Iterator[None]:
    """Run a block under DPC_BACKEND=name."""
    before = os.environ.get("DPC_BACKEND")
    os.environ["DPC_BACKEND"] = name
    try:
        yield
    finally:
        os.environ.pop("DPC_BACKEND")
        if before is not None:
            os.environ["DPC_BACKEND"] = before


def cloud(rng: np.random.Generator, *shape: int, kind: str) -> np.ndarray:
    """Points (*shape,3) f32: `random`, on a `grid` of 5 steps (ties, duplicates), all the `same`, `far` from zero."""
    if kind == "grid":
        return rng.integers(-2, 3, (*shape, 3)).astype(np.float32) / 4
    if kind == "same":
        return np.broadcast_to(rng.normal(size=3).astype(np.float32), (*shape, 3)).copy()
    return rng.normal(size=(*shape, 3)).astype(np.float32) + np.float32(1000 if kind == "far" else 0)


KINDS = st.sampled_from(["random", "grid", "same", "far"])
SEEDS = st.integers(0, 2**32 - 1)


def distances(point: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Squared distances in float32, summed x, y, z."""
    d = point - points
    with np.errstate(over="ignore"):
        return d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1] + d[:, 2] * d[:, 2]


def brute_fps(points: np.ndarray, num_samples: int, start: int = 0) -> list[int]:
    """Farthest point sampling by the definition: the point whose nearest chosen point is furthest away."""
    chosen = [start]
    while len(chosen) < min(num_samples, len(points)):
        nearest = np.min([distances(points[c], points) for c in chosen], axis=0)
        chosen.append(min(i for i in range(len(points)) if nearest[i] == nearest.max()))
    return [chosen[i % len(points)] for i in range(num_samples)]


def brute_ball_query(
    points: np.ndarray, times: np.ndarray, centroid: np.ndarray, time: int, radii: list[float], k: int, order: str
) -> tuple[list[int], int]:
    """One centroid's neighbors by the definition."""
    squared = distances(centroid, points)
    hits = []
    for j in range(len(points)):
        gap = abs(int(times[j]) - int(time))
        if gap < len(radii) and squared[j] < np.float32(radii[gap]) * np.float32(radii[gap]):
            hits.append(j)
    if order == "nearest":
        hits.sort(key=lambda j: (squared[j], j))
    hits = hits[:k]
    return hits + [hits[0] if hits else 0] * (k - len(hits)), len(hits)


def brute_knn(query: np.ndarray, points: np.ndarray, k: int) -> tuple[list[float], list[int]]:
    """One query's nearest points by the definition."""
    squared = distances(query, points)
    order = sorted(range(len(points)), key=lambda j: (squared[j], j))[:k]
    order += order[:1] * (k - len(order))
    return [float(squared[j]) for j in order], order


def assert_fps(function: Callable, points: np.ndarray, num_samples: int, start: int = 0) -> None:
    """The checker: `function` (called as dpcli.ops.fps) samples one cloud as the definition does."""
    got = function(torch.from_numpy(points)[None], num_samples, start=start)
    assert got.dtype == torch.int64 and got.shape == (1, num_samples)
    assert got[0].tolist() == brute_fps(points, num_samples, start)


def assert_ball_query(function: Callable, points, times, centroids, centroid_times, radii, k, order) -> None:
    """The checker: `function` (called as dpcli.ops.space_time_ball_query) finds what the definition does, per clip."""
    tensors = (torch.from_numpy(np.ascontiguousarray(a)) for a in (points, times, centroids, centroid_times))
    index, count = function(*tensors, radii, k, order=order)
    assert index.dtype == count.dtype == torch.int64 and index.shape == (*centroids.shape[:2], k)
    for b in range(len(points)):
        for m in range(centroids.shape[1]):
            want = brute_ball_query(points[b], times[b], centroids[b, m], centroid_times[b, m], radii, k, order)
            assert (index[b, m].tolist(), int(count[b, m])) == want
