"""Space-time ball query: space-time neighbors, those within a radius that depends on the distance in time (thesis 3.3, Kinet)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from dpcli.ops.backend import (
    chosen_backend,
    key_indices,
    ordered_keys,
    positions,
    row_blocks,
    run_in_threads,
    squared_distances,
)

_ROW_NS = {"first": 1e3, "nearest": 1.5e4, "balanced": 1.5e3}  # measured on a 16 x 2048 clip


def space_time_ball_query(
    points: torch.Tensor,  # [B, N, 3]
    times: torch.Tensor,  # [B, N]
    centroids: torch.Tensor,  # [B, M, 3]
    centroid_times: torch.Tensor,  # [B, M]
    radii: torch.Tensor | Sequence[float],  # [R]
    k: int,
    *,
    order: str = "first",
) -> tuple[torch.Tensor, torch.Tensor]:  # [B, M, k], [B, M]
    """Finds up to k neighbors of each centroid in space and time: indices (B,M,k) i64 and hit counts (B,M) i64 in 0..k.

    Point j is a neighbor of centroid i when d = |t_i - t_j| < R and dist(i,j) < radii[d], both strict; distances are
    compared squared, in float32. times are whole frame indices (integers, or floats holding integers), in any order.
    order "first": the k neighbors of lowest index, ascending; unused slots repeat the first. Frame-major points thus
    favor the earlier frame, as the released Kinet does. order "nearest": the k nearest in space, ascending, ties to
    the lowest index; unused slots repeat the nearest. order "balanced": `balanced_shares` of the slots for each frame
    within reach, from the earliest on, filled with the frame's first hits; its unused slots repeat the first; a frame
    without hits gets the centroid's own frame's share, repeated. A centroid without any neighbor has count 0 and index
    0 in all slots.
    Indices carry no gradient: gather with them. Backends: numba on CPU (frames found by bisection when the times are
    sorted), torch elsewhere; same indices. Raises ValueError on wrong shapes, non-finite values, fractional times, or
    fewer slots than frames within reach ("balanced").

    >>> points = torch.tensor([[[0.0, 0, 0], [0.3, 0, 0], [0.3, 0, 0], [0.1, 0, 0]]])
    >>> times = torch.tensor([[0, 0, 1, 2]])  # within 0.5 in its own frame, within 0.2 one frame away, never farther
    >>> found, hits = space_time_ball_query(points, times, points[:, :1], times[:, :1], [0.5, 0.2], 3)
    >>> found.tolist(), hits.tolist()
    ([[[0, 1, 0]]], [[2]])
    """
    query = _checked(points, times, centroids, centroid_times, radii, k, order)
    return _any_torch(query) if chosen_backend(points.device) == "torch" else _query_numba(query)


def balanced_shares(k: int, reach: int) -> list[int]:
    """Returns how k slots are shared among the frames from `reach` before to `reach` after: equally, to one.

    >>> balanced_shares(8, 1)
    [2, 3, 3]
    """
    frames = 2 * reach + 1
    return [k * (i + 1) // frames - k * i // frames for i in range(frames)]


def space_time_ball_query_reference(
    points: torch.Tensor,
    times: torch.Tensor,
    centroids: torch.Tensor,
    centroid_times: torch.Tensor,
    radii: torch.Tensor | Sequence[float],
    k: int,
    *,
    order: str = "first",
) -> tuple[torch.Tensor, torch.Tensor]:
    """Computes `space_time_ball_query` in plain torch, as a reference: all pairs, in blocks of bounded memory."""
    return _any_torch(_checked(points, times, centroids, centroid_times, radii, k, order))


class _Query(NamedTuple):
    """Holds checked arguments: frame indices i64, and in place of the radii their squares."""

    points: torch.Tensor
    times: torch.Tensor
    centroids: torch.Tensor
    centroid_times: torch.Tensor
    limits: torch.Tensor
    k: int
    order: str


def _checked(
    points: torch.Tensor,
    times: torch.Tensor,
    centroids: torch.Tensor,
    centroid_times: torch.Tensor,
    radii: torch.Tensor | Sequence[float],
    k: int,
    order: str,
) -> _Query:
    points, centroids = positions("points", points), positions("centroids", centroids)
    if points.shape[0] != centroids.shape[0] or points.shape[1] == 0:
        raise ValueError(f"points {tuple(points.shape)} and centroids {tuple(centroids.shape)} need one batch, N >= 1")
    if k < 1 or order not in _ROW_NS:
        raise ValueError(f"k must be at least 1 and order one of {', '.join(_ROW_NS)}, but they are {k} and {order!r}")
    limits = _squared_radii(radii, points.device, trim=order != "balanced")
    if order == "balanced" and k < 2 * len(limits) - 1:
        raise ValueError(f"k must be at least 1 per frame within reach, {2 * len(limits) - 1}, but is {k}")
    times = _frame_indices("times", times, points)
    return _Query(
        points, times, centroids, _frame_indices("centroid_times", centroid_times, centroids), limits, k, order
    )


def _frame_indices(name: str, times: torch.Tensor, owner: torch.Tensor) -> torch.Tensor:
    if times.shape != owner.shape[:2]:
        raise ValueError(f"{name} must have shape {tuple(owner.shape[:2])}, but has {tuple(times.shape)}")
    whole = times.detach().to(torch.int64)
    if times.is_floating_point() and not bool((whole == times).all()):
        raise ValueError(f"{name} must hold whole frame indices; divide seconds by the frame interval and round")
    return whole.to(owner.device)


def _squared_radii(radii: torch.Tensor | Sequence[float], device: torch.device, trim: bool) -> torch.Tensor:
    """Returns squared radii (R,); `trim`: without trailing zeros, which accept nothing but would widen the window in time."""
    radii = torch.as_tensor(radii, dtype=torch.float32, device="cpu").detach()
    if radii.ndim != 1 or not bool((torch.isfinite(radii) & (radii >= 0)).all()):
        raise ValueError(
            f"radii must be a list of finite numbers >= 0, one per frame distance, but is {radii.tolist()}"
        )
    if trim:
        radii = radii[: int(radii.nonzero().max()) + 1 if bool(radii.any()) else 0]
    return (radii * radii).to(device)


def _query_numba(query: _Query) -> tuple[torch.Tensor, torch.Tensor]:
    from dpcli.ops.cpu.neighbor_search import balanced_query_kernel, ball_query_kernel

    points, times, *rest, k, order = query
    batch, rows = query.centroid_times.shape
    index = torch.empty((batch, rows, k), dtype=torch.int64)
    count = torch.empty((batch, rows), dtype=torch.int64)
    xyz = np.ascontiguousarray(points.numpy().transpose(0, 2, 1))  # torch's copy would wake OpenMP threads
    when = times.contiguous().numpy()
    arrays = [tensor.contiguous().numpy() for tensor in rest]
    if order == "balanced":
        by_time = np.argsort(when, 1, kind="stable")  # within a frame the lowest index stays first
        if (np.diff(when) < 0).any():
            xyz, when = np.take_along_axis(xyz, by_time[:, None], 2), np.take_along_axis(when, by_time, 1)
        shares = np.array(balanced_shares(k, len(query.limits) - 1), np.int64)
        kernel, arrays = balanced_query_kernel, [*arrays, shares, by_time]
    else:
        kernel, arrays = ball_query_kernel, [*arrays, order == "nearest"]
    run_in_threads(kernel, (xyz, when, *arrays, index.numpy(), count.numpy()), batch * rows, _ROW_NS[order])
    return index, count


def _any_torch(query: _Query) -> tuple[torch.Tensor, torch.Tensor]:
    if query.order != "balanced":
        return _query_torch(query)
    k, limits, reach = query.k, query.limits, len(query.limits) - 1
    found = []
    for offset, share in zip(range(-reach, reach + 1), balanced_shares(k, reach), strict=True):
        only = limits[abs(offset) : abs(offset) + 1]  # one radius: just the frame at this offset
        at = query.centroid_times + offset
        found.append(_query_torch(query._replace(centroid_times=at, limits=only, k=share, order="first")))
    own = found[reach][0]
    slots = torch.arange(k, device=own.device) % own.shape[-1]
    pieces = [torch.where(hits[..., None] > 0, idx, own[..., slots[: idx.shape[-1]]]) for idx, hits in found]
    return torch.cat(pieces, -1), sum(hits for _, hits in found)


def _query_torch(query: _Query) -> tuple[torch.Tensor, torch.Tensor]:
    points, times, centroids, centroid_times, limits, k, order = query
    batch, rows = centroid_times.shape
    total = points.shape[1]
    bounds = torch.cat([limits, limits.new_full((1,), -1.0)])  # last: too far in time
    pick = _first_hits if order == "first" else _nearest_hits
    parts = []
    for block in row_blocks(rows, batch * total, points.device):
        gap = (centroid_times[:, block, None] - times[:, None, :]).abs_().clamp_(max=len(limits))
        distance = squared_distances(centroids[:, block], points)
        parts.append(pick(distance, distance < bounds[gap], min(k, total)))
    if not parts:
        return times.new_empty((batch, 0, k)), times.new_empty((batch, 0))
    index, count = (torch.cat(part, 1) for part in zip(*parts, strict=True))
    slot = torch.arange(k, device=points.device)
    return index.gather(2, torch.where(slot < count[..., None], slot, 0)), count


def _first_hits(distance: torch.Tensor, hit: torch.Tensor, k: int) -> tuple[torch.Tensor, torch.Tensor]:
    rank = hit.cumsum(-1, dtype=torch.int32)
    index = rank.new_zeros((*hit.shape[:2], k), dtype=torch.int64)
    b, m, j = (hit & (rank <= k)).nonzero(as_tuple=True)
    index[b, m, rank[b, m, j].long() - 1] = j
    return index, rank[..., -1].clamp(max=k).long()


def _nearest_hits(distance: torch.Tensor, hit: torch.Tensor, k: int) -> tuple[torch.Tensor, torch.Tensor]:
    keys = ordered_keys(distance.masked_fill(~hit, float("inf")))
    index = key_indices(keys.topk(k, dim=-1, largest=False, sorted=True).values)
    count = hit.sum(-1).clamp(max=k)
    return torch.where(count[..., None] > 0, index, 0), count
