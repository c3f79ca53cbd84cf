"""CPU kernels of a graph over the frames of a clip: the nearest of each point among measured ones, and pooling over them."""

from __future__ import annotations

import numpy as np

from dpcli.ops.cpu.jit import arithmetic_kernel


@arithmetic_kernel
def _insert(value, what, near, index, count):
    """Inserts (value, what) into ascending `near` and `index`, which hold `count`, behind equal values; returns the new count.

    Where they are full the last one leaves; the caller has seen that it is larger.
    """
    at = min(count, near.size - 1)
    while at > 0 and value < near[at - 1]:
        near[at], index[at] = near[at - 1], index[at - 1]
        at -= 1
    near[at], index[at] = value, what
    return min(count + 1, near.size)


@arithmetic_kernel
def nearest_kernel(distance, shares, starts, out, first, last):
    """Finds the nearest points of rows first..last-1 among several frames.

    distance (O,T,P,P) f32, from point p of frame t to those of the frame at the o-th offset; shares (T,O) i64, the most
    that are taken from it; starts (T,O) i64, the index of its first point. out (T*P,k) i64: of those taken the k nearest,
    ascending; equal ones by offset, then by index. Slots beyond them repeat the nearest. Infinity and NaN are near to
    nothing; a point that has no other finds the first point of the first frame that it looks at.
    """
    offsets, size, k = distance.shape[0], distance.shape[2], out.shape[1]
    near, index = np.empty(k, np.float32), np.empty(k, np.int64)
    own_near, own_index = np.empty(k, np.float32), np.empty(k, np.int64)
    for row in range(first, last):
        t, p = row // size, row % size
        total, anywhere = 0, np.int64(-1)
        for o in range(offsets):
            share = min(shares[t, o], k)
            if share == 0:
                continue
            if anywhere < 0:
                anywhere = starts[t, o]
            line, values, places, count = distance[o, t, p], own_near[:share], own_index[:share], 0
            worst = np.float32(np.inf)
            for j in range(np.uintp(size)):
                if line[j] < worst:
                    count = _insert(line[j], starts[t, o] + np.int64(j), values, places, count)
                    if count == share:
                        worst = values[share - 1]
            for i in range(count):
                if total == k and not values[i] < near[k - 1]:
                    break
                total = _insert(values[i], places[i], near, index, total)
        for i in range(k):
            out[row, i] = index[i if i < total else 0] if total else anywhere


@arithmetic_kernel
def pool_kernel(values, idx, largest, total, first, last):
    """Computes maximum and sum over k of values[b, idx[b,m,k]] (B,N,C) into largest and total (B*M,C), rows first..last-1."""
    count, neighbors, channels = idx.shape[1], idx.shape[2], np.uintp(values.shape[2])
    for row in range(first, last):
        b, m = row // count, row % count
        best, added = largest[row], total[row]
        for k in range(neighbors):
            line = values[b, np.uintp(idx[b, m, k])]
            if k == 0:
                for c in range(channels):
                    best[c] = added[c] = line[c]
                continue
            for c in range(channels):
                best[c] = max(best[c], line[c])
                added[c] += line[c]


@arithmetic_kernel
def pool_back_kernel(values, idx, largest, to_largest, to_total, out, first, last):
    """Adds the gradient of `pool_kernel` for clouds first..last-1 to out (B,N,C); equal maxima share theirs."""
    neighbors, channels = idx.shape[2], np.uintp(values.shape[2])
    ties, share = np.empty(values.shape[2], values.dtype), np.empty(values.shape[2], values.dtype)
    for b in range(first, last):
        for m in range(idx.shape[1]):
            best, added = largest[b, m], to_total[b, m]
            ties[:] = 0
            for k in range(neighbors):
                line = values[b, np.uintp(idx[b, m, k])]
                for c in range(channels):
                    ties[c] += line[c] == best[c]
            for c in range(channels):
                share[c] = to_largest[b, m, c] / ties[c]
            for k in range(neighbors):
                j = np.uintp(idx[b, m, k])
                line, target = values[b, j], out[b, j]
                for c in range(channels):
                    target[c] += added[c] + (share[c] if line[c] == best[c] else 0)
