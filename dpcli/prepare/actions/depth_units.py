"""Says what raw depths mean: marks of pixels that saw nothing, raw units per meter, and whether the result can be true."""

from __future__ import annotations

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.median import median

_MARKS_16 = 65533  # this and more in 16 bits say that nothing was measured
_MARKS_FLOAT = (65504.0, 65535.0)  # the largest half, and a mark of 16 bits that became a float
_TOO_LARGE = 1e9  # raw floats beyond are marks, whatever the unit
_PLAUSIBLE = (0.005, 200.0)  # meters that depth cameras see, typically
_PLAUSIBLE_IF_ASKED = (0.005, 1000.0)  # where the user gave the units
_SAMPLED = 4096


def usual_scale(kind: np.dtype) -> float:
    """Returns raw units per meter when nobody says them: millimeters in whole numbers, centimeters in 8 bits, or meters."""
    return 1.0 if kind.kind == "f" else 100.0 if kind.itemsize == 1 else 1000.0


def without_marks(frames: np.ndarray) -> tuple[np.ndarray, dict[str, int]]:
    """Returns frames (T,H,W) with 0 where a value only marks that nothing was seen, and notes of how many those were.

    Marks are the largest values of 16 bits and of wider numbers, NaN, infinity, and floats that no length can be.
    """
    marked = _marks(frames)
    count = 0 if marked is None else int(np.count_nonzero(marked))
    if not count:
        return frames, {}
    return np.where(marked, frames.dtype.type(0), frames), {
        "pixels without a depth (NaN, 65535 and the like) dropped": count
    }


def _marks(frames: np.ndarray) -> np.ndarray | None:
    kind = frames.dtype
    if kind.kind == "f":
        largest = float(np.max(frames, initial=0))  # NaN, when there is one
        if largest < _MARKS_FLOAT[0] and float(np.min(frames, initial=0)) > -np.inf:
            return None
        with np.errstate(invalid="ignore"):
            return ~np.isfinite(frames) | (frames > _TOO_LARGE) | np.isin(frames, np.array(_MARKS_FLOAT, kind))
    if kind.itemsize == 1:
        return None
    largest = int(np.max(frames, initial=0))
    if kind.itemsize == 2:
        least = _MARKS_16 if kind.kind == "u" else np.iinfo(kind).max
        return frames >= least if largest >= least else None
    return (frames == 65535) | (frames >= np.iinfo(np.int32).max) if largest >= 65535 else None


def require_plausible(name: str, depths: np.ndarray, scale: float, *, asked: bool) -> None:
    """Raises DataError when depths in meters, f32 (P), can't be those of a depth camera.

    scale: the raw units per meter that made them. asked: whether the user gave it.
    """
    if not len(depths):
        return
    typical = float(median(depths[:: max(1, len(depths) // _SAMPLED)]))
    least, most = _PLAUSIBLE_IF_ASKED if asked else _PLAUSIBLE
    if least <= typical <= most:
        return
    raw = typical * scale
    better = next((own for own in (1 / scale, 1000.0, 1.0, 10_000.0) if 0.1 <= raw / own <= 100.0), None)
    hint = (
        f"did you mean --depth-scale {better:.6g}, which makes it {raw / better:.3g} m?"
        if better
        else "see --depth-scale"
    )
    keep = "" if asked or typical < least else f" If it is true, say so: --depth-scale {scale:g}."
    raise DataError(
        f"{name}: {scale:g} raw units per meter put the scene at {typical:,.6g} m (median), which no depth camera sees;"
        f" {hint}{keep}"
    )
