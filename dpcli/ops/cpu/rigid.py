"""CPU kernels of `rigid`, for float32 without gradient: the weighted Kabsch fit, and points moved by blended motions."""

from __future__ import annotations

import math

import numpy as np

from dpcli.ops.cpu.jit import arithmetic_kernel

_EMPTY, _TOWARD_IDENTITY = 1e-12, 1e-6  # as in `rigid`
_ROUNDING = 4 * 2.0**-23  # float32's, whatever the sums are made in: the points themselves are rounded to it
_SWEEPS = 12  # of Jacobi rotations at most; six are the rule


@arithmetic_kernel
def _turn_columns(m, v, p, q):
    """Makes columns p and q of m (3,3) orthogonal, the longer one first, by a rotation that v (3,3) takes part in.

    Returns whether there was anything to do.
    """
    a = m[0, p] * m[0, p] + m[1, p] * m[1, p] + m[2, p] * m[2, p]
    b = m[0, q] * m[0, q] + m[1, q] * m[1, q] + m[2, q] * m[2, q]
    c = m[0, p] * m[0, q] + m[1, p] * m[1, q] + m[2, p] * m[2, q]
    if abs(c) <= 1e-15 * math.sqrt(a * b) and a >= b:
        return False
    half = 0.5 * math.atan2(2 * c, a - b)
    cosine, sine = math.cos(half), math.sin(half)
    for i in range(3):
        x, y = m[i, p], m[i, q]
        m[i, p], m[i, q] = cosine * x + sine * y, cosine * y - sine * x
        x, y = v[i, p], v[i, q]
        v[i, p], v[i, q] = cosine * x + sine * y, cosine * y - sine * x
    return True


@arithmetic_kernel
def _unit_columns(m):
    """Makes columns 0 and 1 of m (3,3) orthonormal, and column 2 their cross product; returns False if one is zero."""
    for k in range(2):
        if k == 1:
            dot = m[0, 0] * m[0, 1] + m[1, 0] * m[1, 1] + m[2, 0] * m[2, 1]
            for i in range(3):
                m[i, 1] -= dot * m[i, 0]
        length = math.sqrt(m[0, k] * m[0, k] + m[1, k] * m[1, k] + m[2, k] * m[2, k])
        if length < 1e-100:
            return False
        for i in range(3):
            m[i, k] /= length
    m[0, 2] = m[1, 0] * m[2, 1] - m[2, 0] * m[1, 1]
    m[1, 2] = m[2, 0] * m[0, 1] - m[0, 0] * m[2, 1]
    m[2, 2] = m[0, 0] * m[1, 1] - m[1, 0] * m[0, 1]
    return True


@arithmetic_kernel
def _nearest_rotation(m, v, out):
    """Writes to out (3,3) the rotation nearest to m (3,3), by one-sided Jacobi (Hestenes 1958); m and v (3,3) are overwritten.

    Of a matrix of rank one or less, which leaves a turn open, nothing is written. Else m v = u diag(s) with s descending;
    with cross products as third columns, u and v have determinant +1, so that no sign has to be looked at.
    """
    for i in range(3):
        for j in range(3):
            v[i, j] = 1.0 if i == j else 0.0
    for _ in range(_SWEEPS):
        turned = _turn_columns(m, v, 0, 1)
        turned = _turn_columns(m, v, 0, 2) or turned
        turned = _turn_columns(m, v, 1, 2) or turned
        if not turned:
            break
    if not (_unit_columns(m) and _unit_columns(v)):
        return
    for i in range(3):
        for j in range(3):
            out[i, j] = m[i, 0] * v[j, 0] + m[i, 1] * v[j, 1] + m[i, 2] * v[j, 2]


@arithmetic_kernel
def kabsch_kernel(source, target, weights, rotation, translation, first, last):
    """Computes `weighted_kabsch` of source, target (B,N,3), weights (B,N,S) for slots first..last of B * S; sums in float64."""
    count, slots = source.shape[1], weights.shape[2]
    m, v = np.empty((3, 3)), np.empty((3, 3))
    for row in range(first, last):
        b, s = row // slots, row % slots
        rotation[b, s] = 0
        for i in range(3):
            rotation[b, s, i, i], translation[b, s, i] = 1, 0
        total = x0 = x1 = x2 = y0 = y1 = y2 = 0.0
        for n in range(count):
            w = np.float64(weights[b, n, s])
            total += w
            x0, x1, x2 = x0 + w * source[b, n, 0], x1 + w * source[b, n, 1], x2 + w * source[b, n, 2]
            y0, y1, y2 = y0 + w * target[b, n, 0], y1 + w * target[b, n, 1], y2 + w * target[b, n, 2]
        if not _EMPTY <= total < math.inf:
            continue
        x0, x1, x2, y0, y1, y2 = x0 / total, x1 / total, x2 / total, y0 / total, y1 / total, y2 / total
        m00 = m01 = m02 = m10 = m11 = m12 = m20 = m21 = m22 = xx = yy = 0.0
        for n in range(count):
            w = weights[b, n, s] / total
            a0, a1, a2 = source[b, n, 0] - x0, source[b, n, 1] - x1, source[b, n, 2] - x2
            b0, b1, b2 = target[b, n, 0] - y0, target[b, n, 1] - y1, target[b, n, 2] - y2
            xx += w * (a0 * a0 + a1 * a1 + a2 * a2)
            yy += w * (b0 * b0 + b1 * b1 + b2 * b2)
            a0, a1, a2 = w * a0, w * a1, w * a2
            m00, m01, m02 = m00 + b0 * a0, m01 + b0 * a1, m02 + b0 * a2
            m10, m11, m12 = m10 + b1 * a0, m11 + b1 * a1, m12 + b1 * a2
            m20, m21, m22 = m20 + b2 * a0, m21 + b2 * a1, m22 + b2 * a2
        norm = m00 * m00 + m01 * m01 + m02 * m02 + m10 * m10 + m11 * m11 + m12 * m12
        norm = math.sqrt(norm + m20 * m20 + m21 * m21 + m22 * m22)
        if not norm < math.inf:
            continue
        if norm > 0:
            noise = math.sqrt((x0 * x0 + x1 * x1 + x2 * x2) * yy) + math.sqrt((y0 * y0 + y1 * y1 + y2 * y2) * xx)
            pull = min(_ROUNDING * noise / norm, 1e6) + _TOWARD_IDENTITY
            m[0, 0], m[0, 1], m[0, 2] = m00 / norm + pull, m01 / norm, m02 / norm
            m[1, 0], m[1, 1], m[1, 2] = m10 / norm, m11 / norm + pull, m12 / norm
            m[2, 0], m[2, 1], m[2, 2] = m20 / norm, m21 / norm, m22 / norm + pull
            _nearest_rotation(m, v, rotation[b, s])
        r = rotation[b, s]
        translation[b, s, 0] = y0 - (r[0, 0] * x0 + r[0, 1] * x1 + r[0, 2] * x2)
        translation[b, s, 1] = y1 - (r[1, 0] * x0 + r[1, 1] * x1 + r[1, 2] * x2)
        translation[b, s, 2] = y2 - (r[2, 0] * x0 + r[2, 1] * x1 + r[2, 2] * x2)


@arithmetic_kernel
def flow_kernel(points, mask, rotation, translation, out, first, last):
    """Computes `rigid_flow` of points (B,N,3), mask (B,N,S) for points first..last of the B * N."""
    count, slots = points.shape[1], mask.shape[2]
    for row in range(first, last):
        b, n = row // count, row % count
        x, y, z = points[b, n, 0], points[b, n, 1], points[b, n, 2]
        a0 = a1 = a2 = np.float32(0)
        for s in range(slots):
            w, r, t = mask[b, n, s], rotation[b, s], translation[b, s]
            a0 += w * (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0])
            a1 += w * (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1])
            a2 += w * (r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2])
        out[b, n, 0], out[b, n, 1], out[b, n, 2] = a0 - x, a1 - y, a2 - z
