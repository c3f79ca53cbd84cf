"""Recordings of robots for tests: clouds, depth images and cameras as ROS messages, in every kind of file."""

from __future__ import annotations

import struct
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

import cv2
import numpy as np

TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
KINDS = ("bag", "mcap", "sqlite3")
START = 1_700_000_000_000_000_000  # nanoseconds


def pack_rvl(depth: np.ndarray) -> bytes:
    """Columns, rows and the words of depth u16 (H,W), as Wilson (2017) writes them: every number in nibbles of three bits."""
    nibbles: list[int] = []

    def put(number: int) -> None:
        while True:
            number, low = number >> 3, number & 7
            nibbles.append(low | 8 * (number > 0))
            if not number:
                return

    pixels, last = depth.reshape(-1).tolist(), 0
    for seen, run in groupby(pixels, key=bool):
        values = list(run)
        if not nibbles and seen:
            put(0)  # the picture begins without zeros
        put(len(values))
        for value in values if seen else ():
            put(2 * (value - last) if value >= last else 2 * (last - value) - 1)
            last = value
    if not pixels[-1]:
        put(0)  # zeros at the end are followed by none that are seen
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{nibble:x}" for nibble in nibbles[k : k + 8]), 16) for k in range(0, len(nibbles), 8)]
    return struct.pack(f"<ii{len(words)}I", depth.shape[1], depth.shape[0], *words)


def new_store(ros1: bool) -> Any:
    """Knows the messages of ROS 1 or ROS 2; a test may add its own types to it."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)


_shared_store = cache(new_store)  # which compiles each type once


class Messages:
    """Makes messages of ROS 1 (``bag``) or ROS 2, whose classes and headers differ a little."""

    def __init__(self, kind: str) -> None:
        self.ros1 = kind == "bag"
        self.store = _shared_store(self.ros1)

    def make(self, kind: str, /, **values: Any) -> Any:
        return self.store.types[kind](**values)

    def header(self, stamp: int, place: str = "sensor") -> Any:
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        sequence = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=place, **sequence)

    def cloud(
        self, points: np.ndarray, stamp: int = START, *, height: int = 1, padding: int = 0, big: bool = False
    ) -> Any:
        """A PointCloud2 of a structured array (N), whose rows end in unused bytes."""
        kind = points.dtype.newbyteorder(">" if big else "<")
        fields = [
            self.make(
                "sensor_msgs/msg/PointField", name=n, offset=kind.fields[n][1], datatype=TYPES[kind[n].str[1:]], count=1
            )
            for n in kind.names
        ]
        width = len(points) // height
        rows = points.astype(kind).tobytes()
        step = kind.itemsize * width
        data = b"".join(rows[k * step : (k + 1) * step] + b"\xff" * padding for k in range(height))
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(stamp),
            height=height,
            width=width,
            fields=fields,
            is_bigendian=big,
            point_step=kind.itemsize,
            row_step=step + padding,
            data=np.frombuffer(data, np.uint8),
            is_dense=True,
        )

    def image(
        self, frame: np.ndarray, stamp: int = START, *, encoding: str = "16UC1", big: bool = False, padding: int = 0
    ) -> Any:
        rows = frame.astype(frame.dtype.newbyteorder(">" if big else "<"))
        data = b"".join(row.tobytes() + b"\0" * padding for row in rows)
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(stamp),
            height=frame.shape[0],
            width=frame.shape[1],
            encoding=encoding,
            is_bigendian=int(big),
            step=frame.shape[1] * frame.itemsize + padding,
            data=np.frombuffer(data, np.uint8),
        )

    def compressed(self, frame: np.ndarray, stamp: int = START, *, form: str = "16UC1; compressedDepth png") -> Any:
        """A CompressedImage of depth u16, or f32 by its inverse, with the header of image_transport when ``form`` says so."""
        head, stored = struct.pack("<iff", 0, 0, 0), frame
        if frame.dtype == np.float32:
            a, b = 100.0 * (100.0 / 10.0 + 1), 1 - 100.0 * (100.0 / 10.0 + 1) / 10.0  # as image_transport chooses them
            head = struct.pack("<iff", 0, a, b)
            stored = np.where(frame > 0, a / np.maximum(frame, 1e-9) + b, 0).astype(np.uint16)
        data = pack_rvl(stored) if "rvl" in form else cv2.imencode(".png", stored)[1].tobytes()
        data = head + data if "compressedDepth" in form else data
        return self.make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(stamp),
            format=form,
            data=np.frombuffer(data, np.uint8),
        )

    def camera(
        self, k: list[float], width: int, height: int, *, d: tuple[float, ...] = (0.0,) * 5, p: Any = None
    ) -> Any:
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        arrays = {"d": np.array(d), "k": np.array(k), "r": np.eye(3).reshape(-1)}
        arrays["p"] = np.zeros(12) if p is None else np.array(p, float)
        named = {name.upper() if self.ros1 else name: values for name, values in arrays.items()}
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(START),
            height=height,
            width=width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **named,
        )


def write_recording(
    path: Path, kind: str, messages: Messages, content: list[tuple[str, int, Any]], packed: str = ""
) -> Path:
    """Writes (topic, nanoseconds, message) as a ROS 1 bag, or as a ROS 2 bag in MCAP or SQLite; returns what to read.

    packed: BZ2 or LZ4 in ROS 1; FILE, MESSAGE or STORAGE (MCAP's own) in ROS 2.
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    path.parent.mkdir(parents=True, exist_ok=True)
    if kind == "bag":
        writer, serialize = Writer1(path.with_suffix(".bag")), messages.store.serialize_ros1
    else:
        writer = Writer2(path, version=9, storage_plugin=StoragePlugin[kind.upper()])
        serialize = messages.store.serialize_cdr
    if packed and kind == "bag":
        writer.set_compression(Writer1.CompressionFormat[packed])
    elif packed:
        writer.set_compression(CompressionMode[packed], CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, time, message in content:
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=messages.store)
            writer.write(connections[topic], time, serialize(message, name))
    return path.with_suffix(".bag") if kind == "bag" else path
