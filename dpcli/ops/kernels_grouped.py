"""CPU kernels of `grouped_mlp`: the memory-bound passes around its matrix products, each reading its input once.

Rows are neighbours: row r = i * K + k is neighbour k of centroid i. `blocks` cut the centroids so that every thread sums
into accumulators of its own; sums are float64. All arrays are C-contiguous float32 unless said otherwise.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from dpcli.ops.jit import parallel_kernel


@parallel_kernel
def project_xyz(points, centers, idx, weight, bias, out, sums):
    """out[r] = weight @ (points[idx[r]] - centers[i]) + bias; sums (blocks,2,C) f64 collect sum and sum of squares.

    points (B,N,3), centers (B,M,3), idx (B,M,K) i64, weight (3,C), out (B,M,K,C).
    """
    batch, count, neighbors = idx.shape
    blocks, channels = sums.shape[0], weight.shape[1]
    for block in prange(blocks):
        for i in range(block * batch * count // blocks, (block + 1) * batch * count // blocks):
            b, m = i // count, i % count
            total, squares = np.zeros(channels, np.float32), np.zeros(channels, np.float32)
            for k in range(neighbors):
                j = idx[b, m, k]
                x = points[b, j, 0] - centers[b, m, 0]
                y = points[b, j, 1] - centers[b, m, 1]
                z = points[b, j, 2] - centers[b, m, 2]
                for c in range(channels):
                    value = weight[0, c] * x + weight[1, c] * y + weight[2, c] * z + bias[c]
                    out[b, m, k, c] = value
                    total[c] += value
                    squares[c] += value * value
            for c in range(channels):
                sums[block, 0, c] += total[c]
                sums[block, 1, c] += squares[c]


@parallel_kernel
def gather_difference(table, offset, idx, out, sums):
    """out[r] = table[idx[r]] - offset[i], with sums as in `project_xyz`. table (B,N,C), offset (B,M,C), idx (B,M,K)."""
    batch, count, neighbors = idx.shape
    blocks, channels = sums.shape[0], table.shape[2]
    for block in prange(blocks):
        for i in range(block * batch * count // blocks, (block + 1) * batch * count // blocks):
            b, m = i // count, i % count
            total, squares = np.zeros(channels, np.float32), np.zeros(channels, np.float32)
            for k in range(neighbors):
                j = idx[b, m, k]
                for c in range(channels):
                    value = table[b, j, c] - offset[b, m, c]
                    out[b, m, k, c] = value
                    total[c] += value
                    squares[c] += value * value
            for c in range(channels):
                sums[block, 0, c] += total[c]
                sums[block, 1, c] += squares[c]


@parallel_kernel
def affine_relu(rows, scale, shift):
    """rows = max(rows * scale + shift, 0), in place. rows (R,C)."""
    for r in prange(rows.shape[0]):
        for c in range(rows.shape[1]):
            rows[r, c] = max(rows[r, c] * scale[c] + shift[c], np.float32(0))


@parallel_kernel
def extreme(rows, sign, best, where):
    """Per centroid and channel the largest (sign > 0) or smallest value over its K rows, and which row.

    rows (M,K,C), sign (C), best (M,C), where (M,C) u8; ties: the first row.
    """
    count, neighbors, channels = rows.shape
    for i in prange(count):
        top = np.empty(channels, np.float32)
        at = np.zeros(channels, np.int32)
        for c in range(channels):
            top[c] = rows[i, 0, c] * sign[c]
        for k in range(1, neighbors):
            for c in range(channels):
                signed = rows[i, k, c] * sign[c]
                better = signed > top[c]  # selects, not branches: the loop over channels then vectorises
                top[c] = signed if better else top[c]
                at[c] = np.int32(k) if better else at[c]
        for c in range(channels):
            best[i, c] = top[c] * sign[c]
            where[i, c] = at[c]


@parallel_kernel
def scatter_pooled(grad, where, weight, hidden, dense, grad_weight):
    """Add the gradient that came through the pooling: it reaches one row per centroid and channel.

    grad (M,C2) of the linear output at row where (M,C2) u8; weight (C2,C1); hidden and dense (M,K,C1):
    dense[i, where[i,c]] += grad[i,c] * weight[c] and grad_weight[block, c] += grad[i,c] * hidden[i, where[i,c]].
    """
    count, outputs = grad.shape
    inputs, blocks = weight.shape[1], grad_weight.shape[0]
    for block in prange(blocks):
        for i in range(block * count // blocks, (block + 1) * count // blocks):
            for o in range(outputs):
                g = grad[i, o]
                if g != 0:
                    k = where[i, o]
                    for c in range(inputs):
                        dense[i, k, c] += g * weight[o, c]
                        grad_weight[block, o, c] += g * hidden[i, k, c]


@parallel_kernel
def relu_norm_sums(grad, hidden, scale, shift, sums):
    """Zero `grad` where hidden is 0 (ReLU) and collect, per channel, sum(grad) and sum(grad * normalised).

    grad, hidden (R,C); normalised = hidden * scale + shift recovers the batch-normalised value where hidden > 0.
    """
    rows, channels = grad.shape
    blocks = sums.shape[0]
    for block in prange(blocks):
        first, last = block * rows // blocks, (block + 1) * rows // blocks
        for start in range(first, last, 64):
            total, products = np.zeros(channels, np.float32), np.zeros(channels, np.float32)
            for r in range(start, min(start + 64, last)):
                for c in range(channels):
                    h = hidden[r, c]
                    g = grad[r, c] if h > 0 else np.float32(0)
                    grad[r, c] = g
                    total[c] += g
                    products[c] += g * (h * scale[c] + shift[c])
            for c in range(channels):
                sums[block, 0, c] += total[c]
                sums[block, 1, c] += products[c]


@parallel_kernel
def back_xyz(grad, points, centers, idx, weight, bias, mean, inverse, scale, t0, t1, grad_weight):
    """Through batch norm and the first linear layer of `project_xyz`, straight into its weight: (blocks,3,C) f64."""
    batch, count, neighbors = idx.shape
    blocks, channels = grad_weight.shape[0], weight.shape[1]
    for block in prange(blocks):
        for i in range(block * batch * count // blocks, (block + 1) * batch * count // blocks):
            b, m = i // count, i % count
            sums = np.zeros((3, channels), np.float32)
            for k in range(neighbors):
                j = idx[b, m, k]
                x = points[b, j, 0] - centers[b, m, 0]
                y = points[b, j, 1] - centers[b, m, 1]
                z = points[b, j, 2] - centers[b, m, 2]
                for c in range(channels):
                    value = weight[0, c] * x + weight[1, c] * y + weight[2, c] * z + bias[c]
                    d = scale[c] * (grad[b, m, k, c] - t0[c] - (value - mean[c]) * inverse[c] * t1[c])
                    sums[0, c] += d * x
                    sums[1, c] += d * y
                    sums[2, c] += d * z
            for a in range(3):
                for c in range(channels):
                    grad_weight[block, a, c] += sums[a, c]


@parallel_kernel
def back_gather(grad, table, offset, idx, mean, inverse, scale, t0, t1, grad_table, grad_offset):
    """Through batch norm and `gather_difference`; one thread per clip, since clips don't share points."""
    batch, count, neighbors = idx.shape
    channels = table.shape[2]
    for b in prange(batch):
        for m in range(count):
            for k in range(neighbors):
                j = idx[b, m, k]
                for c in range(channels):
                    value = (table[b, j, c] - offset[b, m, c] - mean[c]) * inverse[c]
                    d = scale[c] * (grad[b, m, k, c] - t0[c] - value * t1[c])
                    grad_table[b, j, c] += d
                    grad_offset[b, m, c] -= d
