"""The side from which points are drawn: words for axes, and a camera on a turntable."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dpcli.errors import UsageError

CAMERA_VIEW = "xyz"  # right, down, away: OpenCV camera axes
IMAGE_VIEW = "yx-z"  # row, column and a depth that grows toward the viewer
_CAMERA_AXES = re.compile(
    r"prepare (depth|msraction3d|ntu60|synthetic gestures)\b|generate4d export\b(?!.*--axes[ =]keep)|--coordinates[ =]camera"
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


def default_view(length_unit: str) -> str:
    """Returns the view of a file from its unit: image coordinates (row, column, ...) are turned upright.

    >>> default_view("m"), default_view("pixel (row, column), gray level")
    ('xyz', 'yx-z')
    """
    return IMAGE_VIEW if "row, column" in length_unit else CAMERA_VIEW


def upright_axis(provenance: Sequence[Mapping[str, Any]]) -> str:
    """Returns the axis that points upwards in a file: -y where one of the commands that made it writes camera axes, else z.

    >>> upright_axis([{"command": "dpc prepare depth my_videos --fov 60"}]), upright_axis([])
    ('-y', 'z')
    """
    return "-y" if any(_CAMERA_AXES.search(str(entry.get("command"))) for entry in provenance) else "z"


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
