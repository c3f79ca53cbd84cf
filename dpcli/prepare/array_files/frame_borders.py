"""Tells where one array of points holds many frames, as arrays beside it say that count them or tell where each begins."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from dpcli.counted import counted
from dpcli.prepare.array_files.choosing import says_times

_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+")
_COUNTS = frozenset("count counts length lengths len lens size sizes num number n points pts npoints npts".split())
_STARTS = frozenset("offset offsets start starts begin begins ptr indptr splits".split())
_OF_OTHERS = frozenset(  # whose counts make up the number of points, too
    "class classes label labels instance instances part parts object objects category categories segment segments"
    " hist histogram bin bins voxel voxels ring rings".split()
)


def frames_beside(arrays: Mapping[str, Any], totals: Iterable[int]) -> str:
    """Returns what to do where an array divides points into frames, as ragged arrays are stored; "" where none does.

    totals: how many points the arrays may hold.

    >>> frames_beside({"points": np.zeros((5, 3)), "counts": np.array([2, 3])}, [5])
    "its array 'counts' divides its 5 points into 2 frames, which one cloud would mix up; put the number of each point's frame beside \
them: frame = numpy.repeat(numpy.arange(2), counts)"
    >>> frames_beside({"points": np.zeros((5, 3)), "class_counts": np.array([2, 3])}, [5])
    ''
    """
    known = [*dict.fromkeys(totals)]
    for name, one in arrays.items():
        own = name.rpartition("/")[2]
        length = 0 if isinstance(one, list) or one.dtype.kind not in "uif" else math.prod(one.shape)
        if length < 2 or max(one.shape) != length:
            continue
        for total in known:
            if length < total and (found := _counts_of(own, np.asarray(one[()]).reshape(-1), total)):
                frames, counts = found
                return (
                    f"its array {own!r} divides its {total} points into {frames} frames, which one cloud would mix up; put"
                    f" the number of each point's frame beside them: frame = numpy.repeat(numpy.arange({frames}), {counts})"
                )
    return ""


def _counts_of(name: str, values: np.ndarray, total: int) -> tuple[int, str] | None:
    """Returns how many frames the values (T) of an array make of so many points, and the points of each, as Python says it."""
    words = {word.lower() for word in _WORD.findall(name)}
    if words & _OF_OTHERS or not np.isfinite(values).all() or (values < 0).any() or (values != np.floor(values)).any():
        return None
    values = values.astype(np.float64)
    rises = values[0] == 0 and bool((np.diff(values) >= 0).all())
    if rises and values[-1] == total and len(values) > 2 and not says_times(name):
        return len(values) - 1, f"numpy.diff({name})"
    if rises and words & _STARTS and values[-1] < total:
        return len(values), f"numpy.diff(numpy.append({name}, {total}))"
    return (len(values), name) if words & _COUNTS and values.sum() == total else None


def rows_of_axes(arrays: Mapping[str, Any], *, timed: bool) -> str:
    """Returns what to do where x, y and z are arrays of frames and points (T,N) each; "" where they are none. timed: only
    where an array beside them tells a time for each row, since they may be a grid of one cloud.

    >>> rows_of_axes({"X": np.zeros((4, 9)), "Y": np.zeros((4, 9)), "Z": np.zeros((4, 9)), "t": np.arange(4)}, timed=True)
    "its arrays X, Y and Z have 4 rows of 9 points, and 't' a time for each: stack them, points = numpy.stack([X, Y, Z], -1), and give \
--axes TNC"
    """
    plain = {name: one for name, one in arrays.items() if not isinstance(one, list)}
    for x in (name for name in plain if name.rpartition("/")[2] in ("x", "X")):
        group, slash, own = x.rpartition("/")
        axes = [own, *("yz" if own == "x" else "YZ")]
        shapes = {getattr(plain.get(f"{group}{slash}{axis}"), "shape", ()) for axis in axes}
        shape = shapes.pop()
        if shapes or len(shape) != 2 or min(shape) < 2:
            continue
        beside = [name.rpartition("/") for name, one in plain.items() if math.prod(one.shape) == shape[0]]
        times = next((own for above, _, own in beside if above == group and says_times(own)), "")
        if times or not timed:
            told = f", and {times!r} a time for each" if times else ""
            named, order = ", ".join(axes), "--axes TNC" if times else "--axes TNC where its rows are frames, else NTC"
            return (
                f"its arrays {axes[0]}, {axes[1]} and {axes[2]} have {shape[0]} rows of {counted(shape[1], 'point')}{told}: stack"
                f" them, points = numpy.stack([{named}], -1), and give {order}"
            )
    return ""
