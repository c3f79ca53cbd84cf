"""CPU kernels of the classical flow: nearest points through a grid filled on demand, and robust ICP steps."""

from __future__ import annotations

import math

import numpy as np

from dpcli.ops.jit import kernel

_BLOCK = 64
_FAR = np.float32(1e30)


@kernel
def nearest_point(x, y, z, cloud):
    """Index of and squared distance to the nearest column of cloud (3,M); the first of equals."""
    count, best, at, first = cloud.shape[1], _FAR, 0, 0
    while first < count:
        last, low = min(first + _BLOCK, count), _FAR
        for j in range(first, last):
            a, b, c = cloud[0, j] - x, cloud[1, j] - y, cloud[2, j] - z
            low = min(low, a * a + b * b + c * c)
        if low < best:
            best, at = low, first
        first = last
    for j in range(at, min(at + _BLOCK, count)):
        a, b, c = cloud[0, j] - x, cloud[1, j] - y, cloud[2, j] - z
        if a * a + b * b + c * c <= best:
            return j, best
    return at, best


@kernel
def _look_up(x, y, z, cloud, around, grid, origin, cells_per_unit):
    """As nearest_point, but only among the neighbours of the point nearest to the centre of the grid's cell."""
    i = min(max(int((x - origin[0]) * cells_per_unit), 0), grid.shape[0] - 1)
    j = min(max(int((y - origin[1]) * cells_per_unit), 0), grid.shape[1] - 1)
    k = min(max(int((z - origin[2]) * cells_per_unit), 0), grid.shape[2] - 1)
    start = grid[i, j, k]
    if start < 0:
        size = 1.0 / cells_per_unit
        cx, cy, cz = origin[0] + (i + 0.5) * size, origin[1] + (j + 0.5) * size, origin[2] + (k + 0.5) * size
        start, _ = nearest_point(np.float32(cx), np.float32(cy), np.float32(cz), cloud)
        grid[i, j, k] = start
    best, at = _FAR, start
    for t in range(around.shape[1]):
        m = around[start, t]
        a, b, c = cloud[0, m] - x, cloud[1, m] - y, cloud[2, m] - z
        squared = a * a + b * b + c * c
        if squared < best:
            best, at = squared, m
    return at, best


@kernel
def _solve(matrix, vector):
    """Cholesky solution of a 6x6 system, in place; reads the lower triangle."""
    for i in range(6):
        for j in range(i + 1):
            s = matrix[i, j]
            for k in range(j):
                s -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = math.sqrt(max(s, 1e-12)) if i == j else s / matrix[j, j]
    for i in range(6):
        for k in range(i):
            vector[i] -= matrix[i, k] * vector[k]
        vector[i] /= matrix[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            vector[i] -= matrix[k, i] * vector[k]
        vector[i] /= matrix[i, i]


@kernel
def _compose(motion, v, centre):
    """motion (3,4) in place: afterwards turn by the rotation vector v[:3] about centre and shift by v[3:]."""
    angle = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    a = math.sin(angle) / angle if angle > 1e-9 else 1.0
    b = (1 - math.cos(angle)) / (angle * angle) if angle > 1e-4 else 0.5
    for j in range(4):
        x, y, z = motion[0, j], motion[1, j], motion[2, j]
        if j == 3:
            x, y, z = x - centre[0], y - centre[1], z - centre[2]
        dot = v[0] * x + v[1] * y + v[2] * z
        c = math.cos(angle)
        motion[0, j] = c * x + a * (v[1] * z - v[2] * y) + b * dot * v[0]
        motion[1, j] = c * y + a * (v[2] * x - v[0] * z) + b * dot * v[1]
        motion[2, j] = c * z + a * (v[0] * y - v[1] * x) + b * dot * v[2]
        if j == 3:
            for i in range(3):
                motion[i, 3] += centre[i] + v[3 + i]


@kernel
def icp_kernel(source, cloud, normals, around, grid, origin, cells_per_unit, motion, steps, wide, narrow, share):
    """Gauss-Newton steps of robust ICP: motion (3,4) f64 in place, source (3,n) onto cloud (3,M).

    Each point's residual is its distance to the nearest point's plane plus `share` times the distance to the point
    itself (both squared), weighted by Geman and McClure's 1 / (1 + d^2/s^2)^2 with s falling from wide to narrow.
    """
    count = source.shape[1]
    matrix, vector, centre, row = np.empty((6, 6)), np.empty(6), np.empty(3), np.empty(6)
    moved = np.empty((3, count))
    for step in range(steps):
        scale = wide * (narrow / wide) ** (step / max(steps - 1, 1))
        matrix[:] = 0.0
        vector[:] = 0.0
        for k in range(3):
            centre[k] = 0.0
            for i in range(count):
                s = motion[k, 0] * source[0, i] + motion[k, 1] * source[1, i] + motion[k, 2] * source[2, i]
                moved[k, i] = s + motion[k, 3]
                centre[k] += moved[k, i]
            centre[k] /= count
        total = 1e-6
        for i in range(count):
            x, y, z = moved[0, i], moved[1, i], moved[2, i]
            j, squared = _look_up(
                np.float32(x), np.float32(y), np.float32(z), cloud, around, grid, origin, cells_per_unit
            )
            w = 1 / (1 + squared / (scale * scale)) ** 2
            total += w
            rx, ry, rz = cloud[0, j] - x, cloud[1, j] - y, cloud[2, j] - z
            nx, ny, nz = normals[0, j], normals[1, j], normals[2, j]
            x, y, z = x - centre[0], y - centre[1], z - centre[2]
            row[0], row[1], row[2] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
            row[3], row[4], row[5] = nx, ny, nz
            gap = nx * rx + ny * ry + nz * rz
            for a in range(6):
                vector[a] += w * row[a] * gap
                for b in range(a + 1):
                    matrix[a, b] += w * row[a] * row[b]
            w *= share
            matrix[0, 0] += w * (y * y + z * z)
            matrix[1, 1] += w * (x * x + z * z)
            matrix[2, 2] += w * (x * x + y * y)
            matrix[1, 0] -= w * x * y
            matrix[2, 0] -= w * x * z
            matrix[2, 1] -= w * y * z
            matrix[3, 1] += w * z
            matrix[3, 2] -= w * y
            matrix[4, 0] -= w * z
            matrix[4, 2] += w * x
            matrix[5, 0] += w * y
            matrix[5, 1] -= w * x
            vector[0] += w * (y * rz - z * ry)
            vector[1] += w * (z * rx - x * rz)
            vector[2] += w * (x * ry - y * rx)
            vector[3] += w * rx
            vector[4] += w * ry
            vector[5] += w * rz
            for a in range(3, 6):
                matrix[a, a] += w
        for a in range(6):  # keeps a line or a single point from turning freely
            matrix[a, a] += 1e-6 * total * (0.05 if a < 3 else 1.0)
        _solve(matrix, vector)
        _compose(motion, vector, centre)


@kernel
def residual_kernel(source, cloud, normals, around, grid, origin, cells_per_unit, motion, share, out):
    """Squared residuals (n) of source moved by motion: (1 - share) plane distance^2 + share point distance^2."""
    for i in range(source.shape[1]):
        x = motion[0, 0] * source[0, i] + motion[0, 1] * source[1, i] + motion[0, 2] * source[2, i] + motion[0, 3]
        y = motion[1, 0] * source[0, i] + motion[1, 1] * source[1, i] + motion[1, 2] * source[2, i] + motion[1, 3]
        z = motion[2, 0] * source[0, i] + motion[2, 1] * source[1, i] + motion[2, 2] * source[2, i] + motion[2, 3]
        j, squared = _look_up(np.float32(x), np.float32(y), np.float32(z), cloud, around, grid, origin, cells_per_unit)
        gap = (cloud[0, j] - x) * normals[0, j] + (cloud[1, j] - y) * normals[1, j] + (cloud[2, j] - z) * normals[2, j]
        out[i] = share * squared + (1 - share) * gap * gap


@kernel
def hypotheses_kernel(
    source, cloud, normals, around, grid, origin, cells_per_unit, motions, steps, wide, narrow, share, share_out, scale, out
):  # fmt: skip
    """ICP from every one of motions (H,3,4), in place; out (H): mean of d^2 / (d^2 + scale^2) afterwards."""
    squared = np.empty(source.shape[1])
    for h in range(len(motions)):
        icp_kernel(source, cloud, normals, around, grid, origin, cells_per_unit, motions[h], steps, wide, narrow, share)
        residual_kernel(source, cloud, normals, around, grid, origin, cells_per_unit, motions[h], share_out, squared)
        out[h] = 0.0
        for i in range(len(squared)):
            out[h] += squared[i] / (squared[i] + scale * scale)
        out[h] /= len(squared)


@kernel
def cover_kernel(moved, normals, queries, share, out):
    """Squared residuals (M) of queries (3,M) to the moved cloud (3,N), by exhaustion; as residual_kernel's."""
    for i in range(queries.shape[1]):
        x, y, z = queries[0, i], queries[1, i], queries[2, i]
        j, squared = nearest_point(x, y, z, moved)
        gap = (moved[0, j] - x) * normals[0, j] + (moved[1, j] - y) * normals[1, j] + (moved[2, j] - z) * normals[2, j]
        out[i] = share * squared + (1 - share) * gap * gap


@kernel
def assign_kernel(cost, neighbours, label, extra, border, rounds):
    """Labels (N) in place, all at once per round: the least of own and neighbours' mean cost (K,N), halved, plus `extra`
    for all bodies but the first, less twice the border's cost for every share of neighbours that agrees."""
    bodies, count = cost.shape
    near = neighbours.shape[1]
    unary = np.empty((count, bodies))
    for i in range(count):
        for k in range(bodies):
            total = 0.0
            for j in range(near):
                total += cost[k, neighbours[i, j]]
            unary[i, k] = 0.5 * cost[k, i] + 0.5 * total / near + (extra if k > 0 else 0.0)
    new, votes = np.empty_like(label), np.empty(bodies)
    for _ in range(rounds):
        changed = False
        for i in range(count):
            votes[:] = 0.0
            for j in range(near):
                votes[label[neighbours[i, j]]] += 1.0
            best = 0
            for k in range(1, bodies):
                if unary[i, k] - 2 * border * votes[k] / near < unary[i, best] - 2 * border * votes[best] / near:
                    best = k
            new[i] = best
            changed = changed or best != label[i]
        label[:] = new
        if not changed:
            break
