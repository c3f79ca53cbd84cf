"""Reading one point cloud from a file of any common format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.decode.open3d_import import load_open3d

SUFFIXES = (".ply", ".pcd", ".npy", ".npz", ".bin", ".csv", ".las", ".xyz", ".txt")
_POINT_KEYS = ("points", "xyz", "pos", "point_cloud")
_COLOR_KEYS = ("color", "colors", "rgb")
_RGB = (("red", "green", "blue"), ("r", "g", "b"))


@dataclass
class Cloud:
    """Holds points f64 (N,3) as stored, NaN where the file has it, and color u8 (N,3) or None."""

    points: np.ndarray
    color: np.ndarray | None = None


def read_cloud(path: Path, bin_columns: int = 4) -> Cloud:
    """Reads one cloud. Raises DataError, which says what is wrong.

    ``bin_columns``: float32 values per point of a ``.bin``.
    """
    readers = {
        ".ply": _read_open3d,
        ".pcd": _read_open3d,
        ".npy": _read_npy,
        ".npz": _read_npz,
        ".las": _read_las,
        ".csv": _read_text,
        ".xyz": _read_text,
        ".txt": _read_text,
    }
    suffix = path.suffix.lower()
    if path.stat().st_size == 0:
        raise DataError(f"{path}: the file is empty")
    cloud = _read_bin(path, bin_columns) if suffix == ".bin" else readers[suffix](path)
    if cloud.points.ndim != 2 or cloud.points.shape[1] != 3:
        raise DataError(f"{path}: points of shape {cloud.points.shape}; expected (points, 3 or more)")
    return cloud


def _read_open3d(path: Path) -> Cloud:
    declared = _declared_points(path)
    if path.suffix.lower() == ".ply":
        _check_ply_is_whole(path, declared)
    open3d = load_open3d()
    cloud = open3d.io.read_point_cloud(str(path))
    points = np.asarray(cloud.points)
    if len(points) != declared:  # Open3D only warns about a file that ends early
        raise DataError(f"{path}: truncated or damaged: its header says {declared} points, {len(points)} can be read")
    return Cloud(points, np.rint(np.asarray(cloud.colors) * 255).astype(np.uint8) if cloud.has_colors() else None)


def _declared_points(path: Path) -> int:
    """Returns the number of points in the header of a ``.ply`` (``element vertex N``) or ``.pcd`` (``POINTS N``)."""
    with path.open("rb") as file:
        header = file.read(4096).decode("latin-1").splitlines()
    for line in header:
        words = line.split()
        if words[:2] == ["element", "vertex"] or words[:1] == ["POINTS"]:
            if len(words) > 1 and words[-1].isdigit():
                return int(words[-1])
    raise DataError(f"{path}: not a {path.suffix[1:].upper()} point cloud: no number of points in its header")


_PLY_BYTES = {
    "char": 1,
    "uchar": 1,
    "int8": 1,
    "uint8": 1,
    "short": 2,
    "ushort": 2,
    "int16": 2,
    "uint16": 2,
    "int": 4,
    "uint": 4,
    "int32": 4,
    "uint32": 4,
    "float": 4,
    "float32": 4,
    "double": 8,
    "float64": 8,
}


def _check_ply_is_whole(path: Path, declared: int) -> None:
    """Raises DataError when the vertices stop early: Open3D fills the rest with points that nobody measured."""
    with path.open("rb") as file:
        head, end, body = file.read(1 << 16).partition(b"end_header")
        lines = [line.split() for line in head.decode("latin-1").splitlines()]
        if not end or ["element", "vertex"] != next((words[:2] for words in lines if words[:1] == ["element"]), None):
            return  # an unusual file: other elements come first
        start = len(head) + len(end) + body.find(b"\n") + 1
        file.seek(start)
        if any(words[:2] == ["format", "ascii"] for words in lines):
            found = sum(1 for line in file if line.strip())
        else:
            elements = [k for k, words in enumerate(lines) if words[:1] == ["element"]] + [len(lines)]
            types = [words[1] for words in lines[elements[0] : elements[1]] if words[:1] == ["property"]]
            stride = sum(_PLY_BYTES.get(kind, 0) for kind in types)
            found = (path.stat().st_size - start) // stride if stride and "list" not in types else declared
    if found < declared:
        raise DataError(f"{path}: truncated: its header says {declared} points, it has room for {found}")


def _read_npy(path: Path) -> Cloud:
    try:
        array = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise DataError(f"{path}: not a readable .npy array ({error})") from None
    return Cloud(_xyz(path, array))


def _read_npz(path: Path) -> Cloud:
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
    except Exception as error:  # zipfile.BadZipFile, ValueError for pickles, EOFError...
        raise DataError(f"{path}: not a readable .npz archive ({error})") from None
    key = next((k for k in _POINT_KEYS if k in arrays), None)
    if key is None:
        raise DataError(f"{path}: arrays {', '.join(arrays) or 'none'}; expected one called {' or '.join(_POINT_KEYS)}")
    color = next((arrays[k] for k in _COLOR_KEYS if k in arrays), None)
    points = _xyz(path, arrays[key])
    if color is not None and (color.shape != points.shape or color.dtype != np.uint8):
        raise DataError(f"{path}: colors {color.dtype} {color.shape}; expected uint8 {points.shape}")
    return Cloud(points, color)


def _read_bin(path: Path, columns: int) -> Cloud:
    size = path.stat().st_size
    if size % (4 * columns):
        raise DataError(
            f"{path}: {size} bytes are no whole number of points of {columns} float32; truncated, or see --bin-columns"
        )
    return Cloud(_xyz(path, np.fromfile(path, "<f4").reshape(-1, columns)))


def _read_las(path: Path) -> Cloud:
    import laspy

    try:
        las = laspy.read(path)
    except Exception as error:  # laspy.errors.LaspyException, struct.error, ValueError on short files
        raise DataError(f"{path}: not a readable LAS file, perhaps truncated ({error})") from None
    if len(las.points) != las.header.point_count:
        raise DataError(f"{path}: truncated: its header says {las.header.point_count} points, found {len(las.points)}")
    names = set(las.point_format.dimension_names)
    # LAS colors have 16 bits
    color = np.stack([las[c] for c in _RGB[0]], axis=1) >> 8 if set(_RGB[0]) <= names else None
    return Cloud(np.asarray(las.xyz, np.float64), None if color is None else color.astype(np.uint8))


def _read_text(path: Path) -> Cloud:
    """Reads columns split by comma, semicolon or blanks; a header names the columns, else x y z come first."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        first = file.readline().strip()
    delimiter = next((d for d in ",;" if d in first), None)
    words = [
        w.strip().strip('"').lower() for w in (first.split(delimiter) if delimiter else first.lstrip("#/ ").split())
    ]
    named = not all(_is_float(word) for word in words)
    if named and not {"x", "y", "z"} <= set(words):
        raise DataError(f"{path}:1: columns {', '.join(words)[:80]}; expected x, y and z among them, or numbers only")
    try:
        table = np.loadtxt(path, delimiter=delimiter, skiprows=int(named), ndmin=2, encoding="utf-8-sig", comments=None)
    except ValueError as error:
        raise DataError(f"{path}: {error}; expected numbers in columns") from None
    if not named:
        return Cloud(_xyz(path, table))
    rgb = next((names for names in _RGB if set(names) <= set(words)), None)
    color = table[:, [words.index(n) for n in rgb]] if rgb else None
    if color is not None and not ((color >= 0) & (color <= 255)).all():
        raise DataError(f"{path}: colors from {color.min():g} to {color.max():g}; expected 0 to 255")
    return Cloud(table[:, [words.index(n) for n in "xyz"]], None if color is None else color.astype(np.uint8))


def _is_float(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _xyz(path: Path, array: np.ndarray) -> np.ndarray:
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind not in "uif":
        raise DataError(f"{path}: array of shape {array.shape}, {array.dtype}; expected numbers (points, 3 or more)")
    return array[:, :3].astype(np.float64)
