"""Nearest neighbors in coordinates or features, among the frames near in time: the graph of DGCNN and SpiderCNN; and pooling over it.

A static DGCNN or SpiderCNN joins a point to the nearest of the whole clip. A surface over time needs several frames in a
neighborhood (thesis eq. 3.1: |dt| <= temporal radius), so here the search is restricted to those; that is ours, like the
equal shares, which keep one dense frame from filling all slots. Distances are taken between pairs of frames only.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dpcli.ops import knn
from dpcli.ops.backend import check_rows, chosen_backend, run_in_threads, squared_distances
from dpcli.runtime.mixed_precision import full_precision

_DISTANCES = 1 << 24  # distances held at once between features, 64 MiB
_ALL_PAIRS = 512  # points a frame up to which the kernel looks at every pair; beyond, `knn`'s buckets look at fewer
_PAIRS = 1 << 20  # distances that it is given at once: 4 MiB
_PAIR_NS, _POOL_NS = 1.0, 0.1  # per pair of points, and per gathered number
_PIECE = 1 << 18  # gathered numbers between two poolings, which then stay in the cache


def frame_size(times: Tensor) -> int:
    """Returns the number of points per frame of a cloud whose frames follow one another and are equally large; times (B,N).

    Raises ValueError for any other cloud.
    """
    size = int((times[0] == times[0, 0]).sum())
    expected = times[:, :1] + torch.arange(times.shape[1], device=times.device) // size
    if times.shape[1] % size or not torch.equal(times, expected.to(times)):
        raise ValueError(f"times {tuple(times.shape)} must count frames of equally many points, one after another")
    return size


@full_precision
@torch.no_grad()
def frame_graph(features: Tensor, times: Tensor, k: int, reach: int, shared: bool) -> Tensor:
    """Returns the k nearest of each point among the frames at most `reach` away, (B,N,k) i64, by ascending distance.

    features (B,N,C) of all frames, coordinates or activations; times (B,N), frame after frame. `shared` divides the slots
    by `frame_shares` and takes the nearest of each frame; without, they are the nearest of those frames together. The point
    itself is among them; equal distances go to the own frame, then to the earlier one, and for C = 3 to the lowest index.
    Slots beyond the points there are repeat the nearest.
    """
    batch, count, channels = features.shape
    size = frame_size(times)
    frames = count // size
    blocks = features.detach().view(batch, frames, size, channels)
    shares = (
        frame_shares(k, frames, reach) if shared else [{d: k for d in row} for row in frame_shares(k, frames, reach)]
    )
    if features.dtype == torch.float32 and size <= _ALL_PAIRS and chosen_backend(features.device) == "numba":
        return _among_all_pairs(blocks, shares, k)
    return _among_nearest(blocks, shares, k)


def _among_all_pairs(blocks: Tensor, shares: list[dict[int, int]], k: int) -> Tensor:
    """Computes `frame_graph` of blocks (B,T,P,C) by a kernel, which looks through the distances of a few frames at a time."""
    from dpcli.ops.cpu.frame_graph import nearest_kernel

    batch, frames, size, channels = blocks.shape
    offsets = sorted({d for row in shares for d in row}, key=_own_first)
    taken = np.array([[row.get(d, 0) for d in offsets] for row in shares])
    starts = (np.arange(frames)[:, None] + offsets) * size
    out = torch.empty(batch, frames, size, k, dtype=torch.int64)
    step = max(1, _PAIRS // (len(offsets) * size * size))
    distance = torch.empty(len(offsets), min(step, frames), size, size)
    for cloud, found in zip(blocks, out):
        if channels != 3:
            cloud = cloud - cloud.mean((0, 1))  # |a|^2 - 2ab + |b|^2 loses fewer digits near the origin
        for first in range(0, frames, step):
            last = min(first + step, frames)
            for offset, into in zip(offsets, distance):
                low, high = max(first, -offset), min(last, frames - offset)
                if low < high:
                    _measure(cloud[low:high], cloud[low + offset : high + offset], into[low - first : high - first])
            arrays = (distance.numpy(), taken[first:last], starts[first:last], found[first:last].flatten(0, 1).numpy())
            run_in_threads(nearest_kernel, arrays, (last - first) * size, len(offsets) * size * _PAIR_NS)
    return out.view(batch, frames * size, k)


def _measure(query: Tensor, points: Tensor, out: Tensor) -> None:
    """Returns squared distances (R,P,P) of query and points (R,P,C); for C = 3 as every search of `dpcli.ops` rounds them."""
    if query.shape[-1] == 3:
        out.copy_(squared_distances(query, points))
        return
    torch.baddbmm(points.square().sum(-1)[:, None], query, points.transpose(1, 2), alpha=-2, out=out)
    out.add_(query.square().sum(-1, keepdim=True)).clamp_(min=0)


def _among_nearest(blocks: Tensor, shares: list[dict[int, int]], k: int) -> Tensor:
    """Computes `frame_graph` of blocks (B,T,P,C) in torch, a search a frame and offset."""
    found = [_between(blocks, offset, shares) for offset in sorted({d for row in shares for d in row}, key=_own_first)]
    distance, index = (torch.cat(parts, -1) for parts in zip(*found))
    distance, order = distance.sort(dim=-1, stable=True)
    index = index.gather(-1, order[..., :k])
    index = torch.where(distance[..., :k].isinf(), index[..., :1], index)
    if index.shape[-1] < k:
        index = torch.cat([index, index[..., :1].expand(-1, -1, -1, k - index.shape[-1])], -1)
    return index.flatten(1, 2)


def frame_shares(k: int, frames: int, reach: int) -> list[dict[int, int]]:
    """Returns how the k slots of a point of each frame are divided: {offset in time: slots} of the frames within reach.

    Equal parts; what is left over goes to the own frame, so that the graph of a clip played backwards is the same.
    """
    rows = []
    for frame in range(frames):
        offsets = range(max(-reach, -frame), min(reach, frames - 1 - frame) + 1)
        part = k // len(offsets)
        rows.append({d: part if d else k - part * (len(offsets) - 1) for d in offsets})
    return rows


def _own_first(offset: int) -> tuple[int, int]:
    return abs(offset), offset


def _between(blocks: Tensor, offset: int, shares: list[dict[int, int]]) -> tuple[Tensor, Tensor]:
    """Returns distances and indices (B,T,P,n) of each point's nearest in the frame at `offset`; infinite beyond its share."""
    batch, frames, size, channels = blocks.shape
    wanted = [row.get(offset, 0) for row in shares]
    most = min(max(wanted), size)
    first, last = max(0, -offset), frames - max(0, offset)
    query, points = blocks[:, first:last], blocks[:, first + offset : last + offset]
    rows = (batch * (last - first), size, channels)
    near, idx = _nearest(query.reshape(rows), points.reshape(rows), most)
    distance = near.new_full((batch, frames, size, most), float("inf"))
    index = idx.new_zeros((batch, frames, size, most))
    distance[:, first:last] = near.view(batch, -1, size, most)
    start = torch.arange(first + offset, last + offset, device=blocks.device)[:, None, None] * size
    index[:, first:last] = idx.view(batch, -1, size, most) + start
    beyond = torch.arange(most) >= torch.tensor(wanted)[:, None]
    return distance.masked_fill_(beyond.to(blocks.device)[None, :, None], float("inf")), index


def _nearest(query: Tensor, points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Returns squared distances and indices (R,P,k) of the nearest of each cloud; query and points (R,P,C)."""
    if query.shape[-1] == 3:
        return knn(query, points, k)
    pieces = []
    step = max(1, _DISTANCES // (points.shape[1] * query.shape[1]))
    for a, b in zip(query.split(step), points.split(step)):
        middle = b.mean(1, keepdim=True)  # |a|^2 - 2ab + |b|^2 loses fewer digits near the origin
        a, b = a - middle, b - middle
        squared = torch.baddbmm(b.square().sum(-1)[:, None], a, b.transpose(1, 2), alpha=-2)
        near, idx = squared.topk(k, dim=-1, largest=False)
        pieces.append(((near + a.square().sum(-1, keepdim=True)).clamp_(min=0), idx))
    near, idx = (torch.cat(parts) for parts in zip(*pieces))
    return near, idx


def pool_edges(values: Tensor, idx: Tensor) -> tuple[Tensor, Tensor]:
    """Returns maximum and sum over each point's neighbors, both (B,N,C), of values (B,N,C) at idx (B,N,K); differentiable.

    The gathered (B,N,K,C) are never all held: a kernel makes none, torch makes and pools them piece by piece on a CPU.
    Equally large neighbors share the maximum's gradient, as in torch.amax. Raises ValueError, on CPU, on an index out of range.
    """
    check_rows(idx, values.shape[1])
    if values.dtype in (torch.float32, torch.float64) and idx.numel() and chosen_backend(values.device) == "numba":
        return _PooledByKernel.apply(values.contiguous(), idx.contiguous())
    batch, count, channels = values.shape
    rows = idx + torch.arange(batch, device=idx.device)[:, None, None] * count
    pooled = _PooledEdges.apply(values.reshape(batch * count, channels), rows.flatten(0, 1))
    return tuple(part.view(batch, idx.shape[1], channels) for part in pooled)


class _PooledByKernel(torch.autograd.Function):
    """Computes from values (B,N,C) and idx (B,M,K) the maximum and sum over K, (B,M,C) each."""

    @staticmethod
    def forward(ctx, values: Tensor, idx: Tensor) -> tuple[Tensor, Tensor]:
        from dpcli.ops.cpu.frame_graph import pool_kernel

        shape, cost = (*idx.shape[:2], values.shape[2]), idx.shape[2] * values.shape[2] * _POOL_NS
        largest, total = (torch.empty(shape, dtype=values.dtype) for _ in range(2))
        arrays = (values.detach().numpy(), idx.numpy(), largest.flatten(0, 1).numpy(), total.flatten(0, 1).numpy())
        run_in_threads(pool_kernel, arrays, len(arrays[2]), cost)
        ctx.save_for_backward(values, idx, largest)
        return largest, total

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, to_largest: Tensor, to_total: Tensor) -> tuple[Tensor, None]:
        from dpcli.ops.cpu.frame_graph import pool_back_kernel

        values, idx, largest = ctx.saved_tensors
        out, cost = torch.zeros_like(values), 3 * idx[0].numel() * values.shape[2] * _POOL_NS
        arrays = (values.detach(), idx, largest, to_largest.contiguous(), to_total.contiguous(), out)
        run_in_threads(pool_back_kernel, tuple(array.numpy() for array in arrays), len(out), cost)
        return out, None


class _PooledEdges(torch.autograd.Function):
    """Computes from values (R,C) and rows (M,K) the maximum and sum over K, (M,C) each."""

    @staticmethod
    def forward(ctx, values: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        parts = []
        for piece in rows.split(_rows_a_piece(values, rows)):
            gathered = values.index_select(0, piece.reshape(-1)).view(*piece.shape, -1)
            parts.append((gathered.amax(1), gathered.sum(1)))
        largest, total = (torch.cat(part) for part in zip(*parts))
        ctx.save_for_backward(values, rows, largest)
        return largest, total

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, to_largest: Tensor, to_total: Tensor) -> tuple[Tensor, None]:
        values, rows, largest = ctx.saved_tensors
        out, step = torch.zeros_like(values), _rows_a_piece(values, rows)
        pieces = (part.split(step) for part in (rows, largest, to_largest, to_total))
        for piece, best, grad, added in zip(*pieces):
            where = (values.index_select(0, piece.reshape(-1)).view(*piece.shape, -1) == best[:, None]).to(grad)
            where.mul_((grad / where.sum(1))[:, None]).add_(added[:, None])
            out.index_add_(0, piece.reshape(-1), where.flatten(0, 1))
        return out, None


def _rows_a_piece(values: Tensor, rows: Tensor) -> int:
    if values.device.type != "cpu":
        return max(len(rows), 1)
    return max(1, _PIECE // (rows.shape[1] * values.shape[1]))
