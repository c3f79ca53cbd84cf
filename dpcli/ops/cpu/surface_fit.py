"""CPU kernels of `surface_fit`: the passes around its matrix products, on pieces of rows that stay in the cache.

Rows are neighbors, `neighbors` of them for each centroid of a piece; all arrays are flat float32 and start at the piece's
first row or centroid. A row's features lie feature after feature, each over all groups, whose number is a multiple of
WIDTH: element a * groups + k is feature a of group k, so that eight groups are one vector. Kernels are serial and release
the GIL.
"""

from __future__ import annotations

import numpy as np

from dpcli.ops.cpu.jit import piece_kernel
from dpcli.ops.cpu.simd import WIDTH, lanes, load, lower, power_of_two, reciprocal, store, where_lower

_LOG2E = 1.4426950408889634


@piece_kernel
def fit_rows(features, bias, floor, xyz, at, times, logits, weights, moments, size, groups, neighbors):
    """Activates the features and sums up what their plane fits need.

    features (R*size*groups): products in, max(products + bias, floor) out; bias (size*groups), floor (groups). xyz (R*3),
    or nothing: coordinates that become group `at`, whose bias is 0 and whose floor is low. times (R). logits (R*groups), or
    nothing for weights of 1; weights (R*groups) = sigmoid(logits). moments (centroids*entries*groups): for each
    feature a the sums of w x_a x_b for b = 0..a, of w x_a and of w x_a t; last of w and of w t.
    NaN stays NaN, so that it shows in the loss.
    """
    weighted, zero, one = logits.size > 0, lanes(np.float32(0)), lanes(np.float32(1))
    most, base2, endless = lanes(np.float32(126)), lanes(np.float32(-_LOG2E)), lanes(np.float32(np.inf))
    entries = (size + 1) * (size + 2) // 2 + size + 1
    for p in range(times.size // neighbors):
        start = p * entries * groups
        for e in range(start, start + entries * groups, WIDTH):
            store(moments, e, zero)
        for r in range(p * neighbors, (p + 1) * neighbors):
            row = r * size * groups
            if xyz.size:
                for a in range(3):
                    features[row + a * groups + at] = xyz[r * 3 + a]
            t = lanes(times[r])
            for k in range(0, groups, WIDTH):
                w = one
                if weighted:
                    logit = load(logits, r * groups + k)
                    w = reciprocal(one + power_of_two(lower(logit * base2, most)))
                    w = where_lower(logit, endless, w, logit)
                    store(weights, r * groups + k, w)
                lowest, e = load(floor, k), start + k
                for a in range(size):
                    x = load(features, row + a * groups + k) + load(bias, a * groups + k)
                    x = where_lower(x, lowest, lowest, x)
                    store(features, row + a * groups + k, x)
                    wx = w * x
                    for b in range(a + 1):
                        store(moments, e, load(moments, e) + wx * load(features, row + b * groups + k))
                        e += groups
                    store(moments, e, load(moments, e) + wx)
                    e += groups
                    store(moments, e, load(moments, e) + wx * t)
                    e += groups
                store(moments, e, load(moments, e) + w)
                e += groups
                store(moments, e, load(moments, e) + w * t)


@piece_kernel
def deviation_rows(features, times, coefficients, out, size, groups, neighbors):
    """Computes out (R*groups) = A f + b - t for coefficients (centroids*(size+1)*groups) = [A, b]."""
    for p in range(times.size // neighbors):
        plane = p * (size + 1) * groups
        for r in range(p * neighbors, (p + 1) * neighbors):
            row = r * size * groups
            t = lanes(times[r])
            for k in range(0, groups, WIDTH):
                value = load(coefficients, plane + size * groups + k) - t
                for a in range(size):
                    value = value + load(coefficients, plane + a * groups + k) * load(features, row + a * groups + k)
                store(out, r * groups + k, value)


@piece_kernel
def deviation_back(features, grad, out, size, groups, neighbors):
    """Adds to out (centroids*(size+1)*groups) the gradient at [A, b] from that at the deviations, grad (R*groups)."""
    for p in range(grad.size // groups // neighbors):
        plane = p * (size + 1) * groups
        for r in range(p * neighbors, (p + 1) * neighbors):
            row = r * size * groups
            for k in range(0, groups, WIDTH):
                g, e = load(grad, r * groups + k), plane + k
                for a in range(size):
                    store(out, e, load(out, e) + g * load(features, row + a * groups + k))
                    e += groups
                store(out, e, load(out, e) + g)


@piece_kernel
def fit_back(
    features,
    weights,
    times,
    coefficients,
    grad_deviations,
    grad_matrix,
    grad_right,
    grad_features,
    grad_logits,
    size,
    groups,
    neighbors,
):
    """Computes the gradients at the products (through the ReLU) and at the logits.

    grad_matrix (centroids*(size+1)^2*groups), made symmetric by the caller (G + G'), and grad_right
    (centroids*(size+1)*groups): of the normal equations. grad_deviations (R*groups), or nothing, with coefficients.
    grad_features (R*size*groups), grad_logits (R*groups), or nothing as weights: written.
    """
    weighted, passed = weights.size > 0, grad_deviations.size > 0
    zero, one, half = lanes(np.float32(0)), lanes(np.float32(1)), lanes(np.float32(0.5))
    for p in range(times.size // neighbors):
        square, plane = p * (size + 1) * (size + 1) * groups, p * (size + 1) * groups
        for r in range(p * neighbors, (p + 1) * neighbors):
            row = r * size * groups
            t = lanes(times[r])
            for k in range(0, groups, WIDTH):
                w, g = one, zero
                if weighted:
                    w = load(weights, r * groups + k)
                if passed:
                    g = load(grad_deviations, r * groups + k)
                product = load(grad_matrix, square + ((size + 1) * size + size) * groups + k)
                linear = load(grad_right, plane + size * groups + k)
                for a in range(size):
                    line = square + (size + 1) * a * groups + k
                    last = load(grad_matrix, line + size * groups)
                    slope = last
                    for b in range(size):
                        slope = slope + load(grad_matrix, line + b * groups) * load(features, row + b * groups + k)
                    f, right = load(features, row + a * groups + k), load(grad_right, plane + a * groups + k)
                    value = w * (slope + right * t)
                    if passed:
                        value = value + g * load(coefficients, plane + a * groups + k)
                    store(grad_features, row + a * groups + k, where_lower(zero, f, value, zero))
                    product, linear = product + f * (slope + last), linear + f * right
                if weighted:
                    store(grad_logits, r * groups + k, (half * product + linear * t) * w * (one - w))
