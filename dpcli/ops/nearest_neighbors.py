"""The k nearest neighbors of each query point."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from dpcli.ops.backend import (
    chosen_backend,
    key_distances,
    key_indices,
    ordered_keys,
    positions,
    row_blocks,
    run_in_threads,
    squared_distances,
)

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_BUCKET_NS, _ROW_NS = 60, 6e3  # measured: per point, and per query with k = 16..32
_LARGE = 16384  # points and queries from which a tree is faster than buckets, whose boxes every query looks at
_TOGETHER = 1 << 13  # queries of a tree at a time, so that memory stays small
_ROUNDING = 1e-6  # a squared distance in float32 is right to 5 roundings of 2^-24 of itself, ...
_LEAST = 1e-37  # ... or, where squares fall below the normal numbers, to far less than this


def knn(
    query: torch.Tensor,  # [B, M, 3]
    points: torch.Tensor,  # [B, N, 3]
    k: int,
) -> tuple[torch.Tensor, torch.Tensor]:  # [B, M, k], [B, M, k]
    """Finds squared distances (B,M,k) f32 and indices (B,M,k) i64 of the k nearest points, ascending.

    Ties go to the lowest index. Slots beyond the N points repeat the nearest. Distances are float32 and carry no
    gradient: recompute them from the indices.
    Backends: numba on CPU (buckets with bounding boxes; exact, ties included; from 16,384 points and queries SciPy's k-d
    tree, whose order is made exact), torch elsewhere (all pairs, in blocks of bounded memory); all give the same numbers.
    Raises ValueError on wrong shapes and non-finite coordinates.

    >>> line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [3, 0, 0]]])
    >>> knn(torch.tensor([[[0.9, 0, 0]]]), line, 2)[1].tolist()
    [[[1, 0]]]
    """
    query, points = _checked(query, points, k)
    if chosen_backend(points.device) == "torch" or query.numel() == 0:
        return _knn_torch(query, points, k)
    if min(query.shape[1], points.shape[1]) >= _LARGE:
        return _knn_tree(query, points, k)
    return _knn_numba(query, points, k)


def knn_reference(query: torch.Tensor, points: torch.Tensor, k: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Computes `knn` in plain torch, as a reference: same arguments, same result."""
    return _knn_torch(*_checked(query, points, k), k)


def _checked(query: torch.Tensor, points: torch.Tensor, k: int) -> tuple[torch.Tensor, torch.Tensor]:
    query, points = positions("query", query), positions("points", points)
    if query.shape[0] != points.shape[0] or points.shape[1] == 0:
        raise ValueError(f"query {tuple(query.shape)} and points {tuple(points.shape)} need one batch and N >= 1")
    if k < 1:
        raise ValueError(f"k must be at least 1, but is {k}")
    return query, points


def _knn_numba(query: torch.Tensor, points: torch.Tensor, k: int) -> tuple[torch.Tensor, torch.Tensor]:
    from dpcli.ops.cpu.farthest_point_sampling import BUCKET, bucket_kernel
    from dpcli.ops.cpu.neighbor_search import knn_kernel

    batch, rows, _ = query.shape
    total = points.shape[1]
    buckets = -(-total // BUCKET)
    order = np.empty((batch, total), np.int32)
    xyz, box = np.empty((batch, 3, buckets * BUCKET), np.float32), np.empty((batch, 6, buckets), np.float32)
    run_in_threads(bucket_kernel, (points.contiguous().numpy(), order, xyz, box), batch, total * _BUCKET_NS)
    squared = torch.empty((batch, rows, k), dtype=torch.float32)
    index = torch.empty((batch, rows, k), dtype=torch.int64)
    found = (order, xyz, box, BUCKET, query.contiguous().numpy(), squared.numpy(), index.numpy())
    run_in_threads(knn_kernel, found, batch * rows, _ROW_NS)
    return squared, index


def _knn_tree(query: torch.Tensor, points: torch.Tensor, k: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns what `_knn_numba` does, from a k-d tree; all rows where k is no less than N, and those with a tie, come from there."""
    from scipy.spatial import cKDTree

    batch, rows, _ = query.shape
    squared, index = torch.empty((batch, rows, k)), torch.empty((batch, rows, k), dtype=torch.int64)
    for b, cloud in enumerate(points):
        sure = np.zeros(rows, bool)
        tree = cKDTree(cloud.numpy()) if len(cloud) > k else None
        for first in range(0, rows if tree else 0, _TOGETHER):
            some = slice(first, first + _TOGETHER)
            own = query[b, some].numpy(), cloud.numpy(), squared[b, some].numpy(), index[b, some].numpy()
            sure[some] = _fill_from_tree(tree, *own)
        rest = torch.from_numpy(np.flatnonzero(~sure))
        if len(rest):
            own = _knn_numba(query[b : b + 1, rest], cloud[None], k)
            squared[b, rest], index[b, rest] = own[0][0], own[1][0]
    return squared, index


def _fill_from_tree(
    tree: cKDTree, query: np.ndarray, points: np.ndarray, squared: np.ndarray, index: np.ndarray
) -> np.ndarray:
    """Fills squared f32 (M,k) and index i64 (M,k); returns whether (M) no other point may belong there.

    The tree measures in float64. A row is sure when its (k+1)-th point is farther than float32's roundings can hide.
    """
    far, found = tree.query(query, squared.shape[1] + 1, workers=torch.get_num_threads())
    gap = points[found]
    with np.errstate(over="ignore", under="ignore"):
        gap -= query[:, None]
        gap *= gap
        near = (gap[..., 0] + gap[..., 1]) + gap[..., 2]
    keys = near.view(np.int32).astype(np.int64)  # distance bits above, index below: as `ordered_keys`
    keys <<= 32
    keys |= found
    keys.sort(1)
    index[:] = keys[:, :-1] & 0xFFFFFFFF
    squared.view(np.int32)[:] = keys[:, :-1] >> 32
    return squared[:, -1].astype(np.float64) * (1 + _ROUNDING) + _LEAST < far[:, -1] ** 2 * (1 - _ROUNDING)


def _knn_torch(query: torch.Tensor, points: torch.Tensor, k: int) -> tuple[torch.Tensor, torch.Tensor]:
    batch, rows, _ = query.shape
    total = points.shape[1]
    parts = []
    for block in row_blocks(rows, batch * total, points.device):
        keys = ordered_keys(squared_distances(query[:, block], points))
        parts.append(keys.topk(min(k, total), dim=-1, largest=False, sorted=True).values)
    keys = torch.cat(parts, 1) if parts else points.new_zeros((batch, rows, min(k, total)), dtype=torch.int64)
    slot = torch.arange(k, device=points.device)
    keys = keys[..., torch.where(slot < total, slot, 0)]
    return key_distances(keys), key_indices(keys)
