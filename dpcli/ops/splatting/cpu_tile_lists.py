"""CPU kernel of `splatting`: which Gaussians each tile holds, nearest first.

A tile is one column of 8 lanes (`ops.cpu.simd`) and TALL rows. Gaussians reach a tile in order of (depth, index): a
radix sort per camera, then blocks of the order are counted and listed side by side; how many blocks never shows.
Arrays are C-contiguous float32 unless said otherwise; C cameras, N Gaussians, T tiles (all cameras'), P pairs of a tile
and a Gaussian. Opacities (1 or C,N) may serve all cameras.

`packed` (C,N,8): mean x, y, then a, b, c, o with alpha = 2^(o + a dx^2 + b dx dy + c dy^2), (dx, dy) from mean to
pixel, then the first and end row of `box`.
`box` (C,N,4) i32: the pixels where alpha can reach 1/255: first and end column, first and end row; empty if unseen.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from dpcli.ops.cpu.jit import arithmetic_kernel, parallel_kernel
from dpcli.ops.cpu.simd import claim

WIDE, TALL, PACKED = 8, 16, 8
_ACROSS, _DOWN = 3, 4  # their logarithms
_BLOCK = 256  # Gaussians packed as one task
_DIGIT, _DIGITS = 11, 3  # bits a pass of the sort looks at, and passes
_BITS = 1 / np.log(2.0)
_LEAST = np.log(255.0)


@parallel_kernel
def tile_lists(means2d, conics, opacities, radii, depths, width, height, workers, counter, packed, box, pair_start):
    """Writes packed, box and pair_start (C,N) i64: where a seen Gaussian's pairs begin, one per tile of its box by rows.

    means2d (C,N,2), conics (C,N,3), radii (C,N,2) i32, depths (C,N) as i32 bits, counter (1) i64, zero. Returns tasks
    i64, the tiles that hold Gaussians, long lists first; tile_start (T+1) i64 and gaussian (P) i32, the tiles' lists.
    """
    cameras, count = radii.shape[:2]
    across, down = (width + WIDE - 1) >> _ACROSS, (height + TALL - 1) >> _DOWN
    tiles, blocks = across * down, (count + _BLOCK - 1) // _BLOCK
    order, seen = np.empty((cameras, count), np.int32), np.empty(cameras, np.int64)
    for _ in prange(workers):
        task = claim(counter)
        while task < cameras * (1 + blocks):
            if task < cameras:
                seen[task] = _sort(depths[task], radii[task], order[task])
            else:
                c, block = (task - cameras) // blocks, (task - cameras) % blocks
                own = opacities[c if opacities.shape[0] > 1 else 0]
                for n in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
                    _pack(means2d[c, n], conics[c, n], own[n], radii[c, n, 0], width, height, packed[c, n], box[c, n])
            task = claim(counter)
    cursor, first = np.empty((cameras, workers, tiles), np.int64), np.empty((cameras, workers), np.int64)
    for share in prange(cameras * workers):
        c, w = share // workers, share % workers
        listed = order[c, seen[c] * w // workers : seen[c] * (w + 1) // workers]
        first[c, w] = _count(listed, box[c], across, cursor[c, w])
    tile_start = np.empty(cameras * tiles + 1, np.int64)
    pairs = _begin(cursor, first, tile_start)
    gaussian = np.empty(pairs, np.int32)
    for share in prange(cameras * workers):
        c, w = share // workers, share % workers
        listed = order[c, seen[c] * w // workers : seen[c] * (w + 1) // workers]
        _fill(listed, box[c], across, cursor[c, w], first[c, w], gaussian, pair_start[c])
    return _longest_first(tile_start), tile_start, gaussian


@arithmetic_kernel
def _pack(mean, conic, opacity, radius, width, height, packed, box):
    box[0] = box[1] = box[2] = box[3] = 0
    xx, xy, yy = np.float64(conic[0]), np.float64(conic[1]), np.float64(conic[2])
    det = xx * yy - xy * xy
    if radius > 0 and opacity >= np.float64(1 / 255) and det > 0:
        x, y, light = np.float64(mean[0]), np.float64(mean[1]), np.log(np.float64(opacity))
        reach = 2 * (_LEAST + light) / det
        to_x, to_y = np.sqrt(reach * yy) + 1e-3, np.sqrt(reach * xx) + 1e-3
        box[0] = np.int32(min(max(np.ceil(x - to_x - 0.5), 0.0), width))
        box[1] = np.int32(min(max(np.floor(x + to_x + 0.5), 0.0), width))
        box[2] = np.int32(min(max(np.ceil(y - to_y - 0.5), 0.0), height))
        box[3] = np.int32(min(max(np.floor(y + to_y + 0.5), 0.0), height))
        packed[0], packed[1] = x, y
        packed[2], packed[3], packed[4] = -0.5 * _BITS * xx, -_BITS * xy, -0.5 * _BITS * yy
        packed[5], packed[6], packed[7] = _BITS * light, box[2], box[3]


@arithmetic_kernel
def _sort(depths, radii, order):
    """Writes the Gaussians with a radius to `order`, by depth, ties by index, and returns how many. A stable radix sort."""
    count, seen, size = depths.size, 0, 1 << _DIGIT
    keys, index = np.empty((2, count), np.uint32), np.empty((2, count), np.int32)
    counts = np.zeros((_DIGITS, size), np.int64)
    for n in range(count):
        if radii[n, 0] > 0:
            bits = np.uint32(depths[n])
            key = ~bits if depths[n] < 0 else bits | np.uint32(1 << 31)
            keys[0, seen], index[0, seen] = key, n
            for digit in range(_DIGITS):
                counts[digit, (key >> np.uint32(_DIGIT * digit)) & np.uint32(size - 1)] += 1
            seen += 1
    source = 0
    for digit in range(_DIGITS):
        begin = 0
        for value in range(size):
            begin, counts[digit, value] = begin + counts[digit, value], begin
        for k in range(seen):
            key = keys[source, k]
            value = (key >> np.uint32(_DIGIT * digit)) & np.uint32(size - 1)
            at = counts[digit, value]
            counts[digit, value] += 1
            keys[1 - source, at], index[1 - source, at] = key, index[source, k]
        source = 1 - source
    for k in range(seen):
        order[k] = index[source, k]
    return seen


@arithmetic_kernel
def _count(listed, box, across, cursor):
    """Counts the listed Gaussians that touch each tile into cursor (tiles), and returns the number of pairs."""
    cursor[:] = 0
    pairs = 0
    for n in listed:
        x0, x1, y0, y1 = box[n, 0], box[n, 1], box[n, 2], box[n, 3]
        if x0 < x1 and y0 < y1:
            left, right = np.uintp(x0) >> np.uintp(_ACROSS), np.uintp(x1 - 1) >> np.uintp(_ACROSS)
            for row in range(np.uintp(y0) >> np.uintp(_DOWN), (np.uintp(y1 - 1) >> np.uintp(_DOWN)) + np.uintp(1)):
                for column in range(left, right + np.uintp(1)):
                    cursor[row * np.uintp(across) + column] += 1
                    pairs += 1
    return pairs


@arithmetic_kernel
def _begin(cursor, first, tile_start):
    """Turns counts into beginnings, of each block's share of each tile's list and of its pairs, and returns P."""
    cameras, workers, tiles = cursor.shape
    at = pair = 0
    for c in range(cameras):
        for tile in range(tiles):
            tile_start[c * tiles + tile] = at
            for w in range(workers):
                at, cursor[c, w, tile] = at + cursor[c, w, tile], at
        for w in range(workers):
            pair, first[c, w] = pair + first[c, w], pair
    tile_start[cameras * tiles] = at
    return at


@arithmetic_kernel
def _fill(listed, box, across, cursor, pair, gaussian, pair_start):
    for n in listed:
        x0, x1, y0, y1 = box[n, 0], box[n, 1], box[n, 2], box[n, 3]
        if x0 < x1 and y0 < y1:
            pair_start[n] = pair
            left, right = np.uintp(x0) >> np.uintp(_ACROSS), np.uintp(x1 - 1) >> np.uintp(_ACROSS)
            top, bottom = np.uintp(y0) >> np.uintp(_DOWN), np.uintp(y1 - 1) >> np.uintp(_DOWN)
            for row in range(top, bottom + np.uintp(1)):
                for column in range(left, right + np.uintp(1)):
                    tile = row * np.uintp(across) + column
                    gaussian[np.uintp(cursor[tile])] = n
                    cursor[tile] += 1
            pair += np.int64((bottom - top + np.uintp(1)) * (right - left + np.uintp(1)))


@arithmetic_kernel
def _longest_first(tile_start):
    """Returns the tiles with lists, those twice as long before the others: enough for workers to end together."""
    tiles, bins = tile_start.size - 1, np.zeros(33, np.int64)
    size = np.empty(tiles, np.int64)
    for tile in range(tiles):
        size[tile], left = 0, tile_start[tile + 1] - tile_start[tile]
        while left > 0:
            size[tile], left = size[tile] + 1, left >> 1
        bins[32 - size[tile]] += 1
    tasks, at = np.empty(tiles - bins[32], np.int64), 0
    for length in range(32):
        at, bins[length] = at + bins[length], at
    for tile in range(tiles):
        if size[tile] > 0:
            tasks[bins[32 - size[tile]]] = tile
            bins[32 - size[tile]] += 1
    return tasks
