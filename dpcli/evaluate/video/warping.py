"""Temporal consistency: how well each frame is explained by the one before, moved along the optical flow."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import reduce

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.proportions import divide
from dpcli.evaluate.video.frechet_features import check_picture_values

SMALLEST = 16  # pixels a side
SLOPE, OFFSET = 0.01, 0.5  # of the tolerated loop, in squared pixels (Sundaram et al. 2010, eq. 5)


@dataclass(frozen=True)
class WarpingStatistics:
    """Sums over pairs of neighboring frames: what `warping_compute` divides.

    squared, absolute: of the prediction's errors over `values` numbers (pixels that both frames show, times 3 channels);
    truth_squared, truth_absolute: of the truth's own, 0 where there is none. pixels: all, seen or not.
    """

    squared: float = 0.0
    absolute: float = 0.0
    truth_squared: float = 0.0
    truth_absolute: float = 0.0
    values: int = 0
    pixels: int = 0
    pairs: int = 0

    def __add__(self, other: WarpingStatistics) -> WarpingStatistics:
        """Statistics of both together."""
        return WarpingStatistics(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


@dataclass(frozen=True)
class WarpingMetrics:
    """Warping errors of colors in 0..1: mean squared (what the field reports) and absolute, and the truth's own.

    occluded: share of the pixels left out. NaN = undefined: no pairs, no pixel seen twice, or no truth.
    """

    squared: float
    absolute: float
    truth_squared: float
    truth_absolute: float
    occluded: float
    pairs: int
    flow_of: str


class Warping:
    """Warping error of a video while its frames stream in; holds the frame before.

    E = mean over the pixels seen in both frames of (x_t(p) - x_(t-1)(p + f(p)))^2 (Lai et al. 2018, eq. 6 and 7), f the
    flow from frame t back to t - 1 of OpenCV's DIS on 8-bit gray pictures: of the truth, else of the prediction, which
    then is judged by its own motion. A pixel counts as seen when its partner lies inside the picture and the flow back
    and forth ends where it began: |f(p) + g(p + f(p))|^2 <= 0.01 (|f|^2 + |g|^2) + 0.5.
    """

    def __init__(self) -> None:
        self._before: tuple[np.ndarray, np.ndarray | None, np.ndarray] | None = None
        self._found = WarpingStatistics()
        self.flow_of = "prediction"

    def add(self, predicted: np.ndarray, truth: np.ndarray | None = None) -> None:
        """The next frame, f32 (3,H,W) in 0..1. DataError as `check_picture_values`, and for pictures under 16 pixels.

        ValueError for sizes that differ, and for a truth that comes and goes.
        """
        for picture in (predicted, truth):
            if picture is not None:
                _check(picture, predicted)
        self.flow_of = "prediction" if truth is None else "truth"
        gray = _gray(predicted if truth is None else truth)
        if self._before is not None:
            self._found += _pair(self._before, (predicted, truth, gray))
        self._before = (predicted, truth, gray)

    def restart(self) -> None:
        """Frames are missing here: the next one is no neighbor of the last one."""
        self._before = None

    def result(self) -> WarpingStatistics:
        """DataError when no two frames followed each other."""
        if not self._found.pairs:
            raise DataError("temporal consistency compares neighboring frames: at least 2 in a row are needed")
        return self._found


def warping_merge(parts: Iterable[WarpingStatistics]) -> WarpingStatistics:
    """Statistics of all videos together."""
    return reduce(WarpingStatistics.__add__, parts, WarpingStatistics())


def warping_compute(found: WarpingStatistics, flow_of: str = "truth") -> WarpingMetrics:
    """Statistics -> errors per value. flow_of: whose flow moved the frames; without a truth it has no errors."""
    sums = (found.squared, found.absolute, found.truth_squared, found.truth_absolute)
    errors = [float(divide(one, found.values)) for one in sums]
    if flow_of != "truth":
        errors[2:] = [float("nan")] * 2
    hidden = float(divide(3 * found.pixels - found.values, 3 * found.pixels))
    return WarpingMetrics(*errors, hidden, found.pairs, flow_of)


def optical_flow(gray: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Flow f32 (H,W,2), x and y in pixels, with other(p + f(p)) = gray(p); u8 (H,W). OpenCV's DIS, preset medium."""
    import cv2

    return cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(gray, other, None)


def moved(picture: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """picture(p + flow(p)), bilinear: (H,W,C) of C <= 4 with flow (H,W,2) in pixels -> f32 (H,W,C); edges repeat."""
    import cv2

    where = _partners(flow)
    source = np.ascontiguousarray(picture, np.float32)
    return cv2.remap(source, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def seen_in_both(back: np.ndarray, forth: np.ndarray) -> np.ndarray:
    """bool (H,W): pixels whose partner lies inside, and whose loop back (H,W,2) and forth (H,W,2) closes.

    Inside is half a pixel wider than the outermost centers: a flow near 0 doesn't push the edge out.
    """
    height, width = back.shape[:2]
    where = _partners(back)
    inside = (where >= -0.5).all(-1) & (where[..., 0] <= width - 0.5) & (where[..., 1] <= height - 0.5)
    returned = moved(forth, back)
    lengths = np.square(back).sum(-1) + np.square(returned).sum(-1)
    return inside & (np.square(back + returned).sum(-1) <= SLOPE * lengths + OFFSET)


def _pair(before: Sequence[np.ndarray | None], now: Sequence[np.ndarray | None]) -> WarpingStatistics:
    back, forth = optical_flow(now[2], before[2]), optical_flow(before[2], now[2])
    seen = seen_in_both(back, forth)
    squared, absolute = _errors(before[0], now[0], back, seen)
    own = (0.0, 0.0) if now[1] is None else _errors(before[1], now[1], back, seen)
    return WarpingStatistics(squared, absolute, *own, 3 * int(seen.sum()), seen.size, 1)


def _errors(before: np.ndarray, now: np.ndarray, back: np.ndarray, seen: np.ndarray) -> tuple[float, float]:
    apart = (now.transpose(1, 2, 0) - moved(before.transpose(1, 2, 0), back))[seen].astype(np.float64)
    return float(np.square(apart).sum()), float(np.abs(apart).sum())


def _partners(flow: np.ndarray) -> np.ndarray:
    height, width = flow.shape[:2]
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
    return (grid + flow).astype(np.float32)


def _gray(picture: np.ndarray) -> np.ndarray:
    import cv2

    rgb = (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)
    return cv2.cvtColor(np.ascontiguousarray(rgb.transpose(1, 2, 0)), cv2.COLOR_RGB2GRAY)


def _check(picture: np.ndarray, other: np.ndarray) -> None:
    check_picture_values(picture)
    if picture.shape != other.shape:
        raise ValueError(f"frames of shapes {picture.shape} and {other.shape}; expected equal ones")
    if min(picture.shape[1:]) < SMALLEST:
        raise DataError(f"frames of {picture.shape[2]}x{picture.shape[1]}: optical flow needs {SMALLEST} pixels a side")
