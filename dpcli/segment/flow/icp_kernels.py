"""CPU kernels of the search for rigid bodies: nearest points through a grid filled on demand, and robust ICP steps."""

from __future__ import annotations

import math

import numpy as np

from dpcli.ops.cpu.jit import inlined_piece, kernel
from dpcli.ops.cpu.simd import WIDTH, lanes, load, store

_BLOCK = 128  # distances whose least is found at once; the compiler vectorizes that for 128, not for 64
_WORST = np.int32(0x7FFFFFFF)
_FAR = np.float32(1e30)


@kernel
def nearest_point(x, y, z, cloud, squared, bits):
    """Returns the index of and squared distance to the nearest column of cloud (3,M); the first of equals.

    Scratch: squared f32 (M) and its bits, the same memory as i32. The bits of numbers that are not negative sort as
    they do, and the least of integers vectorizes: 4.5 times as fast as the least of floats.
    """
    count = np.uintp(cloud.shape[1])  # unsigned: numba then drops the negative-index case and the loop vectorizes
    for j in range(count):
        a, b, c = cloud[0, j] - x, cloud[1, j] - y, cloud[2, j] - z
        squared[j] = a * a + b * b + c * c
    size, best, at, first = np.uintp(_BLOCK), _WORST, np.uintp(0), np.uintp(0)
    whole = count // size * size
    while first < whole:
        low = _WORST
        for t in range(size):
            low = min(low, bits[first + t])
        if low < best:
            best, at = low, first
        first += size
    for j in range(whole, count):
        if bits[j] < best:
            best, at = bits[j], j
    for j in range(at, count):
        if bits[j] == best:
            return np.int64(j), squared[j]
    return np.int64(0), squared[0]


@kernel
def _look_up(points, search, work, bits, at, far):
    """Finds the nearest of cloud (3,M) for points f32 (3,n) through a grid: columns and squared distances.

    They go into at i64 (n) and far f32 (n). Only the neighbors of the point nearest to the center of each one's cell
    are tried. search: a prepared cloud, see `surface_icp.Surface`: cloud, normals f32 (3,M); the neighbors around (M,k)
    and their places near f32 (M,3,16), far away beyond the k; the grid, its origin and scale. Scratch: work f32, of at
    least M and 16 n, and its bits. In three passes, because a search point by point waits for memory each time.
    """
    cloud, _, around, near, grid, origin, cells_per_unit = search
    count, each, top, places = np.uintp(points.shape[1]), np.uintp(near.shape[2]), np.int32(0), near.reshape(-1)
    ends = np.int32(grid.shape[0] - 1), np.int32(grid.shape[1] - 1), np.int32(grid.shape[2] - 1)
    for n in range(count):
        i = min(max(np.int32((points[0, n] - origin[0]) * cells_per_unit), top), ends[0])
        j = min(max(np.int32((points[1, n] - origin[1]) * cells_per_unit), top), ends[1])
        k = min(max(np.int32((points[2, n] - origin[2]) * cells_per_unit), top), ends[2])
        start = grid[np.uintp(i), np.uintp(j), np.uintp(k)]
        if start < 0:
            size = 1.0 / cells_per_unit
            x, y, z = origin[0] + (i + 0.5) * size, origin[1] + (j + 0.5) * size, origin[2] + (k + 0.5) * size
            start, _ = nearest_point(np.float32(x), np.float32(y), np.float32(z), cloud, work, bits)
            grid[i, j, k] = start
        at[n] = start
    for n in range(count):
        row = np.uintp(3) * each * np.uintp(at[n])
        x, y, z = lanes(points[0, n]), lanes(points[1, n]), lanes(points[2, n])
        for t in range(np.uintp(0), each, np.uintp(WIDTH)):
            a, b, c = (
                load(places, row + t) - x,
                load(places, row + each + t) - y,
                load(places, row + each + each + t) - z,
            )
            store(work, n * each + t, a * a + b * b + c * c)
    for n in range(count):
        best = np.int64(0x7FFFFFFFFFFFFFFF)
        for t in range(np.uintp(around.shape[1])):
            best = min(best, (np.int64(bits[n * each + t]) << 32) | np.int64(t))  # sorts as (distance, t)
        t = np.uintp(best & 15)
        far[n] = work[n * each + t]
        at[n] = around[np.uintp(at[n]), t]


@kernel
def _solve(matrix, vector):
    """Solves a 6x6 system by Cholesky, in place; reads the lower triangle."""
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
def _compose(motion, v, center):
    """Lets motion (3,4), in place, also turn by the rotation vector v[:3] about center and shift by v[3:]."""
    angle = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    a = math.sin(angle) / angle if angle > 1e-9 else 1.0
    b = (1 - math.cos(angle)) / (angle * angle) if angle > 1e-4 else 0.5
    for j in range(4):
        x, y, z = motion[0, j], motion[1, j], motion[2, j]
        if j == 3:
            x, y, z = x - center[0], y - center[1], z - center[2]
        dot = v[0] * x + v[1] * y + v[2] * z
        c = math.cos(angle)
        motion[0, j] = c * x + a * (v[1] * z - v[2] * y) + b * dot * v[0]
        motion[1, j] = c * y + a * (v[2] * x - v[0] * z) + b * dot * v[1]
        motion[2, j] = c * z + a * (v[0] * y - v[1] * x) + b * dot * v[2]
        if j == 3:
            for i in range(3):
                motion[i, 3] += center[i] + v[3 + i]


@inlined_piece
def _sum_normal_equations(moved, cloud, normals, at, far, center, scale, share, matrix, vector):
    """Writes the lower triangle of a Gauss-Newton step's matrix (6,6) and its vector (6); returns the sum of weights.

    The sums are plain numbers: kept in arrays, they were stored again for every point. Their order is left to the compiler,
    which then takes several points at a time.
    """
    total = 1e-6
    v0 = v1 = v2 = v3 = v4 = v5 = 0.0
    m00 = m10 = m11 = m20 = m21 = m22 = 0.0
    m30 = m31 = m32 = m40 = m41 = m42 = m50 = m51 = m52 = 0.0
    m33 = m43 = m44 = m53 = m54 = m55 = 0.0
    for i in range(np.uintp(moved.shape[1])):
        x, y, z, j = moved[0, i], moved[1, i], moved[2, i], np.uintp(at[i])
        w = 1 / (1 + far[i] / (scale * scale))
        w *= w
        total += w
        rx, ry, rz = cloud[0, j] - x, cloud[1, j] - y, cloud[2, j] - z
        nx, ny, nz = np.float64(normals[0, j]), np.float64(normals[1, j]), np.float64(normals[2, j])
        x, y, z = x - center[0], y - center[1], z - center[2]
        a, b, c = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
        gap = w * (nx * rx + ny * ry + nz * rz)
        u = w * share
        v0 += gap * a + u * (y * rz - z * ry)
        v1 += gap * b + u * (z * rx - x * rz)
        v2 += gap * c + u * (x * ry - y * rx)
        v3, v4, v5 = v3 + (gap * nx + u * rx), v4 + (gap * ny + u * ry), v5 + (gap * nz + u * rz)
        wa, wb, wc = w * a, w * b, w * c
        m00 += wa * a + u * (y * y + z * z)
        m10 += wb * a - u * x * y
        m11 += wb * b + u * (x * x + z * z)
        m20 += wc * a - u * x * z
        m21 += wc * b - u * y * z
        m22 += wc * c + u * (x * x + y * y)
        m30 += wa * nx
        m31 += wb * nx + u * z
        m32 += wc * nx - u * y
        m40 += wa * ny - u * z
        m41 += wb * ny
        m42 += wc * ny + u * x
        m50 += wa * nz + u * y
        m51 += wb * nz - u * x
        m52 += wc * nz
        wx, wy, wz = w * nx, w * ny, w * nz
        m33, m43, m44 = m33 + (wx * nx + u), m43 + wx * ny, m44 + (wy * ny + u)
        m53, m54, m55 = m53 + wx * nz, m54 + wy * nz, m55 + (wz * nz + u)
    vector[0], vector[1], vector[2], vector[3], vector[4], vector[5] = v0, v1, v2, v3, v4, v5
    matrix[0, 0], matrix[1, 0], matrix[1, 1] = m00, m10, m11
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = m20, m21, m22
    matrix[3, 0], matrix[3, 1], matrix[3, 2], matrix[3, 3] = m30, m31, m32, m33
    matrix[4, 0], matrix[4, 1], matrix[4, 2], matrix[4, 3], matrix[4, 4] = m40, m41, m42, m43, m44
    matrix[5, 0], matrix[5, 1], matrix[5, 2] = m50, m51, m52
    matrix[5, 3], matrix[5, 4], matrix[5, 5] = m53, m54, m55
    return total


@inlined_piece
def _move(source, motion, moved, rounded, center):
    """Moves source (3,n): into `moved` as f64, into `rounded` as f32; and computes the center (3)."""
    for k in range(3):
        total, row, short = 0.0, moved[k], rounded[k]
        for i in range(np.uintp(source.shape[1])):
            s = motion[k, 0] * source[0, i] + motion[k, 1] * source[1, i] + motion[k, 2] * source[2, i] + motion[k, 3]
            row[i] = s
            short[i] = s
            total += s
        center[k] = total / source.shape[1]


@kernel
def icp_kernel(source, search, motion, steps, wide, narrow, share):
    """Makes Gauss-Newton steps of robust ICP: motion (3,4) f64 in place, source (3,n) onto the cloud of `search`.

    search: as `_look_up` has it. Each point's residual is its distance to the nearest point's plane plus `share` times
    the distance to the point itself (both squared), weighted by Geman and McClure's 1 / (1 + d^2/s^2)^2 with s falling
    from wide to narrow.
    """
    cloud, normals, near, count = search[0], search[1], search[3], source.shape[1]
    matrix, vector, center = np.empty((6, 6)), np.empty(6), np.empty(3)
    moved, rounded = np.empty((3, count)), np.empty((3, count), np.float32)
    at, far = np.empty(count, np.int64), np.empty(count, np.float32)
    work = np.empty(max(cloud.shape[1], near.shape[2] * count), np.float32)
    bits = work.view(np.int32)
    for step in range(steps):
        scale = wide * (narrow / wide) ** (step / max(steps - 1, 1))
        _move(source, motion, moved, rounded, center)
        _look_up(rounded, search, work, bits, at, far)
        total = _sum_normal_equations(moved, cloud, normals, at, far, center, scale, share, matrix, vector)
        for a in range(6):  # keeps a line or a single point from turning freely
            matrix[a, a] += 1e-6 * total * (0.05 if a < 3 else 1.0)
        _solve(matrix, vector)
        _compose(motion, vector, center)


@kernel
def linearize_kernel(source, search, motion, scale, share, matrix, vector, center):
    """Computes the Gauss-Newton step of robust ICP at a motion: matrix (6,6), vector (6), and the center (3) it turns about.

    Residuals and weights as in `icp_kernel`, at one scale.
    """
    cloud, normals, near, count = search[0], search[1], search[3], source.shape[1]
    moved, rounded = np.empty((3, count)), np.empty((3, count), np.float32)
    at, far = np.empty(count, np.int64), np.empty(count, np.float32)
    work = np.empty(max(cloud.shape[1], near.shape[2] * count), np.float32)
    _move(source, motion, moved, rounded, center)
    _look_up(rounded, search, work, work.view(np.int32), at, far)
    _sum_normal_equations(moved, cloud, normals, at, far, center, scale, share, matrix, vector)
    for i in range(6):
        for j in range(i):
            matrix[j, i] = matrix[i, j]


@kernel
def residual_kernel(source, search, motion, share, out, at):
    """Computes squared residuals (n) of source (3,n) moved by motion, as f64 into `out`, and the nearest, i64 into `at`.

    A residual is (1 - share) plane distance^2 + share point distance^2.
    """
    cloud, normals, near, count = search[0], search[1], search[3], source.shape[1]
    moved, rounded = np.empty((3, count)), np.empty((3, count), np.float32)
    far = np.empty(count, np.float32)
    work = np.empty(max(cloud.shape[1], near.shape[2] * count), np.float32)
    for k in range(3):
        for i in range(count):
            s = motion[k, 0] * source[0, i] + motion[k, 1] * source[1, i] + motion[k, 2] * source[2, i]
            moved[k, i] = s + motion[k, 3]
            rounded[k, i] = moved[k, i]
    _look_up(rounded, search, work, work.view(np.int32), at, far)
    for i in range(count):
        x, y, z, j = moved[0, i], moved[1, i], moved[2, i], np.uintp(at[i])
        gap = (cloud[0, j] - x) * normals[0, j] + (cloud[1, j] - y) * normals[1, j] + (cloud[2, j] - z) * normals[2, j]
        out[i] = share * far[i] + (1 - share) * gap * gap


@kernel
def explain_kernel(source, search, motion, share, scale, first, cost, nearest):
    """Adds d^2 / (d^2 + scale^2) to cost f32 (n), d^2 as in `residual_kernel`; nearest i32 (n): first + its index."""
    squared, at = np.empty(source.shape[1]), np.empty(source.shape[1], np.int64)
    residual_kernel(source, search, motion, share, squared, at)
    for i in range(len(squared)):
        cost[i] += squared[i] / (squared[i] + scale * scale)
        nearest[i] = first + at[i]


@kernel
def hypotheses_kernel(source, search, motions, steps, wide, narrow, share, share_out, scale, out):
    """Runs ICP from every one of motions (H,3,4), in place.

    out (H): the mean of d^2 / (d^2 + scale^2) afterwards, d^2 as in `residual_kernel` with `share_out`.
    """
    squared, at = np.empty(source.shape[1]), np.empty(source.shape[1], np.int64)
    for h in range(len(motions)):
        icp_kernel(source, search, motions[h], steps, wide, narrow, share)
        residual_kernel(source, search, motions[h], share_out, squared, at)
        out[h] = 0.0
        for i in range(len(squared)):
            out[h] += squared[i] / (squared[i] + scale * scale)
        out[h] /= len(squared)


@kernel
def cover_kernel(moved, normals, queries, share, out):
    """Computes squared residuals (M) of queries (3,M) to the moved cloud (3,N), by exhaustion, as `residual_kernel`."""
    scratch = np.empty(moved.shape[1], np.float32)
    bits = scratch.view(np.int32)
    for i in range(queries.shape[1]):
        x, y, z = queries[0, i], queries[1, i], queries[2, i]
        j, squared = nearest_point(x, y, z, moved, scratch, bits)
        gap = (moved[0, j] - x) * normals[0, j] + (moved[1, j] - y) * normals[1, j] + (moved[2, j] - z) * normals[2, j]
        out[i] = share * squared + (1 - share) * gap * gap


@kernel
def _gap(m, px, py, pz, x, y, z):
    """Returns how far from (x, y, z) the motion m (3,4) takes the point p."""
    a = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3] - x
    b = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3] - y
    c = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3] - z
    return math.sqrt(a * a + b * b + c * c)


@kernel
def energy_kernel(points, normals, label, motion, cost, neighbors, target, weights):
    """Returns what bodies cost: both clouds' mean saturated residuals, the borders, and the way from body 0.

    points (N,3), their normals (N,3), label (N), motion (K,3,4), cost (K,N) saturated residuals, neighbors (N,k),
    target f32 (3,M). A border point costs more, from 1 - tear to 1, the farther apart (0.15 is far) its two motions
    take it. The weights are those of `rigid_bodies.BodySearch`.
    """
    share, scale, tear, border, distance = weights
    count, near = neighbors.shape
    moved, turned = np.empty((3, count), np.float32), np.empty((3, count), np.float32)
    own, torn, away = 0.0, 0.0, 0.0
    for i in range(count):
        body = label[i]
        own += cost[body, i]
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        m = motion[body]
        x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
        y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
        z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
        moved[0, i], moved[1, i], moved[2, i] = x, y, z
        for k in range(3):
            turned[k, i] = m[k, 0] * normals[i, 0] + m[k, 1] * normals[i, 1] + m[k, 2] * normals[i, 2]
        if body > 0:
            away += _gap(motion[0], px, py, pz, x, y, z)
        for j in range(near):
            other = label[neighbors[i, j]]
            if other != body:
                torn += 1 - tear + tear * min(_gap(motion[other], px, py, pz, x, y, z) / 0.15, 1.0)
    squared, seen = np.empty(target.shape[1]), 0.0
    cover_kernel(moved, turned, target, share, squared)
    for i in range(len(squared)):
        seen += squared[i] / (squared[i] + scale * scale)
    return own / count + seen / len(squared) + 0.5 * border * torn / (count * near) + distance * away / count


@kernel
def assign_kernel(cost, neighbors, label, extra, border, rounds):
    """Improves labels (N) in place, all at once per round, by iterated conditional modes (ICM; Besag 1986).

    A label is the least of own and neighbors' mean cost (K,N), halved, plus `extra` for all bodies but the first, less
    twice the border's cost for every share of neighbors that agrees.
    """
    bodies, count = cost.shape
    near = neighbors.shape[1]
    unary = np.empty((count, bodies))
    for i in range(count):
        for k in range(bodies):
            total = 0.0
            for j in range(near):
                total += cost[k, neighbors[i, j]]
            unary[i, k] = 0.5 * cost[k, i] + 0.5 * total / near + (extra if k > 0 else 0.0)
    new, votes = np.empty_like(label), np.empty(bodies)
    for _ in range(rounds):
        changed = False
        for i in range(count):
            votes[:] = 0.0
            for j in range(near):
                votes[label[neighbors[i, j]]] += 1.0
            best = 0
            for k in range(1, bodies):
                if unary[i, k] - 2 * border * votes[k] / near < unary[i, best] - 2 * border * votes[best] / near:
                    best = k
            new[i] = best
            changed = changed or best != label[i]
        for i in range(count):
            label[i] = new[i]
        if not changed:
            break


@kernel
def lloyd_kernel(points, center, rounds, patch):
    """Runs k-means (Lloyd) in place: center f64 (K,D), patch i64 (N) of points f32 (N,D).

    A center without points stays. Distances in float64, ties to the lowest patch; means in float32 in the points'
    order, as numpy takes them.
    """
    total, own = np.empty(center.shape, np.float32), np.empty(len(center), np.int64)
    for _ in range(rounds):
        total[:] = 0
        own[:] = 0
        for i in range(len(points)):
            best, at = math.inf, 0
            for k in range(len(center)):
                apart = 0.0
                for c in range(points.shape[1]):
                    apart += (points[i, c] - center[k, c]) ** 2
                if apart < best:
                    best, at = apart, k
            patch[i] = at
            own[at] += 1
            for c in range(points.shape[1]):
                total[at, c] += points[i, c]
        for k in range(len(center)):
            if own[k]:
                for c in range(points.shape[1]):
                    center[k, c] = total[k, c] / np.float32(own[k])


@kernel
def distinct_kernel(moved, order, apart, chosen):
    """Chooses, of places f64 (H,n,3) in the given order, those no two of which are within `apart` at every point.

    Fills chosen i64 from its start; returns how many there are, its length at most.
    """
    found = 0
    for h in order:
        if found == len(chosen):
            break
        new = True
        for c in chosen[:found]:
            far = False
            for n in range(moved.shape[1]):
                for k in range(3):
                    far = far or abs(moved[h, n, k] - moved[c, n, k]) > apart
            new = new and far
        if new:
            chosen[found] = h
            found += 1
    return found
