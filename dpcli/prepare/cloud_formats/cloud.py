"""A cloud as it lies in a file, and how named columns become one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.column_names import find_axes, find_colors
from dpcli.store.gaussians import color_of

_TINY = 1e-36  # below it and above its inverse lie no numbers but those whose bytes mean something else
AT_ORIGIN = "points at (0,0,0) dropped"
_WHOLE_FLOAT32, _LOST = 1 << 24, 1e-3  # below the first it holds whole numbers; a share of a column's range
_HARMONICS = ("f_dc_0", "f_dc_1", "f_dc_2")  # of Gaussians: color seen from all sides
_LOOKED_AT, _NO_MAP = 1000, 1e6  # rows that tell what a column holds; coordinates below which no map's lie, in any unit
MOST_UNNAMED = 40  # columns; a picture has more
BEYOND = "points beyond the number that their file's header says dropped"


@dataclass
class Cloud:
    """Holds points f32 or f64 (N,3) as stored, NaN where the file has it.

    color: (N,3) in the range the file has, or None (`colors.as_bytes` makes bytes of them). unit: what the file says its
    coordinates are in, as in `store.schema.METERS`, or "". extra: columns that were asked for, (N) each as stored. columns: the
    names of those that points and colors came from. unread: the names of those that nobody asked for. dropped:
    counts of points that the file itself says don't count, by reason, and of what else it says and isn't used. track: the
    identities i64 (N) of the points across frames, or None.
    """

    points: np.ndarray
    color: np.ndarray | None = None
    unit: str = ""
    extra: dict[str, np.ndarray] = field(default_factory=dict)
    columns: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()
    dropped: dict[str, int] = field(default_factory=dict)
    track: np.ndarray | None = None

    def keep(self, rows: np.ndarray) -> None:
        """Keeps only some points: a mask bool (N), or indices."""
        self.points = self.points[rows]
        self.color = None if self.color is None else self.color[rows]
        self.extra = {name: values[rows] for name, values in self.extra.items()}
        self.track = None if self.track is None else self.track[rows]


def require_points(path: Path, declared: int, found: int) -> dict[str, int]:
    """Returns how many points lie behind those that a header declares, as `Cloud.dropped` has it; {} where none do.

    found: how many points the file has room for. Raises DataError where they are fewer.
    """
    if found < declared:
        raise DataError(f"{path}: truncated: its header says {declared} points, it has room for {found}")
    return {BEYOND: found - declared} if found > declared else {}


def cloud_of_columns(path: Path, columns: Mapping[str, np.ndarray], keep: Sequence[str] = ()) -> Cloud:
    """Returns the cloud that named columns (N) of any number types describe, with the columns ``keep`` beside.

    Raises DataError when x, y and z are not among them, or a column to keep isn't.
    """
    names = list(columns)
    axes = named_axes(path, names)
    if axes is None and "packed_position" in columns:
        raise DataError(f"{path}: Gaussians that SuperSplat compressed; export them as plain .ply")
    if axes is None:
        raise DataError(f"{path}: fields {', '.join(names)[:80]}; expected x, y and z among them")
    points = as_points([columns[names[place]] for place in axes[0]])
    colors = find_colors(names)
    color = None
    if len(colors) == 3:
        color = np.stack([columns[names[place]] for place in colors], axis=1)
    elif colors:
        color = unpack_rgb(columns[names[colors[0]]])
        colors = colors if color is not None else []
    elif set(_HARMONICS) <= columns.keys():
        colors = [names.index(name) for name in _HARMONICS]
        color = color_of_harmonics(np.stack([columns[name] for name in _HARMONICS], axis=1))
    used = tuple(names[place] for place in (*axes[0], *colors))
    return Cloud(points, color, axes[1], kept_columns(path, columns, keep), used, without(names, used, keep))


def without(names: Sequence[str], *others: Sequence[str]) -> tuple[str, ...]:
    """Returns the names, in their order, that are in none of the others."""
    known = {name for one in others for name in one}
    return tuple(name for name in names if name not in known)


def unnamed_columns(first: int, last: int) -> tuple[str, ...]:
    """Returns how to call columns without names, counted from 1: "column 4 (no name)", for messages; none if last < first.

    >>> unnamed_columns(4, 6), unnamed_columns(4, 3)
    (('columns 4 to 6 (no names)',), ())
    """
    if last < first:
        return ()
    return (f"column {first} (no name)" if first == last else f"columns {first} to {last} (no names)",)


def unread_columns(first: int, width: int) -> tuple[str, ...]:
    """Returns how to call columns without names beside x y z, of which x is column ``first`` from 0: behind one that counts the
    rows, or the first.
    """
    return (*(("column 1 (no name, numbers of the rows)",) * first), *unnamed_columns(first + 4, width))


def counts_rows(column: np.ndarray) -> bool:
    """Returns whether a column (N) counts the rows, from 0 or 1.

    >>> counts_rows(np.array([1.0, 2.0, 3.0])), counts_rows(np.array([2.0, 3.0, 4.0]))
    (True, False)
    """
    return len(column) > 2 and column[0] in (0, 1) and np.array_equal(column, np.arange(len(column)) + column[0])


def refuse_frames(path: Path, name: str, values: np.ndarray) -> None:
    """Raises DataError where the column that numbers frames has several values, which one cloud would mix up."""
    if (count := len(np.unique(values))) > 1:
        raise DataError(
            f"{path}: its column {name!r} numbers {count} frames; --frame-column {name} makes them a sequence"
        )


def require_columns(path: Path, rows: int, columns: int) -> None:
    """Raises DataError where rows hold too few numbers for a point, or so many without names that they are a picture."""
    if 3 <= columns <= MOST_UNNAMED:
        return
    picture = (
        ", x y z first; is it a picture, such as of depth (dpc prepare depth)? If not, save fewer columns, or name them"
    )
    raise DataError(
        f"{path}: array of shape {(rows, columns)}; expected numbers (points, 3 or more)"
        + (picture if columns > MOST_UNNAMED else "")
    )


def refuse_times(path: Path, values: np.ndarray) -> None:
    """Raises DataError where the first of four columns or more without names (N,C) holds times since 1970, in any unit, beside
    three that are no map's coordinates.
    """
    some = values[:_LOOKED_AT, :4].astype(np.float64)
    some = some[np.isfinite(some).all(1)]
    if not len(some) or some.shape[1] < 4 or np.abs(some[:, 1:]).max() > _NO_MAP:
        return
    least, most = some[:, 0].min(), some[:, 0].max()
    if any(1e9 * parts < least <= most < 2e9 * parts for parts in (1, 1e3, 1e6, 1e9)):
        raise DataError(
            f"{path}: its first column seems to hold times ({least:.16g}), not x; put it behind x y z, or, in a text, write a"
            " line of names above: time x y z"
        )


def named_axes(path: Path, names: Sequence[str]) -> tuple[list[int], str] | None:
    """Returns what `find_axes` does; its DataError names the file."""
    try:
        return find_axes(names)
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def as_points(columns: Sequence[np.ndarray]) -> np.ndarray:
    """Returns three columns (N) as (N,3), by columns: f32 where all are, else f64, which holds every other type's meters."""
    kind = np.float32 if all(c.dtype.kind == "f" and c.dtype.itemsize <= 4 for c in columns) else np.float64
    return np.array(columns, kind).T


def require_names(path: Path, names: Sequence[str], keep: Sequence[str]) -> None:
    """Raises DataError that lists a file's columns where one that was asked for is not among them."""
    if missing := without(keep, names):
        raise DataError(f"{path}: no column {missing[0]} among those to read; found {', '.join(names) or 'no names'}")


def kept_columns(path: Path, columns: Mapping[str, np.ndarray], keep: Sequence[str]) -> dict[str, np.ndarray]:
    """Returns the columns that were asked for, (N) as stored, by name. Raises DataError when one is missing or no numbers."""
    require_names(path, list(columns), keep)
    for name in keep:
        if columns[name].dtype.kind not in "fiub" or columns[name].ndim != 1:
            raise DataError(f"{path}: column {name} holds no numbers, one a point; ask for another, or none")
    return {name: columns[name] for name in keep}


def as_float32(path: Path, name: str, values: np.ndarray) -> np.ndarray:
    """Returns a column of one frame as f32 (N), in which files keep them. Raises DataError where that can't tell its values
    apart.
    """
    known = values[np.isfinite(values)].astype(np.float64)
    if not len(known) or np.abs(known).max() < _WHOLE_FLOAT32:
        return values.astype(np.float32)
    lost = float(np.abs(known - known.astype(np.float32)).max())
    if lost > _LOST * float(np.ptp(known)):
        raise DataError(
            f"{path}: column {name}: float32, in which columns are kept, would round its values by up to {lost:.3g};"
            " keep smaller numbers, such as times since the beginning"
        )
    return values.astype(np.float32)


def color_of_harmonics(first: np.ndarray) -> np.ndarray:
    """Returns colors u8 (N,3) of Gaussians from their spherical harmonics of degree 0 (N,3), black where these are no numbers."""
    return color_of(np.where(np.isnan(first), -np.inf, first.astype(np.float64))[:, None])


def unpack_rgb(packed: np.ndarray) -> np.ndarray | None:
    """Returns colors u8 (N,3) of numbers 0xRRGGBB (or 0xAARRGGBB): whole ones, or float32 whose bytes hold them, as PCL
    has them, in texts, too; None of anything else.
    """
    sizes = np.abs(packed[packed != 0]) if packed.dtype == np.float64 else packed[:0]
    if len(sizes) and ((sizes < _TINY) | (sizes > 1 / _TINY)).all():
        packed = packed.astype(np.float32)
    if packed.dtype.kind == "f" and packed.dtype.itemsize == 4:
        packed = np.ascontiguousarray(packed).view(np.uint32)
    elif packed.dtype.kind == "f" and (packed != np.floor(packed)).any():
        return None
    values = packed.astype(np.int64)
    return np.stack([values >> 16 & 255, values >> 8 & 255, values & 255], axis=1).astype(np.uint8)
