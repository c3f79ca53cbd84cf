"""The transpose of a gather, in numba."""

from __future__ import annotations

import numpy as np

from dpcli.ops.cpu.jit import arithmetic_kernel


@arithmetic_kernel
def scatter_add_kernel(grad, rows, out, per_cloud, first, last):
    """Adds clouds first..last-1 of grad (R,C), per_cloud rows each, to the rows of `out` that `rows` (R,) names."""
    for i in range(first * per_cloud, last * per_cloud):
        source, target = np.uintp(i), np.uintp(rows[i])
        for channel in range(np.uintp(out.shape[1])):
            out[target, channel] += grad[source, channel]


@arithmetic_kernel
def mean_kernel(features, idx, out, first, last):
    """Sets out[i] = mean over k of features[b, idx[b, m, k]] for rows i = b * M + m of out (B*M,C), first..last-1."""
    count, neighbors = idx.shape[1], idx.shape[2]
    for i in range(first, last):
        b, m, row = i // count, i % count, np.uintp(i)
        out[row] = 0
        for k in range(neighbors):
            j = np.uintp(idx[b, m, k])
            for channel in range(np.uintp(out.shape[1])):
                out[row, channel] += features[b, j, channel]
        for channel in range(np.uintp(out.shape[1])):
            out[row, channel] /= neighbors


@arithmetic_kernel
def mean_back_kernel(grad, idx, out, first, last):
    """Adds the gradient of `mean_kernel` for clouds first..last-1, grad (B,M,C), to out (B,N,C), which holds zeros."""
    count, neighbors = idx.shape[1], idx.shape[2]
    part = np.empty(grad.shape[2], grad.dtype)
    for b in range(first, last):
        for m in range(count):
            for channel in range(np.uintp(part.size)):
                part[channel] = grad[b, m, channel] / neighbors
            for k in range(neighbors):
                j = np.uintp(idx[b, m, k])
                for channel in range(np.uintp(part.size)):
                    out[b, j, channel] += part[channel]
