"""Tells which of the arrays in a file are clouds of many frames, and what lies beside them: times, colors, counts, labels."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dpcli.prepare.array_files.attributes import attributes_of
from dpcli.prepare.array_files.axes import are_poses, coordinates_axis
from dpcli.prepare.reader import natural_key
from dpcli.runtime.clips.name_numbers import Name, NumberColumns, parse_names

POINT_KEYS = tuple("points xyz pos point_cloud point_clouds pointcloud clouds pc pcs pcd vertices verts".split())
_BESIDE = re.compile(
    r"(.*[/_.])?(normals?|colou?rs?|rgb|flows?|scene_?flow|veloc\w*|vel|feat\w*|faces?|triangles|edges|weights?|masks?|valids?|"
    r"poses?|transforms?|rotations?|trans\w*|(in|ex)trinsics?|cameras?|joints?_?(names|parents)|images?|depths?|labels?|y|times?|"
    r"time_?stamps?|intensit\w*|reflect\w*)",
    re.IGNORECASE,
)
_TIMES = re.compile(
    r"(.*[/_.])?(times?|time_?stamps?|stamps?|t|ts|seconds)([_ ]?\(?\[?(s|sec|ms|us|ns)\]?\)?)?", re.IGNORECASE
)
_COLORS = re.compile(r"colou?rs?|rgb", re.IGNORECASE)
_MASKS = re.compile(  # of valid points: those of padding, ground, persons and the like are none
    r"(((points?|pts|xyz|cloud|pc)_?)?(masks?|is_?valid|valids?|validity)|(valid|masks?)_?(masks?|points?|pts|xyz|cloud|pc))",
    re.IGNORECASE,
)
_FRAME_COUNTS = re.compile(
    r"(n|num|number)_?(of_)?frames?|frames?_?(counts?|lengths?|lens?)|seq(uence)?_?(lengths?|lens?)", re.IGNORECASE
)
_COUNTS = re.compile(
    r"(n|num|number|valid|real)_?(of_)?(points?|pts)(_.*)?|lengths?|(point_?|pts_?)?counts?|sizes?", re.IGNORECASE
)
_FRAMES = frozenset(  # words beside the numbers of groups that are frames
    "frame frames f scan scans sweep sweeps cloud clouds pc pcd step steps timestep timesteps time times timestamp timestamps stamp"
    " stamps t ts".split()
)
_LABELS = re.compile(r"labels?|y|class(es)?|targets?|actions?|gestures?", re.IGNORECASE)

_LOOKED_AT, _TELLING = 512, 8  # rows of an array that are looked at, and that are enough to tell what they hold
_OF_LENGTH_ONE = 1e-3  # how far lengths of rounded directions are from 1


@dataclass(frozen=True)
class Source:
    """Says where one sequence of clouds lies in a file: in these arrays (each a frame, where they are several), and at this
    place of the only one's sequences, None where it holds one. counted: what each of several arrays is called, or its group, with
    the number that orders them.
    """

    keys: tuple[str, ...]
    name: str = ""
    place: int | None = None
    counted: tuple[Name, ...] = ()

    @property
    def group(self) -> str:
        """Returns the name of the group in which the arrays lie, or, where each frame has a group, that of these."""
        above = self.keys[0].rpartition("/")[0]
        return above.rpartition("/")[0] if self.have_groups else above

    @property
    def have_groups(self) -> bool:
        """Returns whether each frame has a group of its own, in which its array lies."""
        return len(self.keys) > 1 and len({key.rpartition("/")[2] for key in self.keys}) == 1


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

    Where they are called points, the number may be that of their groups (``frame_0001/points``). Those that begin with places and
    go on with whole numbers or directions are the points, colors, normals and triangles of one cloud (``numpy.savez(file, points,
    colors)``, XDMF's ``data0`` and ``data1``).
    """
    groups: dict[tuple[str, str], list[str]] = {}
    for name, one in arrays.items():
        if not isinstance(one, list) and one.ndim in (1, 2) and one.dtype.kind in "uif":
            if 0 in one.shape or one.ndim == 2 and 3 <= one.shape[1] <= 10:
                above, _, own = name.rpartition("/")
                inside = own if above and own.lower() in POINT_KEYS else ""
                groups.setdefault((above.rpartition("/")[0] if inside else above, inside), []).append(name)
    found = []
    for (group, inside), names in groups.items():
        # clouds of one frame, such as of several sensors
        if group and _counts_frames(group.rpartition("/")[2], words=1):
            continue
        own = [name.removesuffix(f"/{inside}").rpartition("/")[2] for name in names]
        if inside and not all(map(_counts_frames, own)):
            continue
        named = list(zip(parse_names([f"{one}." for one in own]), names))  # no suffix: a point may stand in a number
        shapes = {own.shape for own, name in named if 0 not in arrays[name].shape}
        named = [(own, name) for own, name in named if own.shape in shapes]  # nothing was seen in those without points
        columns = NumberColumns([own for own, _ in named])
        if len(named) < 2 or len(shapes) != 1 or len(columns.varying()) != 1:
            continue
        counted, ordered = zip(*sorted(named, key=lambda pair: columns.key(pair[0])))
        filled = [arrays[name] for name in ordered if 0 not in arrays[name].shape]
        if len({one.dtype.kind == "f" for one in filled}) == 1 and not _has_normals(filled):
            found.append(Source(ordered, group, counted=counted))
    found = [one for one in found if one.have_groups] or found
    if len(found) == 1:
        return [replace(found[0], name="")]
    if len({one.name for one in found}) < len(found):  # frame_1/points beside frame_1/vertices
        found = [replace(one, name="/".join(filter(None, (one.name, one.keys[0].rpartition("/")[2])))) for one in found]
    return sorted(found, key=lambda one: natural_key(one.name))


def _counts_frames(name: str, words: int = 0) -> bool:
    """Returns whether a group's name is a number, alone (unless ``words`` are needed) or beside words that say that it counts
    frames.

    >>> _counts_frames("frame_0001"), _counts_frames("17"), _counts_frames("object_3"), _counts_frames("points")
    (True, True, False, False)
    """
    found = [word.lower() for word in re.findall(r"[^\W\d_]+", name)]
    return len(found) >= words and set(found) <= _FRAMES and any(letter.isdecimal() for letter in name)


def _has_normals(parts: list[Any]) -> bool:
    """Returns whether some of several arrays (N,3 or more), but not the first, hold nothing but directions of length 1."""

    def are_directions(array: Any) -> bool:
        lengths = np.linalg.norm(np.asarray(array[:_LOOKED_AT, :3], np.float64), axis=1)
        return array.shape[1] == 3 and len(lengths) >= _TELLING and bool((np.abs(lengths - 1) < _OF_LENGTH_ONE).all())

    return not are_directions(parts[0]) and any(map(are_directions, parts[1:]))


def _plain(shape: tuple[int, ...] | None) -> tuple[int, ...] | None:
    """Returns a shape without the axis of length 1 that MATLAB gives to every list; None of none."""
    if shape is None:
        return None
    return tuple(length for length in shape if length != 1) if len(shape) <= 2 else tuple(shape)


@dataclass(frozen=True)
class Beside:
    """Holds the names of the arrays that tell more of the clouds of one array, "" where there is none."""

    times: str = ""
    colors: str = ""
    mask: str = ""
    counts: str = ""
    labels: str = ""
    frames: str = ""

    def named(self) -> set[str]:
        """Returns the names of all that are there."""
        return {*vars(self).values()} - {""}


def beside_frames(arrays: Mapping[str, Any], source: Source) -> Beside:
    """Returns what lies beside frames of their own sizes, which are arrays that a number counts, or a list: a time or a label for
    each of these.
    """
    count = len(source.keys) if len(source.keys) > 1 else len(arrays[source.keys[0]])
    group = source.group

    def named(pattern: re.Pattern[str]) -> str:
        return _only_fitting(arrays, group, pattern, [(count,)])

    if source.place is not None:  # a list of sequences
        return Beside(labels=named(_LABELS))
    times = named(_TIMES)
    if not times and group and not source.name:  # the only ones of the file
        times = _only_fitting(arrays, group.rpartition("/")[0], _TIMES, [(count,)])
    return Beside(times=times, labels=named(_LABELS) or find_labels_of_clouds(arrays, source))


def find_times_of_groups(arrays: Mapping[str, Any], source: Source) -> list[str]:
    """Returns the names of the single numbers that tell the time of each frame in its group; [] without them."""
    return _of_groups(arrays, source, _TIMES)


def find_labels_of_clouds(arrays: Mapping[str, Any], source: Source) -> str:
    """Returns the name of the number, or attribute, that labels each of several clouds whose names are plain numbers, so that they
    may be samples rather than frames; "" without.
    """
    plain = len(source.keys) > 1 and not any(re.search(r"[^\W\d_]", one.text) for one in source.counted)
    if plain and (names := _of_groups(arrays, source, _LABELS)):
        return names[0].rpartition("/")[2]
    told = [attributes_of(arrays[key]) for key in source.keys] if plain else [{}]
    return next((name for name in told[0] if _LABELS.fullmatch(name) and all(name in one for one in told)), "")


def _of_groups(arrays: Mapping[str, Any], source: Source, pattern: re.Pattern[str]) -> list[str]:
    """Returns the names of single numbers called alike, one in the group of each frame; [] without them."""
    groups = [key.rpartition("/")[0] for key in source.keys] if source.have_groups else []
    first = _called(arrays, groups[0], pattern) if groups else []
    for own in sorted(name.rpartition("/")[2] for name in first):
        names = [f"{group}/{own}" for group in groups]
        if all(_is_single(arrays.get(name)) for name in names):
            return names
    return []


def _is_single(array: Any) -> bool:
    return hasattr(array, "shape") and array.ndim <= 2 and np.prod(array.shape) == 1


def find_labels(arrays: Mapping[str, Any], sources: Sequence[Source]) -> list[float | None]:
    """Returns, for each sequence, the one number beside its only array or its frames, or attribute of its group, that is called
    label or the like; None where there is none, or several.
    """
    beside: dict[str, list[str]] = {}
    for name in filter(says_label, arrays):
        beside.setdefault(name.rpartition("/")[0], []).append(name)
    return [_label(arrays, own, beside.get(own.group, [])) if own.place is None else None for own in sources]


def _label(arrays: Mapping[str, Any], source: Source, names: Sequence[str]) -> float | None:
    found = {name: arrays[name][()] for name in names if _is_single(arrays[name])}
    attributes = attributes_of(arrays[source.keys[0]], above=source.have_groups)
    found = found or {name: one for name, one in attributes.items() if says_label(name)}
    values = [np.asarray(one) for one in found.values()]
    return values[0].item() if len(values) == 1 and values[0].size == 1 and values[0].dtype.kind in "uif" else None


def says_label(name: str) -> bool:
    """Returns whether a name says that it holds labels.

    >>> says_label("y"), says_label("walk_1/label"), says_label("time")
    (True, True, False)
    """
    return _LABELS.fullmatch(name.rpartition("/")[2]) is not None


def says_times(name: str) -> bool:
    """Returns whether a name says that it holds times.

    >>> says_times("timestamps"), says_times("t_ms"), says_times("depth")
    (True, True, False)
    """
    return _TIMES.fullmatch(name) is not None


def _only_fitting(
    arrays: Mapping[str, Any], group: str, pattern: re.Pattern[str], shapes: Sequence[tuple[int, ...]]
) -> str:
    """Returns the only array of a group whose name and shape fit, "" where there is none or several."""
    called = _called(arrays, group, pattern)
    fitting = [name for name in called if _plain(getattr(arrays[name], "shape", None)) in map(_plain, shapes)]
    return fitting[0] if len(fitting) == 1 else ""


def _called(arrays: Mapping[str, Any], group: str, pattern: re.Pattern[str]) -> list[str]:
    """Returns the arrays of a group whose names fit; those of a file are searched once, see `ByName`."""
    known = getattr(arrays, "fitting", {})
    if pattern not in known:
        groups = known[pattern] = {}
        for name in arrays:
            above, _, own = name.rpartition("/")
            if pattern.fullmatch(own):
                groups.setdefault(above, []).append(name)
    return known[pattern].get(group, [])


def find_beside(arrays: Mapping[str, Any], key: str, axes: str) -> Beside:
    """Returns what lies beside the array ``key`` and fits its shape. axes: a letter for each of its axes."""
    sides = dict(zip(axes, arrays[key].shape))
    group = key.rpartition("/")[0]
    whole = tuple(arrays[key].shape)
    flat = tuple(length for letter, length in zip(axes, whole) if letter != "C")
    of_frames = tuple(sides[letter] for letter in axes if letter in "BT")

    def named(pattern: re.Pattern[str], *shapes: tuple[int, ...]) -> str:
        return _only_fitting(arrays, group, pattern, shapes)

    sequences = sides.get("B", 0)
    first = sides["T"] if "T" in sides and not sequences else 0  # labels of frames, or of clouds that make no sequence
    return Beside(
        times=named(_TIMES, of_frames, (sides.get("T", 0),)) if "T" in sides else "",
        colors=named(_COLORS, whole),
        mask=named(_MASKS, flat, tuple(1 if letter == "C" else length for letter, length in zip(axes, whole))),
        counts=named(_COUNTS, of_frames) if "N" in sides else "",
        labels=named(_LABELS, (sequences or first,)) if sequences or first > 1 else "",
        frames=named(_FRAME_COUNTS, (sequences,)) if sequences and "T" in sides else "",
    )
