"""Warping error: how well each frame is explained by the one before, moved along the optical flow (Lai et al. 2018)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.proportions import divide, mean_defined
from dpcli.evaluate.results import merge_statistics
from dpcli.evaluate.video.frechet.frame_inputs import check_picture_values
from dpcli.evaluate.video.learned.base import FrameGap, LearnedMetric, LearnedScore
from dpcli.ops.optical_flow import optical_flow, seen_in_both, warped

SMALLEST = 16  # pixels a side


@dataclass(frozen=True)
class WarpingStatistics:
    """Holds sums over pairs of neighboring frames: what `warping_compute` divides.

    squared, absolute: of the prediction's errors over `values` numbers (pixels that both frames show, times 3 channels);
    truth_squared, truth_absolute: of the truth's own. pixels: all, seen or not.
    """

    squared: float = 0.0
    absolute: float = 0.0
    truth_squared: float = 0.0
    truth_absolute: float = 0.0
    values: int = 0
    pixels: int = 0
    pairs: int = 0


@dataclass(frozen=True)
class WarpingMetrics:
    """Holds warping errors of colors in 0..1: mean squared (what the field reports) and absolute, and the truth's own.

    occluded: share of the pixels left out. NaN = undefined: no pairs, or no pixel seen twice.
    """

    squared: float
    absolute: float
    truth_squared: float
    truth_absolute: float
    occluded: float
    pairs: int


class WarpingError:
    """Sums the warping error of a video while its frames stream in; holds the frame before.

    E = mean over the pixels seen in both frames of (x_t(p) - x_(t-1)(p + f(p)))^2 (Lai et al. 2018, eq. 6 and 7), f the
    truth's flow from frame t back to t - 1, of OpenCV's DIS on 8-bit gray pictures. A pixel counts as seen when its
    partner lies inside the picture and the flow back and forth ends where it began:
    |f(p) + g(p + f(p))|^2 <= 0.01 (|f|^2 + |g|^2) + 0.5.
    """

    def __init__(self) -> None:
        self._before: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        self._found = WarpingStatistics()

    def add(self, predicted: np.ndarray, truth: np.ndarray) -> None:
        """Takes the next frame f32 (3,H,W), 0..1. Raises DataError as `check_picture_values`, and for pictures under 16 pixels.

        Raises ValueError where prediction and truth differ in size.
        """
        for picture in (predicted, truth):
            _check(picture, predicted)
        gray = _gray(truth)
        if self._before is not None:
            pair = _compare_pair(self._before, (predicted, truth, gray))
            self._found = merge_statistics([self._found, pair])
        self._before = (predicted, truth, gray)

    def restart(self) -> None:
        """Says that frames are missing here: the next one is no neighbor of the last one."""
        self._before = None

    def result(self) -> WarpingStatistics:
        """Returns the sums of all pairs. Raises DataError when no two frames followed each other."""
        if not self._found.pairs:
            raise DataError("temporal consistency compares neighboring frames: at least 2 in a row are needed")
        return self._found


def warping_compute(found: WarpingStatistics) -> WarpingMetrics:
    """Returns the errors per value."""
    sums = (found.squared, found.absolute, found.truth_squared, found.truth_absolute)
    errors = (float(divide(one, found.values)) for one in sums)
    hidden = float(divide(3 * found.pixels - found.values, 3 * found.pixels))
    return WarpingMetrics(*errors, hidden, found.pairs)


def _compare_pair(before: Sequence[np.ndarray], now: Sequence[np.ndarray]) -> WarpingStatistics:
    back, forth = optical_flow(now[2], before[2]), optical_flow(before[2], now[2])
    seen = seen_in_both(back, forth)
    squared, absolute = _errors(before[0], now[0], back, seen)
    own = _errors(before[1], now[1], back, seen)
    return WarpingStatistics(squared, absolute, *own, 3 * int(seen.sum()), seen.size, 1)


def _errors(before: np.ndarray, now: np.ndarray, back: np.ndarray, seen: np.ndarray) -> tuple[float, float]:
    apart = (now.transpose(1, 2, 0) - warped(before.transpose(1, 2, 0), back))[seen].astype(np.float64)
    return float(np.square(apart).sum()), float(np.abs(apart).sum())


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


class WarpingMetric(LearnedMetric):
    """Measures the mean squared warping error along the truth's flow, then over views; the truth's own stands beside it.

    A view counts the same whatever its share of occluded pixels, as it does in comparisons and intervals.
    """

    def __init__(self) -> None:
        self._parts: dict[str, Any] = {}

    def start(self, view: str) -> None:
        self._warping, self._gap, self._view = WarpingError(), FrameGap(), view

    def add(self, predicted: np.ndarray, truth: np.ndarray, frame: int) -> None:
        """Compares the next frame with the one before, moved along the flow, unless frames between them are missing."""
        if self._gap.before(frame):
            self._warping.restart()
        self._warping.add(predicted, truth)

    def end(self) -> None:
        self._parts[self._view] = self._warping.result()

    def score(self) -> LearnedScore:
        each = {view: warping_compute(part) for view, part in self._parts.items()}
        value, own = (
            mean_defined(np.array([getattr(one, key) for one in each.values()])) for key in ("squared", "truth_squared")
        )
        shown = [one for one in each.values() if not np.isnan(one.squared)]
        counts = {"views": len(shown), "pairs": sum(one.pairs for one in shown)}
        choices = {
            "flow": "OpenCV DIS of the truth, forward-backward check",
            "error": "mean square, colors in 0..1",
            "mean": "over the pixels of each view, then over views",
            "occluded": round(warping_compute(merge_statistics(self._parts.values())).occluded, 4),
        }
        return LearnedScore("warping", value, {view: one.squared for view, one in each.items()}, own, counts, choices)
