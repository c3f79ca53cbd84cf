"""CPU kernels of `splatting`: the pixels of tiles, forward and backward, from the lists of `cpu_tile_lists`.

Within a tile a Gaussian visits only the rows of its box. Workers take tiles off a `counter` (1 i64, zero), longest
lists first. No two workers write to one place and every sum has a fixed order: results repeat exactly on any number of
threads. Arrays are C-contiguous float32 unless said otherwise, `flat` ones seen as a vector; letters, `packed`, `box`,
`pair_start` and the lists as in `cpu_tile_lists`, D channels. Opacities (1 or C,N) and colors (1 or C,N,D) may
serve all cameras. Indices are unsigned where it matters: numba then leaves out its test for negative ones.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from dpcli.ops.cpu.jit import inlined_piece, parallel_kernel
from dpcli.ops.cpu.simd import any_lower, claim, lanes, load, lower, ramp, reciprocal, store, total, where_lower
from dpcli.ops.splatting.cpu_simd import OWN, constants, power, totals
from dpcli.ops.splatting.cpu_tile_lists import PACKED, TALL, WIDE

_WIDE, _TALL, _PACKED, _RGB = np.uintp(WIDE), np.uintp(TALL), np.uintp(PACKED), np.uintp(3)
_0, _1, _2, _3, _4, _5, _6, _7 = (np.uintp(i) for i in range(8))
_ONE, _HALF, _ZERO = np.float32(1), np.float32(0.5), np.float32(0)
_SKIP, _CAP = np.float32(1 / 255), np.float32(0.999)
_STOP = np.nextafter(np.float32(1e-4), _ONE)  # the least transmittance with which a pixel goes on
_NEVER = np.float32(1 << 24)
_BLOCK = 256  # Gaussians gathered as one task
_CHECK = 16  # Gaussians between two looks for rows where every pixel has stopped
TABLE = constants(_CAP, _SKIP, _STOP, 1)
_CAP_AT, _SKIP_AT, _STOP_AT, _ONE_AT = (np.uintp((OWN + i) * WIDE) for i in range(4))


@inlined_piece
def _add(state, at, more):
    store(state, at, load(state, at) + more)


@inlined_piece
def _composite(table, state, low, high, left, top, packed, g, colors, color, channels, number):
    """Composites one Gaussian, `packed` from g and `colors` from color, onto rows low..high-1 of a tile's state.

    Three channels, where the caller says so by the constant, are unrolled.
    """
    one_row = (_2 + channels) * _WIDE
    dx = ramp() + lanes(left - packed[g])
    across_x = lanes(packed[g + _5]) + lanes(packed[g + _2]) * dx * dx
    along, square = lanes(packed[g + _3]) * dx, lanes(packed[g + _4])
    zero = lanes(_ZERO)
    at, y, center = np.uintp(low) * one_row, top + np.float32(low), packed[g + _1]
    for _ in range(low, high):
        dy = lanes(y - center)
        alpha = lower(power(table, across_x + dy * (along + square * dy)), load(table, _CAP_AT))
        alpha = where_lower(alpha, load(table, _SKIP_AT), zero, alpha)
        before = load(state, at)
        weight = before * alpha
        after = before - weight
        if any_lower(after, load(table, _STOP_AT)):
            stop, last = load(table, _STOP_AT), load(state, at + _WIDE)
            store(state, at + _WIDE, where_lower(after, stop, lower(last, lanes(number)), last))
            weight = where_lower(after, stop, zero, weight)
            after = where_lower(after, stop, lower(before, zero - before), after)
        store(state, at, after)
        slot = at + _2 * _WIDE
        if channels == _RGB:
            _add(state, slot, weight * lanes(colors[color]))
            _add(state, slot + _WIDE, weight * lanes(colors[color + _1]))
            _add(state, slot + _2 * _WIDE, weight * lanes(colors[color + _2]))
        else:
            for d in range(channels):
                _add(state, slot + d * _WIDE, weight * lanes(colors[color + d]))
        at += one_row
        y += _ONE


@parallel_kernel
def forward(table, tasks, workers, counter, tile_start, gaussian, packed, colors, size, shared, out, alphas, ends):
    """Composites the tiles in `tasks` (i64) into out (C,H,W,D), alphas (C,H,W), and ends (T,TALL,2,8), which `backward` reads.

    ends: each pixel's remaining transmittance, and the number (from 1) in the tile's list of the Gaussian before which it
    stopped. packed, colors, out, alphas, ends are flat; size is C, N, H, W, D; shared: one set of colors for all.
    """
    cameras, count, height, width, depth = size
    across, channels = (width + WIDE - 1) // WIDE, np.uintp(depth)
    tiles, fields = (tile_start.size - 1) // cameras, (_2 + channels) * _WIDE
    # of a row of 8 pixels: transmittance (negative: stopped), where, colors
    for _ in prange(workers):
        state = np.empty(_TALL * fields, np.float32)
        task = claim(counter)
        while task < tasks.size:
            tile = tasks[task]
            c, left, top = tile // tiles, tile % tiles % across * WIDE, tile % tiles // across * TALL
            columns, first, end = min(WIDE, width - left), 0, min(TALL, height - top)
            own, own_color = np.uintp(c * count), np.uintp(0 if shared else c * count)
            outside = where_lower(ramp(), lanes(np.float32(columns)), lanes(_ONE), lanes(-_ONE))
            for row in range(_TALL):
                at = row * fields
                store(state, at, outside)
                store(state, at + _WIDE, lanes(_NEVER))
                for field in range(_2, _2 + channels):
                    store(state, at + field * _WIDE, lanes(_ZERO))
            begin = tile_start[tile]
            x, y = np.float32(left) + _HALF, np.float32(top) + _HALF
            for k in range(begin, tile_start[tile + 1]):
                if (k - begin) % _CHECK == _CHECK - 1:
                    while first < end and not any_lower(lanes(_ZERO), load(state, np.uintp(first) * fields)):
                        first += 1
                    while first < end and not any_lower(lanes(_ZERO), load(state, np.uintp(end - 1) * fields)):
                        end -= 1
                    if first == end:
                        break
                n = np.uintp(gaussian[np.uintp(k)])
                g, color, number = (own + n) * _PACKED, (own_color + n) * channels, np.float32(k - begin + 1)
                low = max(first, np.int64(packed[g + _6]) - top)
                high = min(end, np.int64(packed[g + _7]) - top)
                if channels == _RGB:
                    _composite(table, state, low, high, x, y, packed, g, colors, color, _RGB, number)
                else:
                    _composite(table, state, low, high, x, y, packed, g, colors, color, channels, number)
            to_end = np.uintp(tile) * _TALL * _2 * _WIDE
            for row in range(np.uintp(min(TALL, height - top))):
                at = row * fields
                light = load(state, at)
                light = where_lower(light, lanes(_ZERO), lanes(_ZERO) - light, light)
                store(state, at, light)
                store(ends, to_end, light)
                store(ends, to_end + _WIDE, load(state, at + _WIDE))
                to_end += _2 * _WIDE
                pixel = np.uintp((c * height + top) * width + left) + row * np.uintp(width)
                for lane in range(np.uintp(columns)):
                    alphas[pixel + lane] = _ONE - state[at + lane]
                    for d in range(channels):
                        out[(pixel + lane) * channels + d] = state[at + (_2 + d) * _WIDE + lane]
            task = claim(counter)


@inlined_piece
def _retrace(
    table, state, lasts, weights, low, high, left, top, packed, g, colors, color, channels, number, to_color, sums, pair
):
    """Adds one Gaussian's gradients from rows low..high-1 of a tile to `sums` at pair, the state taken back to before it."""
    one_row = (_3 + channels) * _WIDE
    dx = ramp() + lanes(left - packed[g])
    across_x = lanes(packed[g + _5]) + lanes(packed[g + _2]) * dx * dx
    along, square = lanes(packed[g + _3]) * dx, lanes(packed[g + _4])
    zero = lanes(_ZERO)
    above = lanes(np.float32(number) + _HALF)
    y, center = top + np.float32(low), packed[g + _1]
    flat, linear, quadratic = zero, zero, zero
    for row in range(np.uintp(low), np.uintp(high)):
        at, weight, dy = row * one_row, zero, lanes(y - center)
        y += _ONE
        if number <= lasts[row]:
            raw = power(table, across_x + dy * (along + square * dy))
            alpha = lower(raw, load(table, _CAP_AT))
            alpha = where_lower(alpha, load(table, _SKIP_AT), zero, alpha)
            alpha = where_lower(above, load(state, at + _WIDE + _WIDE), alpha, zero)
            inverse = reciprocal(load(table, _ONE_AT) - alpha)
            light = load(state, at) * inverse
            store(state, at, light)
            weight, slot = alpha * light, at + _3 * _WIDE
            if channels == _RGB:
                agreement = load(state, slot) * lanes(colors[color])
                agreement = agreement + load(state, slot + _WIDE) * lanes(colors[color + _1])
                agreement = agreement + load(state, slot + _2 * _WIDE) * lanes(colors[color + _2])
            else:
                agreement = zero
                for d in range(channels):
                    agreement = agreement + load(state, slot + d * _WIDE) * lanes(colors[color + d])
            behind = load(state, at + _WIDE)
            store(state, at + _WIDE, behind + weight * agreement)
            s = where_lower(load(table, _CAP_AT), raw, zero, alpha * (light * agreement - inverse * behind))
            flat = flat + s
            linear = linear + s * dy
            quadratic = quadratic + s * dy * dy
        store(weights, row * _WIDE, weight)
    first = second = zero
    if to_color:
        first = _color_sum(state, weights, low, high, one_row, _0)
        if channels > _1:
            second = _color_sum(state, weights, low, high, one_row, _1)
        for d in range(_2, channels):
            sums[pair + _6 + d] = total(_color_sum(state, weights, low, high, one_row, d))
    # a row of sums is at least 8 long
    store(sums, pair, totals(flat, flat * dx, linear, flat * dx * dx, linear * dx, quadratic, first, second))


@inlined_piece
def _color_sum(state, weights, low, high, one_row, d):
    summed = lanes(_ZERO)
    for row in range(np.uintp(low), np.uintp(high)):
        summed = summed + load(weights, row * _WIDE) * load(state, row * one_row + (_3 + d) * _WIDE)
    return summed


@parallel_kernel
def backward(
    table,
    tasks,
    workers,
    counter,
    tile_start,
    gaussian,
    packed,
    box,
    pair_start,
    colors,
    size,
    shared,
    ends,
    grad_out,
    grad_alphas,
    to_color,
    sums,
):
    """Computes gradients of pairs (P,max(8,6+D)): sums of s, s dx, s dy, s dx^2, s dx dy, s dy^2 over pixels, then of colors.

    s = dL/d(ln alpha), zero where alpha is capped. Walks each list from its far end: B = sum of (weight x color . grad)
    behind a Gaussian gives dL/dalpha = T color . grad - B / (1 - alpha). to_color: else the colors' columns are unset.
    packed, colors, ends, sums and the gradients are flat; size and shared as for `forward`.
    """
    cameras, count, height, width, depth = size
    across, channels = (width + WIDE - 1) // WIDE, np.uintp(depth)
    tiles, fields = (tile_start.size - 1) // cameras, (_3 + channels) * _WIDE
    # of a row of 8 pixels: transmittance, B, where it stopped, gradients of the colors
    stride = np.uintp(max(8, 6 + depth))
    for _ in prange(workers):
        state, weights = np.empty(_TALL * fields, np.float32), np.empty(_TALL * _WIDE, np.float32)
        lasts = np.empty(TALL, np.int64)
        task = claim(counter)
        while task < tasks.size:
            tile = tasks[task]
            c, tile_x, tile_y = tile // tiles, tile % tiles % across, tile % tiles // across
            left, top = tile_x * WIDE, tile_y * TALL
            columns, rows = min(WIDE, width - left), min(TALL, height - top)
            own, own_color = np.uintp(c * count), np.uintp(0 if shared else c * count)
            begin, last, length = tile_start[tile], 0, tile_start[tile + 1] - tile_start[tile]
            from_end = np.uintp(tile) * _TALL * _2 * _WIDE
            for row in range(np.uintp(rows)):
                at = row * fields
                light, stopped = load(ends, from_end), load(ends, from_end + _WIDE)
                store(state, at, light)
                store(state, at + _WIDE + _WIDE, stopped)
                from_end += _2 * _WIDE
                for field in range(_3, _3 + channels):
                    store(state, at + field * _WIDE, lanes(_ZERO))
                store(weights, _0, lanes(_ZERO))
                pixel = np.uintp((c * height + top) * width + left) + row * np.uintp(width)
                lasts[row] = 0
                for lane in range(np.uintp(columns)):
                    weights[lane] = grad_alphas[pixel + lane]
                    lasts[row] = max(lasts[row], min(np.int64(state[at + _2 * _WIDE + lane]) - 1, length))
                    for d in range(channels):
                        state[at + (_3 + d) * _WIDE + lane] = grad_out[(pixel + lane) * channels + d]
                store(state, at + _WIDE, lanes(_ZERO) - light * load(weights, _0))
                last = max(last, lasts[row])
            x, y = np.float32(left) + _HALF, np.float32(top) + _HALF
            for number in range(length, 0, -1):
                n = own + np.uintp(gaussian[np.uintp(begin + number - 1)])
                g, color = n * _PACKED, (own_color + n - own) * channels
                tile_left, tile_right = box[n, 0] // WIDE, (box[n, 1] - 1) // WIDE
                place = (tile_y - box[n, 2] // TALL) * (tile_right - tile_left + 1) + tile_x - tile_left
                pair = np.uintp(pair_start[n] + place) * stride
                if number > last:
                    for i in range(stride):
                        sums[pair + i] = _ZERO
                    continue
                low = max(0, np.int64(packed[g + _6]) - top)
                high = min(rows, np.int64(packed[g + _7]) - top)
                if channels == _RGB:
                    _retrace(
                        table,
                        state,
                        lasts,
                        weights,
                        low,
                        high,
                        x,
                        y,
                        packed,
                        g,
                        colors,
                        color,
                        _RGB,
                        number,
                        to_color,
                        sums,
                        pair,
                    )
                else:
                    _retrace(
                        table,
                        state,
                        lasts,
                        weights,
                        low,
                        high,
                        x,
                        y,
                        packed,
                        g,
                        colors,
                        color,
                        channels,
                        number,
                        to_color,
                        sums,
                        pair,
                    )
            task = claim(counter)


@parallel_kernel
def gather_gradients(
    box, pair_start, sums, conics, opacities, to_color, grad_means, grad_conics, grad_opacities, grad_colors
):
    """Adds up each Gaussian's pairs: grad_means (C,N,2), grad_conics (C,N,3); grad_opacities and grad_colors as the inputs.

    The last two must be zero; cameras that share them are added in order. sums is flat.
    """
    cameras, count = conics.shape[:2]
    channels = np.uintp(grad_colors.shape[2])
    own_opacity, own_color = opacities.shape[0] > 1, grad_colors.shape[0] > 1
    stride = max(_6 + _2, _6 + channels)
    for block in prange((count + _BLOCK - 1) // _BLOCK):
        summed = np.empty(stride, np.float32)
        for n in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            for c in range(cameras):
                wide = (box[c, n, 1] - 1) // WIDE - box[c, n, 0] // WIDE + 1
                tall = (box[c, n, 3] - 1) // TALL - box[c, n, 2] // TALL + 1
                pairs = np.uintp(wide * tall if box[c, n, 0] < box[c, n, 1] and box[c, n, 2] < box[c, n, 3] else 0)
                first, at = lanes(_ZERO), np.uintp(pair_start[c, n]) * stride
                for field in range(_6 + _2, stride):
                    summed[field] = _ZERO
                for _ in range(pairs):
                    first = first + load(sums, at)
                    for field in range(_6 + _2, stride):
                        summed[field] += sums[at + field]
                    at += stride
                store(summed, _0, first)
                if to_color:
                    for d in range(channels):
                        grad_colors[c if own_color else 0, n, d] += summed[_6 + d]
                flat, x, y = summed[_0], summed[_1], summed[_2]
                xx, xy, yy = conics[c, n, 0], conics[c, n, 1], conics[c, n, 2]
                grad_means[c, n, 0], grad_means[c, n, 1] = xx * x + xy * y, xy * x + yy * y
                grad_conics[c, n, 0] = -_HALF * summed[_3]
                grad_conics[c, n, 1], grad_conics[c, n, 2] = -summed[_4], -_HALF * summed[_5]
                if flat != _ZERO:
                    camera = c if own_opacity else 0
                    grad_opacities[camera, n] += flat / opacities[camera, n]
