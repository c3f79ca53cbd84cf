"""CPU kernels of `splatting`: lists of Gaussians per tile, and the pixels of tiles, forward and backward.

A tile is one column of 8 lanes (`kernels_simd`) and TALL rows; within it a Gaussian visits only the rows of its box.
Gaussians reach a tile in order of (depth, index). Workers take tiles off a `counter` (1 i64, zero), longest lists first.
No two workers write to one place and every sum has a fixed order: results repeat exactly on any number of threads.
Arrays are C-contiguous float32 unless said otherwise; C cameras, N Gaussians, D channels, T tiles (all cameras'), P
pairs of a tile and a Gaussian. Opacities (1 or C,N) and colours (1 or C,N,D) may serve all cameras.

`packed` (C,N,6): mean x, y, then a, b, c, o with alpha = 2^(o + a dx^2 + b dx dy + c dy^2), (dx, dy) from mean to pixel.
`box` (C,N,4) i32: the pixels where alpha can reach 1/255: first and end column, first and end row; empty if unseen.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from dpcli.ops.jit import parallel_kernel
from dpcli.ops.kernels_simd import (
    any_lower,
    claim,
    lanes,
    load,
    lower,
    power_of_two,
    ramp,
    reciprocal,
    store,
    total,
    where_lower,
)

WIDE, TALL = 8, 16
_WIDE, _TALL = np.uintp(WIDE), np.uintp(TALL)
_ONE, _HALF, _ZERO = np.float32(1), np.float32(0.5), np.float32(0)
_SKIP, _CAP = np.float32(1 / 255), np.float32(0.999)
_STOP = np.nextafter(np.float32(1e-4), _ONE)  # the least transmittance with which a pixel goes on
_NEVER = np.float32(1 << 24)
_CHECK = 16  # Gaussians between two looks for rows where every pixel has stopped


@parallel_kernel
def pack(means2d, conics, opacities, radii, width, height, packed, box):
    """Write `packed` and `box` of means2d (C,N,2), conics (C,N,3), opacities, radii (C,N,2) i32."""
    cameras, count = radii.shape[:2]
    per_camera = opacities.shape[0] > 1
    for row in prange(cameras * count):
        c, n = row // count, row % count
        box[c, n] = 0
        opacity = np.float64(opacities[c if per_camera else 0, n])
        x, y = np.float64(means2d[c, n, 0]), np.float64(means2d[c, n, 1])
        xx, xy, yy = np.float64(conics[c, n, 0]), np.float64(conics[c, n, 1]), np.float64(conics[c, n, 2])
        det = xx * yy - xy * xy
        if radii[c, n, 0] > 0 and opacity >= 1 / 255 and det > 0:
            reach = 2 * np.log(255 * opacity) / det
            to_x, to_y = np.sqrt(reach * yy) + 1e-3, np.sqrt(reach * xx) + 1e-3
            box[c, n, 0] = np.int32(min(max(np.ceil(x - to_x - 0.5), 0), width))
            box[c, n, 1] = np.int32(min(max(np.floor(x + to_x + 0.5), 0), width))
            box[c, n, 2] = np.int32(min(max(np.ceil(y - to_y - 0.5), 0), height))
            box[c, n, 3] = np.int32(min(max(np.floor(y + to_y + 0.5), 0), height))
            bits = 1 / np.log(2.0)
            packed[c, n, 0], packed[c, n, 1] = x, y
            packed[c, n, 2], packed[c, n, 3], packed[c, n, 4] = -0.5 * bits * xx, -bits * xy, -0.5 * bits * yy
            packed[c, n, 5] = np.log2(opacity)


@parallel_kernel
def count_pairs(box, across, tile_pairs, pairs):
    """How many Gaussians touch each tile, tile_pairs (C,tiles) i64, and tiles each Gaussian, pairs (C,N) i64; both zero."""
    for c in prange(box.shape[0]):
        for n in range(box.shape[1]):
            x0, x1, y0, y1 = box[c, n, 0], box[c, n, 1], box[c, n, 2], box[c, n, 3]
            if x0 < x1 and y0 < y1:
                for down in range(y0 // TALL, (y1 - 1) // TALL + 1):
                    for right in range(x0 // WIDE, (x1 - 1) // WIDE + 1):
                        tile_pairs[c, down * across + right] += 1
                        pairs[c, n] += 1


@parallel_kernel
def fill_pairs(order, box, across, tile_start, pair_start, gaussian, place):
    """List the pairs by tile and depth: gaussian (P) i32, and by Gaussian and tile where they are: place (P) i64.

    order (C,N) i64: Gaussians by depth; tile_start (T+1) and pair_start (C*N+1) i64: where each one's pairs begin.
    """
    cameras, count = order.shape
    tiles = (tile_start.size - 1) // cameras
    for c in prange(cameras):
        cursor = tile_start[c * tiles : (c + 1) * tiles].copy()
        for k in range(count):
            n = order[c, k]
            x0, x1, y0, y1 = box[c, n, 0], box[c, n, 1], box[c, n, 2], box[c, n, 3]
            if x0 < x1 and y0 < y1:
                own = pair_start[c * count + n]
                for down in range(y0 // TALL, (y1 - 1) // TALL + 1):
                    for right in range(x0 // WIDE, (x1 - 1) // WIDE + 1):
                        at = cursor[down * across + right]
                        cursor[down * across + right] += 1
                        gaussian[at] = n
                        place[own] = at
                        own += 1


@parallel_kernel
def forward(tasks, workers, counter, tile_start, gaussian, packed, box, colors, across, out, alphas, ends):
    """Composite: out (C,H,W,D) and alphas (C,H,W) of the tiles in `tasks` (i64), and ends (T,TALL,2,8) for `backward`:

    each pixel's remaining transmittance, and the number (from 1) in the tile's list of the Gaussian before which it stopped.
    """
    height, width, channels = out.shape[1:]
    tiles = (tile_start.size - 1) // out.shape[0]
    fields = np.uintp((2 + channels) * WIDE)  # of a row of 8 pixels: transmittance (negative: stopped), where, colours
    per_camera = colors.shape[0] > 1
    one, zero, skip, cap, stop = lanes(_ONE), lanes(_ZERO), lanes(_SKIP), lanes(_CAP), lanes(_STOP)
    for _ in prange(workers):
        state = np.empty(np.uintp(TALL) * fields, np.float32)
        task = claim(counter)
        while task < tasks.size:
            tile = tasks[task]
            c, left, top = tile // tiles, tile % tiles % across * WIDE, tile % tiles // across * TALL
            own = c if per_camera else 0
            columns, first, end = min(WIDE, width - left), 0, min(TALL, height - top)
            for row in range(np.uintp(TALL)):
                at = row * fields
                store(state, at, where_lower(ramp(), lanes(np.float32(columns)), one, zero - one))
                store(state, at + _WIDE, lanes(_NEVER))
                for field in range(np.uintp(2), np.uintp(2 + channels)):
                    store(state, at + field * _WIDE, zero)
            begin = tile_start[tile]
            for k in range(begin, tile_start[tile + 1]):
                if (k - begin) % _CHECK == _CHECK - 1:
                    while first < end and not any_lower(zero, load(state, np.uintp(first) * fields)):
                        first += 1
                    while first < end and not any_lower(zero, load(state, np.uintp(end - 1) * fields)):
                        end -= 1
                    if first == end:
                        break
                n = np.uintp(gaussian[k])
                dx = ramp() + lanes(np.float32(left) + _HALF - packed[c, n, 0])
                across_x = lanes(packed[c, n, 5]) + lanes(packed[c, n, 2]) * dx * dx
                along, square = lanes(packed[c, n, 3]) * dx, lanes(packed[c, n, 4])
                number = lanes(np.float32(k - begin + 1))
                low, high = max(first, box[c, n, 2] - top), min(end, box[c, n, 3] - top)
                for row in range(low, high):
                    at = np.uintp(row) * fields
                    dy = lanes(np.float32(top + row) + _HALF - packed[c, n, 1])
                    alpha = lower(power_of_two(across_x + dy * (along + square * dy)), cap)
                    alpha = where_lower(alpha, skip, zero, alpha)
                    before = load(state, at)
                    weight = before * alpha
                    after = before - weight
                    if any_lower(after, stop):
                        last = load(state, at + _WIDE)
                        store(state, at + _WIDE, where_lower(after, stop, lower(last, number), last))
                        weight = where_lower(after, stop, zero, weight)
                        after = where_lower(after, stop, lower(before, zero - before), after)
                    store(state, at, after)
                    slot = at + _WIDE
                    for d in range(np.uintp(channels)):
                        slot += _WIDE
                        store(state, slot, load(state, slot) + weight * lanes(colors[own, n, d]))
            for row in range(min(TALL, height - top)):
                at = np.uintp(row) * fields
                for x in range(np.uintp(WIDE)):
                    ends[tile, row, 0, x] = abs(state[at + x])
                    ends[tile, row, 1, x] = state[at + _WIDE + x]
                for x in range(np.uintp(columns)):
                    alphas[c, top + row, left + x] = _ONE - abs(state[at + x])
                    for d in range(np.uintp(channels)):
                        out[c, top + row, left + x, d] = state[at + (np.uintp(2) + d) * _WIDE + x]
            task = claim(counter)


@parallel_kernel
def backward(
    tasks, workers, counter, tile_start, gaussian, packed, box, colors, across, ends, grad_out, grad_alphas, to_color, sums
):  # fmt: skip
    """Gradients of pairs: sums (P,6+D) of s, s dx, s dy, s dx^2, s dx dy, s dy^2 over pixels, then of the colours.

    s = dL/d(ln alpha), zero where alpha is capped. Walks each list from its far end: B = sum of (weight x colour . grad)
    behind a Gaussian gives dL/dalpha = T colour . grad - B / (1 - alpha). to_color: else the colours' columns stay zero.
    """
    height, width, channels = grad_out.shape[1:]
    tiles = (tile_start.size - 1) // grad_out.shape[0]
    fields = np.uintp(
        (3 + channels) * WIDE
    )  # of a row of 8 pixels: transmittance, B, where it stopped, gradients of the colours
    per_camera = colors.shape[0] > 1
    one, zero, skip, cap = lanes(_ONE), lanes(_ZERO), lanes(_SKIP), lanes(_CAP)
    for _ in prange(workers):
        state, colour = np.empty(np.uintp(TALL) * fields, np.float32), np.empty(channels * WIDE, np.float32)
        lasts = np.empty(TALL, np.int64)
        task = claim(counter)
        while task < tasks.size:
            tile = tasks[task]
            c, left, top = tile // tiles, tile % tiles % across * WIDE, tile % tiles // across * TALL
            own = c if per_camera else 0
            columns, rows, begin, last = min(WIDE, width - left), min(TALL, height - top), tile_start[tile], 0
            state[:] = _ZERO
            for row in range(rows):
                at = np.uintp(row) * fields
                lasts[row] = 0
                for x in range(np.uintp(WIDE)):
                    state[at + x] = _ONE
                for x in range(np.uintp(columns)):
                    state[at + x] = ends[tile, row, 0, x]
                    state[at + _WIDE + x] = -ends[tile, row, 0, x] * grad_alphas[c, top + row, left + x]
                    state[at + _WIDE + _WIDE + x] = ends[tile, row, 1, x]
                    lasts[row] = max(lasts[row], min(np.int64(ends[tile, row, 1, x]) - 1, tile_start[tile + 1] - begin))
                    for d in range(np.uintp(channels)):
                        state[at + (np.uintp(3) + d) * _WIDE + x] = grad_out[c, top + row, left + x, d]
                last = max(last, lasts[row])
            sums[begin + last : tile_start[tile + 1]] = _ZERO
            for number in range(last, 0, -1):
                n = np.uintp(gaussian[begin + number - 1])
                dx = ramp() + lanes(np.float32(left) + _HALF - packed[c, n, 0])
                across_x = lanes(packed[c, n, 5]) + lanes(packed[c, n, 2]) * dx * dx
                along, square = lanes(packed[c, n, 3]) * dx, lanes(packed[c, n, 4])
                above = lanes(np.float32(number) + _HALF)
                flat, linear, quadratic = zero, zero, zero
                colour[:] = _ZERO
                for row in range(max(0, box[c, n, 2] - top), min(rows, box[c, n, 3] - top)):
                    if number > lasts[row]:
                        continue
                    at = np.uintp(row) * fields
                    dy = lanes(np.float32(top + row) + _HALF - packed[c, n, 1])
                    raw = power_of_two(across_x + dy * (along + square * dy))
                    alpha = lower(raw, cap)
                    alpha = where_lower(alpha, skip, zero, alpha)
                    alpha = where_lower(above, load(state, at + _WIDE + _WIDE), alpha, zero)
                    inverse = reciprocal(one - alpha)
                    light = load(state, at) * inverse
                    store(state, at, light)
                    weight, agreement = alpha * light, zero
                    slot = at + _WIDE + _WIDE
                    for d in range(np.uintp(channels)):
                        slot += _WIDE
                        gradient = load(state, slot)
                        agreement = agreement + gradient * lanes(colors[own, n, d])
                        if to_color:
                            store(colour, d * _WIDE, load(colour, d * _WIDE) + weight * gradient)
                    behind = load(state, at + _WIDE)
                    store(state, at + _WIDE, behind + weight * agreement)
                    s = where_lower(cap, raw, zero, alpha * (light * agreement - inverse * behind))
                    flat = flat + s
                    linear = linear + s * dy
                    quadratic = quadratic + s * dy * dy
                pair = begin + number - 1
                sums[pair, 0], sums[pair, 1], sums[pair, 2] = total(flat), total(flat * dx), total(linear)
                sums[pair, 3], sums[pair, 4] = total(flat * dx * dx), total(linear * dx)
                sums[pair, 5] = total(quadratic)
                for d in range(np.uintp(channels)):
                    sums[pair, np.uintp(6) + d] = total(load(colour, d * _WIDE))
            task = claim(counter)


@parallel_kernel
def gather_gradients(pair_start, place, sums, conics, opacities, grad_means, grad_conics, grad_opacities, grad_colors):
    """Add up each Gaussian's pairs: grad_means (C,N,2), grad_conics (C,N,3); grad_opacities and grad_colors as the inputs.

    The last two must be zero; cameras that share them are added in order.
    """
    cameras, count = conics.shape[:2]
    channels = grad_colors.shape[2]
    own_opacity, own_color = opacities.shape[0] > 1, grad_colors.shape[0] > 1
    for n in prange(count):
        for c in range(cameras):
            flat = x = y = x2 = xy2 = y2 = _ZERO
            color = c if own_color else 0
            for own in range(pair_start[c * count + n], pair_start[c * count + n + 1]):
                pair = place[own]
                flat, x, y = flat + sums[pair, 0], x + sums[pair, 1], y + sums[pair, 2]
                x2, xy2, y2 = x2 + sums[pair, 3], xy2 + sums[pair, 4], y2 + sums[pair, 5]
                for d in range(channels):
                    grad_colors[color, n, d] += sums[pair, 6 + d]
            xx, xy, yy = conics[c, n, 0], conics[c, n, 1], conics[c, n, 2]
            grad_means[c, n, 0], grad_means[c, n, 1] = xx * x + xy * y, xy * x + yy * y
            grad_conics[c, n, 0], grad_conics[c, n, 1], grad_conics[c, n, 2] = -_HALF * x2, -xy2, -_HALF * y2
            if flat != _ZERO:
                camera = c if own_opacity else 0
                grad_opacities[camera, n] += flat / opacities[camera, n]
