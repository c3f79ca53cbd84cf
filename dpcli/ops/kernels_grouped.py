"""CPU kernels of `grouped_mlp`: the passes around its matrix products, on pieces of rows that stay in the cache.

Rows are neighbours: row r = i * K + k is neighbour k of centroid i, centroids counted through all clouds. A piece is
centroids first..last-1; its arrays start at its first row. Work is cut by centroids, or by channels where centroids
share a target: no two threads add to one place, and the order of every sum is fixed, so results repeat exactly on any
number of threads. All arrays are C-contiguous float32 unless said otherwise. Unsigned indices: numba then drops the
negative-index case and the loops over channels vectorise.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from dpcli.ops.jit import parallel_kernel


@parallel_kernel
def moments_xyz(points, centers, idx, sums):
    """Sums over all rows of x = points[idx[r]] - centers[i]: sums (blocks,9) f64, x y z xx xy xz yy yz zz.

    points (B,N,3), centers (B,M,3), idx (B,M,K) i64.
    """
    batch, count, neighbors = idx.shape
    blocks = sums.shape[0]
    for block in prange(blocks):
        for i in range(block * batch * count // blocks, (block + 1) * batch * count // blocks):
            b, m = i // count, i % count
            cx, cy, cz = centers[b, m, 0], centers[b, m, 1], centers[b, m, 2]
            sx = sy = sz = xx = xy = xz = yy = yz = zz = np.float32(0)
            for k in range(neighbors):
                j = np.uintp(idx[b, m, k])
                x, y, z = points[b, j, 0] - cx, points[b, j, 1] - cy, points[b, j, 2] - cz
                sx, sy, sz = sx + x, sy + y, sz + z
                xx, xy, xz, yy, yz, zz = xx + x * x, xy + x * y, xz + x * z, yy + y * y, yz + y * z, zz + z * z
            for slot, value in enumerate((sx, sy, sz, xx, xy, xz, yy, yz, zz)):
                sums[block, slot] += value


@parallel_kernel
def moments_table(table, offset, idx, sums, squares):
    """Sums of v = table[idx[r]] - offset[i]: of each centroid, sums (B*M,C), and of v * v, squares (blocks,C) f64.

    table (B,N,C), offset (B,M,C), idx (B,M,K) i64.
    """
    batch, count, neighbors = idx.shape
    blocks, channels = squares.shape
    for block in prange(blocks):
        for i in range(block * batch * count // blocks, (block + 1) * batch * count // blocks):
            b, m = i // count, i % count
            total, products = np.zeros(channels, np.float32), np.zeros(channels, np.float32)
            for k in range(neighbors):
                j = np.uintp(idx[b, m, k])
                for c in range(np.uintp(channels)):
                    value = table[b, j, c] - offset[b, m, c]
                    total[c] += value
                    products[c] += value * value
            for c in range(np.uintp(channels)):
                sums[i, c] = total[c]
                squares[block, c] += products[c]


@parallel_kernel
def hidden_xyz(points, centers, idx, weight, bias, first, out):
    """out[r] = max(weight @ (points[idx[r]] - centers[i]) + bias, 0) of a piece. weight (3,C), bias (C), out (rows,C)."""
    count, neighbors = idx.shape[1], idx.shape[2]
    for piece in prange(out.shape[0] // neighbors):
        i = first + piece
        b, m = i // count, i % count
        for k in range(neighbors):
            j, r = np.uintp(idx[b, m, k]), np.uintp(piece * neighbors + k)
            x = points[b, j, 0] - centers[b, m, 0]
            y = points[b, j, 1] - centers[b, m, 1]
            z = points[b, j, 2] - centers[b, m, 2]
            for c in range(np.uintp(out.shape[1])):
                value = weight[0, c] * x + weight[1, c] * y + weight[2, c] * z + bias[c]
                out[r, c] = max(value, np.float32(0))


@parallel_kernel
def hidden_table(table, offset, idx, first, out):
    """out[r] = max(table[idx[r]] - offset[i], 0) of a piece. table (B,N,C), offset (B,M,C), out (rows,C)."""
    count, neighbors = idx.shape[1], idx.shape[2]
    for r in prange(out.shape[0]):
        i, k = first + r // neighbors, r % neighbors
        b, m = i // count, i % count
        j, row = np.uintp(idx[b, m, k]), np.uintp(r)
        for c in range(np.uintp(out.shape[1])):
            out[row, c] = max(table[b, j, c] - offset[b, m, c], np.float32(0))


@parallel_kernel
def largest(rows, best, where, width):
    """Per centroid and channel the largest value over its K rows, and which row; ties: the first.

    rows (M,K,C), best (M,C), where (M,C) i32; width: channels per task.
    """
    count, neighbors, channels = rows.shape
    tasks = (channels + width - 1) // width
    for task in prange(count * tasks):
        i, low = np.uintp(task // tasks), np.uintp(task % tasks * width)
        high = min(low + np.uintp(width), np.uintp(channels))
        for c in range(low, high):
            best[i, c] = rows[i, 0, c]
            where[i, c] = 0
        for k in range(0, neighbors, 4):  # four rows at a time: the running maximum is read and written once for them
            k0, k1 = np.uintp(k), np.uintp(min(k + 1, neighbors - 1))
            k2, k3 = np.uintp(min(k + 2, neighbors - 1)), np.uintp(min(k + 3, neighbors - 1))
            for c in range(low, high):  # selects, not branches: the loop then vectorises
                at = np.int32(k + 1) if rows[i, k1, c] > rows[i, k0, c] else np.int32(k)
                top = max(rows[i, k0, c], rows[i, k1, c])
                other_at = np.int32(k + 3) if rows[i, k3, c] > rows[i, k2, c] else np.int32(k + 2)
                other = max(rows[i, k2, c], rows[i, k3, c])
                at = other_at if other > top else at
                top = max(top, other)
                where[i, c] = at if top > best[i, c] else where[i, c]
                best[i, c] = max(best[i, c], top)


@parallel_kernel
def back_pooled(grad, where, weight, hidden, dense, grad_weight, width):
    """Add the gradient that came through the pooling: it reaches one row per centroid and channel.

    grad (M,C2) of the linear output at row where (M,C2) i32; weight (C2,C1); hidden and dense (M,K,C1):
    dense[i, where[i,o]] += grad[i,o] * weight[o] and grad_weight[split, o] += grad[i,o] * hidden[i, where[i,o]], the
    centroids cut into splits; width: channels of C1 per task.
    """
    count, outputs = grad.shape
    splits, channels = grad_weight.shape[0], weight.shape[1]
    tasks = (channels + width - 1) // width
    for task in prange(splits * tasks):
        split, low = np.uintp(task // tasks), np.uintp(task % tasks * width)
        high = min(low + np.uintp(width), np.uintp(channels))
        for i in range(
            split * np.uintp(count) // np.uintp(splits), (split + np.uintp(1)) * np.uintp(count) // np.uintp(splits)
        ):
            for o in range(np.uintp(outputs)):
                g = grad[i, o]
                if g != 0:
                    k = np.uintp(where[i, o])
                    for c in range(low, high):
                        dense[i, k, c] += g * weight[o, c]
                    for c in range(low, high):
                        grad_weight[split, o, c] += g * hidden[i, k, c]


@parallel_kernel
def back_xyz(grad, hidden, constant, points, centers, idx, first, sums, width):
    """Through the ReLU of `hidden_xyz`: with g = grad + constant where hidden > 0, else 0, and x as in `moments_xyz`,

    sums (splits,4,C) f64 += sums over the piece's rows of g, g x, g y, g z. grad and hidden (rows,C), constant (C).
    """
    count, neighbors = idx.shape[1], idx.shape[2]
    splits, _, channels = sums.shape
    tasks = (channels + width - 1) // width
    piece = grad.shape[0] // neighbors
    zero = np.float32(0)
    for task in prange(splits * tasks):
        split, low = task // tasks, np.uintp(task % tasks * width)
        high = min(low + np.uintp(width), np.uintp(channels))
        parts = np.zeros((4, channels), np.float32)
        for p in range(split * piece // splits, (split + 1) * piece // splits):
            b, m = (first + p) // count, (first + p) % count
            cx, cy, cz = centers[b, m, 0], centers[b, m, 1], centers[b, m, 2]
            parts[:] = zero
            for k in range(0, neighbors - 1, 2):
                r = np.uintp(p * neighbors + k)
                s = r + np.uintp(1)
                i, j = np.uintp(idx[b, m, k]), np.uintp(idx[b, m, k + 1])
                x0, y0, z0 = points[b, i, 0] - cx, points[b, i, 1] - cy, points[b, i, 2] - cz
                x1, y1, z1 = points[b, j, 0] - cx, points[b, j, 1] - cy, points[b, j, 2] - cz
                for c in range(low, high):
                    g = grad[r, c] + constant[c] if hidden[r, c] > zero else zero
                    h = grad[s, c] + constant[c] if hidden[s, c] > zero else zero
                    parts[0, c] += g + h
                    parts[1, c] += g * x0 + h * x1
                    parts[2, c] += g * y0 + h * y1
                    parts[3, c] += g * z0 + h * z1
            if neighbors % 2:
                r, j = np.uintp((p + 1) * neighbors - 1), np.uintp(idx[b, m, neighbors - 1])
                x, y, z = points[b, j, 0] - cx, points[b, j, 1] - cy, points[b, j, 2] - cz
                for c in range(low, high):
                    g = grad[r, c] + constant[c] if hidden[r, c] > zero else zero
                    parts[0, c] += g
                    parts[1, c] += g * x
                    parts[2, c] += g * y
                    parts[3, c] += g * z
            for a in range(4):
                for c in range(low, high):
                    sums[split, a, c] += parts[a, c]


@parallel_kernel
def back_table(grad, hidden, constant, idx, first, to_table, to_offset, width):
    """Through the ReLU of `hidden_table`: g as in `back_xyz`; to_table[idx[r]] += g and to_offset[i] += g.

    grad and hidden (rows,C), constant (C), to_table (B,N,C), to_offset (B*M,C).
    """
    count, neighbors = idx.shape[1], idx.shape[2]
    channels = grad.shape[1]
    zero = np.float32(0)
    for task in prange((channels + width - 1) // width):
        low = np.uintp(task * width)
        high = min(low + np.uintp(width), np.uintp(channels))
        for r in range(np.uintp(grad.shape[0])):
            i = np.uintp(first) + r // np.uintp(neighbors)
            b, m = i // np.uintp(count), i % np.uintp(count)
            j = np.uintp(idx[b, m, r % np.uintp(neighbors)])
            for c in range(low, high):
                g = grad[r, c] + constant[c] if hidden[r, c] > zero else zero
                to_table[b, j, c] += g
                to_offset[i, c] += g


@parallel_kernel
def reach(idx, centers, out):
    """out (B,N,4) f64: how many rows have neighbour j, and the sum of their centroids. idx (B,M,K) i64, centers (B,M,3)."""
    batch, count, neighbors = idx.shape
    for b in prange(batch):
        for m in range(count):
            for k in range(neighbors):
                j = np.uintp(idx[b, m, k])
                out[b, j, 0] += 1
                for a in range(3):
                    out[b, j, a + 1] += centers[b, m, a]


@parallel_kernel
def products(first, second, shift, sums):
    """sums (blocks,C) f64 += sums over rows of first * (second - shift). first and second (R,C), shift (C)."""
    rows, channels = first.shape
    blocks = sums.shape[0]
    for block in prange(blocks):
        low, high = block * rows // blocks, (block + 1) * rows // blocks
        for start in range(low, high, 64):
            parts = np.zeros(channels, np.float32)
            for r in range(np.uintp(start), np.uintp(min(start + 64, high))):
                for c in range(np.uintp(channels)):
                    parts[c] += first[r, c] * (second[r, c] - shift[c])
            for c in range(np.uintp(channels)):
                sums[block, c] += parts[c]


@parallel_kernel
def back_norm(grad, table, reach, weight, mean, scale, t0, t1):
    """Through batch norm, in place: the gradient at the table from the sums of the gradient behind it, grad (B,N,C).

    A row of neighbour j and centroid i adds scale * (g - t0 - (table[j] - offset[i] - mean) * t1); the sums of offsets,
    weight @ centroid, come from `reach`. table (B,N,C), weight (3,C), mean, scale, t0, t1 (C).
    """
    batch, count, channels = grad.shape
    for row in prange(batch * count):
        b, j = np.uintp(row // count), np.uintp(row % count)
        n, x, y, z = (
            np.float32(reach[b, j, 0]),
            np.float32(reach[b, j, 1]),
            np.float32(reach[b, j, 2]),
            np.float32(reach[b, j, 3]),
        )
        for c in range(np.uintp(channels)):
            away = weight[0, c] * x + weight[1, c] * y + weight[2, c] * z
            value = n * (table[b, j, c] - mean[c]) - away
            grad[b, j, c] = scale[c] * (grad[b, j, c] - n * t0[c] - value * t1[c])
