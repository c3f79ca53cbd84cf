"""CPU kernels of the picture metrics: compositing, squared errors, and structural similarity with rolling rows.

Serial and without the GIL: callers spread frames over plain threads.
"""

from __future__ import annotations

import numpy as np

from dpcli.ops.cpu.jit import arithmetic_kernel

TAPS = 11  # of the Gaussian window
_REACH = TAPS // 2


@arithmetic_kernel
def composite(rgba, background, out):
    """Writes straight-alpha rgba u8 (H,W,4) over background f32 (3) to out f32 (3,H,W); all colors in 0..1."""
    height, width, _ = rgba.shape
    for channel in range(3):
        behind = background[channel]
        for row in range(height):
            for column in range(width):
                alpha = np.float32(rgba[row, column, 3]) * np.float32(1 / 255)
                color = np.float32(rgba[row, column, channel]) * np.float32(1 / 255)
                out[channel, row, column] = alpha * color + (np.float32(1) - alpha) * behind


@arithmetic_kernel
def squared_errors(predicted, truth, mask):
    """Returns the sums of squared differences of f32 (C,H,W) pictures: over all values, and over the pixels of mask u8 (H,W)."""
    channels, height, width = predicted.shape
    whole, inside = np.zeros(width), np.zeros(width)  # a sum per column: float64, and still a vector loop
    for channel in range(channels):
        for row in range(height):
            for column in range(width):
                error = np.float64(predicted[channel, row, column] - truth[channel, row, column])
                whole[column] += error * error
                inside[column] += error * error * mask[row, column]
    return whole.sum(), inside.sum()


@arithmetic_kernel
def _across(line, taps, out):
    """Computes the horizontal pass: out f32 (W-10) of line f32 (W), with the window's six different weights."""
    a, b, c, d, e, f = taps[0], taps[1], taps[2], taps[3], taps[4], taps[5]
    for x in range(len(out)):
        out[x] = (
            a * (line[x] + line[x + 10])
            + b * (line[x + 1] + line[x + 9])
            + c * (line[x + 2] + line[x + 8])
            + d * (line[x + 3] + line[x + 7])
            + e * (line[x + 4] + line[x + 6])
            + f * line[x + 5]
        )


@arithmetic_kernel
def _down(ring, first, taps, out):
    """Computes the vertical pass: out f32 (W) of ring f32 (11,W), whose oldest row is `first`."""
    a, b, c, d, e, f = taps[0], taps[1], taps[2], taps[3], taps[4], taps[5]
    r0, r1, r2 = ring[first], ring[(first + 1) % TAPS], ring[(first + 2) % TAPS]
    r3, r4, r5 = ring[(first + 3) % TAPS], ring[(first + 4) % TAPS], ring[(first + 5) % TAPS]
    r6, r7, r8 = ring[(first + 6) % TAPS], ring[(first + 7) % TAPS], ring[(first + 8) % TAPS]
    r9, r10 = ring[(first + 9) % TAPS], ring[(first + 10) % TAPS]
    for x in range(len(out)):
        out[x] = (
            a * (r0[x] + r10[x])
            + b * (r1[x] + r9[x])
            + c * (r2[x] + r8[x])
            + d * (r3[x] + r7[x])
            + e * (r4[x] + r6[x])
            + f * r5[x]
        )


@arithmetic_kernel
def _lines(predicted, truth, pad, center, lines):
    """Writes a row's difference, its square, centered sum and its square to lines f32 (4,W+2 pad), mirrored at the edges."""
    width = len(predicted)
    for x in range(width):
        apart = predicted[x] - truth[x]
        both = (predicted[x] - center) + (truth[x] - center)
        lines[0, pad + x], lines[1, pad + x] = apart, apart * apart
        lines[2, pad + x], lines[3, pad + x] = both, both * both
    for kind in range(4):
        for x in range(pad):
            lines[kind, pad - 1 - x] = lines[kind, pad + 1 + x]
            lines[kind, pad + width + x] = lines[kind, pad + width - 2 - x]


@arithmetic_kernel
def _similarity(moments, center, c1, c2, whole, contrast):
    """Adds the similarity and its contrast-structure factor at each column to whole, contrast f64 (W).

    With d = p - t and s = p + t: luminance 1 - E[d]^2 / (E[p]^2 + E[t]^2 + c1), contrast-structure
    1 - Var d / ((Var s + Var d) / 2 + c2): equal to the usual form, but what is subtracted from 1 is itself exact to
    rounding, and the variances are those of small numbers.
    """
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    for x in range(len(whole)):
        apart, both = moments[0, x], moments[2, x]
        spread = max(moments[1, x] - apart * apart, zero)
        joint = max(moments[3, x] - both * both, zero)
        total = both + center + center
        squares = half * (total * total + apart * apart)
        structure = one - spread / (half * (joint + spread) + c2)
        contrast[x] += structure
        whole[x] += structure * (one - apart * apart / (squares + c1))


@arithmetic_kernel
def similarity_sums(predicted, truth, taps, pad, center, c1, c2):
    """Returns the sums over all windows of f32 (C,H,W) pictures of the similarity and of its contrast-structure factor.

    taps f32 (6): the window's weights from its edge to its middle. pad 0: windows inside the picture only; 5: one
    window per pixel, the picture mirrored at its edges (which are not repeated). center: about the mean value, taken
    off before squaring.
    """
    channels, height, width = predicted.shape
    across = width + 2 * pad - 2 * _REACH
    lines = np.empty((4, width + 2 * pad), np.float32)
    ring, moments = np.empty((4, TAPS, across), np.float32), np.empty((4, across), np.float32)
    whole, contrast = np.zeros(across), np.zeros(across)
    for channel in range(channels):
        for row in range(-pad, height + pad):
            source = abs(row) if row < height else 2 * height - 2 - row
            _lines(predicted[channel, source], truth[channel, source], pad, center, lines)
            slot = (row + pad) % TAPS
            for kind in range(4):
                _across(lines[kind], taps, ring[kind, slot])
            if row + pad >= TAPS - 1:
                for kind in range(4):
                    _down(ring[kind], (slot + 1) % TAPS, taps, moments[kind])
                _similarity(moments, center, c1, c2, whole, contrast)
    return whole.sum(), contrast.sum()


@arithmetic_kernel
def halve(picture, out):
    """Writes the means of 2 x 2 pixels of f32 (C,H,W) to out f32 (C,H//2,W//2)."""
    channels, height, width = out.shape
    for channel in range(channels):
        for row in range(height):
            for column in range(width):
                upper = picture[channel, 2 * row, 2 * column] + picture[channel, 2 * row, 2 * column + 1]
                lower = picture[channel, 2 * row + 1, 2 * column] + picture[channel, 2 * row + 1, 2 * column + 1]
                out[channel, row, column] = np.float32(0.25) * (upper + lower)
