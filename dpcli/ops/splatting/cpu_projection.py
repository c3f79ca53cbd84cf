"""CPU kernels of `splatting`: projecting Gaussians, forward and backward. The steps are `torch_reference.project_torch`'s.

Arithmetic is float64 in registers, arrays are C-contiguous float32. What serves all cameras has 1 in place of C. With
U = J W R (2,3) the 2D covariance is U S S U^T + eps2d I; the backward pass recomputes U from the inputs.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from dpcli.ops.cpu.jit import arithmetic_kernel, parallel_kernel

_BLOCK = 128  # Gaussians a thread takes at once


@arithmetic_kernel
def _lens(view, K, width, height):
    """Returns (fx, fy, cx, cy), the least and largest x/z and y/z of the Jacobian, and the rows of W."""
    fx, fy, cx, cy = np.float64(K[0, 0]), np.float64(K[1, 1]), np.float64(K[0, 2]), np.float64(K[1, 2])
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    limits = -cx / fx - margin_x, (width - cx) / fx + margin_x, -cy / fy - margin_y, (height - cy) / fy + margin_y
    rows = view[0, 0], view[0, 1], view[0, 2], view[1, 0], view[1, 1], view[1, 2], view[2, 0], view[2, 1], view[2, 2]
    return (fx, fy, cx, cy), limits, rows


@arithmetic_kernel
def _camera(mean, view):
    m0, m1, m2 = np.float64(mean[0]), np.float64(mean[1]), np.float64(mean[2])
    x = view[0, 0] * m0 + view[0, 1] * m1 + view[0, 2] * m2 + view[0, 3]
    y = view[1, 0] * m0 + view[1, 1] * m1 + view[1, 2] * m2 + view[1, 3]
    z = view[2, 0] * m0 + view[2, 1] * m1 + view[2, 2] * m2 + view[2, 3]
    return x, y, z


@arithmetic_kernel
def _unit(quat):
    """Returns the unit quaternion and 1 / length."""
    w, x, y, z = np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])
    shrink = 1 / max(np.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    return w * shrink, x * shrink, y * shrink, z * shrink, shrink


@arithmetic_kernel
def _rotation(w, a, b, c):
    return (
        1 - 2 * (b * b + c * c),
        2 * (a * b - w * c),
        2 * (a * c + w * b),
        2 * (a * b + w * c),
        1 - 2 * (a * a + c * c),
        2 * (b * c - w * a),
        2 * (a * c - w * b),
        2 * (b * c + w * a),
        1 - 2 * (a * a + b * b),
    )


@arithmetic_kernel
def _jacobian(x, y, nearness, lens, limits):
    """Returns fx/z, -fx tx/z^2, fy/z, -fy ty/z^2, and 1 where tx, ty is not clamped; nearness is 1/z."""
    u, v = x * nearness, y * nearness
    tx, ty = min(max(u, limits[0]), limits[1]), min(max(v, limits[2]), limits[3])
    across, down = lens[0] * nearness, lens[1] * nearness
    return across, -across * tx, down, -down * ty, (1.0 if tx == u else 0.0), (1.0 if ty == v else 0.0)


@arithmetic_kernel
def _rows(jacobian, w):
    """Returns J W (2,3) as six numbers."""
    a, b, c, d = jacobian[0], jacobian[1], jacobian[2], jacobian[3]
    return (
        a * w[0] + b * w[6],
        a * w[1] + b * w[7],
        a * w[2] + b * w[8],
        c * w[3] + d * w[6],
        c * w[4] + d * w[7],
        c * w[5] + d * w[8],
    )


@arithmetic_kernel
def _turned(p, r):
    """Returns U = (J W) R (2,3) as six numbers."""
    return (
        p[0] * r[0] + p[1] * r[3] + p[2] * r[6],
        p[0] * r[1] + p[1] * r[4] + p[2] * r[7],
        p[0] * r[2] + p[1] * r[5] + p[2] * r[8],
        p[3] * r[0] + p[4] * r[3] + p[5] * r[6],
        p[3] * r[1] + p[4] * r[4] + p[5] * r[7],
        p[3] * r[2] + p[4] * r[5] + p[5] * r[8],
    )


@arithmetic_kernel
def _add_quat(w, x, y, z, shrink, g, to_quat):
    """Adds the gradient g (3,3 as nine numbers) of the rotation to to_quat (4), through the unit quaternion and its length."""
    to_w = 2 * (x * (g[7] - g[5]) + y * (g[2] - g[6]) + z * (g[3] - g[1]))
    to_x = 2 * (y * (g[1] + g[3]) + z * (g[2] + g[6]) + w * (g[7] - g[5]) - 2 * x * (g[4] + g[8]))
    to_y = 2 * (x * (g[1] + g[3]) + z * (g[5] + g[7]) + w * (g[2] - g[6]) - 2 * y * (g[0] + g[8]))
    to_z = 2 * (x * (g[2] + g[6]) + y * (g[5] + g[7]) + w * (g[3] - g[1]) - 2 * z * (g[0] + g[4]))
    along = w * to_w + x * to_x + y * to_y + z * to_z
    to_quat[0] += (to_w - along * w) * shrink
    to_quat[1] += (to_x - along * x) * shrink
    to_quat[2] += (to_y - along * y) * shrink
    to_quat[3] += (to_z - along * z) * shrink


@parallel_kernel
def project(
    means, quats, scales, opacities, views, Ks, width, height, near, far, clip, eps, means2d, conics, depths, radii
):
    """Writes means2d (C,N,2), conics (C,N,3), depths (C,N) and radii (C,N,2) i32.

    means (1 or C,N,3), quats (.,N,4), scales (.,N,3), opacities (.,N); views (C,4,4) and Ks (C,3,3) f64.
    """
    cameras, count = depths.shape
    for block in prange((count + _BLOCK - 1) // _BLOCK):
        for n in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            for c in range(cameras):
                m, q = (c if means.shape[0] > 1 else 0), (c if quats.shape[0] > 1 else 0)
                s, o = (c if scales.shape[0] > 1 else 0), (c if opacities.shape[0] > 1 else 0)
                lens, limits, rows = _lens(views[c], Ks[c], width, height)
                x, y, z = _camera(means[m, n], views[c])
                depths[c, n] = z
                means2d[c, n, 0], means2d[c, n, 1] = lens[2], lens[3]
                conics[c, n, 0] = conics[c, n, 1] = conics[c, n, 2] = 0
                radii[c, n, 0] = radii[c, n, 1] = 0
                if not near <= z <= far:
                    continue
                nearness = 1 / z
                u, v = lens[0] * x * nearness + lens[2], lens[1] * y * nearness + lens[3]
                means2d[c, n, 0], means2d[c, n, 1] = u, v
                unit = _unit(quats[q, n])
                turned = _turned(
                    _rows(_jacobian(x, y, nearness, lens, limits), rows), _rotation(unit[0], unit[1], unit[2], unit[3])
                )
                s0, s1, s2 = np.float64(scales[s, n, 0]), np.float64(scales[s, n, 1]), np.float64(scales[s, n, 2])
                a0, a1, a2 = turned[0] * s0, turned[1] * s1, turned[2] * s2
                b0, b1, b2 = turned[3] * s0, turned[4] * s1, turned[5] * s2
                xx, yy = eps + a0 * a0 + a1 * a1 + a2 * a2, eps + b0 * b0 + b1 * b1 + b2 * b2
                xy = a0 * b0 + a1 * b1 + a2 * b2
                det, opacity = xx * yy - xy * xy, np.float64(opacities[o, n])
                if not (det > 0 and det < 1e300 and opacities[o, n] >= np.float32(1 / 255)):
                    continue
                shrink = 1 / det
                conics[c, n, 0], conics[c, n, 1], conics[c, n, 2] = yy * shrink, -xy * shrink, xx * shrink
                extent = min(3.33, np.sqrt(2 * np.log(max(255 * opacity, 1.0))))
                across, down = np.ceil(extent * np.sqrt(xx)), np.ceil(extent * np.sqrt(yy))
                inside = u + across > 0 and u - across < width and v + down > 0 and v - down < height
                if inside and (across > clip or down > clip):
                    radii[c, n, 0], radii[c, n, 1] = min(across, 2.0**30), min(down, 2.0**30)


@parallel_kernel
def project_backward(
    means,
    quats,
    scales,
    views,
    Ks,
    width,
    height,
    conics,
    radii,
    to_means2d,
    to_conics,
    to_depths,
    to_means,
    to_quats,
    to_scales,
):
    """Adds to to_means, to_quats, to_scales (as the inputs, zero) what comes through means2d, conics and depths."""
    cameras, count = to_depths.shape
    for block in prange((count + _BLOCK - 1) // _BLOCK):
        for n in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            for c in range(cameras):
                if radii[c, n, 0] <= 0:
                    continue
                m, q = (c if means.shape[0] > 1 else 0), (c if quats.shape[0] > 1 else 0)
                s, to_scale = (c if scales.shape[0] > 1 else 0), to_scales[c if scales.shape[0] > 1 else 0, n]
                lens, limits, rows = _lens(views[c], Ks[c], width, height)
                x, y, z = _camera(means[m, n], views[c])
                nearness = 1 / z
                qw, qx, qy, qz, shrink = _unit(quats[q, n])
                rotation, jacobian = _rotation(qw, qx, qy, qz), _jacobian(x, y, nearness, lens, limits)
                seen = _rows(jacobian, rows)
                turned = _turned(seen, rotation)
                xx, xy, yy = np.float64(conics[c, n, 0]), np.float64(conics[c, n, 1]), np.float64(conics[c, n, 2])
                a, b, d = np.float64(to_conics[c, n, 0]), 0.5 * to_conics[c, n, 1], np.float64(to_conics[c, n, 2])
                # the covariance's gradient -K G K, with K the conic and G its gradient as a symmetric matrix; twice that
                left, right, low, high = a * xx + b * xy, b * xx + d * xy, a * xy + b * yy, b * xy + d * yy
                to_xx, to_xy, to_yy = (
                    -2 * (left * xx + right * xy),
                    -2 * (left * xy + right * yy),
                    -2 * (low * xy + high * yy),
                )
                s0, s1, s2 = np.float64(scales[s, n, 0]), np.float64(scales[s, n, 1]), np.float64(scales[s, n, 2])
                a0, b0 = (to_xx * turned[0] + to_xy * turned[3]) * s0, (to_xy * turned[0] + to_yy * turned[3]) * s0
                a1, b1 = (to_xx * turned[1] + to_xy * turned[4]) * s1, (to_xy * turned[1] + to_yy * turned[4]) * s1
                a2, b2 = (to_xx * turned[2] + to_xy * turned[5]) * s2, (to_xy * turned[2] + to_yy * turned[5]) * s2
                to_scale[0] += a0 * turned[0] + b0 * turned[3]
                to_scale[1] += a1 * turned[1] + b1 * turned[4]
                to_scale[2] += a2 * turned[2] + b2 * turned[5]
                a0, a1, a2, b0, b1, b2 = a0 * s0, a1 * s1, a2 * s2, b0 * s0, b1 * s1, b2 * s2  # of U
                to_rotation = (
                    seen[0] * a0 + seen[3] * b0,
                    seen[0] * a1 + seen[3] * b1,
                    seen[0] * a2 + seen[3] * b2,
                    seen[1] * a0 + seen[4] * b0,
                    seen[1] * a1 + seen[4] * b1,
                    seen[1] * a2 + seen[4] * b2,
                    seen[2] * a0 + seen[5] * b0,
                    seen[2] * a1 + seen[5] * b1,
                    seen[2] * a2 + seen[5] * b2,
                )
                _add_quat(qw, qx, qy, qz, shrink, to_rotation, to_quats[q, n])
                r = rotation
                g0, g1, g2 = (
                    a0 * r[0] + a1 * r[1] + a2 * r[2],
                    a0 * r[3] + a1 * r[4] + a2 * r[5],
                    a0 * r[6] + a1 * r[7] + a2 * r[8],
                )
                h0, h1, h2 = (
                    b0 * r[0] + b1 * r[1] + b2 * r[2],
                    b0 * r[3] + b1 * r[4] + b2 * r[5],
                    b0 * r[6] + b1 * r[7] + b2 * r[8],
                )
                j00, j02 = g0 * rows[0] + g1 * rows[1] + g2 * rows[2], g0 * rows[6] + g1 * rows[7] + g2 * rows[8]
                j11, j12 = h0 * rows[3] + h1 * rows[4] + h2 * rows[5], h0 * rows[6] + h1 * rows[7] + h2 * rows[8]
                across, down = lens[0] * nearness, lens[1] * nearness
                u, v = np.float64(to_means2d[c, n, 0]), np.float64(to_means2d[c, n, 1])
                to_x, to_y = across * (u - jacobian[4] * j02 * nearness), down * (v - jacobian[5] * j12 * nearness)
                to_z = to_depths[c, n] - (across * x * u + down * y * v + across * j00 + down * j11) * nearness
                to_z -= ((1 + jacobian[4]) * jacobian[1] * j02 + (1 + jacobian[5]) * jacobian[3] * j12) * nearness
                to_means[m, n, 0] += rows[0] * to_x + rows[3] * to_y + rows[6] * to_z
                to_means[m, n, 1] += rows[1] * to_x + rows[4] * to_y + rows[7] * to_z
                to_means[m, n, 2] += rows[2] * to_x + rows[5] * to_y + rows[8] * to_z
