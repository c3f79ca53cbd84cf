"""Writes MCAP files by their specification, and Foxglove's messages in Protobuf and JSON, without the libraries for them."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import pytest

MAGIC = b"\x89MCAP0\r\n"
PACKERS = {"lz4": ["lz4.frame"], "zstd": ["compression.zstd", "backports.zstd"]}  # Python's own, or what rosbags needs
NUMBERS = {"u1": 1, "i1": 2, "u2": 3, "i2": 4, "u4": 5, "i4": 6, "f4": 7, "f8": 8}


@dataclass(frozen=True)
class Layout:
    """Says how a file is written: messages in a chunk (0: outside of chunks), how these are packed, and what its summary has."""

    chunk: int = 2
    packing: str = ""
    summary: tuple[str, ...] = ("schemas", "channels", "statistics", "index")
    profile: str = ""


def record(kind: int, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return struct.pack("<BQ", kind, len(body)) + body


def text(words: str | bytes) -> bytes:
    data = words if isinstance(words, bytes) else words.encode()
    return struct.pack("<I", len(data)) + data


def mcap(
    channels: list[tuple[str, str, str, str, str]], messages: list[tuple[int, int, bytes]], layout: Layout = Layout()
) -> bytes:
    """The bytes of a file.

    channels: (topic, encoding, name of the type, form of its description, description). messages: (place of the channel, time
    of recording, bytes), in the order of the file.
    """
    schemas, lines = b"", b""
    for number, (topic, encoding, name, form, description) in enumerate(channels, 1):
        schemas += record(3, struct.pack("<H", number), text(name), text(form), text(description))
        lines += record(4, struct.pack("<HH", number, number), text(topic), text(encoding), text(""))
    parts = [
        (place + 1, time, record(5, struct.pack("<HIQQ", place + 1, 0, time, time), raw))
        for place, time, raw in messages
    ]
    data, index = MAGIC + record(1, text(layout.profile), text("")), b""
    data += b"" if layout.chunk else schemas + lines + b"".join(raw for *_, raw in parts)
    for k in range(0, len(parts), layout.chunk or len(parts) or 1):
        if not layout.chunk:
            break
        some = parts[k : k + layout.chunk]
        inner = (schemas + lines if k == 0 else b"") + b"".join(raw for *_, raw in some)
        times = min(time for _, time, _ in some), max(time for _, time, _ in some)
        packed = inner
        if layout.packing in PACKERS:
            packed = _packer(layout.packing).compress(inner)
        head = struct.pack("<QQQI", *times, len(inner), zlib.crc32(inner)) + text(layout.packing)
        chunk = record(6, head, struct.pack("<Q", len(packed)), packed)
        offsets = b"".join(struct.pack("<HQ", number, 0) for number in sorted({number for number, *_ in some}))
        sizes = struct.pack("<Q", 0) + text(layout.packing) + struct.pack("<QQ", len(packed), len(inner))
        index += record(8, struct.pack("<QQQQ", *times, len(data), len(chunk)), text(offsets), sizes)
        data += chunk
    data += record(15, bytes(4))
    counts = [sum(number == one for number, *_ in parts) for one in range(1, len(channels) + 1)]
    by_channel = b"".join(struct.pack("<HQ", number, count) for number, count in enumerate(counts, 1))
    head = struct.pack("<QHIIIIQQ", len(parts), len(channels), len(channels), 0, 0, 0, 0, 0)
    every = {"schemas": schemas, "channels": lines, "statistics": record(11, head, text(by_channel)), "index": index}
    every["uncounted"] = record(11, head, text(""))  # statistics that don't tell how many messages a channel has
    summary = b"".join(every[name] for name in layout.summary)
    start = len(data) if summary else 0
    return data + summary + record(2, struct.pack("<QQI", start, 0, 0)) + MAGIC


def _packer(name: str) -> Any:
    for module in PACKERS[name]:
        with suppress(ImportError):
            return import_module(module)
    return pytest.importorskip(PACKERS[name][-1])


def protobuf(*fields: tuple[int, Any]) -> bytes:
    """A message of (number, value): int as varint, np.uint32 as fixed32, float as double, bytes or text, floats packed."""
    out = b""
    for number, value in fields:
        if isinstance(value, np.uint32):
            out += _varint(number << 3 | 5) + struct.pack("<I", value)
        elif isinstance(value, float):
            out += _varint(number << 3 | 1) + struct.pack("<d", value)
        elif isinstance(value, int):
            out += _varint(number << 3) + _varint(value)
        else:
            data = struct.pack(f"<{len(value)}d", *value) if isinstance(value, list) else value
            data = data.encode() if isinstance(data, str) else data
            out += _varint(number << 3 | 2) + _varint(len(data)) + data
    return out


def _varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out, value = out + bytes([value & 127 | 128]), value >> 7
    return out + bytes([value])


def cloud(points: np.ndarray, stamp: int, encoding: str, pose: tuple[list[float], list[float]] | None = None) -> bytes:
    """Foxglove's PointCloud of a structured array. pose: (x, y, z) and the quaternion (x, y, z, w), or None."""
    kind = points.dtype
    fields = [(name, kind.fields[name][1], NUMBERS[kind[name].str[1:]]) for name in kind.names]
    if encoding == "json":
        said: dict[str, Any] = {"frame_id": "sensor", "point_stride": kind.itemsize}
        said["timestamp"] = {"sec": stamp // 10**9, "nsec": stamp % 10**9}
        said["fields"] = [{"name": name, "offset": offset, "type": number} for name, offset, number in fields]
        said["data"] = base64.b64encode(points.tobytes()).decode()
        if pose:
            said["pose"] = {"position": dict(zip("xyz", pose[0])), "orientation": dict(zip("xyzw", pose[1]))}
        return json.dumps(said).encode()
    described = [
        (5, protobuf((1, name), (2, np.uint32(offset)), (3, number), (99, 7.0))) for name, offset, number in fields
    ]
    moved = [(3, protobuf(*((k, protobuf(*enumerate(one, 1))) for k, one in enumerate(pose, 1))))] if pose else []
    return protobuf(
        (1, protobuf((1, stamp // 10**9), (2, stamp % 10**9))),
        (2, "sensor"),
        *moved,
        (4, np.uint32(kind.itemsize)),
        *described,
        (6, points.tobytes()),
    )
