"""The transpose of a gather, in numba."""

from __future__ import annotations

import numpy as np

from dpcli.ops.jit import arithmetic_kernel


@arithmetic_kernel
def scatter_add_kernel(grad, rows, out, per_cloud, first, last):
    """Add clouds first..last-1 of grad (R,C), per_cloud rows each, to the rows of `out` that `rows` (R,) names."""
    for i in range(first * per_cloud, last * per_cloud):
        source, target = np.uintp(i), np.uintp(rows[i])
        for channel in range(np.uintp(out.shape[1])):
            out[target, channel] += grad[source, channel]
