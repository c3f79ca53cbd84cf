"""CPU kernels of the labels: mean field over neighbors inside a frame and nearest points in other frames."""

from __future__ import annotations

import math

import numpy as np

from dpcli.ops.cpu.jit import kernel


@kernel
def alike_kernel(points, motions, width, hinge, out):
    """Computes how nearly two bodies take a point to one place, f32 (n,K,K): 1 for a body itself, `hinge` at most for others.

    points f64 (n,3) of a frame; motions f64 (P,K,3,4) to its partner frames. With d, the mean distance of the two places:
    hinge exp(-d^2 / width^2).
    """
    partners, bodies = motions.shape[0], motions.shape[1]
    place = np.empty((bodies, 3))
    gap = np.empty((bodies, bodies))
    for i in range(len(points)):
        gap[:] = 0.0
        for p in range(partners):
            for k in range(bodies):
                for axis in range(3):
                    m = motions[p, k, axis]
                    place[k, axis] = m[0] * points[i, 0] + m[1] * points[i, 1] + m[2] * points[i, 2] + m[3]
            for k in range(bodies):
                for other in range(k):
                    squared = 0.0
                    for axis in range(3):
                        squared += (place[k, axis] - place[other, axis]) ** 2
                    gap[k, other] += math.sqrt(squared) / partners
        for k in range(bodies):
            out[i, k, k] = 1
            for other in range(k):
                out[i, k, other] = hinge * math.exp(-((gap[k, other] / width) ** 2))
                out[i, other, k] = out[i, k, other]


@kernel
def support_kernel(share, neighbors, nearest, alike, out):
    """Computes how far the others agree with each label, f32 (2,N,K): neighbors, and the nearest points in other frames.

    share f32 (N,K); neighbors i64 (N,k) inside a frame; nearest i32 (K,N,P): in other frames, under each body; alike f32
    (N,K,K): how far another label of a point counts as this one (`alike_kernel`).
    """
    count, bodies = share.shape
    counted = np.zeros((count, bodies), np.float32)
    for i in range(count):
        for k in range(bodies):
            for other in range(bodies):
                counted[i, k] += share[i, other] * alike[i, k, other]
    for i in range(count):
        for k in range(bodies):
            around, across = np.float32(0), np.float32(0)
            for j in range(neighbors.shape[1]):
                around += counted[neighbors[i, j], k]
            for j in range(nearest.shape[2]):
                across += counted[nearest[k, i, j], k]
            out[0, i, k] = around / neighbors.shape[1]
            out[1, i, k] = across / nearest.shape[2]


@kernel
def mean_field_kernel(cost, neighbors, nearest, alike, border, agreement, temperatures, share):
    """Makes a step of damped mean field for each of the temperatures; share f32 (N,K) in place.

    cost f32 (N,K): of the points under the bodies. The cost of a label at a point falls by `border` and `agreement` times
    how far its neighbors and its nearest points agree (`support_kernel`).
    """
    count, bodies = share.shape
    support, field = np.empty((2, count, bodies), np.float32), np.empty(bodies)
    for temperature in temperatures:
        support_kernel(share, neighbors, nearest, alike, support)
        for i in range(count):
            low = math.inf
            for k in range(bodies):
                field[k] = cost[i, k] - border * support[0, i, k] - agreement * support[1, i, k]
                low = min(low, field[k])
            total = 0.0
            for k in range(bodies):
                field[k] = math.exp((low - field[k]) / temperature)
                total += field[k]
            for k in range(bodies):
                share[i, k] = 0.5 * share[i, k] + 0.5 * field[k] / total
