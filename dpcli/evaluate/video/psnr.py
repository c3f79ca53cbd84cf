"""PSNR of pictures, and what every metric of two pictures checks first."""

from __future__ import annotations

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.proportions import divide

PSNR_CAP = 100.0  # dB: what equal pictures score, whose PSNR is infinite (common_metrics does the same)


def planar(picture: np.ndarray) -> np.ndarray:
    """Returns a picture (H,W) or (H,W,C) of any number type as contiguous f32 (C,H,W). Raises ValueError on another shape."""
    if picture.ndim not in (2, 3):
        raise ValueError(f"a picture must have shape (H,W) or (H,W,C), but has {picture.shape}")
    picture = picture[..., None] if picture.ndim == 2 else picture
    return np.ascontiguousarray(np.moveaxis(picture, -1, 0), dtype=np.float32)


def check_pair(predicted: np.ndarray, truth: np.ndarray, data_range: float) -> None:
    """Raises ValueError when shapes differ; DataError for values that are not finite, or not of a picture in 0..data_range."""
    if predicted.shape != truth.shape:
        raise ValueError(f"pictures of shapes {predicted.shape} and {truth.shape}; expected equal ones")
    if not data_range > 0:
        raise DataError(f"data_range {data_range:g}: expected the largest possible difference of two values, above 0")
    largest = []
    for name, values in (("prediction", predicted), ("truth", truth)):
        largest.append(float(values.max()) if values.size else 0.0)
        if not np.isfinite(values).all():
            raise DataError(f"the {name} has {int((~np.isfinite(values)).sum())} values that are NaN or infinite")
        if largest[-1] > 1.5 * data_range:
            raise DataError(
                f"the {name} has values up to {largest[-1]:g}, but data_range is {data_range:g}; "
                "divide by 255, or give data_range=255"
            )
    if data_range == 255 and 0 < max(largest) <= 1:
        raise DataError(
            f"both pictures have values up to {max(largest):g}, but data_range is 255; multiply by 255, or data_range=1"
        )


def psnr_of(squared: np.ndarray | float, values: np.ndarray | float, data_range: np.ndarray | float) -> np.ndarray:
    """Returns 10 log10(range^2 / mean squared error) in dB, at most PSNR_CAP; NaN for no values.

    squared: sum of squared errors, values: their number, data_range: largest possible difference; numbers or arrays.

    >>> float(psnr_of(0.25, 25, 1.0)), float(psnr_of(0.0, 25, 1.0))
    (20.0, 100.0)
    """
    mean = divide(squared, values)
    with np.errstate(divide="ignore"):
        return np.minimum(10 * np.log10(np.square(data_range)) - 10 * np.log10(mean), PSNR_CAP)


def psnr(
    predicted: np.ndarray,  # (H,W) or (H,W,C)
    truth: np.ndarray,  # the same
    *,
    data_range: float = 1.0,
    mask: np.ndarray | None = None,  # bool (H,W)
) -> float:
    """Returns the peak signal-to-noise ratio (PSNR) in dB over all values, or over those of the pixels in `mask`; at most PSNR_CAP.

    NaN for an empty mask. Raises as `check_pair`.

    >>> round(psnr(np.full((4, 4), 0.5), np.full((4, 4), 0.6)), 3)
    20.0
    """
    from dpcli.evaluate.video.image_kernels import squared_errors  # it imports numba

    check_pair(predicted, truth, data_range)
    predicted, truth = planar(predicted), planar(truth)
    mask = np.ones(truth.shape[1:], np.uint8) if mask is None else np.ascontiguousarray(mask, dtype=np.uint8)
    _, inside = squared_errors(predicted, truth, mask)
    return float(psnr_of(inside, int(mask.sum()) * len(truth), data_range))
