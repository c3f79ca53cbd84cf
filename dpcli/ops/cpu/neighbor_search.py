"""Neighbor searches in numba: space-time ball query (first or nearest hits) and nearest neighbors among buckets.

Distances are float32, summed as (dx*dx + dy*dy) + dz*dz, so hits and ties are the torch reference's own. Points come as
rows of coordinates (3,N) and are measured in blocks, so that the arithmetic vectorizes; a block's least distance tells
whether it needs a closer look. The nearest are kept as int64 keys, distance bits above index, that sort as (distance,
index): non-negative floats sort as their bits do.
"""

from __future__ import annotations

import numpy as np

from dpcli.ops.cpu.jit import kernel

_BLOCK = 128  # points measured together: 32 took 1.7 times as long per point, 2048 as long
_MARGIN = np.float32(2.2)  # growth of the last k-th squared distance; 1.3 rescans too often, 1.7 and 2.2 measured alike
_INDEX_BITS = np.int64(0xFFFFFFFF)
_INFINITE = np.int64(0x7F800000)  # bits of float32 infinity


@kernel
def _is_sorted(times):
    for i in range(1, times.size):
        if times[i] < times[i - 1]:
            return False
    return True


@kernel
def _lower_bound(times, value):
    """Returns the first position whose time is at least `value`, in sorted times."""
    low, high = 0, times.size
    while low < high:
        middle = (low + high) >> 1
        if times[middle] < value:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def _measure(x, y, z, first, size, cx, cy, cz, out):
    """Writes the squared distances of `size` points from `first` on into `out` and returns the least."""
    base = np.uintp(first)  # unsigned: numba then drops the negative-index case and the loop vectorizes
    for i in range(np.uintp(size)):
        dx = cx - x[base + i]
        dy = cy - y[base + i]
        dz = cz - z[base + i]
        out[i] = dx * dx + dy * dy + dz * dz
    least = np.float32(np.inf)
    for i in range(np.uintp(size)):
        least = min(least, out[i])
    return least


@kernel
def _sift_down(heap, at):
    """Restores the max-heap below position `at`."""
    key = heap[at]
    child = 2 * at + 1
    while child < heap.size:
        if child + 1 < heap.size and heap[child + 1] > heap[child]:
            child += 1
        if heap[child] <= key:
            break
        heap[at] = heap[child]
        at = child
        child = 2 * at + 1
    heap[at] = key


@kernel
def _keep(heap, filled, key):
    """Keeps the heap.size smallest keys seen; a heap only once full. Returns how many are kept."""
    if filled == heap.size:
        heap[0] = key
        _sift_down(heap, 0)
        return filled
    heap[filled] = key
    if filled + 1 == heap.size:
        for at in range(heap.size // 2 - 1, -1, -1):
            _sift_down(heap, at)
    return filled + 1


@kernel
def _worst(heap, filled, block, bits):
    """Returns the largest kept distance of a full heap, else infinity. The block's spare slot turns bits into a float."""
    bits[_BLOCK] = heap[0] >> 32 if filled == heap.size else _INFINITE
    return block[_BLOCK]


@kernel
def _first_hits(x, y, z, times, low, high, cx, cy, cz, t, limits, widest, block, row):
    """Writes the first hits among points low..high-1, ascending, until the row is full; returns how many."""
    filled = 0
    for first in range(low, high, _BLOCK):
        size = min(_BLOCK, high - first)
        if _measure(x, y, z, first, size, cx, cy, cz, block) >= widest:
            continue
        for i in range(size):
            if block[i] < widest:
                gap = abs(times[first + i] - t)
                if gap < limits.size and block[i] < limits[gap]:
                    row[filled] = first + i
                    filled += 1
                    if filled == row.size:
                        return filled
    return filled


@kernel
def _nearest_hits(x, y, z, times, low, high, cx, cy, cz, t, limits, widest, block, bits, heap):
    """Collects the nearest hits among points low..high-1 that lie within `widest`; returns how many."""
    filled = 0
    worst = widest
    for first in range(low, high, _BLOCK):
        size = min(_BLOCK, high - first)
        least = _measure(x, y, z, first, size, cx, cy, cz, block)
        if least >= widest or least > worst:
            continue
        for i in range(size):
            if block[i] < widest and block[i] <= worst:
                gap = abs(times[first + i] - t)
                key = (np.int64(bits[i]) << 32) | (first + i)
                if gap < limits.size and block[i] < limits[gap] and (filled < heap.size or key < heap[0]):
                    filled = _keep(heap, filled, key)
                    worst = _worst(heap, filled, block, bits)
    return filled


@kernel
def _nearest_row(x, y, z, times, low, high, cx, cy, cz, t, limits, widest, guess, block, bits, heap, row):
    """Finds one row of nearest hits; returns how many, and a radius likely to hold k for the next centroid.

    Looks first within `guess`, the last centroid's suggestion: a full row proves that far enough, else all is searched.
    """
    near = min(guess, widest)
    filled = _nearest_hits(x, y, z, times, low, high, cx, cy, cz, t, limits, near, block, bits, heap)
    if filled < heap.size and near < widest:
        filled = _nearest_hits(x, y, z, times, low, high, cx, cy, cz, t, limits, widest, block, bits, heap)
    guess = _worst(heap, filled, block, bits) * _MARGIN
    heap[:filled].sort()
    for slot in range(filled):
        row[slot] = heap[slot] & _INDEX_BITS
    return filled, guess


@kernel
def _query_clip(xyz, times, centroids, centroid_times, limits, nearest, low_row, high_row, index, count):
    """Fills rows low_row..high_row-1 of one clip; where its times are sorted, only the frames within reach are looked at."""
    x, y, z = xyz[0], xyz[1], xyz[2]  # views made once: each costs an atomic reference count
    block = np.empty(_BLOCK + 1, np.float32)
    bits = block.view(np.int32)
    heap = np.empty(index.shape[1], np.int64)
    in_order = _is_sorted(times)
    guess = np.float32(np.inf)
    widest = np.float32(0)
    for limit in limits:
        widest = max(widest, limit)
    low, high = 0, times.size
    for m in range(low_row, high_row):
        row = index[m]
        cx, cy, cz, t = centroids[m, 0], centroids[m, 1], centroids[m, 2], centroid_times[m]
        if in_order:
            low, high = _lower_bound(times, t - limits.size + 1), _lower_bound(times, t + limits.size)
        if nearest:
            filled, guess = _nearest_row(
                x, y, z, times, low, high, cx, cy, cz, t, limits, widest, guess, block, bits, heap, row
            )
        else:
            filled = _first_hits(x, y, z, times, low, high, cx, cy, cz, t, limits, widest, block, row)
        row[filled:] = row[0] if filled else 0
        count[m] = filled


@kernel
def ball_query_kernel(xyz, times, centroids, centroid_times, limits, nearest, index, count, first, last):
    """Fills rows first..last-1, counted through all clips, of index (B,M,k) i64 and count (B,M) i64.

    xyz (B,3,N) f32, times (B,N) i64, centroids (B,M,3) f32, centroid_times (B,M) i64, limits (R,) f32 squared radii;
    see `ops.ball_query.space_time_ball_query`.
    """
    rows = centroids.shape[1]
    while first < last:
        b = first // rows
        low, high = first - b * rows, min(last - b * rows, rows)
        _query_clip(xyz[b], times[b], centroids[b], centroid_times[b], limits, nearest, low, high, index[b], count[b])
        first += high - low


@kernel
def _frame_hits(x, y, z, low, high, cx, cy, cz, limit, block, row):
    """Finds hits as `_first_hits` does, among points low..high-1 of one frame, whose limit is the same for all."""
    filled = 0
    for first in range(low, high, _BLOCK):
        size = min(_BLOCK, high - first)
        if _measure(x, y, z, first, size, cx, cy, cz, block) >= limit:
            continue
        for i in range(size):  # written first, kept if a hit: a branch on every second point would be guessed wrong
            row[filled] = first + i
            filled += block[i] < limit
            if filled == row.size:
                return filled
    return filled


@kernel
def _balanced_row(x, y, z, times, centroid, t, limits, shares, block, row):
    """Fills one row by frames, from the earliest; returns the number of hits."""
    reach = limits.size - 1
    own = row[shares[:reach].sum() :][: shares[reach]]
    total = _frame_share(x, y, z, times, centroid, t, limits[0], block, own)
    start = 0
    for i in range(shares.size):
        part = row[start : start + shares[i]]
        start += shares[i]
        if i == reach:
            continue
        filled = _frame_share(x, y, z, times, centroid, t + i - reach, limits[abs(i - reach)], block, part)
        total += filled
        if filled == 0:
            for slot in range(part.size):
                part[slot] = own[slot % own.size]
    return total


@kernel
def _frame_share(x, y, z, times, centroid, t, limit, block, part):
    """Finds the first hits of frame t, the first repeated in unused slots, -1 in all if there is none; returns how many."""
    low, high = _lower_bound(times, t), _lower_bound(times, t + 1)
    filled = _frame_hits(x, y, z, low, high, centroid[0], centroid[1], centroid[2], limit, block, part)
    part[filled:] = part[0] if filled else -1
    return filled


@kernel
def balanced_query_kernel(xyz, times, centroids, centroid_times, limits, shares, order, index, count, first, last):
    """Fills rows as `ball_query_kernel` does, but slots are shared among frames: shares (2R-1,) i64.

    times are sorted and the points in their order, the point of column i being named order[b, i] i64 in the index.
    """
    rows = centroids.shape[1]
    block = np.empty(_BLOCK + 1, np.float32)
    while first < last:
        b = first // rows
        low, high = first - b * rows, min(last - b * rows, rows)
        x, y, z, when = xyz[b, 0], xyz[b, 1], xyz[b, 2], times[b]
        for m in range(low, high):
            row, t = index[b, m], centroid_times[b, m]
            count[b, m] = _balanced_row(x, y, z, when, centroids[b, m], t, limits, shares, block, row)
            for slot in range(row.size):
                row[slot] = order[b, row[slot]] if row[slot] >= 0 else 0
        first += high - low


@kernel
def _box_bounds(box, cx, cy, cz, lower, upper):
    """Computes squared distances to the near and the far side of every box; returns the box with the closest far side.

    The near side is never further than a point inside: rounding is monotone, the order of operations the same.
    """
    zero = np.float32(0)
    for b in range(lower.size):
        gx = max(max(box[0, b] - cx, cx - box[1, b]), zero)
        gy = max(max(box[2, b] - cy, cy - box[3, b]), zero)
        gz = max(max(box[4, b] - cz, cz - box[5, b]), zero)
        lower[b] = gx * gx + gy * gy + gz * gz
    for b in range(lower.size):
        fx = max(box[1, b] - cx, cx - box[0, b])
        fy = max(box[3, b] - cy, cy - box[2, b])
        fz = max(box[5, b] - cz, cz - box[4, b])
        upper[b] = fx * fx + fy * fy + fz * fz
    least = np.float32(np.inf)
    for b in range(upper.size):
        least = min(least, upper[b])
    for b in range(upper.size):
        if upper[b] == least:
            return b
    return 0


@kernel
def _scan_bucket(x, y, z, order, first, size, cx, cy, cz, block, bits, heap, filled):
    worst = _worst(heap, filled, block, bits)
    if _measure(x, y, z, first, size, cx, cy, cz, block) > worst:
        return filled
    for i in range(size):
        if block[i] <= worst:
            key = (np.int64(bits[i]) << 32) | np.int64(order[first + i])
            if filled < heap.size or key < heap[0]:
                filled = _keep(heap, filled, key)
                worst = _worst(heap, filled, block, bits)
    return filled


@kernel
def _search(x, y, z, order, n, box, bucket, cx, cy, cz, lower, upper, block, bits, heap):
    """Keeps the nearest of all n bucketed points: first some close buckets, then all that may hold a nearer point."""
    start = _box_bounds(box, cx, cy, cz, lower, upper)
    reach = (heap.size - 1) // (2 * bucket)  # neighbors on the curve, enough for k points, are close in space
    filled = 0
    for b in range(max(0, start - reach), min(start + reach + 1, lower.size)):
        size = min(bucket, n - b * bucket)
        filled = _scan_bucket(x, y, z, order, b * bucket, size, cx, cy, cz, block, bits, heap, filled)
        lower[b] = -1  # done
    worst = _worst(heap, filled, block, bits)
    for b in range(lower.size):
        if 0 <= lower[b] <= worst:
            size = min(bucket, n - b * bucket)
            filled = _scan_bucket(x, y, z, order, b * bucket, size, cx, cy, cz, block, bits, heap, filled)
            worst = _worst(heap, filled, block, bits)
    return filled


@kernel
def _knn_cloud(order, n, xyz, box, bucket, queries, low, high, squared, index):
    """Fills rows low..high-1 of one cloud."""
    x, y, z = xyz[0], xyz[1], xyz[2]
    block = np.empty(_BLOCK + 1, np.float32)
    bits = block.view(np.int32)
    heap = np.empty(index.shape[1], np.int64)
    buckets = (n + bucket - 1) // bucket
    lower, upper = np.empty(buckets, np.float32), np.empty(buckets, np.float32)
    for m in range(low, high):
        cx, cy, cz = queries[m, 0], queries[m, 1], queries[m, 2]
        filled = _search(x, y, z, order, n, box, bucket, cx, cy, cz, lower, upper, block, bits, heap)
        heap[:filled].sort()
        for slot in range(heap.size):
            key = heap[slot if slot < filled else 0]
            index[m, slot] = key & _INDEX_BITS
            bits[_BLOCK] = key >> 32
            squared[m, slot] = block[_BLOCK]


@kernel
def knn_kernel(order, xyz, box, bucket, queries, squared, index, first, last):
    """Fills rows first..last-1, counted through all clouds, of squared (B,M,k) f32 and index (B,M,k) i64.

    order, xyz, box: of `farthest_point_sampling.bucket_kernel`, with `bucket` points in each; queries (B,M,3) f32; see
    `ops.nearest_neighbors.knn`.
    """
    rows = queries.shape[1]
    while first < last:
        b = first // rows
        low, high = first - b * rows, min(last - b * rows, rows)
        _knn_cloud(order[b], order.shape[1], xyz[b], box[b], bucket, queries[b], low, high, squared[b], index[b])
        first += high - low
