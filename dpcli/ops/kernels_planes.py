"""CPU kernels of `plane_fit`: normal equations and deviations of many small least-squares fits, and their gradients.

features (M,n,K,d), times (M,n), weights (M,n,K): n neighbours and K groups of d features for each of M centroids. All are
C-contiguous float32. One pass over the features each; a thread owns whole centroids.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from dpcli.ops.jit import parallel_kernel


@parallel_kernel
def normal_forward(features, times, weights, matrix, right):
    """matrix (M,K,d+1,d+1) = sum_n w x x', right (M,K,d+1) = sum_n w x t, x = [f, 1]; weights of size 0 mean 1."""
    count, neighbors, groups, size = features.shape
    weighted = weights.size > 0
    for m in prange(count):
        total = np.zeros((groups, size + 1, size + 1), np.float32)
        moment = np.zeros((groups, size + 1), np.float32)
        for j in range(neighbors):
            t = times[m, j]
            for k in range(groups):
                w = weights[m, j, k] if weighted else np.float32(1)
                for a in range(size):
                    wa = w * features[m, j, k, a]
                    for b in range(a + 1):
                        total[k, a, b] += wa * features[m, j, k, b]
                    total[k, size, a] += wa
                    moment[k, a] += wa * t
                total[k, size, size] += w
                moment[k, size] += w * t
        for k in range(groups):
            for a in range(size + 1):
                right[m, k, a] = moment[k, a]
                for b in range(a + 1):
                    matrix[m, k, a, b] = total[k, a, b]
                    matrix[m, k, b, a] = total[k, a, b]


@parallel_kernel
def normal_backward(features, times, weights, grad_matrix, grad_right, grad_features, grad_weights):
    """Gradients from those of matrix (made symmetric by the caller: G + G') and right. grad_features is added to."""
    count, neighbors, groups, size = features.shape
    weighted = weights.size > 0
    for m in prange(count):
        for j in range(neighbors):
            t = times[m, j]
            for k in range(groups):
                w = weights[m, j, k] if weighted else np.float32(1)
                last = grad_matrix[m, k, size, size]
                linear = grad_right[m, k, size] * t
                for a in range(size):
                    slope = grad_matrix[m, k, a, size]
                    for b in range(size):
                        slope += grad_matrix[m, k, a, b] * features[m, j, k, b]
                    f = features[m, j, k, a]
                    grad_features[m, j, k, a] += w * (slope + grad_right[m, k, a] * t)
                    last += f * (slope + grad_matrix[m, k, a, size])
                    linear += f * grad_right[m, k, a] * t
                if weighted:
                    grad_weights[m, j, k] = np.float32(0.5) * last + linear


@parallel_kernel
def deviation_forward(features, times, coefficients, out):
    """out (M,n,K) = A f + b - t for coefficients (M,K,d+1) = [A, b]."""
    count, neighbors, groups, size = features.shape
    for m in prange(count):
        for j in range(neighbors):
            for k in range(groups):
                value = coefficients[m, k, size] - times[m, j]
                for a in range(size):
                    value += coefficients[m, k, a] * features[m, j, k, a]
                out[m, j, k] = value


@parallel_kernel
def deviation_backward(features, coefficients, grad, grad_features, grad_coefficients):
    """Gradients of `deviation_forward`; grad_coefficients must start at zero."""
    count, neighbors, groups, size = features.shape
    for m in prange(count):
        for j in range(neighbors):
            for k in range(groups):
                g = grad[m, j, k]
                for a in range(size):
                    grad_features[m, j, k, a] = g * coefficients[m, k, a]
                    grad_coefficients[m, k, a] += g * features[m, j, k, a]
                grad_coefficients[m, k, size] += g
