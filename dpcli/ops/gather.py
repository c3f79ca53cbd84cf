"""Rows of features by index, with a backward that keeps up with the forward."""

from __future__ import annotations

import torch
from torch import Tensor

from dpcli.ops.backend import check_rows, chosen_backend, run_in_threads

_ENTRY_NS = 0.4  # measured, per number that is added


def gather_points(features: Tensor, idx: Tensor) -> Tensor:
    """Takes rows by index: features (B,N,C), idx (B,...) i64 in 0..N-1 -> (B,...,C), differentiable in features.

    Backward adds each row's gradient to its source: by a kernel per cloud on CPU (threads never share a cloud, so sums
    repeat exactly), by index_add_ elsewhere. Raises ValueError on wrong shapes and, on CPU, on indices out of range (on
    a GPU that look would stall the stream, and an index past a cloud's end reads its neighbor in the batch).

    >>> import torch
    >>> gather_points(torch.tensor([[[1.0], [2.0], [3.0]]]), torch.tensor([[2, 0]])).tolist()
    [[[3.0], [1.0]]]
    """
    _check(features, idx)
    batch, count, channels = features.shape
    shift = torch.arange(batch, device=idx.device).mul_(count).view(-1, *[1] * (idx.ndim - 1))
    rows = (idx + shift).reshape(-1)
    flat = features.reshape(batch * count, channels)
    if features.dtype in (torch.float32, torch.float64) and chosen_backend(features.device) == "numba":
        gathered = _GatherRows.apply(flat, rows, batch)
    else:
        gathered = flat.index_select(0, rows)
    return gathered.view(*idx.shape, channels)


def gather_mean(features: Tensor, idx: Tensor) -> Tensor:
    """Computes the mean of each row's neighbors, features (B,N,C), idx (B,M,K) i64 -> (B,M,C): `gather_points(features, idx).mean(2)`.

    On a CPU the (B,M,K,C) in between are never made. Differentiable in features; errors as `gather_points`.

    >>> import torch
    >>> gather_mean(torch.tensor([[[1.0], [2.0], [4.0]]]), torch.tensor([[[0, 1], [2, 2]]])).tolist()
    [[[1.5], [4.0]]]
    """
    kernel = features.dtype in (torch.float32, torch.float64) and chosen_backend(features.device) == "numba"
    if not kernel or idx.ndim != 3 or not idx.numel():
        return gather_points(features, idx).mean(2)
    _check(features, idx)
    return _GatherMean.apply(features, idx.contiguous())


def _check(features: Tensor, idx: Tensor) -> None:
    if features.ndim != 3 or idx.ndim < 1 or idx.shape[0] != features.shape[0]:
        raise ValueError(f"features (B,N,C) and idx (B,...) do not fit: {tuple(features.shape)}, {tuple(idx.shape)}")
    check_rows(idx, features.shape[1])


class _GatherMean(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features: Tensor, idx: Tensor) -> Tensor:
        from dpcli.ops.cpu.gather import mean_kernel

        ctx.save_for_backward(idx)
        ctx.points = features.shape[1]
        (batch, count, neighbors), channels = idx.shape, features.shape[2]
        out = torch.empty(batch * count, channels, dtype=features.dtype)
        arrays = (features.detach().contiguous().numpy(), idx.numpy(), out.numpy())
        run_in_threads(mean_kernel, arrays, len(out), neighbors * channels * _ENTRY_NS)
        return out.view(batch, count, channels)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        from dpcli.ops.cpu.gather import mean_back_kernel

        (idx,) = ctx.saved_tensors
        out = torch.zeros(len(idx), ctx.points, grad.shape[2], dtype=grad.dtype)
        arrays = (grad.contiguous().numpy(), idx.numpy(), out.numpy())
        run_in_threads(mean_back_kernel, arrays, len(idx), idx[0].numel() * grad.shape[2] * _ENTRY_NS)
        return out, None


class _GatherRows(torch.autograd.Function):
    """Computes index_select of rows whose indices come cloud after cloud, equally many for each, with its gradient."""

    @staticmethod
    def forward(ctx, flat: Tensor, rows: Tensor, batch: int) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.sizes = (flat.shape, batch)
        return flat.index_select(0, rows)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None]:
        from dpcli.ops.cpu.gather import scatter_add_kernel

        (rows,) = ctx.saved_tensors
        shape, batch = ctx.sizes
        out = torch.zeros(shape, dtype=grad.dtype)
        arrays = (grad.contiguous().numpy(), rows.numpy(), out.numpy())
        per_cloud = len(rows) // max(batch, 1)
        run_in_threads(scatter_add_kernel, (*arrays, per_cloud), batch, per_cloud * shape[1] * _ENTRY_NS)
        return out, None, None
