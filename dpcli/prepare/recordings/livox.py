"""Livox's CustomMsg, which its drivers record instead of PointCloud2: all points at once, out of the message's bytes.

A library of ROS messages makes an object of every point, which takes a hundred times longer.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

LIVOX_KINDS = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg", "livox_interfaces/msg/CustomMsg")
_POINT = [
    ("offset_time", "u4"),
    ("x", "f4"),
    ("y", "f4"),
    ("z", "f4"),
    ("reflectivity", "u1"),
    ("tag", "u1"),
    ("line", "u1"),
]
_PACKED, _ALIGNED = 19, 20  # bytes from a point to the next in ROS 1 and in ROS 2; the last one has 19 in both


@dataclass(frozen=True)
class LivoxScan:
    """Holds the columns of a scan by name, each (N), and the ``header`` of its message with stamp and frame_id."""

    header: Any
    columns: dict[str, np.ndarray]


def read_livox(raw: bytes | memoryview, *, ros1: bool) -> LivoxScan:
    """Returns the points of a serialized CustomMsg. Raises ValueError where its counts and its bytes differ."""
    data = bytes(raw)
    order = "<" if ros1 or data[1:2] == b"\1" else ">"
    body = data if ros1 else data[4:]  # behind the encapsulation of CDR
    at = 4 if ros1 else 0  # behind the running number of ROS 1
    try:
        seconds, nanoseconds, length = struct.unpack_from(order + "III", body, at)
        at += 12
        place = body[at : at + length].split(b"\0")[0].decode("latin-1")
        at += length
        at += 0 if ros1 else -at % 8
        at += 8 + 4 + 1 + 3  # time base, number of points, lidar, reserved
        (count,) = struct.unpack_from(order + "I", body, at)
    except struct.error as error:
        raise ValueError(f"a CustomMsg of {len(data)} bytes is cut off ({error})") from None
    at += 4
    step = _PACKED if ros1 else _ALIGNED
    left = len(body) - at
    if count and left < count * step - (step - _PACKED):
        raise ValueError(f"a CustomMsg of {count} points has {left} bytes for them")
    rows = body[at : at + count * step].ljust(count * step, b"\0")
    names, kinds = zip(*_POINT)
    kind = np.dtype(
        {
            "names": names,
            "formats": [order + one for one in kinds],
            "offsets": [0, 4, 8, 12, 16, 17, 18],
            "itemsize": step,
        }
    )
    points = np.frombuffer(rows, kind, count)
    stamp = SimpleNamespace(sec=seconds, nanosec=nanoseconds)
    columns = {name: points[name].astype(points[name].dtype.newbyteorder("=")) for name in names}
    return LivoxScan(SimpleNamespace(stamp=stamp, frame_id=place), columns)
