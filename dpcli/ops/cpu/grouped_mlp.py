"""CPU kernels of `grouped_mlp`: the passes around its matrix products, on pieces of rows that stay in the cache.

Rows are neighbors: row r = i * K + k is neighbor k of centroid i, centroids counted through all clouds. A piece is
centroids first..last-1; its arrays start at its first row. Kernels of a piece are serial and release the GIL; the others
run on numba's threads, cut by centroids. No two threads add to one place, and the order of every sum is fixed, so results
repeat exactly on any number of threads. All arrays are C-contiguous float32 unless said otherwise. Unsigned indices:
numba then drops the negative-index case and the loops over channels vectorize.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from dpcli.ops.cpu.jit import inlined, parallel_kernel, piece_kernel
from dpcli.ops.cpu.simd import WIDTH, higher, lanes, load, store, where_lower

PAIR = 2 * WIDTH  # channels that go through a backward kernel together, and the width of a block of its weights
CHUNK = 4  # centroids whose rows stay in the cache while the blocks of weights go by


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


@piece_kernel
def hidden_xyz(points, centers, idx, weight, bias, first, out):
    """Computes out[r] = max(weight @ (points[idx[r]] - centers[i]) + bias, 0) for a block of rows.

    weight (3,C), bias (C), out (rows,C); `first`: the block's first centroid.
    """
    count, neighbors = idx.shape[1], idx.shape[2]
    for piece in range(out.shape[0] // neighbors):
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


@piece_kernel
def hidden_table(table, offset, idx, first, out):
    """Computes out[r] = max(table[idx[r]] - offset[i], 0) for a block of rows. table (B,N,C), offset (B,M,C), out (rows,C)."""
    count, neighbors = idx.shape[1], idx.shape[2]
    for piece in range(out.shape[0] // neighbors):
        i = first + piece
        b, m = i // count, i % count
        for k in range(neighbors):
            j, r = np.uintp(idx[b, m, k]), np.uintp(piece * neighbors + k)
            for c in range(np.uintp(out.shape[1])):
                out[r, c] = max(table[b, j, c] - offset[b, m, c], np.float32(0))


@piece_kernel
def activate_largest(rows, bias, neighbors, best):
    """Sets rows (R*C) of products to max(products + bias, 0), best (M*C) to each centroid's largest. bias (C), C in eights."""
    channels = bias.size
    zero = lanes(np.float32(0))
    for i in range(rows.size // channels // neighbors):
        for c in range(0, channels, WIDTH):
            add, most = load(bias, c), zero
            for row in range(i * neighbors * channels + c, (i + 1) * neighbors * channels + c, channels):
                value = higher(load(rows, row) + add, zero)
                store(rows, row, value)
                most = higher(value, most)
            store(best, i * channels + c, most)


@piece_kernel
def largest(rows, neighbors, first, best, where):
    """Finds, per centroid and channel of a block, the largest value over its rows, and which row; ties: the first.

    rows (rows*C), best (M,C) and where (M,C) i32 for all centroids, at least WIDTH channels. Four vectors of running maxima
    stay in registers while the rows go by; where fewer channels are left, vectors overlap.
    """
    channels = best.shape[1]
    tasks = (channels + 4 * WIDTH - 1) // (4 * WIDTH)
    at = np.empty(channels, np.float32)  # row numbers: exact below 2^24
    top = np.empty(channels, np.float32)
    for i in range(rows.size // channels // neighbors):
        for task in range(tasks):
            last = channels - WIDTH
            c0 = task * 4 * WIDTH
            c1, c2, c3 = min(c0 + WIDTH, last), min(c0 + 2 * WIDTH, last), min(c0 + 3 * WIDTH, last)
            c0 = min(c0, last)
            row = i * neighbors * channels
            m0, m1, m2, m3 = load(rows, row + c0), load(rows, row + c1), load(rows, row + c2), load(rows, row + c3)
            k0 = k1 = k2 = k3 = lanes(np.float32(0))
            for k in range(1, neighbors):
                row += channels
                number = lanes(np.float32(k))
                v0, v1, v2, v3 = load(rows, row + c0), load(rows, row + c1), load(rows, row + c2), load(rows, row + c3)
                k0, k1 = where_lower(m0, v0, number, k0), where_lower(m1, v1, number, k1)
                k2, k3 = where_lower(m2, v2, number, k2), where_lower(m3, v3, number, k3)
                m0, m1, m2, m3 = higher(m0, v0), higher(m1, v1), higher(m2, v2), higher(m3, v3)
            store(top, c0, m0)
            store(top, c1, m1)
            store(top, c2, m2)
            store(top, c3, m3)
            store(at, c0, k0)
            store(at, c1, k1)
            store(at, c2, k2)
            store(at, c3, k3)
        for c in range(np.uintp(channels)):
            best[first + i, c] = top[c]
            where[first + i, c] = np.int32(at[c])


@parallel_kernel
def sort_pooled(grad, out, best, where, mean, order, values, starts, sums):
    """Sorts the gradient at a ReLU's pooled output `out` by the rows it goes to, and sums it.

    grad, out, best (M,C), where (M,C) i32 in 0..K-1, mean (C). g is grad where out > 0. Centroid i's channels with
    out > 0 that reach row k, ascending, are order[i, starts[i,k] : starts[i,k+1]], i32, and values (M,C) f32 their g;
    starts (M,K+1) i32. sums (2,blocks,C) f64: sums over centroids of g and of g * (best - mean).
    """
    count, channels = grad.shape
    neighbors, blocks = starts.shape[1] - 1, sums.shape[1]
    zero = np.float32(0)
    for block in prange(blocks):
        slots = np.empty(neighbors + 2, np.int32)
        for i in range(block * count // blocks, (block + 1) * count // blocks):
            for c in range(np.uintp(channels)):
                g = grad[i, c] if out[i, c] > zero else zero
                sums[0, block, c] += g
                sums[1, block, c] += g * (best[i, c] - mean[c])
            slots[:] = 0
            for c in range(np.uintp(channels)):
                slots[(where[i, c] if out[i, c] > zero else neighbors) + 1] += 1
            for k in range(neighbors):
                slots[k + 1] += slots[k]
                starts[i, k] = slots[k]
            starts[i, neighbors] = slots[neighbors]
            for c in range(np.uintp(channels)):
                k = where[i, c] if out[i, c] > zero else neighbors  # the last: nowhere
                slot = slots[k]
                order[i, slot] = c
                values[i, slot] = grad[i, c]
                slots[k] = slot + 1


@inlined
def _through_relu(hidden, dense, at0, at1, add0, add1, order, values, first, last, base, weight, grad_weight, zero):
    """Takes the gradient of two runs of WIDTH channels of one row, at `at0` and `at1`, through the ReLU; adds to grad_weight.

    first..last: the outputs whose maximum this row is, in `order`, with their gradients in `values`.
    """
    h0, h1 = load(hidden, at0), load(hidden, at1)
    g0, g1 = load(dense, at0) + add0, load(dense, at1) + add1
    for slot in range(first, last):
        w = base + order[slot] * PAIR
        value = lanes(values[slot])
        g0 = g0 + value * load(weight, w)
        g1 = g1 + value * load(weight, w + WIDTH)
        store(grad_weight, w, load(grad_weight, w) + value * h0)
        store(grad_weight, w + WIDTH, load(grad_weight, w + WIDTH) + value * h1)
    return where_lower(zero, h0, g0, zero), where_lower(zero, h1, g1, zero)


@piece_kernel
def back_xyz(hidden, dense, constant, order, values, starts, weight, grad_weight, points, centers, idx, first, sums):
    """Computes the gradient through the pooling, the second linear layer and the ReLU of `hidden_xyz`, for a block of rows.

    With g[r] = dense[r] + constant + sum over the row's pooled values of value * weight[o], where hidden[r] > 0, else 0,
    and x as in `moments_xyz`: sums (4,C1) f64 += sums over rows of g, g x, g y, g z, and grad_weight[o] += value * hidden[r].
    hidden and dense (rows*C1), constant (C1), order, values, starts: of `sort_pooled`, for all centroids; weight and
    grad_weight (blocks*C2*2*WIDTH): in blocks of channels as `grouped_mlp` packs them.
    """
    count, neighbors = idx.shape[1], idx.shape[2]
    channels, outputs = constant.size, order.shape[1]
    blocks = (channels + PAIR - 1) // PAIR
    piece = hidden.size // channels // neighbors
    zero = lanes(np.float32(0))
    parts = np.empty(8 * WIDTH, np.float32)
    for chunk in range(0, piece, CHUNK):
        for block in range(blocks):
            c0 = block * PAIR
            c1 = min(c0 + WIDTH, channels - WIDTH)
            base = block * outputs * PAIR
            add0, add1 = load(constant, c0), load(constant, c1)
            for p in range(chunk, min(chunk + CHUNK, piece)):
                i = first + p
                b, m = i // count, i % count
                cx, cy, cz = centers[b, m, 0], centers[b, m, 1], centers[b, m, 2]
                t0 = t1 = x0 = x1 = y0 = y1 = z0 = z1 = zero
                for k in range(neighbors):
                    row = (p * neighbors + k) * channels
                    g0, g1 = _through_relu(
                        hidden,
                        dense,
                        row + c0,
                        row + c1,
                        add0,
                        add1,
                        order[i],
                        values[i],
                        starts[i, k],
                        starts[i, k + 1],
                        base,
                        weight,
                        grad_weight,
                        zero,
                    )
                    j = idx[b, m, k]
                    x, y, z = lanes(points[b, j, 0] - cx), lanes(points[b, j, 1] - cy), lanes(points[b, j, 2] - cz)
                    t0, x0, y0, z0 = t0 + g0, x0 + g0 * x, y0 + g0 * y, z0 + g0 * z
                    t1, x1, y1, z1 = t1 + g1, x1 + g1 * x, y1 + g1 * y, z1 + g1 * z
                store(parts, 0 * WIDTH, t0)
                store(parts, 1 * WIDTH, x0)
                store(parts, 2 * WIDTH, y0)
                store(parts, 3 * WIDTH, z0)
                store(parts, 4 * WIDTH, t1)
                store(parts, 5 * WIDTH, x1)
                store(parts, 6 * WIDTH, y1)
                store(parts, 7 * WIDTH, z1)
                for a in range(4):
                    for c in range(WIDTH):
                        sums[a, c0 + c] += parts[a * WIDTH + c]
                        if c1 > c0:
                            sums[a, c1 + c] += parts[(4 + a) * WIDTH + c]


@piece_kernel
def back_table(
    hidden, dense, constant, order, values, starts, weight, grad_weight, idx, first, to_table, to_offset, nodes
):
    """Computes as `back_xyz`, through the ReLU of `hidden_table`: to_table[idx[r]] += g and to_offset[i] = sum of g.

    to_table (blocks*B*N*2*WIDTH), in blocks of channels (rows of all channels would fall on few sets of the cache),
    to_offset (B*M*C1), nodes = N.
    """
    batch, count, neighbors = idx.shape
    channels, outputs = constant.size, order.shape[1]
    blocks = (channels + PAIR - 1) // PAIR
    piece = hidden.size // channels // neighbors
    zero = lanes(np.float32(0))
    for chunk in range(0, piece, CHUNK):
        for block in range(blocks):
            c0 = block * PAIR
            c1 = min(c0 + WIDTH, channels - WIDTH)
            base = block * outputs * PAIR
            add0, add1 = load(constant, c0), load(constant, c1)
            for p in range(chunk, min(chunk + CHUNK, piece)):
                i = first + p
                b, m = i // count, i % count
                t0 = t1 = zero
                for k in range(neighbors):
                    row = (p * neighbors + k) * channels
                    g0, g1 = _through_relu(
                        hidden,
                        dense,
                        row + c0,
                        row + c1,
                        add0,
                        add1,
                        order[i],
                        values[i],
                        starts[i, k],
                        starts[i, k + 1],
                        base,
                        weight,
                        grad_weight,
                        zero,
                    )
                    t0, t1 = t0 + g0, t1 + g1
                    at = ((block * batch + b) * nodes + idx[b, m, k]) * PAIR
                    store(to_table, at, load(to_table, at) + g0)
                    store(to_table, at + WIDTH, load(to_table, at + WIDTH) + g1)
                store(to_offset, i * channels + c0, t0)
                store(to_offset, i * channels + c1, t1)


@parallel_kernel
def reach(idx, centers, out):
    """Counts into out (B,N,4) f64 the rows that have neighbor j, and sums their centroids. idx (B,M,K) i64, centers (B,M,3)."""
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
    """Adds sums over rows of first * (second - shift) to sums (blocks,C) f64. first and second (R,C), shift (C)."""
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
    """Computes in place, through batch norm, the gradient at the table from the sums of the gradient behind it, grad (B,N,C).

    A row of neighbor j and centroid i adds scale * (g - t0 - (table[j] - offset[i] - mean) * t1); the sums of offsets,
    weight @ centroid, come from `reach`. table (B,N,C), weight (3,C), mean, scale, t0, t1 (C).
    """
    batch, count, channels = grad.shape
    for row in prange(batch * count):
        b, j = np.uintp(row // count), np.uintp(row % count)
        n, x = np.float32(reach[b, j, 0]), np.float32(reach[b, j, 1])
        y, z = np.float32(reach[b, j, 2]), np.float32(reach[b, j, 3])
        for c in range(np.uintp(channels)):
            away = weight[0, c] * x + weight[1, c] * y + weight[2, c] * z
            value = n * (table[b, j, c] - mean[c]) - away
            grad[b, j, c] = scale[c] * (grad[b, j, c] - n * t0[c] - value * t1[c])
