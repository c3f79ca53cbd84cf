"""SSIM and MS-SSIM of pictures, and the float64 twin of SSIM as the tests' reference."""

from __future__ import annotations

import numpy as np

from dpcli.evaluate.video.psnr import check_pair, planar

BORDERS = ("valid", "reflect")
SIGMA, K1, K2 = 1.5, 0.01, 0.03  # Wang et al. 2004
SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # Wang et al. 2003
_TAPS = 11
_REACH = _TAPS // 2


def ssim(predicted: np.ndarray, truth: np.ndarray, *, data_range: float = 1.0, border: str = "valid") -> float:
    """Returns the structural similarity SSIM (Wang et al. 2004): Gaussian window 11 x 11 of sigma 1.5, population variances, K 0.01, 0.03.

    Mean over windows and channels of pictures (H,W) or (H,W,C). border "valid": windows inside the picture (what
    scikit-image and the authors' code average); "reflect": a window per pixel, the picture mirrored at its edges
    (torchmetrics). Raises ValueError when the picture is too small; else raises as `check_pair`.

    >>> ramp = np.tile(np.linspace(0, 1, 16, dtype=np.float32), (16, 1))
    >>> ssim(ramp, ramp), round(ssim(ramp, 1 - ramp), 3)
    (1.0, -0.827)
    """
    check_pair(predicted, truth, data_range)
    whole, _, windows = similarity(planar(predicted), planar(truth), data_range, border)
    return whole / windows


def ms_ssim(predicted: np.ndarray, truth: np.ndarray, *, data_range: float = 1.0, border: str = "valid") -> float:
    """Returns the multi-scale structural similarity MS-SSIM (Wang et al. 2003) over five scales, each half the size of the one before.

    Negative factors count as 0. `border` is that of the last scale's similarity; the contrast-structure factors are
    means over the windows inside the picture (torchmetrics, whose value "reflect" gives, does the same).
    Raises ValueError for pictures under 176 pixels; else raises as `check_pair`.
    """
    check_pair(predicted, truth, data_range)
    return multi_scale(planar(predicted), planar(truth), data_range, border)


def multi_scale(predicted: np.ndarray, truth: np.ndarray, data_range: float, border: str) -> float:
    """Returns `ms_ssim` of contiguous f32 (C,H,W)."""
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


def ssim_reference(
    predicted: np.ndarray, truth: np.ndarray, *, data_range: float = 1.0, border: str = "valid"
) -> float:
    """Returns `ssim` in float64 by numpy, as a reference, by the paper's formula: same arguments, same result to rounding."""
    check_pair(predicted, truth, data_range)
    pictures = [np.moveaxis(np.atleast_3d(p).astype(np.float64), -1, 0) for p in (predicted, truth)]
    whole, _, windows = _similarity_numpy(*pictures, data_range, _padding(pictures[0].shape, border))
    return whole / windows


def _similarity_numpy(
    predicted: np.ndarray, truth: np.ndarray, data_range: float, pad: int
) -> tuple[float, float, int]:
    p, t = (np.pad(x.astype(np.float64), ((0, 0), (pad, pad), (pad, pad)), mode="reflect") for x in (predicted, truth))
    mean_p, mean_t = _filtered(p), _filtered(t)
    var_p, var_t = (np.maximum(_filtered(x * x) - m * m, 0) for x, m in ((p, mean_p), (t, mean_t)))
    covariance = _filtered(p * t) - mean_p * mean_t
    c1, c2 = (K1 * data_range) ** 2, (K2 * data_range) ** 2
    contrast = (2 * covariance + c2) / (var_p + var_t + c2)
    whole = contrast * (2 * mean_p * mean_t + c1) / (mean_p**2 + mean_t**2 + c1)
    return float(whole.sum()), float(contrast.sum()), whole.size


def _filtered(planes: np.ndarray) -> np.ndarray:
    """Returns f64 (C,H,W) averaged over the Gaussian window, (C,H-10,W-10)."""
    rows = np.lib.stride_tricks.sliding_window_view(planes, _TAPS, axis=1) @ gaussian_window()
    return np.lib.stride_tricks.sliding_window_view(rows, _TAPS, axis=2) @ gaussian_window()
