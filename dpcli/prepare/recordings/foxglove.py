"""Foxglove's messages (PointCloud, RawImage, CompressedImage, CameraCalibration) in Protobuf, JSON or ROS, made to look like
those of ROS.

The field numbers of Protobuf are those of Foxglove's schemas, which never change; fields that aren't read are passed over.
"""

from __future__ import annotations

import base64
import json
from types import SimpleNamespace
from typing import Any

import numpy as np

from dpcli.ops.rotations import quaternion_to_matrix

_NAMES = ("PointCloud", "RawImage", "CompressedImage", "CameraCalibration")
# in Protobuf and JSON, and in ROS
CLOUDS, IMAGES, COMPRESSED, CAMERAS = ((f"foxglove.{name}", f"foxglove_msgs/msg/{name}") for name in _NAMES)
FOXGLOVE_KINDS = (*CLOUDS, *IMAGES, *COMPRESSED, *CAMERAS)
_NUMBERS = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}  # NumericType -> datatype of PointField
_VECTOR = {1: ("x", float), 2: ("y", float), 3: ("z", float)}
_FIELDS: dict[str, dict[int, tuple[str, Any]]] = {
    "Timestamp": {1: ("sec", int), 2: ("nsec", int)},
    "Vector3": _VECTOR,
    "Quaternion": {**_VECTOR, 4: ("w", float)},
    "Pose": {1: ("position", "Vector3"), 2: ("orientation", "Quaternion")},
    "PackedElementField": {1: ("name", str), 2: ("offset", int), 3: ("type", int)},
    "PointCloud": {
        1: ("timestamp", "Timestamp"),
        2: ("frame_id", str),
        3: ("pose", "Pose"),
        4: ("point_stride", int),
        5: ("fields", ["PackedElementField"]),
        6: ("data", bytes),
    },
    "RawImage": {
        1: ("timestamp", "Timestamp"),
        7: ("frame_id", str),
        2: ("width", int),
        3: ("height", int),
        4: ("encoding", str),
        5: ("step", int),
        6: ("data", bytes),
    },
    "CompressedImage": {1: ("timestamp", "Timestamp"), 4: ("frame_id", str), 2: ("data", bytes), 3: ("format", str)},
    "CameraCalibration": {
        1: ("timestamp", "Timestamp"),
        9: ("frame_id", str),
        2: ("width", int),
        3: ("height", int),
        4: ("distortion_model", str),
        **{number: (name, [float]) for number, name in ((5, "D"), (6, "K"), (7, "R"), (8, "P"))},
    },
}  # message -> number of a field -> (name, type; in a list where it repeats)


def read_protobuf(raw: bytes, kind: str) -> SimpleNamespace:
    """Returns a message of Foxglove's ``kind`` that Protobuf packed. Raises ValueError where it is cut off or of another one."""
    return _parse(bytes(raw), _name(kind))


def read_json(raw: bytes, kind: str) -> SimpleNamespace:
    """Returns a message of Foxglove's ``kind`` that JSON holds, bytes in base64. Raises ValueError where it isn't one."""
    return _of_json(json.loads(raw), _name(kind))


def as_ros(content: Any, kind: str) -> SimpleNamespace:
    """Returns what a message of Foxglove's ``kind`` says under the names of ROS: of a PointCloud2 (with ``pose``, the motion f64
    (4,4) from the points to their frame, or None), Image, CompressedImage or CameraInfo.
    """
    told = SimpleNamespace(**vars(content))
    stamp = content.timestamp
    nanoseconds = stamp.nsec if hasattr(stamp, "nsec") else stamp.nanosec  # as Foxglove and ROS call them
    told.header = SimpleNamespace(stamp=SimpleNamespace(sec=stamp.sec, nanosec=nanoseconds), frame_id=content.frame_id)
    told.is_bigendian = False
    if kind in CLOUDS:
        told.fields = [
            SimpleNamespace(name=one.name, offset=one.offset, datatype=_NUMBERS.get(one.type, 0), count=1)
            for one in content.fields
        ]
        told.point_step, told.row_step, told.height = content.point_stride, 0, 1
        told.width = -(-len(content.data) // max(content.point_stride, 1))  # a last one that was cut is one, too
        told.pose = _motion(content.pose)
    elif kind in CAMERAS:
        told.roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
        for name, size in (("K", 9), ("P", 12)):  # which nobody fills before the camera is calibrated
            if len(getattr(told, name, ())) != size and not hasattr(told, name.lower()):
                setattr(told, name, [0.0] * size)
    return told


def _name(kind: str) -> str:
    return kind.replace("/", ".").rpartition(".")[2]


def _motion(pose: Any) -> np.ndarray | None:
    """Returns the motion f64 (4,4) of a pose, None where it moves nothing; a quaternion of zeros turns nothing."""
    place, turn = pose.position, pose.orientation
    quaternion = np.array([turn.w, turn.x, turn.y, turn.z], np.float64)
    motion = np.eye(4)
    with np.errstate(invalid="ignore", over="ignore"):  # points become NaN, which are dropped and counted
        motion[:3, :3] = quaternion_to_matrix(quaternion / (np.linalg.norm(quaternion) or 1))
    motion[:3, 3] = place.x, place.y, place.z
    return None if np.array_equal(motion, np.eye(4)) else motion


def _empty(kind: str) -> SimpleNamespace:
    """Returns a message that says nothing: zeros, empty texts, bytes and lists, which Protobuf leaves out."""
    told = {}
    for name, one in _FIELDS[kind].values():
        told[name] = [] if isinstance(one, list) else _empty(one) if isinstance(one, str) else one()
    return SimpleNamespace(**told)


def _of_json(said: Any, kind: str) -> SimpleNamespace:
    if not isinstance(said, dict):
        raise ValueError(f"a {kind} in JSON is no object")
    told = _empty(kind)
    for name, one in _FIELDS[kind].values():
        if said.get(name) is not None:
            many = isinstance(one, list)
            setattr(told, name, [_json_value(v, one[0]) for v in said[name]] if many else _json_value(said[name], one))
    return told


def _json_value(said: Any, one: Any) -> Any:
    if isinstance(one, str):
        return _of_json(said, one)
    if one is int and isinstance(said, float) and not said.is_integer():
        raise ValueError(f"{said} stands where Foxglove's messages have whole numbers")
    return base64.b64decode(said, validate=True) if one is bytes else _whole(int(said)) if one is int else one(said)


def _parse(data: bytes, kind: str) -> SimpleNamespace:
    found: dict[int, list[Any]] = {}
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        value, at = _varint(data, at) if tag & 7 in (0, 2) else ({1: 8, 5: 4}.get(tag & 7, -1), at)
        if tag & 7:  # what was read is its length, not itself
            if not 0 <= value <= len(data) - at:
                raise ValueError(f"a {kind} of {len(data)} bytes in Protobuf is cut off or damaged")
            value, at = data[at : at + value], at + value
        found.setdefault(tag >> 3, []).append(value)
    told = _empty(kind)
    for number, values in found.items():
        name, one = _FIELDS[kind].get(number, ("", None))
        if one == [float]:
            setattr(told, name, [number for value in values for number in np.frombuffer(value, "<f8").tolist()])
        elif isinstance(one, list):
            setattr(told, name, [_parse(value, one[0]) for value in values])
        elif name:
            merged = isinstance(one, str) and int not in map(type, values)  # a message that came in parts
            setattr(told, name, _value(b"".join(values) if merged else values[-1], one))
    return told


def _value(value: int | bytes, one: Any) -> Any:
    if isinstance(value, int):
        if one is not int:
            raise ValueError("a field in Protobuf is of another type than Foxglove's")
        return _whole(value - 2**64 if value >= 2**63 else value)
    if isinstance(one, str):
        return _parse(value, one)
    if one is str:
        return value.decode("utf-8", "replace")
    return value if one is bytes else np.frombuffer(value, {int: "<u4", float: "<f8"}[one]).item()


def _whole(value: int) -> int:
    if value < 0:
        raise ValueError(f"{value} stands where Foxglove's messages have sizes, places and times")
    return value


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Returns the number that begins at a byte, seven bits in each, the lowest first, and where it ends."""
    value = 0
    for place, byte in enumerate(data[at : at + 10]):
        value |= (byte & 127) << (7 * place)
        if byte < 128:
            return value, at + place + 1
    raise ValueError("a number in Protobuf is cut off")
