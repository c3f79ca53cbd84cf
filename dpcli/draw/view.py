"""The side from which points are drawn: words for axes, and a camera on a turntable."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dpcli.errors import UsageError

CAMERA_VIEW = "xyz"  # right, down, away: OpenCV camera axes
IMAGE_VIEW = "yx-z"  # row, column and a depth that grows toward the viewer
# By the words of a command: the view that its files look upright in.
_VIEW_OF_COMMANDS = (
    (r"--coordinates[ =]camera|prepare (depth|msraction3d|ntu60|synthetic gestures)\b", CAMERA_VIEW),
    (r"prepare (kitti-sf|kitti-det|semantickitti)\b", "-x-yz"),  # as published: x left, y up, z forward
    (r"prepare (sapien|synthetic articulated)\b", "x-zy"),
    (r"prepare (video|animation|artemis|synthetic animal)\b", "x-y-z"),
    (r"generate4d export\b.*--axes[ =]keep", "x-y-z"),
    (r"generate4d export\b", CAMERA_VIEW),
)


def parse_view(text: str) -> np.ndarray:  # [3, 3]
    """Returns the rows of a signed permutation, f32, from names of the axes that point right, down and away.

    Raises UsageError for a text that doesn't name each axis once.

    >>> parse_view("x-zy").tolist()
    [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    """
    axes = re.findall(r"-?[xyz]", text)
    if "".join(axes) != text or sorted(axis[-1] for axis in axes) != ["x", "y", "z"]:
        raise UsageError(f"--view {text}: expected the axes that point right, down and away, such as xyz or x-zy")
    matrix = np.zeros((3, 3), np.float32)
    for row, axis in enumerate(axes):
        matrix[row, "xyz".index(axis[-1])] = -1 if axis[0] == "-" else 1
    return matrix


def default_view(length_unit: str, provenance: Sequence[Mapping[str, Any]] = ()) -> str:
    """Returns the view of a file from its unit, as image coordinates (row, column, ...) are turned upright, and its commands.

    >>> default_view("m"), default_view("pixel (row, column), gray level")
    ('xyz', 'yx-z')
    >>> default_view("m", [{"command": "dpc prepare kitti-sf RAW"}, {"command": "dpc segment predict"}])
    '-x-yz'
    >>> default_view("", [{"command": "dpc prepare animation Fox.glb -o v.h5"}, {"command": "dpc prepare clouds v.h5"}])
    'x-y-z'
    """
    return IMAGE_VIEW if "row, column" in length_unit else _known_view(provenance) or CAMERA_VIEW


def upright_axis(provenance: Sequence[Mapping[str, Any]]) -> str:
    """Returns the axis that points upwards in a file, by the commands that made it; z where they don't tell.

    >>> upright_axis([{"command": "dpc prepare depth my_videos --fov 60"}]), upright_axis([])
    ('-y', 'z')
    """
    down = re.findall("-?[xyz]", _known_view(provenance) or "x-zy")[1]
    return down[1:] if down[0] == "-" else f"-{down}"


def _known_view(provenance: Sequence[Mapping[str, Any]]) -> str | None:
    """Returns the view of the last command whose axes are known."""
    for entry in reversed(provenance):
        for words, view in _VIEW_OF_COMMANDS:
            if re.search(words, str(entry.get("command"))):
                return view
    return None


def turntable_view(azimuth: float, elevation: float, up: str = "z") -> np.ndarray:  # [3, 3]
    """Returns the rows right, down and away, f64, of a camera that looks at the origin.

    azimuth: radians about `up` (x, y, z or one with a minus). elevation: radians above the horizon.

    >>> turntable_view(0.0, 0.0, "z").tolist()  # looks along x
    [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]
    """
    axis = "xyz".index(up[-1])
    first, second, upright = np.eye(3)[[(axis + 1) % 3, (axis + 2) % 3, axis]]
    if up[0] == "-":
        second, upright = -second, -upright
    ahead = np.cos(azimuth) * first + np.sin(azimuth) * second
    away = np.cos(elevation) * ahead - np.sin(elevation) * upright
    right = np.cross(ahead, upright)
    return np.stack([right, np.cross(away, right), away])
