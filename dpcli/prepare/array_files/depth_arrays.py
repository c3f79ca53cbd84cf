"""Frames of depth in arrays: which array of a file holds them, and which of its axes counts frames."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.path_names import first_names
from dpcli.prepare.array_files.attributes import attributes_of, model_texts, told_lengths, told_units
from dpcli.prepare.array_files.axes import MATRICES, are_poses
from dpcli.prepare.array_files.containers import Unreadable, open_arrays
from dpcli.prepare.array_files.netcdf_packing import PACKING, Unpacked

# names that say depth, and not a picture of it or what lies beside it
DEPTH_NAME = r"^(?!.*(vis|colou?r|preview|rgb|jet|mask|conf|normal)).*(depth|(^|[-_. ])[dz]([-_. *]|$))"
_SIZES = (  # (height, width) of depth cameras
    *((480, 640), (240, 320), (424, 512), (576, 640), (512, 512), (1024, 1024), (288, 320), (192, 256), (720, 1280)),
    *((480, 848), (400, 640), (270, 480), (360, 640), (171, 224), (172, 224), (180, 240), (800, 1280), (1080, 1920)),
)
_SMALL = 1 << 16  # numbers of an array that may tell of the camera
_LEAST, _TALL = 32, 4  # pixels; how much higher than wide no picture is
_WHOLE = 50  # numbers above are no meters
_MARK = 65535  # what whole numbers have where nothing was seen, see `depth_units.without_marks`


def says_depth(name: str) -> bool:
    """Returns whether a name without suffix says that its pictures are depth, and no picture of depth.

    >>> says_depth("lowres_depth"), says_depth("depth_vis"), says_depth("anna_1")
    (True, False, False)
    """
    return re.search(DEPTH_NAME, name, re.IGNORECASE) is not None


def depth_frames(path: Path, array: np.ndarray, stride: int = 1) -> np.ndarray:
    """Returns every ``stride``-th frame of an array of depth as (T,H,W). Raises DataError of what is none, such as the poses of a
    camera.
    """
    if array.ndim == 2 or array.ndim == 3 and array.shape[2] == 1:  # no picture is one pixel wide
        array = array.reshape(1, *array.shape[:2])
    if array.ndim == 4 and 1 in (array.shape[1], array.shape[3]):  # one channel, as networks want it
        array = array[..., 0] if array.shape[3] == 1 else array[:, 0]
    if array.ndim != 3 or array.dtype.kind not in "uif":
        raise DataError(
            f"{path}: array of shape {array.shape}, {array.dtype}; expected numbers (frames, height, width)"
        )
    _require_frames_first(path, array.shape)
    if are_poses(array) or array.shape[1:] in MATRICES and _project(array):
        raise DataError(f"{path}: holds {len(array)} matrices of a camera, no depth; expected (frames, height, width)")
    return np.ascontiguousarray(array[::stride])


def _require_frames_first(path: Path, shape: tuple[int, ...]) -> None:
    """Raises DataError of a shape whose last axis seems to count frames: its first two are a camera's, or the last is tiny."""
    *first, last = shape
    usual = tuple(first) in _SIZES and (first[1], last) not in _SIZES and (last, first[1]) not in _SIZES
    if usual or (min(first) >= _LEAST and min(first) >= _TALL * last):
        raise DataError(
            f"{path}: array of shape {shape}; expected (frames, height, width): if its last axis counts the frames, save"
            " numpy.moveaxis(array, -1, 0)"
        )


@dataclass(frozen=True)
class ArchivedDepth:
    """Holds the depth of a file of named arrays, and what lies beside it. small: arrays that may tell of the camera or of times, by
    name, of which ``units`` has what their attributes say; large: the names of other arrays; attributes: those of HDF5's depth;
    lengths: what may tell its unit, the nearest first.
    """

    depth: np.ndarray
    small: dict[str, np.ndarray]
    units: dict[str, str]
    large: tuple[str, ...]
    attributes: dict[str, np.ndarray]
    lengths: list[str]


def archived_depth(path: Path) -> ArchivedDepth:
    """Reads the array of a file that is called depth, or the only one of two or three dimensions."""
    with open_arrays(path) as opened:
        arrays = {name: one for name, one in opened.items() if not isinstance(one, list)}
        shaped = [k for k, v in arrays.items() if v.ndim in (2, 3) and 1 not in v.shape[:2] and v.dtype.kind in "uif"]
        called = [k for k, v in arrays.items() if says_depth(k) and v.ndim > 1 and v.shape not in MATRICES]
        plainly = [k for k in called if k in shaped and "depth" in k.lower()]  # d_depth beside d_color and d_time
        chosen = next((choice[0] for choice in (called, plainly, shaped) if len(choice) == 1), None)
        if chosen is None:
            raise DataError(f"{path}: arrays {first_names(list(arrays), 8) or 'none'}; expected one called depth")
        depth = _marked(arrays[chosen])
        depth = _of_matlab(path, depth) if path.suffix.lower() == ".mat" else depth
        others = {k: one for k, one in arrays.items() if k != chosen and not isinstance(one, Unreadable)}
        small = {name: np.asarray(one[()]) for name, one in others.items() if np.prod(one.shape) <= _SMALL}
        units = {name: told_units(others[name]) for name in small}
        small |= model_texts(opened.texts)
        return ArchivedDepth(
            depth,
            small,
            units,
            tuple(name for name in others if name not in units),
            _told_by_attributes(arrays[chosen]),
            told_lengths(opened, chosen),
        )


def _marked(array: Any) -> np.ndarray:
    """Returns depth as it is stored, with the greatest of its whole numbers in place of those that netCDF declares missing: what
    `depth_units.without_marks` drops and counts.
    """
    values = np.asarray(array[()])
    if not isinstance(array, Unpacked) or values.dtype.kind not in "ui":
        return values
    mark = np.iinfo(values.dtype).max if values.dtype.itemsize > 1 else 0  # 8 bits have no marks
    return np.where(array.missing() & (values != 0), values.dtype.type(mark), values)


def _told_by_attributes(array: Any) -> dict[str, np.ndarray]:
    """Returns the numbers among the attributes of HDF5's depth and of its group, and the model of a lens."""
    told = attributes_of(array)
    found = {name: np.asarray(one) for name, one in told.items() if name not in PACKING}
    return {name: one for name, one in found.items() if one.dtype.kind in "uif" and one.size} | model_texts(told)


def _of_matlab(path: Path, array: np.ndarray) -> np.ndarray:
    """Returns depth (H,W,T), as MATLAB has it, as (T,H,W); also one that a program of another order wrote, where the sizes tell.

    Whole numbers among MATLAB's doubles are counted as such, in millimeters. Raises DataError where nothing tells the order.
    """
    if array.ndim not in (2, 3) or min(array.shape[:2]) < _LEAST and min(array.shape[1:]) < _LEAST:
        raise DataError(f"{path}: array of shape {array.shape}; expected depth (height, width, frames)")
    if array.dtype.kind == "f":
        finite = np.isfinite(array)
        told = array[finite]
        if told.max(initial=0) > _WHOLE and (told == np.floor(told)).all():
            kind = np.uint16 if told.min() >= 0 and told.max() <= _MARK else np.int32
            array = np.where(finite, array, _MARK).astype(kind)
    if array.ndim == 2:
        return array
    behind, before = array.shape[:2] in _SIZES, array.shape[1:] in _SIZES
    if behind == before:
        behind, before = (
            _TALL * n <= min(sides)
            for n, sides in ((array.shape[2], array.shape[:2]), (array.shape[0], array.shape[1:]))
        )
    if behind == before:
        raise DataError(
            f"{path}: array of shape {array.shape}: whether its first or its last axis counts the frames can't be told; save it as"
            " .npy (frames, height, width)"
        )
    return np.ascontiguousarray(array.transpose(2, 0, 1)) if behind else array


def _project(matrices: np.ndarray) -> bool:
    """Returns whether each of some 3x3, 3x4 or 4x4 numbers projects as a pinhole camera does."""
    return bool((matrices[:, 2, :3] == (0, 0, 1)).all() and not matrices[:, (0, 1), (1, 0)].any())
