"""Batched small inverses in numba: `TILE` matrices side by side, entry by entry, so that the arithmetic vectorises.

Mirrors `linalg._inverse` for n <= 8: one block partition at most, whose blocks have the closed form.
"""

from __future__ import annotations

import numpy as np

from dpcli.ops.jit import kernel

TILE = 64  # matrices per tile: an 8x8 tile of float32 is 16 kB
_SIGNED, _NONE = 0, 2  # positions in linalg._GUARDS


@kernel
def _guard_row(det, moved, min_det, guard):
    """Move small determinants (W,) away from zero and note which; then invert them in place."""
    for w in range(det.size):
        if guard != _NONE and abs(det[w]) < min_det:
            moved[w] = True
            det[w] = -min_det if guard == _SIGNED and det[w] < 0 else min_det
        det[w] = 1 / det[w]


@kernel
def _closed1(m, out, det):
    for w in range(TILE):
        det[w] = m[0, 0, w]
        out[0, 0, w] = 1


@kernel
def _closed2(m, out, det):
    for w in range(TILE):
        a, b, c, d = m[0, 0, w], m[0, 1, w], m[1, 0, w], m[1, 1, w]
        det[w] = a * d - b * c
        out[0, 0, w], out[0, 1, w], out[1, 0, w], out[1, 1, w] = d, -b, -c, a


@kernel
def _closed3(m, out, det):
    for w in range(TILE):
        a, b, c = m[0, 0, w], m[0, 1, w], m[0, 2, w]
        d, e, f = m[1, 0, w], m[1, 1, w], m[1, 2, w]
        g, h, i = m[2, 0, w], m[2, 1, w], m[2, 2, w]
        x, y, z = e * i - f * h, f * g - d * i, d * h - e * g
        det[w] = a * x + b * y + c * z
        out[0, 0, w], out[0, 1, w], out[0, 2, w] = x, c * h - b * i, b * f - c * e
        out[1, 0, w], out[1, 1, w], out[1, 2, w] = y, a * i - c * g, c * d - a * f
        out[2, 0, w], out[2, 1, w], out[2, 2, w] = z, b * g - a * h, a * e - b * d


@kernel
def _closed4(m, out, det):
    for w in range(TILE):
        a, b, c, d = m[0, 0, w], m[0, 1, w], m[0, 2, w], m[0, 3, w]
        e, f, g, h = m[1, 0, w], m[1, 1, w], m[1, 2, w], m[1, 3, w]
        i, j, k, l = m[2, 0, w], m[2, 1, w], m[2, 2, w], m[2, 3, w]  # noqa: E741 - the sixteen entries, a to p
        n, o, p, q = m[3, 0, w], m[3, 1, w], m[3, 2, w], m[3, 3, w]
        u01, u02, u03 = a * f - b * e, a * g - c * e, a * h - d * e
        u12, u13, u23 = b * g - c * f, b * h - d * f, c * h - d * g
        v01, v02, v03 = i * o - j * n, i * p - k * n, i * q - l * n
        v12, v13, v23 = j * p - k * o, j * q - l * o, k * q - l * p
        det[w] = u01 * v23 - u02 * v13 + u03 * v12 + u12 * v03 - u13 * v02 + u23 * v01
        out[0, 0, w] = f * v23 - g * v13 + h * v12
        out[0, 1, w] = -(b * v23 - c * v13 + d * v12)
        out[0, 2, w] = o * u23 - p * u13 + q * u12
        out[0, 3, w] = -(j * u23 - k * u13 + l * u12)
        out[1, 0, w] = -(e * v23 - g * v03 + h * v02)
        out[1, 1, w] = a * v23 - c * v03 + d * v02
        out[1, 2, w] = -(n * u23 - p * u03 + q * u02)
        out[1, 3, w] = i * u23 - k * u03 + l * u02
        out[2, 0, w] = e * v13 - f * v03 + h * v01
        out[2, 1, w] = -(a * v13 - b * v03 + d * v01)
        out[2, 2, w] = n * u13 - o * u03 + q * u01
        out[2, 3, w] = -(i * u13 - j * u03 + l * u01)
        out[3, 0, w] = -(e * v12 - f * v02 + g * v01)
        out[3, 1, w] = a * v12 - b * v02 + c * v01
        out[3, 2, w] = -(n * u12 - o * u02 + p * u01)
        out[3, 3, w] = i * u12 - j * u02 + k * u01


@kernel
def _closed(m, out, det, moved, min_det, guard):
    """Closed-form inverses of a tile (n,n,W), n <= 4."""
    n = m.shape[0]
    if n == 1:
        _closed1(m, out, det)
    elif n == 2:
        _closed2(m, out, det)
    elif n == 3:
        _closed3(m, out, det)
    else:
        _closed4(m, out, det)
    _guard_row(det, moved, min_det, guard)
    for i in range(n):
        for j in range(n):
            for w in range(TILE):
                out[i, j, w] *= det[w]


@kernel
def _add_product(a, b, sign, out):
    """out += sign * a b for tiles (p,r,W), (r,q,W), (p,q,W)."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            for k in range(b.shape[0]):
                for w in range(TILE):
                    out[i, j, w] += sign * a[i, k, w] * b[k, j, w]


@kernel
def _blocks(m, out, det, moved, left, right, min_det, guard):
    """Block-partitioned inverses of a tile (n,n,W), 4 < n <= 8; left (q,p,W) and right (p,q,W) are scratch."""
    half = (m.shape[0] + 1) // 2
    one = m.dtype.type(1)
    a, b, c, d = m[:half, :half], m[:half, half:], m[half:, :half], m[half:, half:]
    inverse, upper, lower, corner = out[:half, :half], out[:half, half:], out[half:, :half], out[half:, half:]
    _closed(a, inverse, det, moved, min_det, guard)
    left[:] = 0
    right[:] = 0
    _add_product(c, inverse, one, left)
    _add_product(inverse, b, one, right)
    _add_product(left, b, -one, d)  # m is a copy: d becomes the Schur complement
    _closed(d, corner, det, moved, min_det, guard)
    upper[:] = 0
    lower[:] = 0
    _add_product(right, corner, -one, upper)
    _add_product(corner, left, -one, lower)
    _add_product(upper, left, -one, inverse)


@kernel
def _load(matrices, first, size, tile):
    """Matrices first..first+size-1 as a tile (n,n,W); the identity behind them."""
    n = tile.shape[0]
    for i in range(n):
        for j in range(n):
            for w in range(size):
                tile[i, j, w] = matrices[first + w, i, j]
            tile[i, j, size:] = 1 if i == j else 0


@kernel
def _store(tile, matrices, first, size):
    n = tile.shape[0]
    for w in range(size):
        for i in range(n):
            for j in range(n):
                matrices[first + w, i, j] = tile[i, j, w]


@kernel
def inverse_kernel(matrices, inverse, moved, min_det, guard, first, last):
    """Invert matrices first..last-1 of (R,n,n), n <= 8, into `inverse`; moved (R,) bool: where the guard acted."""
    n = matrices.shape[1]
    half = (n + 1) // 2
    tile = np.empty((n, n, TILE), matrices.dtype)
    out = np.empty_like(tile)
    left = np.empty((n - half, half, TILE), matrices.dtype)
    right = np.empty((half, n - half, TILE), matrices.dtype)
    det = np.empty(TILE, matrices.dtype)
    floor = matrices.dtype.type(min_det)
    acted = np.empty(TILE, np.bool_)
    for low in range(first, last, TILE):
        size = min(TILE, last - low)
        _load(matrices, low, size, tile)
        acted[:] = False
        if n <= 4:
            _closed(tile, out, det, acted, floor, guard)
        else:
            _blocks(tile, out, det, acted, left, right, floor, guard)
        _store(out, inverse, low, size)
        moved[low : low + size] = acted[:size]


@kernel
def inverse_gradient_kernel(inverse, grad, out, first, last):
    """out = -X' G X' for rows first..last-1 of X = inverse (R,n,n) and G = grad: the gradient of an exact inverse."""
    n = inverse.shape[1]
    x = np.empty((n, n, TILE), inverse.dtype)
    g = np.empty_like(x)
    inner = np.empty_like(x)
    outer = np.empty_like(x)
    one = inverse.dtype.type(1)
    for low in range(first, last, TILE):
        size = min(TILE, last - low)
        _load(inverse, low, size, x)
        _load(grad, low, size, g)
        transposed = x.transpose(1, 0, 2)
        inner[:] = 0
        outer[:] = 0
        _add_product(g, transposed, one, inner)
        _add_product(transposed, inner, -one, outer)
        _store(outer, out, low, size)
