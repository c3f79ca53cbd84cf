"""CPU kernels of the labels: mean field over neighbors inside a frame and nearest points in other frames."""

from __future__ import annotations

import math

import numpy as np

from dpcli.ops.cpu.jit import kernel


@kernel
def support_kernel(share, neighbors, nearest, out):
    """Computes what the others say, f32 (2,N,K): the mean share of each body among neighbors and among nearest points.

    share f32 (N,K); neighbors i64 (N,k) inside a frame; nearest i32 (K,N,P): in other frames, under each body.
    """
    count, bodies = share.shape
    for i in range(count):
        for k in range(bodies):
            around, across = np.float32(0), np.float32(0)
            for j in range(neighbors.shape[1]):
                around += share[neighbors[i, j], k]
            for j in range(nearest.shape[2]):
                across += share[nearest[k, i, j], k]
            out[0, i, k] = around / neighbors.shape[1]
            out[1, i, k] = across / nearest.shape[2]


@kernel
def mean_field_kernel(cost, neighbors, nearest, border, agreement, temperatures, share):
    """Makes a step of damped mean field for each of the temperatures; share f32 (N,K) in place.

    cost f32 (N,K): of the points under the bodies. The cost of label k at a point falls by `border` and `agreement`
    times the share of k among its neighbors and its nearest points.
    """
    count, bodies = share.shape
    support, field = np.empty((2, count, bodies), np.float32), np.empty(bodies)
    for temperature in temperatures:
        support_kernel(share, neighbors, nearest, support)
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
