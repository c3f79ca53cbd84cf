"""Farthest point sampling in numba: exact, bucketed; imports numpy and numba only (no torch).

Points are sorted along a Morton curve and cut into buckets of 32 with bounding boxes, buckets into groups likewise. A new
sample can only change a bucket whose box is nearer than the bucket's largest remaining distance, so most buckets, and
most groups, are skipped. That is exact: float32 rounding is monotone, so the distance to a box, computed by the same
operations as that to a point, never exceeds the distance to a point inside.
"""

from __future__ import annotations

import numpy as np

from dpcli.ops.cpu.jit import inlined, kernel

BUCKET = 32  # points per bucket: 16 and 64 measured slower or equal on 2 k - 32 k points
GROUP = 8  # buckets in a group, with a box of its own: 16 is a tenth faster on 32 k points, a quarter slower on 4 k
_SMALL = 8192  # points up to which 7 bits per axis and two radix passes do; more get 10 and three
_DIGIT = 11  # bits sorted per radix pass: 2,048 counters stay in the nearest cache


@kernel
def _spread_bits(v):
    """Puts two zero bits between the ten low bits of `v`."""
    v = (v | (v << 16)) & 0x030000FF
    v = (v | (v << 8)) & 0x0300F00F
    v = (v | (v << 4)) & 0x030C30C3
    return (v | (v << 2)) & 0x09249249


@kernel
def _morton_keys(points, n, bits):
    """Computes Morton keys i32 (n) with `bits` bits per axis."""
    lx, ly, lz = points[0, 0], points[0, 1], points[0, 2]
    mx, my, mz = lx, ly, lz
    for i in range(n):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        lx, ly, lz = min(lx, x), min(ly, y), min(lz, z)
        mx, my, mz = max(mx, x), max(my, y), max(mz, z)
    low = (np.float64(lx), np.float64(ly), np.float64(lz))
    extent = max(max(mx - low[0], my - low[1]), mz - low[2])
    scale = ((1 << bits) - 1.0) / extent if extent > 0.0 else 0.0
    keys = np.empty(n, np.int32)
    for i in range(n):
        keys[i] = (
            _spread_bits(np.int32((points[i, 0] - low[0]) * scale))
            | (_spread_bits(np.int32((points[i, 1] - low[1]) * scale)) << 1)
            | (_spread_bits(np.int32((points[i, 2] - low[2]) * scale)) << 2)
        )
    return keys


@kernel
def _morton_order(points, n):
    """Returns the indices of the first `n` points along the Morton curve, by a stable radix sort of their keys."""
    bits = 7 if n <= _SMALL else 10
    keys = _morton_keys(points, n, bits)
    order = np.arange(n).astype(np.int32)
    other = np.empty(n, np.int32)
    start = np.empty((1 << _DIGIT) + 1, np.int32)
    mask = (1 << _DIGIT) - 1
    for shift in range(0, 3 * bits, _DIGIT):
        start[:] = 0
        for i in range(n):
            start[((keys[i] >> shift) & mask) + 1] += 1
        for digit in range(mask + 1):
            start[digit + 1] += start[digit]
        for i in range(n):
            digit = (keys[order[i]] >> shift) & mask
            other[start[digit]] = order[i]
            start[digit] += 1
        order, other = other, order
    return order


@kernel
def _fill_buckets(points, n, order, xyz, box):
    """Sorts points[:n] into buckets: order (n,), xyz (3, buckets*BUCKET) and box (6, buckets); see `bucket_kernel`."""
    along = _morton_order(points, n)
    for i in range(n):
        order[i] = along[i]
    for b in range((n + BUCKET - 1) // BUCKET):
        first = b * BUCKET
        for axis in range(3):
            least = points[order[first], axis]
            most = least
            for i in range(first, min(first + BUCKET, n)):
                value = points[order[i], axis]
                xyz[axis, i] = value
                least, most = min(least, value), max(most, value)
            box[2 * axis, b], box[2 * axis + 1, b] = least, most


@kernel
def bucket_kernel(points, order, xyz, box, first, last):
    """Sorts clouds first..last-1 of points (B,N,3) f32 into buckets.

    Bucket j holds the points order[b, j*BUCKET:(j+1)*BUCKET]; order is (B,N) i32, xyz (B,3,buckets*BUCKET) their
    coordinates, box (B,6,buckets) the rows x min, x max, y min, y max, z min, z max.
    """
    for b in range(first, last):
        _fill_buckets(points[b], points.shape[1], order[b], xyz[b], box[b])


@inlined
def _box_distance(box, b, cx, cy, cz):
    zero = np.float32(0)
    gx = max(max(box[0, b] - cx, cx - box[1, b]), zero)
    gy = max(max(box[2, b] - cy, cy - box[3, b]), zero)
    gz = max(max(box[4, b] - cz, cz - box[5, b]), zero)
    return gx * gx + gy * gy + gz * gz


@kernel
def _group_boxes(box, buckets, out):
    """Computes the bounding boxes of the groups, out (6, groups), from the boxes of `buckets` buckets."""
    for group in range(out.shape[1]):
        first = group * GROUP
        for row in range(6):
            out[row, group] = box[row, first]
        for b in range(first + 1, min(first + GROUP, buckets)):
            for axis in range(3):
                out[2 * axis, group] = min(out[2 * axis, group], box[2 * axis, b])
                out[2 * axis + 1, group] = max(out[2 * axis + 1, group], box[2 * axis + 1, b])


@kernel
def _interleaved(xyz, n):
    """Lays each bucket's x, y, z and distances side by side: at constant steps the compiler knows they don't overlap."""
    data = np.empty(4 * xyz.shape[1], np.float32)
    for i in range(xyz.shape[1]):
        at = i // BUCKET * 4 * BUCKET + i % BUCKET
        for axis in range(3):
            data[at + axis * BUCKET] = xyz[axis, i]
        data[at + 3 * BUCKET] = np.inf if i < n else -1  # padding keeps -1: never a maximum
    return data


@inlined
def _update_bucket(data, bucket, cx, cy, cz):
    """Lowers the distances of one bucket and returns its new maximum."""
    x = np.uintp(4 * BUCKET * bucket)  # unsigned: numba then drops the negative-index case and the loop vectorizes
    y, z, best = x + np.uintp(BUCKET), x + np.uintp(2 * BUCKET), x + np.uintp(3 * BUCKET)
    for i in range(np.uintp(BUCKET)):
        dx = data[x + i] - cx
        dy = data[y + i] - cy
        dz = data[z + i] - cz
        data[best + i] = min(data[best + i], dx * dx + dy * dy + dz * dz)
    most = np.float32(-1)
    for i in range(np.uintp(BUCKET)):
        most = max(most, data[best + i])
    return most


@inlined
def _update_group(data, box, top, group, cx, cy, cz, lower):
    """Updates a group's buckets that are nearer than their largest distance `top` and returns the group's largest."""
    first = np.uintp(group * GROUP)
    for i in range(np.uintp(GROUP)):
        lower[i] = _box_distance(box, first + i, cx, cy, cz)
    most = np.float32(-1)
    for i in range(np.uintp(GROUP)):
        if lower[i] < top[first + i]:
            top[first + i] = _update_bucket(data, first + i, cx, cy, cz)
        most = max(most, top[first + i])
    return most


@inlined
def _farthest(data, top, group_top, order, n):
    """Returns the lowest original index among the points at the largest distance, and that distance."""
    most = np.float32(0)
    for group in range(group_top.size):
        most = max(most, group_top[group])
    none = np.int32(n)
    found = none
    for group in range(group_top.size):
        if group_top[group] == most:
            for b in range(group * GROUP, group * GROUP + GROUP):
                if top[b] == most:
                    for i in range(BUCKET):
                        if data[(4 * b + 3) * BUCKET + i] == most:
                            found = min(found, order[b * BUCKET + i])
    return found, most


@kernel
def _sample(points, n, start, out):
    buckets = (n + BUCKET - 1) // BUCKET
    groups = (buckets + GROUP - 1) // GROUP
    order = np.full(groups * GROUP * BUCKET, n, np.int32)
    xyz = np.zeros((3, groups * GROUP * BUCKET), np.float32)
    box, group_box = np.zeros((6, groups * GROUP), np.float32), np.empty((6, groups), np.float32)
    _fill_buckets(points, n, order, xyz, box)
    _group_boxes(box, buckets, group_box)
    data = _interleaved(xyz, n)
    top, group_top = np.full(groups * GROUP, np.float32(-1)), np.full(groups, np.float32(np.inf))
    top[:buckets] = np.inf
    lower, group_lower = np.empty(GROUP, np.float32), np.empty(groups, np.float32)
    last = start
    for s in range(min(out.size, n)):
        out[s] = last
        cx, cy, cz = points[last, 0], points[last, 1], points[last, 2]
        for group in range(np.uintp(groups)):
            group_lower[group] = _box_distance(group_box, group, cx, cy, cz)
        for group in range(groups):
            if group_lower[group] < group_top[group]:
                group_top[group] = _update_group(data, box, top, group, cx, cy, cz, lower)
        last, most = _farthest(data, top, group_top, order, n)
        if most == 0:  # every distinct position is taken: all further maxima tie at the lowest index
            for rest in range(s + 1, min(out.size, n)):
                out[rest] = 0
            break
    for s in range(n, out.size):
        out[s] = out[s - n]


@kernel
def fps_kernel(points, start, out, first, last):
    """Writes farthest points of clouds first..last-1, of points (B,N,3) f32, into out (B,S) i64.

    The first sample is `start`, ties go to the lowest index, and samples beyond N repeat the sequence.
    """
    for b in range(first, last):
        _sample(points[b], points.shape[1], start, out[b])
