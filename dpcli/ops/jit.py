"""One decorator for every CPU kernel: numba, cached on disk, releasing the GIL."""

from __future__ import annotations

from collections.abc import Callable

import numba


# No NaN ever enters (callers check), and a zero's sign never matters: this lets minima vectorise. Nothing that changes a
# value is allowed, neither reassociation nor fused multiply-add: indices must equal the reference's, ties included.
_FLAGS = {"nnan", "nsz"}


def kernel(function: Callable) -> Callable:
    """Compile `function` on first call.

    Serial by design: callers spread work over plain threads (`backend.run_in_threads`), which unlike numba's parallel
    mode survives a fork. Where no cache folder is writable the kernel is compiled anew in each process.
    """
    try:
        return numba.njit(nogil=True, fastmath=_FLAGS, cache=True)(function)
    except RuntimeError:
        return numba.njit(nogil=True, fastmath=_FLAGS)(function)


def parallel_kernel(function: Callable) -> Callable:
    """For floating-point work on numba's own threads: contraction and reordering allowed, results to rounding only.

    Must not run in a process that forks afterwards; `parallel.parallel_kernels` loads modules that use it.
    """
    options = {"parallel": True, "fastmath": {"contract", "nsz", "arcp", "reassoc"}, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:
        return numba.njit(**options)(function)
