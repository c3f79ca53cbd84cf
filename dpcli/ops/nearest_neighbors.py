"""The k nearest neighbors of each query point."""

from __future__ import annotations

import numpy as np
import torch

from dpcli.ops.backend import (
    chosen_backend,
    key_distances,
    key_indices,
    ordered_keys,
    positions,
    row_blocks,
    row_lengths,
    run_in_threads,
    squared_distances,
)

_BUCKET_NS, _ROW_NS = 60, 6e3  # measured: per point, and per query with k = 16..32


def knn(
    query: torch.Tensor,  # [B, M, 3]
    points: torch.Tensor,  # [B, N, 3]
    k: int,
    *,
    lengths: torch.Tensor | None = None,  # [B]
) -> tuple[torch.Tensor, torch.Tensor]:  # [B, M, k], [B, M, k]
    """Finds squared distances (B,M,k) f32 and indices (B,M,k) i64 of the k nearest points, ascending.

    Ties go to the lowest index.
    lengths: valid points per cloud; padding behind them is never found (but must be finite). Slots beyond a cloud's
    number of points repeat the nearest. Distances are float32 and carry no gradient: recompute them from the indices.
    Backends: numba on CPU (buckets with bounding boxes; exact, ties included), torch elsewhere (all pairs, in blocks of
    bounded memory); both give the same numbers. Raises ValueError on wrong shapes, non-finite coordinates, lengths out
    of range.

    >>> line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [3, 0, 0]]])
    >>> knn(torch.tensor([[[0.9, 0, 0]]]), line, 2)[1].tolist()
    [[[1, 0]]]
    """
    query, points, lengths = _checked(query, points, k, lengths)
    if chosen_backend(points.device) == "torch" or query.numel() == 0:
        return _knn_torch(query, points, k, lengths)
    return _knn_numba(query, points, k, lengths)


def knn_reference(
    query: torch.Tensor, points: torch.Tensor, k: int, *, lengths: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Is the torch twin of `knn`: same arguments, same result."""
    query, points, lengths = _checked(query, points, k, lengths)
    return _knn_torch(query, points, k, lengths)


def _checked(
    query: torch.Tensor, points: torch.Tensor, k: int, lengths: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    query, points = positions("query", query), positions("points", points)
    if query.shape[0] != points.shape[0] or points.shape[1] == 0:
        raise ValueError(f"query {tuple(query.shape)} and points {tuple(points.shape)} need one batch and N >= 1")
    if k < 1:
        raise ValueError(f"k must be at least 1, but is {k}")
    return query, points, row_lengths(lengths, points.shape[0], points.shape[1], points.device)


def _knn_numba(
    query: torch.Tensor, points: torch.Tensor, k: int, lengths: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    from dpcli.ops.cpu.farthest_point_sampling import BUCKET, bucket_kernel
    from dpcli.ops.cpu.neighbor_search import knn_kernel

    batch, rows, _ = query.shape
    total = points.shape[1]
    buckets = -(-total // BUCKET)
    valid = (torch.full((batch,), total) if lengths is None else lengths).numpy()
    order = np.empty((batch, total), np.int32)
    xyz, box = np.empty((batch, 3, buckets * BUCKET), np.float32), np.empty((batch, 6, buckets), np.float32)
    run_in_threads(bucket_kernel, (points.contiguous().numpy(), valid, order, xyz, box), batch, total * _BUCKET_NS)
    squared = torch.empty((batch, rows, k), dtype=torch.float32)
    index = torch.empty((batch, rows, k), dtype=torch.int64)
    found = (order, valid, xyz, box, BUCKET, query.contiguous().numpy(), squared.numpy(), index.numpy())
    run_in_threads(knn_kernel, found, batch * rows, _ROW_NS)
    return squared, index


def _knn_torch(
    query: torch.Tensor, points: torch.Tensor, k: int, lengths: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    batch, rows, _ = query.shape
    total = points.shape[1]
    valid = torch.full((batch,), total, device=points.device) if lengths is None else lengths
    beyond = torch.arange(total, device=points.device) >= valid[:, None]
    parts = []
    for block in row_blocks(rows, batch * total, points.device):
        keys = ordered_keys(squared_distances(query[:, block], points))
        keys.masked_fill_(beyond[:, None, :], torch.iinfo(torch.int64).max)
        parts.append(keys.topk(min(k, total), dim=-1, largest=False, sorted=True).values)
    keys = torch.cat(parts, 1) if parts else beyond.new_zeros((batch, rows, min(k, total)), dtype=torch.int64)
    slot = torch.arange(k, device=points.device).expand(batch, rows, k)
    keys = keys.gather(2, torch.where(slot < valid[:, None, None], slot, 0))
    return key_distances(keys), key_indices(keys)
