"""Chooses which implementation runs, on how many threads and in pieces of what size, and holds the shared checks.

Two backends exist: `torch`, the reference, which runs on any device (on CUDA it is the GPU path: vectorized, chunked),
and `numba`, the fast kernels for CPU tensors. The environment variable DPC_BACKEND=torch|numba overrides the choice.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

from dpcli.errors import UsageError

# Elements of one pairwise block: bounds the reference's memory, and on CPU keeps a block near the cache.
_BLOCK_ELEMENTS = {"cpu": 1 << 20, "cuda": 1 << 24}
_THREAD_NS = 4e6


@functools.cache
def numba_available() -> bool:
    """Returns whether numba imports; says so once on stderr if not."""
    try:
        import numba  # noqa: F401
    except Exception as error:  # a broken llvmlite raises more than ImportError
        print(f"dpc: numba does not import ({error}); the slower torch operations are used instead", file=sys.stderr)
        return False
    return True


def chosen_backend(device: torch.device | str = "cpu") -> str:
    """Returns the backend for tensors on `device`: "numba" on CPU where it imports, else "torch". Reads DPC_BACKEND.

    DPC_BACKEND=numba has no say over tensors on another device: their only path is torch.
    Raises UsageError when DPC_BACKEND is something else than torch or numba.
    """
    wanted = os.environ.get("DPC_BACKEND", "")
    if wanted not in ("", "torch", "numba"):
        raise UsageError(f"DPC_BACKEND is {wanted!r}; expected torch or numba, or leave it unset")
    if torch.device(device).type != "cpu" or wanted == "torch":
        return "torch"
    return "numba" if numba_available() else "torch"


@contextlib.contextmanager
def reference_only() -> Iterator[None]:
    """Makes `chosen_backend` say torch for the length of a block: for what watches torch's operations, which kernels and threads hide."""
    before = os.environ.get("DPC_BACKEND")
    os.environ["DPC_BACKEND"] = "torch"
    try:
        yield
    finally:
        if before is None:
            del os.environ["DPC_BACKEND"]
        else:
            os.environ["DPC_BACKEND"] = before


def run_in_threads(kernel: Callable[..., None], arguments: tuple, total: int, item_ns: float) -> None:
    """Calls kernel(*arguments, first, last) on windows that cover 0..total-1, one per thread.

    For kernels that release the GIL: one call each, since a thread that has to come back for the GIL may find its
    holder preempted. As many threads as torch has, but none for less than 4 ms of work by the estimate item_ns: torch's
    OpenMP threads spin for about as long after each operation and hold the core that a new thread would need. Threads
    live only as long as the call, so a forked process inherits none; DataLoader workers have one torch thread and run
    serially.
    """
    workers = max(1, min(torch.get_num_threads(), total, int(total * item_ns / _THREAD_NS)))
    bounds = [total * worker // workers for worker in range(workers + 1)]
    if workers == 1:
        return kernel(*arguments, 0, total)
    with ThreadPoolExecutor(workers - 1) as pool:  # the caller works too
        others = [pool.submit(kernel, *arguments, *window) for window in zip(bounds[1:], bounds[2:], strict=False)]
        kernel(*arguments, *bounds[:2])
        for other in others:
            other.result()


def row_blocks(rows: int, elements_per_row: int, device: torch.device) -> list[slice]:
    """Cuts `rows` into slices whose pairwise blocks stay within the memory bound of `device`."""
    bound = _BLOCK_ELEMENTS.get(device.type, _BLOCK_ELEMENTS["cpu"])
    step = max(1, bound // max(1, elements_per_row))
    return [slice(first, min(first + step, rows)) for first in range(0, rows, step)]


def positions(name: str, tensor: torch.Tensor) -> torch.Tensor:
    """Checks a (B,N,3) tensor of positions and returns it detached as float32. Raises ValueError."""
    if tensor.ndim != 3 or tensor.shape[-1] != 3:
        raise ValueError(f"{name} must have shape (B,N,3), but has {tuple(tensor.shape)}")
    if not tensor.is_floating_point():
        raise ValueError(f"{name} must be floating point, but is {tensor.dtype}")
    tensor = tensor.detach().to(torch.float32)
    if not is_finite(tensor):
        raise ValueError(f"{name} holds NaN or infinite coordinates; remove those points first")
    return tensor


def is_finite(tensor: torch.Tensor) -> bool:
    """Returns whether all values are finite; their sum is the cheaper first look, numpy's wakes no OpenMP threads."""
    if tensor.device.type == "cpu":
        with np.errstate(all="ignore"):
            array = tensor.detach().numpy()
            return bool(np.isfinite(array.sum()) or np.isfinite(array).all())
    return bool(torch.isfinite(tensor.sum())) or bool(torch.isfinite(tensor).all())


def check_rows(idx: torch.Tensor, count: int) -> None:
    """Checks that indices of `count` rows lie in 0..count-1, which kernels take on trust; on a GPU that look would stall the stream.

    Raises ValueError.
    """
    if idx.device.type == "cpu" and idx.numel() and not (0 <= int(idx.min()) and int(idx.max()) < count):
        raise ValueError(f"idx must lie in 0..{count - 1}, but spans {int(idx.min())}..{int(idx.max())}")


def squared_distances(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Computes squared distances (B,M,N) of a (B,M,3) and b (B,N,3): (dx*dx + dy*dy) + dz*dz, the order every kernel keeps."""
    dx, dy, dz = ((a[..., axis, None] - b[..., None, :, axis]) for axis in range(3))
    return dx.mul_(dx).add_(dy.mul_(dy)).add_(dz.mul_(dz))


def ordered_keys(distances: torch.Tensor) -> torch.Tensor:
    """Returns unique int64 keys (..., N) that sort as (distance, index): non-negative float bits above, the index below.

    torch.topk breaks ties as it likes; on these keys it cannot.
    """
    index = torch.arange(distances.shape[-1], device=distances.device)
    return distances.contiguous().view(torch.int32).to(torch.int64).bitwise_left_shift_(32).bitwise_or_(index)


def key_distances(keys: torch.Tensor) -> torch.Tensor:
    """Returns the float32 distances inside `ordered_keys`."""
    return keys.bitwise_right_shift(32).to(torch.int32).view(torch.float32)


def key_indices(keys: torch.Tensor) -> torch.Tensor:
    """Returns the indices inside `ordered_keys`."""
    return keys.bitwise_and(0xFFFFFFFF)
