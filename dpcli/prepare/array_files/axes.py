"""Tells which axis of one array of many clouds counts sequences (B), frames (T), points (N) and coordinates (C).

The coordinates' axis is the one of length 3. Frames and points are told apart by two things that must agree: there are
mostly fewer frames than points, and a point is near where it was a frame ago but not near the next point. Where they
don't, nothing is guessed.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from dpcli.errors import UsageError

LETTERS = "BTNC"
_MOST_COLUMNS = 10  # x y z and what is known of a point
_LOOKED_AT, _SEQUENCES = 512, 4  # places along an axis that are looked at
_PAIRS = 4096
_SMOOTHER = 0.5  # steps along one axis as a share of those along another
_NEAR, _FAR = 0.1, 0.3  # steps as a share of the size: those of motion are below, those to what is no neighbor above
_FEWER = 2  # times fewer frames than points, from which on the shape tells
MATRICES = ((3, 3), (3, 4), (4, 4))  # shapes of a camera's


def check_axes(asked: str) -> str:
    """Returns the letters that a user gave, in capitals. Raises UsageError when they name no array of clouds.

    >>> check_axes("ntc"), check_axes("BTNC")
    ('NTC', 'BTNC')
    """
    letters = asked.upper()
    often = {letter: letters.count(letter) for letter in LETTERS}
    good = (
        set(letters) <= set(LETTERS) and often["C"] == 1 and 1 <= often["N"] <= 2 and max(often["B"], often["T"]) <= 1
    )
    if letters and not good:
        raise UsageError(
            f"--axes {asked}: expected a letter for each axis: C once (x y z), N (points; twice for rows and columns), and T"
            " (frames) and B (sequences) where there are such, as in TNC, NTC or BTNC"
        )
    return letters


def coordinates_axis(shape: tuple[int, ...]) -> int | None:
    """Returns which axis holds x y z: the only one of length 3, else the last one of 3 to 10; None where several may.

    >>> [coordinates_axis(shape) for shape in ((8, 100, 3), (100, 3, 8), (3, 50, 6), (8, 100, 5), (8, 100, 40))]
    [2, 1, None, 2, None]
    """
    last = len(shape) - 1
    threes = [place for place, length in enumerate(shape) if length == 3]
    if last in threes:
        return last
    few = 3 < shape[last] <= _MOST_COLUMNS
    if len(threes) == 1 and not (few and threes[0] == 0):
        return threes[0]
    return last if few and not threes else None


def are_poses(array: Any) -> bool:
    """Returns whether each of some 3x3, 3x4 or 4x4 numbers turns: poses of a camera, no clouds."""
    if array.ndim != 3 or tuple(array.shape[1:]) not in MATRICES:
        return False
    first = np.asarray(array[:_LOOKED_AT])[:, :3, :3].astype(np.float64)
    return bool(np.allclose(first @ first.transpose(0, 2, 1), np.eye(3), atol=1e-3))


def axes_of(array: Any) -> str:
    """Returns a letter for each axis of an array of three or four, "" where its shape and values leave a choice."""
    place = coordinates_axis(array.shape)
    if place is None or array.ndim not in (3, 4) or array.dtype.kind not in "uif":
        return ""
    others = [axis for axis in range(array.ndim) if axis != place]
    most = (*([_SEQUENCES] if array.ndim == 4 else []), *[_LOOKED_AT] * 2)
    key = dict(zip(others, (slice(0, count) for count in most)))
    some = np.moveaxis(np.asarray(array[tuple(key.get(axis, slice(None)) for axis in range(array.ndim))]), place, -1)
    shape = [array.shape[axis] for axis in others]
    some = some[..., :3].astype(np.float64)
    letters, stacked = "", place == array.ndim - 1
    if array.ndim == 3:
        letters = _of_one(some[None], shape[0], shape[1], stacked)
    elif _is_rough(some):
        letters = "B" + inner if (inner := _of_one(some, shape[1], shape[2], stacked)) else ""
    return letters[:place] + "C" + letters[place:] if letters else ""


def _is_rough(some: np.ndarray) -> bool:
    """Returns whether neighbors along the first axis of some sequences (B,P,Q,3) are unlike, as those of a batch are."""
    if len(some) == 1:
        return True
    steps, size = _step(some, 0), _size(some)
    return steps > _FAR * size


def _of_one(some: np.ndarray, first: int, second: int, stacked: bool) -> str:
    """Returns TN or NT for the axes behind the first of some sequences (B,P,Q,3) of which there are so many in all; "" where
    nothing decides. stacked: coordinates come last, as where frames were put one after the other; then frames come first where
    values say nothing.
    """
    if 1 in (first, second):
        return "TN" if first == 1 else "NT"
    along_first, along_second, size = _step(some, 1), _step(some, 2), _size(some)
    fewer = _FEWER * first <= second
    if along_first < _SMOOTHER * along_second:
        near = along_first < _NEAR * size
        return "TN" if near and along_second > _FAR * size or fewer and (near or stacked) else ""
    if along_second < _SMOOTHER * along_first:
        unlike = along_first > _FAR * size and along_second < _NEAR * size
        return "NT" if unlike and second <= first else ""
    return "TN" if stacked and min(along_first, along_second) > _FAR * size and fewer else ""


def _step(some: np.ndarray, axis: int) -> float:
    """Returns the median distance between neighbors along an axis of points (B,P,Q,3), without padding."""
    near = [np.take(some, range(begin, some.shape[axis] - 1 + begin), axis).reshape(-1, 3) for begin in (0, 1)]
    keep = slice(None, None, max(1, len(near[0]) // _PAIRS))
    return _median_distance(near[0][keep], near[1][keep])


def _size(some: np.ndarray) -> float:
    """Returns the median distance between points that are far apart in the arrays (B,P,Q,3)."""
    flat = some.reshape(len(some), -1, 3)
    shuffled = np.random.default_rng(0).permutation(flat.shape[1])[:_PAIRS]
    half = len(shuffled) // 2
    return _median_distance(*(flat[:, part].reshape(-1, 3) for part in (shuffled[:half], shuffled[half : 2 * half])))


def _median_distance(first: np.ndarray, second: np.ndarray) -> float:
    real = np.isfinite(first).all(1) & np.isfinite(second).all(1) & first.any(1) & second.any(1)
    with np.errstate(over="ignore", invalid="ignore"):  # of numbers that are no coordinates
        between = np.linalg.norm(first[real] - second[real], axis=1)
        return float(np.median(between)) if len(between) else 0.0


def choices(shape: tuple[int, ...]) -> list[str]:
    """Returns what the axes of an array of so many may be, likeliest first, for messages.

    >>> choices((24, 2048, 3)), choices((3, 50, 6))
    (['TNC', 'NTC', 'NNC'], ['TNC', 'NTC', 'CTN', 'CNT'])
    """
    place = coordinates_axis(shape)
    places = [len(shape) - 1, 0] if place is None else [place]
    orders = ("TN", "NT", "NN") if len(shape) == 3 and place is not None else ("TN", "NT")
    orders = ("BTN", "TBN", "TNN") if len(shape) == 4 else orders
    return [letters[:at] + "C" + letters[at:] for at, letters in product(places, orders)]
