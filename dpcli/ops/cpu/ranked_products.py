"""CPU kernels of SpiderCNN's products: features of the k-th neighbors times each of their Taylor channels."""

from __future__ import annotations

import numpy as np

from dpcli.ops.cpu.jit import piece_kernel


@piece_kernel
def modulate_kernel(gathered, taylor, k, out, first, last):
    """Sets out[r] (T,C) = taylor[r,k] times gathered[r,k], from gathered (R,K,C) and taylor (R,K,T), for rows first..last-1."""
    channels = np.uintp(gathered.shape[2])
    for r in range(first, last):
        line = gathered[r, k]
        for t in range(taylor.shape[2]):
            factor, target = taylor[r, k, t], out[r, t]
            for c in range(channels):
                target[c] = line[c] * factor


@piece_kernel
def modulate_back_kernel(grad, gathered, taylor, k, to_gathered, to_taylor, first, last):
    """Sets to_gathered[r,k] and to_taylor[r,k] to the gradient of `modulate_kernel`, from grad (R,T,C)."""
    channels = np.uintp(gathered.shape[2])
    for r in range(first, last):
        line, target = gathered[r, k], to_gathered[r, k]
        target[:] = 0
        for t in range(taylor.shape[2]):
            factor, given = taylor[r, k, t], grad[r, t]
            total = line.dtype.type(0)
            for c in range(channels):
                target[c] += given[c] * factor
                total += given[c] * line[c]
            to_taylor[r, k, t] = total
