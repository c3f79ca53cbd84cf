"""CPU kernels of `kernel_convolution`: neighbors added into kernel points, whole rows of rotations and channels at once."""

from __future__ import annotations

from dpcli.ops.cpu.jit import arithmetic_kernel


@arithmetic_kernel
def group_forward(features, index, weight, out, first, last):
    """Computes out (P,D,F) of features (N,F), index (P,n) and weight (P,n,D), for centers first..last."""
    for p in range(first, last):
        out[p] = 0
        for j in range(index.shape[1]):
            source = features[index[p, j]]
            for d in range(weight.shape[2]):
                w = weight[p, j, d]
                if w != 0:
                    target = out[p, d]
                    for c in range(len(source)):
                        target[c] += w * source[c]


@arithmetic_kernel
def group_backward(grad, index, weight, out, first, last):
    """Adds the transpose of `group_forward`, of grad (P,D,F), to out (N,F), in columns first..last; threads share none."""
    for p in range(index.shape[0]):
        for j in range(index.shape[1]):
            target = out[index[p, j], first:last]
            for d in range(weight.shape[2]):
                w = weight[p, j, d]
                if w != 0:
                    given = grad[p, d, first:last]
                    for c in range(len(target)):
                        target[c] += w * given[c]
