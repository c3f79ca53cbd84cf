"""The decorators of the CPU kernels: numba, cached on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numba

from dpcli.runtime.tuning import load_numba_without_blas

load_numba_without_blas()

_FOLDER = Path(__file__).parent
_SHARED = (Path(__file__), _FOLDER / "simd.py", _FOLDER.parent / "splatting" / "cpu_simd.py")
# A digest of what is compiled into kernels of other files: an edit there makes their cached code stale.
SHARED_CODE = hashlib.sha256(b"".join(path.read_bytes() for path in _SHARED)).hexdigest()

# No NaN ever enters (callers check), and a zero's sign never matters: this lets minima vectorize. Nothing that changes
# a value is allowed, neither reassociation nor fused multiply-add: indices must equal the reference's, ties included.
_FLAGS = {"nnan", "nsz"}
_ARITHMETIC = {"contract", "nsz", "arcp", "reassoc"}


def kernel(function: Callable) -> Callable:
    """Compiles a search, whose indices and distances must equal the reference's, on its first call.

    Serial by design: callers spread work over plain threads (`backend.run_in_threads`), which unlike numba's parallel
    mode survives a fork. Where no cache folder is writable the kernel is compiled anew in each process. Helpers belong
    in the file of the kernel that calls them: the cache looks for changes in that file and in the lanes' files only.
    """
    return _compiled(function, nogil=True, fastmath=_FLAGS, error_model="numpy")


def inlined(function: Callable) -> Callable:
    """Compiles a helper of a `kernel` whose text goes into the caller: for what is called once a microsecond."""
    return _compiled(function, nogil=True, fastmath=_FLAGS, error_model="numpy", inline="always")


def arithmetic_kernel(function: Callable) -> Callable:
    """Compiles as `kernel`, but infinities and NaN pass through as IEEE 754 has them: for values that were not checked."""
    return _compiled(function, nogil=True, error_model="numpy")


def _compiled(function: Callable, **options: object) -> Callable:
    try:
        kernel = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder for the cache
        return numba.njit(**options)(function)
    file = kernel._cache._cache_file
    file._source_stamp = (file._source_stamp, SHARED_CODE)  # numba's own stamp is of the kernel's file alone
    return kernel


def parallel_kernel(function: Callable) -> Callable:
    """Compiles floating-point work for numba's own threads: contraction and reordering allowed, results to rounding only.

    Must not run in a process that forks afterwards; `parallel.parallel_kernels` loads modules that use it.
    """
    return _compiled(function, parallel=True, fastmath=_ARITHMETIC, error_model="numpy")


def piece_kernel(function: Callable) -> Callable:
    """Compiles as `parallel_kernel`, but serial and without the GIL: for work that plain threads share among them."""
    return _compiled(function, nogil=True, fastmath=_ARITHMETIC, error_model="numpy")
