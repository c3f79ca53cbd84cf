"""CPU kernels of the labels: how bodies share places, and mean field over neighbors and nearest points in other frames.

Rows that hold a number for each of K bodies are as long as a multiple of 8, so that a row is a few vectors of 8 lanes.
"""

from __future__ import annotations

import math

import numpy as np

from dpcli.ops.cpu.jit import inlined, kernel
from dpcli.ops.cpu.simd import WIDTH, lanes, load, store

_ALONE = 87.0  # exponent beyond which exp is below the least normal f32: slow to compute with, and nothing beside 1


def row_length(bodies: int) -> int:
    """Returns how long rows of so many bodies are.

    >>> row_length(3), row_length(9)
    (8, 16)
    """
    return -(-bodies // WIDTH) * WIDTH


@kernel
def displacement_kernel(points, starts, motions, reference, out):
    """Computes how far two bodies take every point from each other, f32 (N), on average over partner frames.

    points f64 (3,N), frame t from starts[t] on; motions and reference f64 (T,P,3,4), from frame t to its partners.
    """
    frames, partners = motions.shape[0], motions.shape[1]
    for t in range(frames):
        first, end = np.uintp(starts[t]), np.uintp(starts[t + 1])
        out[first:end] = 0
        for p in range(partners):
            m, o = motions[t, p], reference[t, p]
            a, b, c, d = m[0, 0] - o[0, 0], m[0, 1] - o[0, 1], m[0, 2] - o[0, 2], m[0, 3] - o[0, 3]
            e, f, g, h = m[1, 0] - o[1, 0], m[1, 1] - o[1, 1], m[1, 2] - o[1, 2], m[1, 3] - o[1, 3]
            q, r, s, w = m[2, 0] - o[2, 0], m[2, 1] - o[2, 1], m[2, 2] - o[2, 2], m[2, 3] - o[2, 3]
            for i in range(first, end):
                x = a * points[0, i] + b * points[1, i] + c * points[2, i] + d
                y = e * points[0, i] + f * points[1, i] + g * points[2, i] + h
                z = q * points[0, i] + r * points[1, i] + s * points[2, i] + w
                out[i] += math.sqrt(x * x + y * y + z * z)
        out[first:end] /= partners


@kernel
def gain_kernel(current, cost, away, displacement, neighbors, least):
    """Returns what connected points would save by another body, on average, beyond `least` each.

    current, cost, away f32 (N): what points cost now and by the other body, and how far it lies from the largest one
    (`displacement` each diameter); neighbors i64 (N,k).
    """
    less, total = np.empty(len(current), np.float32), 0.0
    for i in range(np.uintp(len(current))):
        less[i] = current[i] - cost[i] - displacement * away[i]
    near = np.uintp(neighbors.shape[1])
    for i in range(np.uintp(len(current))):
        around = np.float32(0)
        for j in range(near):
            around += less[np.uintp(neighbors[i, j])]
        total += max(0.5 * less[i] + 0.5 * around / near - least, 0.0)
    return total / len(current)


@kernel
def alike_kernel(points, starts, motions, width, hinge, alike, away):
    """Computes how nearly two bodies take a point to one place, f32 (N,K,row): 1 for a body itself, `hinge` at most for others.

    points f64 (3,N), frame t from starts[t] on; motions f64 (K,T,P,3,4), from frame t to its partners. With d, the mean
    distance of the two places: hinge exp(-d^2 / width^2). away f32 (N,K): d of each body and the first.
    """
    gap = np.empty(len(alike), np.float32)
    away[:, 0] = 0
    for k in range(len(motions)):
        alike[:, k, k] = 1
        for other in range(k):
            displacement_kernel(points, starts, motions[k], motions[other], gap)
            for i in range(len(gap)):
                exponent = (gap[i] / width) ** 2
                value = hinge * math.exp(-exponent) if exponent < _ALONE else 0.0
                alike[i, k, other] = value
                alike[i, other, k] = value
                if other == 0:
                    away[i, k] = gap[i]


@inlined
def _count(share, alike, bodies, row, counted):
    """Writes how far each label is at each point, counting others by how alike they are; flat f32 (N,row)."""
    for i in range(np.uintp(len(share)) // row):
        for block in range(np.uintp(0), row, np.uintp(WIDTH)):
            total = lanes(np.float32(0))
            for other in range(bodies):
                total = total + lanes(share[i * row + other]) * load(alike, (i * bodies + other) * row + block)
            store(counted, i * row + block, total)


@inlined
def _support(i, counted, neighbors, nearest, bodies, row, around, across):
    """Writes how far the others agree with each label at point i: neighbors, f32 (row), and nearest points, f32 (row)."""
    near, seen = np.uintp(neighbors.shape[1]), np.uintp(nearest.shape[2])
    each = lanes(np.float32(1) / np.float32(near))
    for block in range(np.uintp(0), row, np.uintp(WIDTH)):
        total = lanes(np.float32(0))
        for j in range(near):
            total = total + load(counted, np.uintp(neighbors[i, j]) * row + block)
        store(around, block, total * each)
    for k in range(bodies):
        sum_ = np.float32(0)
        for j in range(seen):
            sum_ += counted[np.uintp(nearest[k, i, j]) * row + k]
        across[k] = sum_ / seen


@kernel
def support_kernel(share, neighbors, nearest, alike, out):
    """Computes how far the others agree with each label, f32 (2,N,K): neighbors, and the nearest points in other frames.

    share f32 (N,row); neighbors i64 (N,k) inside a frame; nearest i32 (K,N,P): in other frames, under each body; alike f32
    (N,K,row): how far another label of a point counts as this one (`alike_kernel`).
    """
    count, bodies, row = np.uintp(alike.shape[0]), np.uintp(alike.shape[1]), np.uintp(alike.shape[2])
    counted = np.empty(count * row, np.float32)
    around, across = np.empty(row, np.float32), np.empty(row, np.float32)
    _count(share.reshape(-1), alike.reshape(-1), bodies, row, counted)
    for i in range(count):
        _support(i, counted, neighbors, nearest, bodies, row, around, across)
        out[0, i] = around[:bodies]
        out[1, i] = across[:bodies]


@kernel
def mean_field_kernel(cost, neighbors, nearest, alike, border, agreement, temperatures, share):
    """Makes a step of damped mean field for each of the temperatures; share f32 (N,row) in place.

    cost f32 (N,K): of the points under the bodies. The cost of a label at a point falls by `border` and `agreement` times
    how far its neighbors and its nearest points agree (`support_kernel`).
    """
    count, bodies, row = np.uintp(alike.shape[0]), np.uintp(alike.shape[1]), np.uintp(alike.shape[2])
    counted, field = np.empty(count * row, np.float32), np.empty(bodies)
    around, across = np.empty(row, np.float32), np.empty(row, np.float32)
    flat, alike = share.reshape(-1), alike.reshape(-1)
    for temperature in temperatures:
        _count(flat, alike, bodies, row, counted)
        for i in range(count):
            _support(i, counted, neighbors, nearest, bodies, row, around, across)
            low = math.inf
            for k in range(bodies):
                field[k] = cost[i, k] - border * around[k] - agreement * across[k]
                low = min(low, field[k])
            total = 0.0
            for k in range(bodies):
                field[k] = math.exp((low - field[k]) / temperature)
                total += field[k]
            for k in range(bodies):
                share[i, k] = 0.5 * share[i, k] + 0.5 * field[k] / total
