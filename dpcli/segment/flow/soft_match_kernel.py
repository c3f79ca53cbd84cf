"""The CPU kernel of object-aware ICP: where the points of one frame lie in another, softly."""

from __future__ import annotations

import numpy as np

from dpcli.ops.cpu.jit import kernel
from dpcli.ops.cpu.simd import WIDTH, any_lower, higher, lanes, load, power_of_two, store, total

_FORGOTTEN = np.float32(20.0)  # a weight below exp(-20) of the largest: a thousand of them change nothing in float32
_LEAST = np.float32(-3e38)
_BINARY = np.float32(1.4426950408889634)  # exp(x) = 2^(this x)


@kernel
def soft_match_kernel(moved, target, bias, temperature, out, first, last):
    """Computes out (B,N,3): the mean of target (B,3,M) weighted by softmax(bias - |moved - target| / temperature).

    float32; moved (B,N,3), bias (B,N,M); rows first..last of the B * N. A row of `bias` holds at least one finite
    number. target may have further columns, up to a multiple of 8: finite numbers that are not read.
    """
    rows, count = np.uintp(moved.shape[1]), np.uintp(bias.shape[2])
    width, end = np.uintp(WIDTH), np.uintp(target.shape[2])
    logit, found = np.full(end, _LEAST, np.float32), np.empty(WIDTH, np.float32)
    rate = np.float32(-1.0) / np.float32(temperature)
    base = lanes(_BINARY)
    for row in range(np.uintp(first), np.uintp(last)):
        b, n = row // rows, row % rows
        x, y, z = moved[b, n, 0], moved[b, n, 1], moved[b, n, 2]
        xs, ys, zs = target[b, 0], target[b, 1], target[b, 2]
        for m in range(count):
            dx, dy, dz = xs[m] - x, ys[m] - y, zs[m] - z
            logit[m] = rate * np.sqrt(dx * dx + dy * dy + dz * dz) + bias[b, n, m]
        best = lanes(_LEAST)
        for m in range(np.uintp(0), end, width):
            best = higher(best, load(logit, m))
        store(found, np.uintp(0), best)
        top = found[0]
        for m in range(1, WIDTH):
            top = max(top, found[m])
        highest, bound = lanes(top), lanes(top - _FORGOTTEN)
        weights = sx = sy = sz = lanes(np.float32(0))
        for m in range(np.uintp(0), end, width):
            here = load(logit, m)
            if any_lower(bound, here):
                weight = power_of_two((here - highest) * base)
                weights, sx = weights + weight, sx + weight * load(xs, m)
                sy, sz = sy + weight * load(ys, m), sz + weight * load(zs, m)
        whole = total(weights)
        out[b, n, 0], out[b, n, 1], out[b, n, 2] = total(sx) / whole, total(sy) / whole, total(sz) / whole
