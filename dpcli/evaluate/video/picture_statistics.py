"""PSNR, SSIM and overlap of silhouettes over the frames of a video: frames -> sufficient statistics -> metrics."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dpcli.evaluate.proportions import divide, mean_defined
from dpcli.evaluate.video.ssim import multi_scale, similarity

PSNR_CAP = 100.0  # dB: what equal pictures score, whose PSNR is infinite (common_metrics does the same)


@dataclass(frozen=True)
class PictureStatistics:
    """Holds one row per frame, in the order the frames came; F frames.

    frame i64 (F): its number. squared f64 (F), values i64 (F): sum of squared errors, and of how many values; inside,
    inside_values: the same over the object's pixels. data_range f64 (F). similarity f64 (F), windows i64 (F): sum of
    SSIM, and over how many windows; multi_scale f64 (F): MS-SSIM. overlap, union i64 (F): pixels in both silhouettes, in
    either. NaN, 0 windows or an empty union where a metric wasn't asked for.
    """

    frame: np.ndarray
    squared: np.ndarray
    values: np.ndarray
    inside: np.ndarray
    inside_values: np.ndarray
    data_range: np.ndarray
    similarity: np.ndarray
    windows: np.ndarray
    multi_scale: np.ndarray
    overlap: np.ndarray
    union: np.ndarray


@dataclass(frozen=True)
class PictureMetrics:
    """Holds means over frames; psnr in dB. NaN = undefined or not asked for.

    pixels: of one frame. exact: frames without any error, which count as PSNR_CAP. without_object: frames whose mask is
    empty, which psnr_foreground leaves out; silhouette_iou leaves out those in which both are. worst: frame of the largest
    squared error, -1 = none has any.
    """

    psnr: float
    psnr_foreground: float
    ssim: float
    ms_ssim: float
    silhouette_iou: float
    frames: int
    pixels: int
    object_pixels: int
    exact: int
    without_object: int
    worst: int


def picture_update(
    frame: int,
    predicted: np.ndarray,  # f32 (C,H,W), finite
    truth: np.ndarray,  # f32 (C,H,W), finite
    *,
    data_range: float = 1.0,
    similarity_range: float | None = None,
    mask: np.ndarray | None = None,  # u8 (H,W)
    predicted_mask: np.ndarray | None = None,  # u8 (H,W)
    border: str = "valid",
    metrics: Iterable[str] = ("psnr", "ssim"),
) -> PictureStatistics:
    """Returns the statistics of one frame. Without a mask the object's share is empty. similarity_range: SSIM's, if it has its own.

    predicted_mask: the predicted object; without it the silhouettes' union is empty.
    """
    from dpcli.evaluate.video.image_kernels import squared_errors  # it imports numba

    inside = np.zeros(truth.shape[1:], np.uint8) if mask is None else mask
    squared, object_squared = squared_errors(predicted, truth, inside)
    own = data_range if similarity_range is None else similarity_range
    whole, _, windows = similarity(predicted, truth, own, border) if "ssim" in metrics else (0.0, 0.0, 0)
    many = multi_scale(predicted, truth, own, border) if "ms_ssim" in metrics else np.nan
    other = np.zeros_like(inside) if predicted_mask is None else predicted_mask
    either = 0 if predicted_mask is None else int((inside | other).sum())
    found = (
        frame,
        squared,
        truth.size,
        object_squared,
        int(inside.sum()) * len(truth),
        data_range,
        whole,
        windows,
        many,
        int((inside & other).sum()),
        either,
    )
    types = (np.int64, float, np.int64, float, np.int64, float, float, np.int64, float, np.int64, np.int64)
    return PictureStatistics(*(np.array([value], kind) for value, kind in zip(found, types, strict=True)))


def psnr_of(squared: np.ndarray | float, values: np.ndarray | float, data_range: np.ndarray | float) -> np.ndarray:
    """Returns the peak signal-to-noise ratio, 10 log10(range^2 / mean squared error), in dB, at most PSNR_CAP; NaN for no values.

    squared: sum of squared errors, values: their number, data_range: largest possible difference; numbers or arrays.

    >>> float(psnr_of(0.25, 25, 1.0)), float(psnr_of(0.0, 25, 1.0))
    (20.0, 100.0)
    """
    mean = divide(squared, values)
    with np.errstate(divide="ignore"):
        return np.minimum(10 * np.log10(np.square(data_range)) - 10 * np.log10(mean), PSNR_CAP)


def picture_compute(found: PictureStatistics) -> PictureMetrics:
    """Returns the metrics of RGB frames: each the mean of the frames' own values."""
    each = psnr_of(found.squared, found.values, found.data_range)
    objects = psnr_of(found.inside, found.inside_values, found.data_range)
    return PictureMetrics(
        psnr=mean_defined(each),
        psnr_foreground=mean_defined(objects),
        ssim=mean_defined(divide(found.similarity, found.windows)),
        ms_ssim=mean_defined(found.multi_scale),
        silhouette_iou=mean_defined(divide(found.overlap, found.union)),
        frames=len(each),
        pixels=int(found.values[0] // 3) if len(each) else 0,
        object_pixels=int(found.inside_values.sum() // 3),
        exact=int((found.squared == 0).sum()),
        without_object=int((found.inside_values == 0).sum()),
        worst=int(found.frame[np.argmax(found.squared)]) if found.squared.any() else -1,
    )
