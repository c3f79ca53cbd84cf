"""CPU kernels of `splatting`: projecting Gaussians, forward and backward. The steps are `splatting_torch.project_torch`'s.

Arithmetic is float64 in registers, arrays are C-contiguous float32. What serves all cameras has 1 in place of C. With
U = J W R (2,3) the 2D covariance is U S S U^T + eps2d I; the backward pass recomputes U from the inputs.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from dpcli.ops.jit import arithmetic_kernel, parallel_kernel

_BLOCK = 64  # Gaussians that share scratch memory


@arithmetic_kernel
def _geometry(mean, quat, view, K, width, height, camera, jacobian, rotation, turned):
    """Fill camera (3), jacobian (6: fx/z, -fx tx/z^2, fy/z, -fy ty/z^2, and 1 where tx, ty is not clamped), R (3,3), U (2,3)."""
    for i in range(3):
        camera[i] = view[i, 0] * mean[0] + view[i, 1] * mean[1] + view[i, 2] * mean[2] + view[i, 3]
    x, y, z = camera[0], camera[1], camera[2]
    fx, fy, cx, cy = np.float64(K[0, 0]), np.float64(K[1, 1]), np.float64(K[0, 2]), np.float64(K[1, 2])
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    tx = min(max(x / z, -cx / fx - margin_x), (width - cx) / fx + margin_x)
    ty = min(max(y / z, -cy / fy - margin_y), (height - cy) / fy + margin_y)
    jacobian[0], jacobian[1], jacobian[2], jacobian[3] = fx / z, -fx * tx / z, fy / z, -fy * ty / z
    jacobian[4], jacobian[5] = (1.0 if tx == x / z else 0.0), (1.0 if ty == y / z else 0.0)
    length = np.sqrt(
        np.float64(quat[0]) ** 2 + np.float64(quat[1]) ** 2 + np.float64(quat[2]) ** 2 + np.float64(quat[3]) ** 2
    )
    length = max(length, 1e-12)
    w, a, b, c = quat[0] / length, quat[1] / length, quat[2] / length, quat[3] / length
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = 1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = 2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = 2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)
    for j in range(3):
        seen_x = view[0, 0] * rotation[0, j] + view[0, 1] * rotation[1, j] + view[0, 2] * rotation[2, j]
        seen_y = view[1, 0] * rotation[0, j] + view[1, 1] * rotation[1, j] + view[1, 2] * rotation[2, j]
        seen_z = view[2, 0] * rotation[0, j] + view[2, 1] * rotation[1, j] + view[2, 2] * rotation[2, j]
        turned[0, j] = jacobian[0] * seen_x + jacobian[1] * seen_z
        turned[1, j] = jacobian[2] * seen_y + jacobian[3] * seen_z


@arithmetic_kernel
def _add_quat(quat, g, to_unit, to_quat):
    """Add the gradient g (3,3) of the rotation to to_quat (4): through the unit quaternion (to_unit: scratch), then its length."""
    length = np.sqrt(
        np.float64(quat[0]) ** 2 + np.float64(quat[1]) ** 2 + np.float64(quat[2]) ** 2 + np.float64(quat[3]) ** 2
    )
    length = max(length, 1e-12)
    w, x, y, z = quat[0] / length, quat[1] / length, quat[2] / length, quat[3] / length
    to_unit[0] = x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1])
    to_unit[1] = (
        y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) + w * (g[2, 1] - g[1, 2]) - 2 * x * (g[1, 1] + g[2, 2])
    )
    to_unit[2] = (
        x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) + w * (g[0, 2] - g[2, 0]) - 2 * y * (g[0, 0] + g[2, 2])
    )
    to_unit[3] = (
        x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) + w * (g[1, 0] - g[0, 1]) - 2 * z * (g[0, 0] + g[1, 1])
    )
    along = w * to_unit[0] + x * to_unit[1] + y * to_unit[2] + z * to_unit[3]
    to_quat[0] += 2 * (to_unit[0] - along * w) / length
    to_quat[1] += 2 * (to_unit[1] - along * x) / length
    to_quat[2] += 2 * (to_unit[2] - along * y) / length
    to_quat[3] += 2 * (to_unit[3] - along * z) / length


@parallel_kernel
def project(
    means, quats, scales, opacities, views, Ks, width, height, near, far, clip, eps, means2d, conics, depths, radii
):
    """Write means2d (C,N,2), conics (C,N,3), depths (C,N) and radii (C,N,2) i32.

    means (1 or C,N,3), quats (.,N,4), scales (.,N,3), opacities (.,N); views (C,4,4) and Ks (C,3,3) f64.
    """
    cameras, count = depths.shape
    for block in prange((count + _BLOCK - 1) // _BLOCK):
        camera, jacobian, rotation, turned = np.empty(3), np.empty(6), np.empty((3, 3)), np.empty((2, 3))
        for n in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            for c in range(cameras):
                m, q = (c if means.shape[0] > 1 else 0), (c if quats.shape[0] > 1 else 0)
                s, o = (c if scales.shape[0] > 1 else 0), (c if opacities.shape[0] > 1 else 0)
                _geometry(means[m, n], quats[q, n], views[c], Ks[c], width, height, camera, jacobian, rotation, turned)
                z = camera[2]
                depths[c, n] = z
                means2d[c, n, 0], means2d[c, n, 1] = Ks[c, 0, 2], Ks[c, 1, 2]
                conics[c, n], radii[c, n] = 0, 0
                if not near <= z <= far:
                    continue
                u, v = Ks[c, 0, 0] * camera[0] / z + Ks[c, 0, 2], Ks[c, 1, 1] * camera[1] / z + Ks[c, 1, 2]
                means2d[c, n, 0], means2d[c, n, 1] = u, v
                xx, xy, yy = eps, 0.0, eps
                for j in range(3):
                    variance = np.float64(scales[s, n, j]) ** 2
                    xx += turned[0, j] * turned[0, j] * variance
                    xy += turned[0, j] * turned[1, j] * variance
                    yy += turned[1, j] * turned[1, j] * variance
                det, opacity = xx * yy - xy * xy, np.float64(opacities[o, n])
                if not (det > 0 and det < 1e300 and opacities[o, n] >= np.float32(1 / 255)):
                    continue
                conics[c, n, 0], conics[c, n, 1], conics[c, n, 2] = yy / det, -xy / det, xx / det
                extent = min(3.33, np.sqrt(2 * np.log(max(255 * opacity, 1.0))))
                across, down = np.ceil(extent * np.sqrt(xx)), np.ceil(extent * np.sqrt(yy))
                inside = u + across > 0 and u - across < width and v + down > 0 and v - down < height
                if inside and (across > clip or down > clip):
                    radii[c, n, 0], radii[c, n, 1] = min(across, 2.0**30), min(down, 2.0**30)


@parallel_kernel
def project_backward(
    means, quats, scales, views, Ks, width, height, conics, radii, to_means2d, to_conics, to_depths, to_means, to_quats, to_scales
):  # fmt: skip
    """Add to to_means, to_quats, to_scales (as the inputs, zero) what comes through means2d, conics and depths."""
    cameras, count = to_depths.shape
    for block in prange((count + _BLOCK - 1) // _BLOCK):
        camera, jacobian, rotation, turned = np.empty(3), np.empty(6), np.empty((3, 3)), np.empty((2, 3))
        to_turned, to_rotation, to_camera, to_quat = np.empty((2, 3)), np.empty((3, 3)), np.empty(3), np.empty(4)
        for n in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            for c in range(cameras):
                if radii[c, n, 0] <= 0:
                    continue
                m, q = (c if means.shape[0] > 1 else 0), (c if quats.shape[0] > 1 else 0)
                s = c if scales.shape[0] > 1 else 0
                view, mean, quat = views[c], means[m, n], quats[q, n]
                _geometry(mean, quat, view, Ks[c], width, height, camera, jacobian, rotation, turned)
                xx, xy, yy = np.float64(conics[c, n, 0]), np.float64(conics[c, n, 1]), np.float64(conics[c, n, 2])
                a, b, d = np.float64(to_conics[c, n, 0]), 0.5 * to_conics[c, n, 1], np.float64(to_conics[c, n, 2])
                # the covariance's gradient -K G K, with K the conic and G its gradient as a symmetric matrix
                to_xx = -(a * xx * xx + 2 * b * xx * xy + d * xy * xy)
                to_xy = -(a * xx * xy + b * (xx * yy + xy * xy) + d * xy * yy)
                to_yy = -(a * xy * xy + 2 * b * xy * yy + d * yy * yy)
                for j in range(3):
                    scale = np.float64(scales[s, n, j])
                    across = 2 * (to_xx * turned[0, j] + to_xy * turned[1, j]) * scale
                    down = 2 * (to_xy * turned[0, j] + to_yy * turned[1, j]) * scale
                    to_scales[s, n, j] += across * turned[0, j] + down * turned[1, j]
                    to_turned[0, j], to_turned[1, j] = across * scale, down * scale
                j00 = j02 = j11 = j12 = 0.0
                for i in range(3):
                    across = jacobian[0] * view[0, i] + jacobian[1] * view[2, i]
                    down = jacobian[2] * view[1, i] + jacobian[3] * view[2, i]
                    to_across = to_down = 0.0
                    for j in range(3):
                        to_rotation[i, j] = across * to_turned[0, j] + down * to_turned[1, j]
                        to_across += to_turned[0, j] * rotation[i, j]
                        to_down += to_turned[1, j] * rotation[i, j]
                    j00, j02 = j00 + to_across * view[0, i], j02 + to_across * view[2, i]
                    j11, j12 = j11 + to_down * view[1, i], j12 + to_down * view[2, i]
                _add_quat(quat, to_rotation, to_quat, to_quats[q, n])
                fx, fy, z = Ks[c, 0, 0], Ks[c, 1, 1], camera[2]
                u, v = np.float64(to_means2d[c, n, 0]), np.float64(to_means2d[c, n, 1])
                to_camera[0] = fx / z * (u - jacobian[4] * j02 / z)
                to_camera[1] = fy / z * (v - jacobian[5] * j12 / z)
                to_camera[2] = to_depths[c, n] - (fx * camera[0] * u + fy * camera[1] * v) / z**2
                to_camera[2] -= (fx * j00 + fy * j11 + (1 + jacobian[4]) * jacobian[1] * j02 * z) / z**2
                to_camera[2] -= (1 + jacobian[5]) * jacobian[3] * j12 / z
                for i in range(3):
                    to_means[m, n, i] += (
                        view[0, i] * to_camera[0] + view[1, i] * to_camera[1] + view[2, i] * to_camera[2]
                    )
