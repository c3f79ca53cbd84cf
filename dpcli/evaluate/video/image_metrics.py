"""Picture metrics: PSNR, SSIM and MS-SSIM of arrays, and their sufficient statistics over the frames of a video."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.proportions import divide, mean_defined

PSNR_CAP = 100.0  # dB: what equal pictures score, whose PSNR is infinite (common_metrics does the same)
BORDERS = ("valid", "reflect")
SIGMA, K1, K2 = 1.5, 0.01, 0.03  # Wang et al. 2004
SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # Wang et al. 2003
_TAPS = 11
_REACH = _TAPS // 2


@dataclass(frozen=True)
class PictureStatistics:
    """Holds one row per frame, in the order the frames came; F frames.

    frame i64 (F): its number. squared f64 (F), values i64 (F): sum of squared errors, and of how many values; inside,
    inside_values: the same over the object's pixels. data_range f64 (F). similarity f64 (F), windows i64 (F): sum of
    SSIM, and over how many windows; multi_scale f64 (F): MS-SSIM. NaN or 0 windows where a metric wasn't asked for.
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

    def __add__(self, other: PictureStatistics) -> PictureStatistics:
        """Returns the statistics of both sets of frames together."""
        return picture_merge([self, other])


@dataclass(frozen=True)
class PictureMetrics:
    """Holds means over frames; psnr in dB. NaN = undefined or not asked for.

    pixels: of one frame. exact: frames without any error, which count as PSNR_CAP. without_object: frames whose mask is
    empty, which psnr_foreground leaves out. worst: frame of the largest squared error, -1 = none has any.
    """

    psnr: float
    psnr_foreground: float
    ssim: float
    ms_ssim: float
    frames: int
    pixels: int
    object_pixels: int
    exact: int
    without_object: int
    worst: int


def planar(picture: np.ndarray) -> np.ndarray:
    """Returns a picture (H,W) or (H,W,C) of any number type as contiguous f32 (C,H,W). ValueError on another shape."""
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
        return np.minimum(10 * np.log10(divide(np.square(data_range), 1.0)) - 10 * np.log10(mean), PSNR_CAP)


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
    check_pair(predicted, truth, data_range)
    predicted, truth = planar(predicted), planar(truth)
    mask = np.ones(truth.shape[1:], np.uint8) if mask is None else np.ascontiguousarray(mask, dtype=np.uint8)
    _, inside = _kernels().squared_errors(predicted, truth, mask)
    return float(psnr_of(inside, int(mask.sum()) * len(truth), data_range))


def ssim(predicted: np.ndarray, truth: np.ndarray, *, data_range: float = 1.0, border: str = "valid") -> float:
    """Returns the structural similarity SSIM (Wang et al. 2004): Gaussian window 11 x 11 of sigma 1.5, population variances, K 0.01, 0.03.

    Mean over windows and channels of pictures (H,W) or (H,W,C). border "valid": windows inside the picture (what
    scikit-image and the authors' code average); "reflect": a window per pixel, the picture mirrored at its edges
    (torchmetrics). ValueError when the picture is too small; else raises as `check_pair`.

    >>> ramp = np.tile(np.linspace(0, 1, 16, dtype=np.float32), (16, 1))
    >>> ssim(ramp, ramp), round(ssim(ramp, 1 - ramp), 3)
    (1.0, -0.588)
    """
    check_pair(predicted, truth, data_range)
    whole, _, windows = similarity(planar(predicted), planar(truth), data_range, border)
    return whole / windows


def ms_ssim(predicted: np.ndarray, truth: np.ndarray, *, data_range: float = 1.0, border: str = "valid") -> float:
    """Returns the multi-scale structural similarity MS-SSIM (Wang et al. 2003) over five scales, each half the size of the one before.

    Negative factors count as 0. `border` is that of the last scale's similarity; the contrast-structure factors are
    means over the windows inside the picture (torchmetrics, whose value "reflect" gives, does the same).
    ValueError for pictures under 176 pixels; else raises as `check_pair`.
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
    channels, height, width = picture.shape
    out = np.empty((channels, height // 2, width // 2), np.float32)
    _kernels().halve(picture, out)
    return out


def similarity(predicted: np.ndarray, truth: np.ndarray, data_range: float, border: str) -> tuple[float, float, int]:
    """Returns the sums over windows of SSIM and of its contrast-structure factor, and their number, of contiguous f32 (C,H,W)."""
    pad = _padding(truth.shape, border)
    single = np.float32
    constants = (single(data_range / 2), single((K1 * data_range) ** 2), single((K2 * data_range) ** 2))
    sums = _kernels().similarity_sums(predicted, truth, gaussian_window()[: _REACH + 1].astype(single), pad, *constants)
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


def _kernels():  # -> module; it imports numba
    from dpcli.evaluate.video import image_kernels

    return image_kernels


def ssim_reference(
    predicted: np.ndarray, truth: np.ndarray, *, data_range: float = 1.0, border: str = "valid"
) -> float:
    """Returns `ssim` by its float64 numpy twin, after the paper's formula: same arguments, same result to rounding."""
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


def picture_update(
    frame: int,
    predicted: np.ndarray,  # f32 (C,H,W), finite
    truth: np.ndarray,  # f32 (C,H,W), finite
    *,
    data_range: float = 1.0,
    similarity_range: float | None = None,
    mask: np.ndarray | None = None,  # u8 (H,W)
    border: str = "valid",
    metrics: Iterable[str] = ("psnr", "ssim"),
) -> PictureStatistics:
    """Returns the statistics of one frame. Without a mask the object's share is empty. similarity_range: SSIM's, if it has its own."""
    inside = np.zeros(truth.shape[1:], np.uint8) if mask is None else mask
    squared, object_squared = _kernels().squared_errors(predicted, truth, inside)
    own = data_range if similarity_range is None else similarity_range
    whole, _, windows = similarity(predicted, truth, own, border) if "ssim" in metrics else (0.0, 0.0, 0)
    many = multi_scale(predicted, truth, own, border) if "ms_ssim" in metrics else np.nan
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
    )
    types = (np.int64, float, np.int64, float, np.int64, float, float, np.int64, float)
    return PictureStatistics(*(np.array([value], kind) for value, kind in zip(found, types, strict=True)))


def picture_merge(parts: Iterable[PictureStatistics]) -> PictureStatistics:
    """Returns the statistics of several sets of frames, one after the other. ValueError for none."""
    rows = [[getattr(part, f.name) for f in fields(PictureStatistics)] for part in parts]
    if not rows:
        raise ValueError("no statistics to merge")
    return PictureStatistics(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def frame_psnr(found: PictureStatistics) -> np.ndarray:
    """Returns the PSNR of each frame in dB, f64 (F)."""
    return psnr_of(found.squared, found.values, found.data_range)


def picture_compute(found: PictureStatistics) -> PictureMetrics:
    """Returns the metrics of RGB frames: each the mean of the frames' own values."""
    each = frame_psnr(found)
    objects = psnr_of(found.inside, found.inside_values, found.data_range)
    return PictureMetrics(
        psnr=mean_defined(each),
        psnr_foreground=mean_defined(objects),
        ssim=mean_defined(divide(found.similarity, found.windows)),
        ms_ssim=mean_defined(found.multi_scale),
        frames=len(each),
        pixels=int(found.values[0] // 3) if len(each) else 0,
        object_pixels=int(found.inside_values.sum() // 3),
        exact=int((found.squared == 0).sum()),
        without_object=int((found.inside_values == 0).sum()),
        worst=int(found.frame[np.argmax(found.squared)]) if found.squared.any() else -1,
    )
