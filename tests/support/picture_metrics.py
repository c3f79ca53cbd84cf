"""PSNR, SSIM and MS-SSIM of two pictures (H,W) or (H,W,C) by the code that scores videos, and SSIM by the paper's formula."""

from __future__ import annotations

import numpy as np

from dpcli.evaluate.video.picture_statistics import picture_compute, picture_update
from dpcli.evaluate.video.ssim import K1, K2, gaussian_window, multi_scale, similarity


def planar(picture: np.ndarray) -> np.ndarray:
    """A picture as contiguous f32 (C,H,W)."""
    return np.ascontiguousarray(np.moveaxis(np.atleast_3d(picture), -1, 0), np.float32)


def psnr(predicted: np.ndarray, truth: np.ndarray, *, data_range: float = 1.0, mask: np.ndarray | None = None) -> float:
    """Over all values, or over those of the pixels in `mask`."""
    inside = None if mask is None else mask.astype(np.uint8)
    pair = planar(predicted), planar(truth)
    found = picture_compute(picture_update(0, *pair, data_range=data_range, mask=inside, metrics=()))
    return found.psnr if mask is None else found.psnr_foreground


def ssim(predicted: np.ndarray, truth: np.ndarray, *, data_range: float = 1.0, border: str = "valid") -> float:
    whole, _, windows = similarity(planar(predicted), planar(truth), data_range, border)
    return whole / windows


def ms_ssim(predicted: np.ndarray, truth: np.ndarray, *, data_range: float = 1.0, border: str = "valid") -> float:
    return multi_scale(planar(predicted), planar(truth), data_range, border)


def ssim_reference(
    predicted: np.ndarray, truth: np.ndarray, *, data_range: float = 1.0, border: str = "valid"
) -> float:
    """`ssim` in float64 by numpy, by the paper's formula."""
    around = ((0, 0), *((5 if border == "reflect" else 0,) * 2,) * 2)
    planes = (np.moveaxis(np.atleast_3d(picture).astype(np.float64), -1, 0) for picture in (predicted, truth))
    p, t = (np.pad(picture, around, mode="reflect") for picture in planes)
    mean_p, mean_t = _filtered(p), _filtered(t)
    var_p, var_t = (np.maximum(_filtered(x * x) - m * m, 0) for x, m in ((p, mean_p), (t, mean_t)))
    covariance = _filtered(p * t) - mean_p * mean_t
    c1, c2 = (K1 * data_range) ** 2, (K2 * data_range) ** 2
    contrast = (2 * covariance + c2) / (var_p + var_t + c2)
    whole = contrast * (2 * mean_p * mean_t + c1) / (mean_p**2 + mean_t**2 + c1)
    return float(whole.mean())


def _filtered(planes: np.ndarray) -> np.ndarray:
    """f64 (C,H,W) averaged over the Gaussian window, (C,H-10,W-10)."""
    rows = np.lib.stride_tricks.sliding_window_view(planes, 11, axis=1) @ gaussian_window()
    return np.lib.stride_tricks.sliding_window_view(rows, 11, axis=2) @ gaussian_window()
