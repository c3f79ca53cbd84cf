"""Arrays of numbers: NumPy's files, and bare float32 as KITTI and nuScenes have them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.npy_files import map_npy, read_arrays
from dpcli.prepare.array_files.attributes import says_unit, told_lengths, told_units
from dpcli.prepare.array_files.containers import open_arrays, tables_inside
from dpcli.prepare.array_files.frame_borders import frames_beside, rows_of_axes
from dpcli.prepare.array_files.netcdf_packing import with_gaps
from dpcli.prepare.cloud_formats.cloud import (
    Cloud,
    cloud_of_columns,
    counts_rows,
    kept_columns,
    refuse_frames,
    refuse_times,
    require_columns,
    unread_columns,
    without,
)
from dpcli.prepare.cloud_formats.column_names import find_frame_column, first_unit, note_of_units
from dpcli.prepare.named_columns import ArrayTable, holds_table

_POINT_KEYS = ("points", "xyz", "pos", "point_cloud")
_COLOR_KEYS = ("color", "colors", "rgb")
_CORNERS = ("faces", "face", "triangles", "tris", "cells", "indices", "edges")  # of meshes: numbers of points
_COLUMNS = (4, 3, 5, 6, 7, 8, 9, 10)  # of a .bin, the likeliest first
_BY_CHANCE = 0.12  # nats a value that one number of columns must explain better than another
_TELLING, _FLOATS = 400, 1 << 16  # values that are needed to tell columns apart; that are looked at in a file
_SAMPLED, _SURELY_APART = 4096, 0.4  # values of an axis that are looked at; nats a value that leave no doubt
_CLOUDCOMPARE = b"CCB"  # the first bytes of projects, which CloudCompare calls .bin, too
_LARGEST, _SMALLEST = 1e10, 1e-20  # beyond these the bytes are no float32 coordinates


def read_npy(path: Path, keep: Sequence[str] = ()) -> Cloud:
    """Reads an array of rows, x y z first, or a structured one with fields of these names."""
    return _cloud_of_array(path, map_npy(path), keep)


def read_npz(path: Path, keep: Sequence[str] = ()) -> Cloud:
    """Reads the array called points (or xyz, pos, point_cloud), and colors where there are some; or the only structured one."""
    arrays = read_arrays(path)
    records = [name for name, one in arrays.items() if one.dtype.names]
    if len(records) == 1 and not _has_points(arrays):
        cloud = _cloud_of_array(path, arrays[records[0]], keep)
        cloud.unread += without(list(arrays), records)
        return cloud
    texts = {name: str(one.item()) for name, one in arrays.items() if one.dtype.kind == "U" and one.size == 1}
    units = {name: first_unit([text]) for name, text in texts.items() if says_unit(name)}
    told = {name: unit for name, unit in units.items() if unit}
    cloud = _cloud_of_arrays(path, {name: one for name, one in arrays.items() if name not in told}, keep)
    cloud.unit = cloud.unit or next(iter(told.values()), "")
    return cloud


def read_mat(path: Path, keep: Sequence[str] = ()) -> Cloud:
    """Reads a MATLAB or HDF5 file of one cloud as `read_npz` reads its arrays, or the rows of the only table in it."""
    if holds_table(path):
        table = ArrayTable(path)
        _refuse_frames(path, table.by_name)
        cloud = cloud_of_columns(path, table.by_name, keep)
        cloud.unit = cloud.unit or table.unit
        cloud.dropped |= table.cut
        return cloud
    with open_arrays(path) as arrays:
        shown = {name: one if name in _COLOR_KEYS else with_gaps(one) for name, one in arrays.items()}
        plain = {name: np.asarray(one[()]) for name, one in shown.items() if not isinstance(one, list)}
        if not plain and tables_inside(path):
            ArrayTable(path)  # says that there are several
        told = {name: told_units(arrays[name]) for name in plain}
        lengths = {name: first_unit(told_lengths(arrays, name)) for name in plain}
    cloud = _cloud_of_arrays(path, {name: _as_vector(name, one) for name, one in plain.items()}, keep)
    units = {lengths[name] for name in cloud.columns[:3]} - {""}
    cloud.unit = cloud.unit or (units.pop() if len(units) == 1 else "")
    cloud.dropped |= note_of_units(cloud.columns[:3], told)
    return cloud


def _as_vector(name: str, array: np.ndarray) -> np.ndarray:
    """Returns a single row or column as the vector (N) that it is in MATLAB; that of points or colors is one point's."""
    one_point = name in _POINT_KEYS or (name in _COLOR_KEYS and array.shape in ((1, 3), (1, 4)))
    return array.reshape(-1) if array.ndim == 2 and 1 in array.shape and not one_point else array


def _cloud_of_arrays(path: Path, arrays: dict[str, np.ndarray], keep: Sequence[str]) -> Cloud:
    key = next((k for k in _POINT_KEYS if k in arrays), None) or _only_points(arrays)
    if key is None and (advice := rows_of_axes(arrays, timed=True)):
        raise DataError(f"{path}: {advice}")
    if key is None and {"x", "y", "z"} <= arrays.keys():
        shape = arrays["x"].shape  # perhaps rows and columns of a grid
        if advice := frames_beside(arrays, [arrays["x"].size]):
            raise DataError(f"{path}: {advice}")
        alike = {k: a.reshape(-1) for k, a in arrays.items() if a.shape == shape}
        _refuse_frames(path, alike)
        cloud = cloud_of_columns(path, alike, keep)
        cloud.unread += without(list(arrays), alike)
        return cloud
    if key is None:
        held = [f"{name} (a pickle)" if one.dtype.hasobject else name for name, one in arrays.items()]
        raise DataError(f"{path}: arrays {', '.join(held) or 'none'}; expected one called {' or '.join(_POINT_KEYS)}")
    cloud = _cloud_of_array(path, arrays[key], ())
    if advice := frames_beside(arrays, [len(cloud.points)]):
        raise DataError(f"{path}: {advice}")
    cloud.columns = (key,)
    color_key, rows = next((k for k in _COLOR_KEYS if k in arrays), ""), len(cloud.points)
    if color_key:
        color = arrays[color_key]
        if color.dtype.kind not in "uif" or color.ndim != 2 or color.shape[0] != rows or color.shape[1] not in (3, 4):
            raise DataError(f"{path}: colors {color.dtype} {color.shape}; expected numbers {(rows, 3)}")
        cloud.color = color[:, :3]
    shapes = ((rows,), (rows, 1))  # the second as Open3D writes attributes
    columns = {name: one.reshape(-1) for name, one in arrays.items() if one.shape in shapes}
    _refuse_frames(path, columns)
    cloud.extra = kept_columns(path, columns, keep)
    cloud.unread += without(list(arrays), [key, color_key], keep)
    return cloud


def _refuse_frames(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Raises DataError where one of the columns holds whole numbers of several frames."""
    name = find_frame_column(list(columns))
    if name and columns[name].dtype.kind in "uif" and (columns[name] == np.floor(columns[name])).all():
        refuse_frames(path, name, columns[name])


def _has_points(arrays: Mapping[str, np.ndarray]) -> bool:
    called = any(name in arrays for name in _POINT_KEYS) or {"x", "y", "z"} <= arrays.keys()
    return called or _only_points(arrays) is not None


def _only_points(arrays: Mapping[str, np.ndarray]) -> str | None:
    """Returns the name of the only array that can be points, numbers (N,3 or more); None when none or several can."""
    others = (*_COLOR_KEYS, "normal", "normals", *_CORNERS)
    numbers = {k: a for k, a in arrays.items() if a.dtype.kind in "uif" and k not in others}
    found = [k for k, a in numbers.items() if a.ndim == 2 and a.shape[1] >= 3]
    return found[0] if len(found) == 1 else None


def _cloud_of_array(path: Path, array: np.ndarray, keep: Sequence[str]) -> Cloud:
    if array.dtype.names:
        flat = array.reshape(-1)
        single = [name for name in array.dtype.names if array.dtype[name].shape in ((), (1,))]
        _refuse_frames(path, {name: flat[name].reshape(-1) for name in single})
        cloud = cloud_of_columns(path, {name: flat[name].reshape(-1) for name in single}, keep)
        cloud.unread += without(array.dtype.names, single)
        return cloud
    if keep:
        raise DataError(f"{path}: column {keep[0]}: its columns have no names")
    if array.size == 0:  # of an empty list of points, [] or [[]]
        return Cloud(np.zeros((0, 3), np.float32))
    if array.ndim == 3 and array.shape[0] == 1:  # a batch of one
        array = array[0]
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind not in "uif":
        several = "; of several frames save a file for each, of a cloud in rows and columns its reshape(-1, 3)"
        hint = several if array.ndim == 3 else ""
        raise DataError(
            f"{path}: array of shape {array.shape}, {array.dtype}; expected numbers (points, 3 or more){hint}"
        )
    if len(array) in (3, 4) and array.shape[1] > 16:
        raise DataError(f"{path}: array of shape {array.shape}; expected a row for each point: save its transpose (.T)")
    require_columns(path, *array.shape)
    if array.shape in ((3, 4), (4, 4)) and np.allclose(array[:3, :3] @ array[:3, :3].T, np.eye(3), atol=1e-3):
        raise DataError(
            f"{path}: a matrix {array.shape} that turns, the pose of a camera; expected numbers (points, 3 or more)"
        )
    refuse_times(path, array)
    kind = np.float32 if array.dtype.kind == "f" and array.itemsize <= 4 else np.float64
    first = _first_axis(array)
    return Cloud(array[:, first : first + 3].astype(kind), unread=unread_columns(first, array.shape[1]))


def _first_axis(array: np.ndarray) -> int:
    """Returns which column of an array is x: 0, or 1 behind one that counts the rows, before three columns of fractions."""
    if array.shape[1] < 4 or array.dtype.kind != "f" or not counts_rows(array[:, 0]):
        return 0
    axes = array[:, 1:4]
    return int((axes != np.floor(axes)).any(0).all())


def read_bin(path: Path, columns: int) -> Cloud:
    """Reads float32 values, ``columns`` for each point, x y z first."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(len(_CLOUDCOMPARE)) == _CLOUDCOMPARE:
            raise DataError(
                f"{path}: CloudCompare's own .bin, which is not read; save its clouds as .ply with CloudCompare"
            )
    if size % (4 * columns):
        raise DataError(
            f"{path}: {size} bytes are no whole number of points of {columns} float32; truncated, or see --bin-columns"
        )
    numbers = np.fromfile(path, "<f4")
    values = numbers.reshape(-1, columns)[:, :3]
    size_of = np.abs(values[np.isfinite(values)])
    words = numbers.view(np.uint32)
    rounded = len(words) % 2 == 0 and words.any() and not words[::2].any()  # float64 of few digits ends in zeros
    if rounded or np.mean((size_of > _LARGEST) | ((size_of > 0) & (size_of < _SMALLEST))) > 0.01:
        raise DataError(
            f"{path}: its bytes are no coordinates in float32 (another type, or a header before them); if they are float64, as NumPy"
            " writes by default, save them as .npy: numpy.save(NAME, numpy.fromfile(FILE, 'f8').reshape(-1, COLUMNS))"
        )
    if len(values) and 0 < abs(values[0, 0]) < _SMALLEST:
        raise DataError(
            f"{path}: its first four bytes are no coordinate, but the whole number {values.view(np.uint32)[0, 0]}; a header"
            " before the points? Save them without it"
        )
    return Cloud(np.ascontiguousarray(values))


def guess_bin_columns(paths: Sequence[Path]) -> tuple[int, bool]:
    """Returns how many float32 a point of some ``.bin`` files of one sequence has, and whether the numbers leave no doubt.

    In the right number of columns each holds values of one kind: little spread within, more between. Where that decides
    nothing, 4 (x y z reflectance, as KITTI has it) needs a fourth column without negative values; else it is 3. Raises
    DataError where the numbers lie axis after axis.
    """
    sizes = [path.stat().st_size for path in paths]
    possible = [c for c in _COLUMNS if all(size % (4 * c) == 0 for size in sizes)]
    if not possible:
        return 4, True  # reading says what is wrong
    with np.errstate(invalid="ignore"):  # bytes of another type may be no numbers; reading says so
        values = [np.fromfile(path, "<f4", _FLOATS).astype(np.float64) for path in paths]
    _refuse_axes_apart(paths[0], possible, values[0])
    near = _likely(values, possible)
    if 4 in near and all(_is_reflectance(one[: len(one) // 4 * 4].reshape(-1, 4)[:, 3]) for one in values):
        return 4, True
    chosen = min(c for c in near if c != 4 or near == [4])
    return chosen, len(near) == 1


def _refuse_axes_apart(path: Path, possible: Sequence[int], head: np.ndarray) -> None:
    """Raises DataError where the numbers of a ``.bin`` are told much better as all x, then all y, and so on (RobotCar).

    head: those at its beginning, f64.
    """
    if len(head) < _TELLING or not np.abs(head).max() < _LARGEST:  # reading says that these are no coordinates
        return
    values = np.memmap(path, "<f4", "c")  # private, as some network file systems share no maps
    apart = {}
    for count in possible:
        parts = values.reshape(count, -1)
        some = parts[:, :: max(1, parts.shape[1] // _SAMPLED)]
        with np.errstate(invalid="ignore"):
            apart[count] = _cost(some.T.astype(np.float64).ravel(), count)
    least = min(_cost(head[: 4 * _SAMPLED], count) for count in possible) - _SURELY_APART
    fitting = [count for count in apart if apart[count] < least]
    if fitting:
        raise DataError(
            f"{path}: its numbers seem to lie axis after axis, all x first; expected point after point: save them as"
            f" numpy.fromfile(file, 'f4').reshape({min(fitting)}, -1).T, or say --bin-columns if they don't"
        )


def _likely(values: list[np.ndarray], possible: list[int]) -> list[int]:
    """Returns the numbers of columns that explain the values about as well as the best one, without their multiples."""
    near = sorted(c for c in possible if c <= 6) or possible
    if sum(map(len, values)) >= _TELLING:
        costs = {c: float(np.mean([_cost(one, c) for one in values])) for c in possible}
        near = sorted(c for c in possible if costs[c] <= min(costs.values()) + _BY_CHANCE)
    return [c for c in near if not any(c > other and c % other == 0 for other in near)]


def _cost(values: np.ndarray, columns: int) -> float:
    """Returns how badly columns tell the values: the mean logarithm of their spread, nats a value."""
    table = values[: len(values) // columns * columns].reshape(-1, columns)
    table = table[np.isfinite(table).all(1)]
    if len(table) < 2:
        return float("inf")
    spread = np.subtract(*np.percentile(table, [84, 16], axis=0)) / 2 + 1e-3 * (np.abs(table).max(0) + 1e-6)
    return float(np.log(spread).mean()) + 0.5 * columns * np.log(len(table)) / table.size


def _is_reflectance(column: np.ndarray) -> bool:
    return bool((column >= 0).all() and (column <= 65535).all())
