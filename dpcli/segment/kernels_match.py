"""CPU kernel of object-aware ICP: where the points of one frame lie in another, softly."""

from __future__ import annotations

import numpy as np

from dpcli.ops.jit import kernel

_FORGOTTEN = np.float32(20.0)  # a weight below exp(-20) of the largest: a thousand of them change nothing in float32
_LEAST = np.float32(-3e38)


@kernel
def soft_match_kernel(moved, target, bias, temperature, out, first, last):
    """out (B,N,3): mean of target (B,3,M) weighted by softmax(bias (B,N,M) - |moved (B,N,3) - target| / temperature).

    float32; rows first..last of the B * N. A row of `bias` holds at least one finite number.
    """
    rows, count = np.uintp(moved.shape[1]), np.uintp(target.shape[2])
    logit = np.empty(count, np.float32)
    rate = np.float32(-1.0) / np.float32(temperature)
    for row in range(np.uintp(first), np.uintp(last)):
        b, n = row // rows, row % rows
        x, y, z = moved[b, n, 0], moved[b, n, 1], moved[b, n, 2]
        for m in range(count):
            dx, dy, dz = target[b, 0, m] - x, target[b, 1, m] - y, target[b, 2, m] - z
            logit[m] = rate * np.sqrt(dx * dx + dy * dy + dz * dz) + bias[b, n, m]
        top = _LEAST
        for m in range(count):
            top = max(top, logit[m])
        total = sx = sy = sz = np.float32(0)
        for m in range(count):
            if logit[m] > top - _FORGOTTEN:
                weight = np.exp(logit[m] - top)
                total += weight
                sx += weight * target[b, 0, m]
                sy += weight * target[b, 1, m]
                sz += weight * target[b, 2, m]
        out[b, n, 0], out[b, n, 1], out[b, n, 2] = sx / total, sy / total, sz / total
