"""Batched small inverses in numba: `TILE` matrices side by side, entry by entry, so that the arithmetic vectorizes.

Mirrors `ops.small_inverses._inverse` for n <= 8: one block partition at most, whose blocks have the closed form.
"""

from __future__ import annotations

import numpy as np

from dpcli.ops.cpu.jit import arithmetic_kernel

TILE = 64  # matrices per tile: an 8x8 tile of float32 is 16 kB
_SIGNED, _NONE = 0, 2  # positions in ops.small_inverses.GUARDS


@arithmetic_kernel
def _guard_row(det, moved, min_det, guard):
    """Moves small determinants (W,) away from zero, notes which, and then inverts them in place."""
    for w in range(det.size):
        if guard != _NONE and abs(det[w]) < min_det:
            moved[w] = True
            det[w] = -min_det if guard == _SIGNED and det[w] < 0 else min_det
        det[w] = 1 / det[w]


@arithmetic_kernel
def _closed1(m, out, at, det):
    for w in range(TILE):
        det[w] = m[at, at, w]
        out[at, at, w] = 1


@arithmetic_kernel
def _closed2(m, out, at, det):
    for w in range(TILE):
        a, b, c, d = m[at, at, w], m[at, at + 1, w], m[at + 1, at, w], m[at + 1, at + 1, w]
        det[w] = a * d - b * c
        out[at, at, w], out[at, at + 1, w], out[at + 1, at, w], out[at + 1, at + 1, w] = d, -b, -c, a


@arithmetic_kernel
def _closed3(m, out, at, det):
    for w in range(TILE):
        a, b, c = m[at, at, w], m[at, at + 1, w], m[at, at + 2, w]
        d, e, f = m[at + 1, at, w], m[at + 1, at + 1, w], m[at + 1, at + 2, w]
        g, h, i = m[at + 2, at, w], m[at + 2, at + 1, w], m[at + 2, at + 2, w]
        x, y, z = e * i - f * h, f * g - d * i, d * h - e * g
        det[w] = a * x + b * y + c * z
        out[at, at, w], out[at, at + 1, w], out[at, at + 2, w] = x, c * h - b * i, b * f - c * e
        out[at + 1, at, w], out[at + 1, at + 1, w], out[at + 1, at + 2, w] = y, a * i - c * g, c * d - a * f
        out[at + 2, at, w], out[at + 2, at + 1, w], out[at + 2, at + 2, w] = z, b * g - a * h, a * e - b * d


@arithmetic_kernel
def _closed4(m, out, at, det):
    for w in range(TILE):
        a, b, c, d = m[at, at, w], m[at, at + 1, w], m[at, at + 2, w], m[at, at + 3, w]
        e, f, g, h = m[at + 1, at, w], m[at + 1, at + 1, w], m[at + 1, at + 2, w], m[at + 1, at + 3, w]
        i, j, k, l = m[at + 2, at, w], m[at + 2, at + 1, w], m[at + 2, at + 2, w], m[at + 2, at + 3, w]  # noqa: E741 - the sixteen entries, a to p
        n, o, p, q = m[at + 3, at, w], m[at + 3, at + 1, w], m[at + 3, at + 2, w], m[at + 3, at + 3, w]
        u01, u02, u03 = a * f - b * e, a * g - c * e, a * h - d * e
        u12, u13, u23 = b * g - c * f, b * h - d * f, c * h - d * g
        v01, v02, v03 = i * o - j * n, i * p - k * n, i * q - l * n
        v12, v13, v23 = j * p - k * o, j * q - l * o, k * q - l * p
        det[w] = u01 * v23 - u02 * v13 + u03 * v12 + u12 * v03 - u13 * v02 + u23 * v01
        out[at, at, w] = f * v23 - g * v13 + h * v12
        out[at, at + 1, w] = -(b * v23 - c * v13 + d * v12)
        out[at, at + 2, w] = o * u23 - p * u13 + q * u12
        out[at, at + 3, w] = -(j * u23 - k * u13 + l * u12)
        out[at + 1, at, w] = -(e * v23 - g * v03 + h * v02)
        out[at + 1, at + 1, w] = a * v23 - c * v03 + d * v02
        out[at + 1, at + 2, w] = -(n * u23 - p * u03 + q * u02)
        out[at + 1, at + 3, w] = i * u23 - k * u03 + l * u02
        out[at + 2, at, w] = e * v13 - f * v03 + h * v01
        out[at + 2, at + 1, w] = -(a * v13 - b * v03 + d * v01)
        out[at + 2, at + 2, w] = n * u13 - o * u03 + q * u01
        out[at + 2, at + 3, w] = -(i * u13 - j * u03 + l * u01)
        out[at + 3, at, w] = -(e * v12 - f * v02 + g * v01)
        out[at + 3, at + 1, w] = a * v12 - b * v02 + c * v01
        out[at + 3, at + 2, w] = -(n * u12 - o * u02 + p * u01)
        out[at + 3, at + 3, w] = i * u12 - j * u02 + k * u01


@arithmetic_kernel
def _closed(m, out, at, n, det, moved, min_det, guard):
    """Inverts the diagonal n x n blocks, n <= 4, that start at row and column `at`, in closed form."""
    if n == 1:
        _closed1(m, out, at, det)
    elif n == 2:
        _closed2(m, out, at, det)
    elif n == 3:
        _closed3(m, out, at, det)
    else:
        _closed4(m, out, at, det)
    _guard_row(det, moved, min_det, guard)
    for i in range(at, at + n):
        for j in range(at, at + n):
            for w in range(TILE):
                out[i, j, w] *= det[w]


@arithmetic_kernel
def _add_product(a, a_at, b, b_at, sign, out, out_at, shape):
    """Adds sign * a b to `out`, for blocks that start at the entries given: shape (p,r,q) for p x r times r x q.

    Offsets, not slices: a sliced tile has an unknown stride, and its loops no longer vectorize.
    """
    for i in range(shape[0]):
        for j in range(shape[2]):
            for k in range(shape[1]):
                ai, ak, bk, bj = a_at[0] + i, a_at[1] + k, b_at[0] + k, b_at[1] + j
                oi, oj = out_at[0] + i, out_at[1] + j
                for w in range(TILE):
                    out[oi, oj, w] += sign * a[ai, ak, w] * b[bk, bj, w]


@arithmetic_kernel
def _invert(m, out, left, right, det, moved, min_det, guard):
    """Inverts a tile (n,n,W), n <= 8, which is overwritten; left (q,p,W) and right (p,q,W) are scratch.

    The leading p x p block A in closed form; where q = n - p rows are left, the others by its Schur complement. det (2,W):
    one over the two blocks' guarded determinants.
    """
    p, q = right.shape[0], left.shape[0]
    plus, minus = m.dtype.type(1), m.dtype.type(-1)
    zero = p - p  # a literal 0 would compile every callee once more
    a, b, c, d = (zero, zero), (zero, p), (p, zero), (p, p)
    out[:] = 0
    for at, size in ((zero, p), (p, q)):
        if size == 0:
            break
        _closed(m, out, at, size, det[0 if at == 0 else 1], moved, min_det, guard)
        if at == 0 and q > 0:
            left[:] = 0
            right[:] = 0
            _add_product(m, c, out, a, plus, left, a, (q, p, p))
            _add_product(out, a, m, b, plus, right, a, (p, p, q))
            _add_product(left, a, m, b, minus, m, d, (q, p, q))
    if q > 0:
        _add_product(right, a, out, d, minus, out, b, (p, q, q))
        _add_product(out, d, left, a, minus, out, c, (q, q, p))
        _add_product(out, b, left, a, minus, out, a, (p, q, p))


@arithmetic_kernel
def _workspace(n, like):
    """Returns what `_invert` works on, of the type of an array: tile and out (n,n,W), left, right, det, and moved (W)."""
    half = n if n <= 4 else (n + 1) // 2
    tile, out = np.empty((n, n, TILE), like.dtype), np.empty((n, n, TILE), like.dtype)
    left, right = np.empty((n - half, half, TILE), like.dtype), np.empty((half, n - half, TILE), like.dtype)
    return tile, out, left, right, np.empty((2, TILE), like.dtype), np.empty(TILE, np.bool_)


@arithmetic_kernel
def _load_planes(moments, places, first, size, groups, tile, right, ridge):
    """Loads a tile (n,n,W) of normal matrices and one (n,W) of right sides of fits first..first+size-1, centroid by centroid.

    The identity stands behind them. places (n,n+1): which of a fit's entries; ridge: the share of the mean diagonal added to
    it.
    """
    n = tile.shape[0]
    entries = places[n - 1, n] + 1
    for w in range(size):
        base = (first + w) // groups * entries * groups + (first + w) % groups
        mean = tile.dtype.type(0)
        for i in range(n):
            for j in range(n):
                tile[i, j, w] = moments[base + places[i, j] * groups]
            right[i, w] = moments[base + places[i, n] * groups]
            mean += tile[i, i, w]
        if ridge > 0:
            for i in range(n):
                tile[i, i, w] += ridge * (mean / n) + tile.dtype.type(1e-9)
    for w in range(size, TILE):
        for i in range(n):
            right[i, w] = 0
            for j in range(n):
                tile[i, j, w] = 1 if i == j else 0


@arithmetic_kernel
def _eliminate(m, sides):
    """Solves m x = y for a tile (n,n,W) of symmetric positive definite matrices and sides (s,n,W), which x overwrites.

    Without pivoting, which such matrices don't need. What a ridge makes of a rank-deficient matrix has a determinant far
    below float32's rounding of its terms, so no adjugate of it is right; each pivot of this is at least the ridge.
    """
    n = m.shape[0]
    for k in range(n):
        for w in range(TILE):
            m[k, k, w] = 1 / m[k, k, w]
        for i in range(k + 1, n):
            for w in range(TILE):
                m[i, k, w] = m[k, i, w] * m[k, k, w]
            for j in range(i, n):
                for w in range(TILE):
                    m[i, j, w] -= m[i, k, w] * m[k, j, w]
            for s in range(sides.shape[0]):
                for w in range(TILE):
                    sides[s, i, w] -= m[i, k, w] * sides[s, k, w]
    for s in range(sides.shape[0]):
        for back in range(n):
            k = n - 1 - back
            for j in range(k + 1, n):
                for w in range(TILE):
                    sides[s, k, w] -= m[k, j, w] * sides[s, j, w]
            for w in range(TILE):
                sides[s, k, w] *= m[k, k, w]


@arithmetic_kernel
def solve_planes(moments, places, groups, ridge, min_det, guard, planes):
    """Computes coefficients of fits from their moments (centroids*entries*groups), flat, in the order of `surface_fit`.

    planes (centroids*n*groups) solve the normal equations, n <= 8; with a ridge by elimination, else by the guarded inverse.
    """
    n = places.shape[0]
    tile, out, left, right, det, acted = _workspace(n, moments)
    sides = np.empty((1, n, TILE), np.float32)
    side, solved, count = sides[0], np.empty((n, TILE), np.float32), planes.size // n
    for low in range(0, count, TILE):
        size = min(TILE, count - low)
        _load_planes(moments, places, low, size, groups, tile, side, np.float32(ridge))
        if ridge > 0:
            _eliminate(tile, sides)
            solved = side
        else:
            acted[:] = False
            _invert(tile, out, left, right, det, acted, np.float32(min_det), guard)
            solved[:] = 0
            for i in range(n):
                for j in range(n):
                    for w in range(TILE):
                        solved[i, w] += out[i, j, w] * side[j, w]
        for i in range(n):
            for w in range(size):
                planes[((low + w) // groups * n + i) * groups + (low + w) % groups] = solved[i, w]


@arithmetic_kernel
def solve_planes_back(moments, places, groups, ridge, min_det, guard, grad, grad_matrix, grad_right, moved):
    """Computes the gradient of `solve_planes`: grad (centroids*n*groups) at the planes -> grad_matrix, grad_right.

    grad_matrix (centroids*n*n*groups) is G + G', grad_right (centroids*n*groups). moved (centroids*groups): the fits whose
    determinant the guard moved, and on whose plane something depends; their grad_matrix is the caller's to correct
    (`ops.small_inverses.correct_guarded_gradients`).
    """
    n = places.shape[0]
    tile, out, left, right, det, acted = _workspace(n, moments)
    side = np.empty((n, TILE), np.float32)
    given, both_sides = np.empty((n, TILE), np.float32), np.empty((2, n, TILE), np.float32)
    x, u, count = both_sides[0], both_sides[1], grad.size // n
    for low in range(0, count, TILE):
        size = min(TILE, count - low)
        _load_planes(moments, places, low, size, groups, tile, side, np.float32(ridge))
        for i in range(n):
            given[i] = 0
            for w in range(size):
                given[i, w] = grad[((low + w) // groups * n + i) * groups + (low + w) % groups]
        acted[:] = False
        if ridge > 0:
            for i in range(n):
                for w in range(TILE):
                    x[i, w], u[i, w] = side[i, w], given[i, w]
            _eliminate(tile, both_sides)
        else:
            _invert(tile, out, left, right, det, acted, np.float32(min_det), guard)
            x[:] = 0
            u[:] = 0
            for i in range(n):
                for j in range(n):
                    for w in range(TILE):
                        x[i, w] += out[i, j, w] * side[j, w]
                        u[i, w] += out[j, i, w] * given[j, w]
        for w in range(size):
            p, k = (low + w) // groups, (low + w) % groups
            trace, asked = np.float32(0), False
            for i in range(n):
                grad_right[(p * n + i) * groups + k] = u[i, w]
                trace -= u[i, w] * x[i, w]
                asked |= given[i, w] != 0
            moved[low + w] = acted[w] and asked  # a plane that nothing depends on is often a dead feature's
            for i in range(n):
                for j in range(n):
                    value = -(u[i, w] * x[j, w] + u[j, w] * x[i, w])
                    if i == j:
                        value += np.float32(2 * ridge / n) * trace
                    grad_matrix[((p * n + i) * n + j) * groups + k] = value
