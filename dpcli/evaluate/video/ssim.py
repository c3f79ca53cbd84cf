"""The structural similarity of pictures, SSIM (Wang et al. 2004), and MS-SSIM (Wang et al. 2003).

Gaussian window of 11 x 11 pixels and sigma 1.5, population variances. Border "valid": windows inside the picture, what
scikit-image and the authors' code average; "reflect": a window per pixel, the picture mirrored at its edges (torchmetrics).
"""

from __future__ import annotations

import numpy as np

BORDERS = ("valid", "reflect")
SIGMA, K1, K2 = 1.5, 0.01, 0.03  # Wang et al. 2004
SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # Wang et al. 2003
_TAPS = 11
_REACH = _TAPS // 2


def multi_scale(predicted: np.ndarray, truth: np.ndarray, data_range: float, border: str) -> float:
    """Returns MS-SSIM of contiguous f32 (C,H,W) over five scales, each half the size of the one before.

    Negative factors count as 0. `border` is that of the last scale's similarity; the contrast-structure factors are
    means over the windows inside the picture (torchmetrics, whose value "reflect" gives, does the same).
    Raises ValueError for pictures under 176 pixels.
    """
    coarsest = min(truth.shape[1:]) >> (len(SCALE_WEIGHTS) - 1)
    if coarsest < _TAPS:
        raise ValueError(f"MS-SSIM needs at least {_TAPS << 4} pixels a side, but the picture has {truth.shape[1:]}")
    product = 1.0
    for scale, weight in enumerate(SCALE_WEIGHTS):
        last = scale == len(SCALE_WEIGHTS) - 1
        whole, contrast, windows = similarity(predicted, truth, data_range, border if last else "valid")
        product *= max((whole if last else contrast) / windows, 0.0) ** weight
        predicted, truth = _halved(predicted), _halved(truth)
    return product


def _halved(picture: np.ndarray) -> np.ndarray:
    from dpcli.evaluate.video import image_kernels as kernels  # it imports numba

    channels, height, width = picture.shape
    out = np.empty((channels, height // 2, width // 2), np.float32)
    kernels.halve(picture, out)
    return out


def similarity(predicted: np.ndarray, truth: np.ndarray, data_range: float, border: str) -> tuple[float, float, int]:
    """Returns the sums over windows of SSIM and of its contrast-structure factor, and their number, of contiguous f32 (C,H,W)."""
    from dpcli.evaluate.video import image_kernels as kernels  # it imports numba

    pad = _padding(truth.shape, border)
    single = np.float32
    constants = (single(data_range / 2), single((K1 * data_range) ** 2), single((K2 * data_range) ** 2))
    sums = kernels.similarity_sums(predicted, truth, gaussian_window()[: _REACH + 1].astype(single), pad, *constants)
    return float(sums[0]), float(sums[1]), _windows(truth.shape, pad)


def _padding(shape: tuple[int, ...], border: str) -> int:
    if border not in BORDERS:
        raise ValueError(f"border {border!r}: expected {' or '.join(BORDERS)}")
    if min(shape[1:]) < _TAPS:
        raise ValueError(f"SSIM needs pictures of at least {_TAPS} x {_TAPS} pixels, but this has {shape[1:]}")
    return _REACH if border == "reflect" else 0


def _windows(shape: tuple[int, ...], pad: int) -> int:
    channels, height, width = shape
    cut = 2 * (pad - _REACH)
    return channels * (height + cut) * (width + cut)


def gaussian_window() -> np.ndarray:
    """Returns the weights of the Gaussian window along one axis, f64 (11), sum 1."""
    weights = np.exp(-0.5 * (np.arange(-_REACH, _REACH + 1) / SIGMA) ** 2)
    return weights / weights.sum()
