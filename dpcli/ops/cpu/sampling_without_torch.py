"""Farthest point sampling of one cloud without torch: for the preparing processes, which never import it."""

from __future__ import annotations

import functools
import os

import numpy as np


def fps_numpy(points: np.ndarray, num_samples: int, *, start: int = 0) -> np.ndarray:
    """Samples farthest points of one cloud: indices (S,) i64 into points (N,3) f32, as `dpcli.ops.fps` would give them.

    One thread; ties to the lowest index; num_samples beyond N repeats the sequence from its beginning.
    DPC_BACKEND=torch, or numba missing, selects the plain numpy loop. Raises ValueError on a wrong shape, an empty
    cloud, non-finite coordinates, or start out of range.

    >>> fps_numpy(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 0, 0]]), 3).tolist()
    [0, 3, 2]
    """
    points = np.ascontiguousarray(points, np.float32)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"points must have shape (N,3) with N >= 1, but has {points.shape}")
    if num_samples < 1 or not 0 <= start < len(points):
        raise ValueError(f"num_samples must be >= 1 and start in 0..{len(points) - 1}: got {num_samples}, {start}")
    if not np.isfinite(points).all():
        raise ValueError("points holds NaN or infinite coordinates; remove those points first")
    kernel = _kernel() if os.environ.get("DPC_BACKEND") != "torch" else None
    if kernel is None:
        return _fps_plain(points, num_samples, start)
    out = np.empty((1, num_samples), np.int64)
    kernel(points[None], start, out, 0, 1)
    return out[0]


@functools.cache
def _kernel():  # a numba dispatcher or None
    try:
        from dpcli.ops.cpu.farthest_point_sampling import fps_kernel
    except Exception:  # a broken llvmlite raises more than ImportError
        return None
    return fps_kernel


def _fps_plain(points: np.ndarray, num_samples: int, start: int) -> np.ndarray:
    """Samples farthest points as `fps_numpy` does, by one numpy pass over all points per sample."""
    x, y, z = np.ascontiguousarray(points.T)
    nearest = np.full(len(points), np.inf, np.float32)
    index = [start]
    for _ in range(min(num_samples, len(points)) - 1):
        dx, dy, dz = x - x[index[-1]], y - y[index[-1]], z - z[index[-1]]
        np.minimum(nearest, dx * dx + dy * dy + dz * dz, out=nearest)
        index.append(int(nearest.argmax()))
    return np.resize(np.array(index, np.int64), num_samples)
