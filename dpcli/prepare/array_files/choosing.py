"""Tells which of the arrays in a file are clouds of many frames, and what lies beside them: times, colors, counts, labels."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dpcli.prepare.array_files.axes import are_poses, coordinates_axis
from dpcli.prepare.reader import natural_key
from dpcli.runtime.clips.name_numbers import NumberColumns, parse_names

POINT_KEYS = (
    "points",
    "xyz",
    "pos",
    "point_cloud",
    "point_clouds",
    "pointcloud",
    "clouds",
    "pc",
    "pcs",
    "pcd",
    "vertices",
    "verts",
)
_BESIDE = re.compile(
    r"(.*[/_.])?(normals?|colou?rs?|rgb|flows?|scene_?flow|veloc\w*|vel|feat\w*|faces?|triangles|edges|weights?|masks?|valid|"
    r"poses?|transforms?|rotations?|trans\w*|(in|ex)trinsics?|cameras?|joints?_?(names|parents)|images?|depths?|labels?|y|times?|"
    r"time_?stamps?|intensit\w*|reflect\w*)",
    re.IGNORECASE,
)
_TIMES = re.compile(
    r"(.*[/_.])?(times?|time_?stamps?|stamps?|t|ts|seconds)([_ ]?\(?\[?(s|sec|ms|us|ns)\]?\)?)?", re.IGNORECASE
)
_COLORS = re.compile(r"colou?rs?|rgb", re.IGNORECASE)
_MASKS = re.compile(r"(.*_)?(valid|mask|is_valid)(_.*)?", re.IGNORECASE)
_COUNTS = re.compile(
    r"(n|num|number|valid|real)_?(of_)?(points?|pts)(_.*)?|lengths?|(point_?|pts_?)?counts?|sizes?", re.IGNORECASE
)
_LABELS = re.compile(r"labels?|y|class(es)?|targets?|actions?|gestures?", re.IGNORECASE)

_LOOKED_AT, _TELLING = 512, 8  # rows of an array that are looked at, and that are enough to tell what they hold
_OF_LENGTH_ONE = 1e-3  # how far lengths of rounded directions are from 1


@dataclass(frozen=True)
class Source:
    """Says where one sequence of clouds lies in a file: in these arrays (each a frame, where they are several), and at this
    place of the only one's sequences, None where it holds one.
    """

    keys: tuple[str, ...]
    name: str = ""
    place: int | None = None


def find_sources(arrays: Mapping[str, Any], axes: str = "") -> list[Source]:
    """Returns the sequences of clouds that arrays hold; [] where they hold single clouds, or none.

    axes: what the user says the axes are, "" where nobody does.
    """
    many = {name: one for name, one in arrays.items() if _is_many(name, one, axes)}
    called = [name for name in many if name.rpartition("/")[2].lower() in POINT_KEYS]
    names = called if len(called) == 1 else [*many]
    found = []
    for name in sorted(names, key=natural_key):
        count = _sequences(many[name], axes)
        own = name if len(names) > 1 else ""
        digits = len(str((count or 1) - 1))
        places = [None] if count is None else range(count)
        found += [
            Source((name,), "/".join([*([own] if own else []), *([] if k is None else [f"{k:0{digits}d}"])]), k)
            for k in places
        ]
    return found or _numbered(arrays)


def _is_many(name: str, array: Any, axes: str) -> bool:
    if isinstance(array, list):
        return len({one.ndim for one in array if one.size}) == 1 and _is_frame_or_video(array)
    if array.dtype.kind not in "uif" or 0 in array.shape:
        return False
    if axes:
        return array.ndim == len(axes) and not _BESIDE.fullmatch(name)
    if array.ndim == 3 and 1 in array.shape:  # one cloud
        return False
    wanted = array.ndim in (3, 4) and not _BESIDE.fullmatch(name) and not are_poses(array)
    return wanted and (coordinates_axis(array.shape) is not None or array.ndim == 3 and 3 in array.shape)


def _is_frame_or_video(parts: list[np.ndarray]) -> bool:
    filled = [one for one in parts if one.size]
    flat = all(one.ndim == 2 and 3 in (one.shape[0], min(one.shape[1], 3)) for one in filled)
    return flat or all(one.ndim == 3 and coordinates_axis(one.shape) is not None for one in filled)


def _sequences(array: Any, axes: str) -> int | None:
    """Returns how many sequences an array holds, None where it holds one."""
    if isinstance(array, list):
        return None if all(one.ndim == 2 for one in array if one.size) else len(array)
    if axes:
        return array.shape[axes.index("B")] if "B" in axes else None
    return array.shape[0] if array.ndim == 4 else None


def _numbered(arrays: Mapping[str, Any]) -> list[Source]:
    """Returns the sequences of arrays (N,3 or more) whose names a number counts, one for each group of them.

    Those that begin with places and go on with whole numbers or directions are the points, colors, normals and triangles of one
    cloud (``numpy.savez(file, points, colors)``, XDMF's ``data0`` and ``data1``).
    """
    groups: dict[str, list[str]] = {}
    for name, one in arrays.items():
        if not isinstance(one, list) and one.ndim in (1, 2) and one.dtype.kind in "uif":
            if 0 in one.shape or one.ndim == 2 and 3 <= one.shape[1] <= 10:
                groups.setdefault(name.rpartition("/")[0], []).append(name)
    found = []
    for group, names in groups.items():
        last = [name.rpartition("/")[2] + "." for name in names]  # no suffix: a point may stand in a number
        named = list(zip(parse_names(last), names))
        shapes = {own.shape for own, name in named if 0 not in arrays[name].shape}
        named = [(own, name) for own, name in named if own.shape in shapes]  # nothing was seen in those without points
        if (
            len(named) < 2
            or len(shapes) != 1
            or len((columns := NumberColumns([own for own, _ in named])).varying()) != 1
        ):
            continue
        ordered = [name for _, name in sorted(named, key=lambda pair: columns.key(pair[0]))]
        filled = [arrays[name] for name in ordered if 0 not in arrays[name].shape]
        if len({one.dtype.kind == "f" for one in filled}) == 1 and not _has_normals(filled):
            found.append(Source(tuple(ordered), group))
    if len(found) == 1:
        return [Source(found[0].keys)]
    return sorted(found, key=lambda one: natural_key(one.name))


def _has_normals(parts: list[Any]) -> bool:
    """Returns whether some of several arrays (N,3 or more), but not the first, hold nothing but directions of length 1."""

    def are_directions(array: Any) -> bool:
        lengths = np.linalg.norm(np.asarray(array[:_LOOKED_AT, :3], np.float64), axis=1)
        return array.shape[1] == 3 and len(lengths) >= _TELLING and bool((np.abs(lengths - 1) < _OF_LENGTH_ONE).all())

    return not are_directions(parts[0]) and any(map(are_directions, parts[1:]))


def _plain(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Returns a shape without the axis of length 1 that MATLAB gives to every list."""
    return tuple(length for length in shape if length != 1) if len(shape) <= 2 else tuple(shape)


@dataclass(frozen=True)
class Beside:
    """Holds the names of the arrays that tell more of the clouds of one array, "" where there is none."""

    times: str = ""
    colors: str = ""
    mask: str = ""
    counts: str = ""
    labels: str = ""

    def named(self) -> set[str]:
        """Returns the names of all that are there."""
        return {self.times, self.colors, self.mask, self.counts, self.labels} - {""}


def find_beside(arrays: Mapping[str, Any], key: str, axes: str) -> Beside:
    """Returns what lies beside the array ``key`` and fits its shape. axes: a letter for each of its axes."""
    sides = dict(zip(axes, arrays[key].shape))
    group = key.rpartition("/")[0]
    whole = tuple(arrays[key].shape)
    flat = tuple(length for letter, length in zip(axes, whole) if letter != "C")
    of_frames = tuple(sides[letter] for letter in axes if letter in "BT")

    def named(pattern: re.Pattern[str], *shapes: tuple[int, ...]) -> str:
        fitting = [
            name
            for name, one in arrays.items()
            if not isinstance(one, list)
            and name.rpartition("/")[0] == group
            and pattern.fullmatch(name.rpartition("/")[2])
            and _plain(one.shape) in map(_plain, shapes)
        ]
        return fitting[0] if len(fitting) == 1 else ""

    sequences = sides.get("B", 0)
    first = sides["T"] if "T" in sides and not sequences else 0  # labels of frames, or of clouds that make no sequence
    return Beside(
        times=named(_TIMES, of_frames, (sides.get("T", 0),)) if "T" in sides else "",
        colors=named(_COLORS, whole),
        mask=named(_MASKS, flat),
        counts=named(_COUNTS, of_frames) if "N" in sides else "",
        labels=named(_LABELS, (sequences or first,)) if sequences or first > 1 else "",
    )
