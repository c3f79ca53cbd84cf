"""The transpose of a gather, in numba."""

from __future__ import annotations

import numpy as np

from dpcli.ops.jit import arithmetic_kernel


@arithmetic_kernel
def scatter_add_kernel(grad, rows, out, first, last):
    """Add rows first..last-1 of grad (R,C) to the rows of `out` (N,C) that `rows` (R,) names, in order."""
    for i in range(first, last):
        source, target = np.uintp(i), np.uintp(rows[i])
        for channel in range(np.uintp(out.shape[1])):
            out[target, channel] += grad[source, channel]
