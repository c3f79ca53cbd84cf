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
