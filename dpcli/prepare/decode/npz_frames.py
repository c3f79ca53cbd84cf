"""A video's frames in one `.npz` member, as the peers save them: an object array of clouds, or one regular array."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from dpcli.errors import DataError, reading
from dpcli.npy_files import open_archive
from dpcli.prepare.array_files.safe_pickle import read_npz_member


def member_names(path: Path) -> list[str]:
    """Returns the arrays in an .npz, without reading them. Raises DataError when it is none."""
    try:
        with open_archive(path) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist()]
    except (zipfile.BadZipFile, OSError) as error:
        raise DataError(f"{path}: not a readable .npz file, perhaps truncated ({error})") from None


def read_frames(path: Path, key: str) -> list[np.ndarray]:
    """Reads frames (N,3 or more) of numbers, N their own each, from array ``key`` of an .npz; columns 0 to 2 are
    returned.

    An object array is a pickle: it is read through an allow list of plain arrays. Raises DataError on anything else.
    """
    with reading(path), open_archive(path) as archive:
        array = read_npz_member(archive, path, key, pickled=True)
    return [_frame(path, key, t, frame) for t, frame in enumerate(_as_frames(path, key, array))]


def _as_frames(path: Path, key: str, array: object) -> list:
    if isinstance(array, np.ndarray) and (array.ndim == 3 or (array.ndim == 1 and array.dtype == object)):
        return list(array)
    found = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
    raise DataError(f"{path}: {key} is {found}; expected frames (T,) of points (N,3), or numbers (T,N,3)")


def _frame(path: Path, key: str, t: int, frame: object) -> np.ndarray:
    if isinstance(frame, np.ndarray) and frame.dtype == object and frame.ndim == 2:
        try:  # equal frames in one object array lose their type, not their numbers
            frame = frame.astype(np.float64)
        except (TypeError, ValueError):
            pass
    good = isinstance(frame, np.ndarray) and frame.dtype.kind in "iuf" and frame.ndim == 2 and frame.shape[1] >= 3
    if not good:
        found = f"{frame.dtype} {frame.shape}" if isinstance(frame, np.ndarray) else type(frame).__name__
        raise DataError(f"{path}: frame {t} of {key} is {found}; expected numbers (points, 3)")
    points = frame[:, :3]
    if points.dtype.kind == "f" and not np.isfinite(points).all():
        raise DataError(f"{path}: frame {t} of {key} holds NaN or infinity; expected finite coordinates")
    return np.array(points, np.float32)  # a plain array, whatever the pickle's
