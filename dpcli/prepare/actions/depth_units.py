"""Says what raw depths mean: marks of pixels that saw nothing, raw units per meter, and whether the result can be true."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.median import median

_MARKS_16 = 65533  # this and more in 16 bits say that nothing was measured
_MARKS_FLOAT = (65504.0, 65535.0)  # the largest half, and a mark of 16 bits that became a float
_TOO_LARGE = 1e9  # raw floats beyond are marks, whatever the unit
_PLAUSIBLE = (0.005, 100.0)  # meters that depth cameras see, typically
_PLAUSIBLE_IF_ASKED = (0.005, 1000.0)  # where the user gave the units
_SAMPLED = 4096
_ROUGH, _SMOOTHER = 0.01, 8.0  # how much neighbors differ, as a share of the mean; how much less with bytes swapped
_STEPS = {8: 8000, 5: 5000}  # what raw depths are multiples of -> raw units per meter, of a sensor's millimeters
_SAME_REST, _KINDS = 0.9, 32  # share of depths with one rest, and different depths that make it no chance
_MARKED, _WELL_BELOW = 0.005, 0.97  # share of pixels that hold a mark; up to where the others reach then
_FAR_BELOW = 0.25  # up to where they reach where the mark is no largest number of some bits
# width by height, and share of pixels with a depth, of a lidar's points drawn into a street's picture
_WIDE, _SPARSE = (3, 0.5)
LIKE_VIRTUAL_KITTI = (
    "videos of pictures as wide as those of streets, full of depths; if they are Virtual KITTI's, 100 units are a meter: give"
    " --depth-scale 100"
)
LIKE_KITTI = (
    "videos of wide pictures with few depths; if they are KITTI's, 256 units are a meter: give --depth-scale 256"
)
_OF_TUM = ("depth.txt", "associations.txt", "association.txt", "associate.txt", "associated.txt")
_FAR_INDOORS = 4000  # raw units: four meters of millimeters, or the desk of a data set like TUM's
LIKE_TUM = "videos beside {}, a list as TUM's data sets have it; if they are of their kind, 5000 units are a meter: give --depth-scale 5000"
UP_TO_ONE = (
    "videos of depths that end at exactly 1, as a depth buffer's or those divided by the largest do; taken for meters"
    " (--depth-scale, --far)"
)
_ALONG_RAY = re.compile(
    r"distances?(?!_to_image_plane)(?![a-z])|depth_meters|ray_?(length|depth)|radial|euclid|long[ _]?throw|ahat|depth_?perspective",
    re.IGNORECASE,
)
_RELATIVE = re.compile(r"midas|(?<![a-z])dpt[-_](beit|swin|large|hybrid|levit|next)|marigold", re.IGNORECASE)
_PANORAMA = re.compile(r"panoram|(?<![a-z])pano(?![a-z])|equirect|(?<![a-z])erp(?![a-z])", re.IGNORECASE)
_BAND = 6  # times as wide as high: what turning lidars see, and no depth camera
LIKE_RANGES = (
    "videos of pictures many times as wide as high, as turning lidars' range images are, whose columns are angles and whose numbers"
    " lengths of rays; taken for a camera's (their points are read by `dpc prepare clouds`)"
)
_ROWS = 16  # of a frame that are looked at


def usual_scale(kind: np.dtype) -> float:
    """Returns raw units per meter where they are not given: millimeters in whole numbers, centimeters in 8 bits, or meters."""
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
        with np.errstate(invalid="ignore", over="ignore"):
            return ~np.isfinite(frames) | (frames > _TOO_LARGE) | np.isin(frames, np.array(_MARKS_FLOAT, kind))
    if kind.itemsize == 1:
        return None
    largest = int(np.max(frames, initial=0))
    if kind.itemsize == 2:
        least = _MARKS_16 if kind.kind == "u" else np.iinfo(kind).max
        return frames >= least if largest >= least else None
    return (frames == 65535) | (frames >= np.iinfo(np.int32).max) if largest >= 65535 else None


def doubts_of_name(name: str) -> dict[str, int]:
    """Returns a note where a video's name says distances from the camera's center, or what a network makes of one picture."""
    if said := _ALONG_RAY.search(name):
        return {
            f"videos that by their names hold distances from the camera ({said[0]}), taken for depth along its axis; if they are"
            " lengths of the rays, as Hypersim's are, flat walls come out bent: divide each by that of its pixel's ray": 1
        }
    if said := _RELATIVE.search(name):
        return {
            f"videos that by their names are what a network guessed from one picture ({said[0]}): as a rule neither meters nor, as"
            " MiDaS's, depth but its inverse; taken for depth": 1
        }
    return {}


def doubts_of_shape(path: Path, name: str, width: int, height: int) -> dict[str, int]:
    """Returns a note where pictures are so wide that no camera took them. Raises DataError where they are panoramas, by their
    name and shape.
    """
    if width == 2 * height and _PANORAMA.search(name):
        raise DataError(
            f"{path}: by its name and its shape ({width}x{height}) it holds panoramas, whose columns are angles; expected depth of"
            " a pinhole camera: cut views out of them (such as with py360convert's e2p), or call it otherwise if it isn't so"
        )
    return {LIKE_RANGES: 1} if width >= _BAND * height > _BAND else {}


def require_byte_order(name: str, frames: np.ndarray) -> None:
    """Raises DataError when depths (T,H,W) of 16 bits have their two bytes the other way round: then neighbors differ wildly."""
    if frames.dtype.itemsize != 2 or frames.dtype.kind == "f":
        return
    frame = frames[len(frames) // 2]
    some = frame[:: max(1, len(frame) // _ROWS)]
    rough = _roughness(some)
    if rough > _ROUGH and rough > _SMOOTHER * _roughness(some.byteswap()) and _kinds(some) > _KINDS:
        raise DataError(
            f"{name}: its depths leap from pixel to pixel, as where the two bytes of each are the wrong way round; write"
            " them again in the byte order that the format prescribes, such as by NumPy's byteswap"
        )


def _roughness(rows: np.ndarray) -> float:
    """Returns how much neighbors in rows (R,W) differ where both saw something, as a share of their mean."""
    values = rows.astype(np.float32)
    both = (values[:, 1:] > 0) & (values[:, :-1] > 0)
    return float(np.abs(np.diff(values))[both].mean() / values[:, 1:][both].mean()) if both.any() else 0.0


def doubts_of_units(frames: np.ndarray) -> dict[str, int]:
    """Returns a note when raw depths (T,H,W) of 16 bits go in steps of 8 or 5, as data sets store what a sensor measured
    in millimeters; the low bits of 8 may hold flags. Or when they are wide pictures with few depths, as KITTI has them of its
    lidar; or such with many; or floats of which many are 1 and none more, as where a range was divided by its end.
    """
    middle = frames[len(frames) // 2]
    if frames.dtype.kind == "f":
        several = np.count_nonzero(middle == 1) > _MARKED * middle.size
        return {UP_TO_ONE: 1} if several and frames.max() == 1 and ((middle > 0) & (middle < 1)).any() else {}
    if frames.dtype.itemsize != 2:
        return {}
    if middle.shape[1] >= _WIDE * middle.shape[0]:
        return {LIKE_KITTI if np.count_nonzero(middle) < _SPARSE * middle.size else LIKE_VIRTUAL_KITTI: 1}
    some = _some_depths(frames)
    if _mark(some) or _kinds(some) <= _KINDS:
        return {}
    for step, scale in _STEPS.items():
        alike, coarser = (np.bincount(some % own).max() > _SAME_REST * len(some) for own in (step, 2 * step))
        if alike and not coarser:
            what = f"videos whose raw depths go in steps of {step}"
            return {f"{what}; if their sensor counted millimeters, give --depth-scale {scale}": 1}
    return {}


def doubts_of_place(path: Path, frames: np.ndarray) -> dict[str, int]:
    """Returns a note when far raw depths (T,H,W) of 16 bits lie in a folder beside the lists of TUM's data sets, ICL-NUIM's or Bonn's."""
    some = _some_depths(frames)
    if frames.dtype.itemsize != 2 or not len(some) or float(median(some)) < _FAR_INDOORS:
        return {}
    beside = next((name for name in _OF_TUM if (path.parent / name).is_file()), "")
    return {LIKE_TUM.format(beside): 1} if beside else {}


def doubts_of_marks(frames: np.ndarray) -> dict[str, int]:
    """Returns a note when the largest number of raw depths (T,H,W) seems to mark that nothing was seen."""
    mark = _mark(_some_depths(frames))
    what = f"videos in which many pixels hold {mark:g}, their largest number, and none a little less"
    return {f"{what}: a mark of nothing seen? --far leaves them out": 1} if mark else {}


def _some_depths(frames: np.ndarray) -> np.ndarray:
    """Returns some raw depths above 0 of the middle one of frames (T,H,W)."""
    flat = frames[len(frames) // 2].reshape(-1)
    some = flat[:: max(1, len(flat) // _SAMPLED)]
    return some[some > 0]


def _kinds(values: np.ndarray) -> int:
    """Returns how many different numbers there are; `np.unique` loads masked arrays first, for which every process would wait."""
    ordered = np.sort(values, axis=None)
    return np.count_nonzero(ordered[1:] != ordered[:-1]) + min(len(ordered), 1)


def _mark(values: np.ndarray) -> float:
    """Returns the largest of some raw depths (N) if several have it and the others end far below, or well below where it is
    all that 8 or 10 to 15 bits can hold; else 0.
    """
    most = float(values.max(initial=0))
    others = values[values < most]
    several = len(values) - len(others) > _MARKED * len(values)
    bits = (8 if values.itemsize == 1 else None, *range(10, 16))
    full = values.dtype.kind != "f" and most + 1 in [1 << own for own in bits if own]
    return most if several and 0 < float(others.max(initial=0)) < (_WELL_BELOW if full else _FAR_BELOW) * most else 0.0


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
    better = next((own for own in (1 / scale, 1000.0, 1.0, 10_000.0, 100.0) if 0.2 <= raw / own <= 100.0), None)
    hint = (
        f"did you mean --depth-scale {better:.6g}, which makes it {raw / better:.3g} m?"
        if better
        else "see --depth-scale."
    )
    keep = "" if asked or typical < least else f" If it is true, say so: --depth-scale {scale:g}."
    raise DataError(
        f"{name}: {scale:g} raw units per meter put the scene at {typical:,.6g} m (median), which no depth camera sees;"
        f" {hint}{keep}"
    )
