"""The CPU kernel of the convolutions' norm and activation: three passes over a cloud's features instead of eight."""

from __future__ import annotations

import math

import numpy as np

from dpcli.ops.cpu.jit import kernel
from dpcli.ops.cpu.simd import WIDTH, higher, lanes, load, store

PAIR = 2 * WIDTH  # channels at a time
_ROWS = 64  # summed in float32 before they are added to a float64


@kernel
def _means(features, start, step, rows, shift, squared, part, out):
    """Computes the means f64 (16), in `out`, of rows start, start + step, .. of features less shift f32 (16).

    squared: of the squares of these differences instead.
    """
    width, zero = np.uintp(WIDTH), np.uintp(0)
    low_shift, high_shift = load(shift, zero), load(shift, width)
    out[:] = 0.0
    for block in range(0, rows, _ROWS):
        low = high = lanes(np.float32(0))
        for row in range(np.uintp(block), np.uintp(min(block + _ROWS, rows))):
            at = start + row * step
            a, b = load(features, at) - low_shift, load(features, at + width) - high_shift
            if squared:
                a, b = a * a, b * b
            low, high = low + a, high + b
        store(part, zero, low)
        store(part, width, high)
        for c in range(PAIR):
            out[c] += part[c]
    for c in range(PAIR):
        out[c] /= rows


@kernel
def norm_kernel(features, rows, channels, slope, first, last):
    """Applies `instance_norm` and leaky ReLU in place to features, a flat f32 (B*rows*channels), of clouds first..last.

    channels must be a multiple of 16. Sums of 64 rows are float32, sums of those float64.
    """
    width, zero, step, leak = np.uintp(WIDTH), np.uintp(0), np.uintp(channels), lanes(np.float32(slope))
    shift, scale, part = np.empty(PAIR, np.float32), np.empty(PAIR, np.float32), np.empty(PAIR, np.float32)
    found = np.empty(PAIR)
    groups = channels // PAIR
    for item in range(first * groups, last * groups):
        start = np.uintp(item // groups * rows * channels + item % groups * PAIR)
        shift[:] = 0
        _means(features, start, step, rows, shift, False, part, found)
        for c in range(PAIR):
            shift[c] = found[c]
        _means(features, start, step, rows, shift, True, part, found)
        for c in range(PAIR):
            scale[c] = 1 / math.sqrt(found[c] + 1e-5)
        low_shift, high_shift = load(shift, zero), load(shift, width)
        low_scale, high_scale = load(scale, zero), load(scale, width)
        for row in range(np.uintp(rows)):
            at = start + row * step
            a, b = (load(features, at) - low_shift) * low_scale, (load(features, at + width) - high_shift) * high_scale
            store(features, at, higher(a, a * leak))
            store(features, at + width, higher(b, b * leak))
