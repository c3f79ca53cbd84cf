"""Reads MCAP files with messages of ROS 1, ROS 2 or Foxglove, whatever their index leaves out.

rosbags, which decodes the messages of ROS, opens only files of ROS 2 with a whole index. Foxglove's package ``mcap`` (1.6) loses
messages where chunks are missing from the index, reads unknown compression as none, and takes 3 times as long where many small
messages lie between clouds.
"""

from __future__ import annotations

import heapq
import os
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from dpcli.prepare.recordings.foxglove import FOXGLOVE_KINDS, read_json, read_protobuf
from dpcli.prepare.recordings.ros_types import Channel, RosMessages

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _CHUNK_INDEX, _STATISTICS = 2, 3, 4, 5, 6, 8, 11
_RECORD, _MESSAGE_HEAD, _CHUNK_HEAD = struct.Struct("<BQ"), struct.Struct("<HIQQ"), struct.Struct("<QQQI")
_ROS_SCHEMAS = ("ros1msg", "ros2msg", "ros2idl", "omgidl", "")


class McapReader:
    """Reads the MCAP files of one recording. topics: by name, with ``msgtype`` and ``msgcount``; connections: their channels.

    Whatever a damaged file makes struct, zlib and the decompression raise comes through; what is said here is a ValueError.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._files: list[_McapFile] = []
        self._names = [path.name if len(paths) > 1 else "" for path in paths]
        try:
            for path, name in zip(paths, self._names):
                with _named(name):
                    self._files.append(_McapFile(path))
        except BaseException:
            self.close()
            raise
        self.connections = list(dict.fromkeys(one for file in self._files for one in file.connections))
        self._ros = RosMessages(self.connections)
        self.topics: dict[str, SimpleNamespace] = {}
        for file in self._files:
            for one, count in file.connections.items():
                topic = self.topics.setdefault(one.topic, SimpleNamespace(msgtype=one.msgtype, msgcount=0))
                topic.msgtype = one.msgtype if topic.msgtype == one.msgtype else None
                topic.msgcount += count

    def close(self) -> None:
        """Closes the files."""
        for file in self._files:
            file.close()

    def messages(self, connections: Collection[Channel]) -> Iterator[tuple[Channel, int, bytes]]:
        """Yields the messages of channels, sorted by when they were recorded: the channel, that in nanoseconds, the bytes."""

        def of_file(file: _McapFile, name: str) -> Iterator[tuple[Channel, int, bytes]]:
            with _named(name):
                yield from file.messages(connections)

        return heapq.merge(*map(of_file, self._files, self._names), key=lambda message: message[1])

    def decode(self, channel: Channel, raw: bytes) -> Any:
        """Returns the content of a message, with its fields as attributes. Raises ValueError where it is damaged."""
        if channel.encoding in ("protobuf", "json"):
            return (read_protobuf if channel.encoding == "protobuf" else read_json)(raw, channel.msgtype)
        return self._ros.decode(channel, raw)


@contextmanager
def _named(file: str) -> Iterator[None]:
    """Puts the name of a file before what is raised about it; "" leaves it as it is."""
    try:
        yield
    except Exception as error:
        if not file or isinstance(error, MemoryError):
            raise
        raise ValueError(f"{file}: {error}") from None


class _McapFile:
    """Reads one open file. connections: its channels and how many messages they have."""

    def __init__(self, path: Path) -> None:
        self._schemas: dict[int, tuple[str, str, bytes]] = {0: ("", "", b"")}
        self._channels: dict[int, tuple[int, str, str]] = {}
        self._pieces: list[tuple[int, int, int, int]] = []  # (first time, place, kind, size) of chunks and messages
        self._channels_in: dict[int, set[int]] = {}  # by the places of chunks, where an index tells
        self._counts: Counter[int] = Counter()
        self._file = path.open("rb")
        self._size = self._file.seek(0, os.SEEK_END)
        try:
            self._survey()
        except BaseException:
            self.close()
            raise
        self.connections = {self._described(number): self._counts[number] for number in self._channels}

    def close(self) -> None:
        self._file.close()

    def messages(self, connections: Collection[Channel]) -> Iterator[tuple[Channel, int, bytes]]:
        wanted = {one.id: one for one in connections if one in self.connections}
        waiting: list[tuple[int, int, int, int, bytes]] = []
        for start, at, kind, size in [*sorted(self._pieces), (2**64, 0, 0, 0)]:
            while waiting and waiting[0][0] < start:
                logged, *_, number, raw = heapq.heappop(waiting)
                yield wanted[number], logged, raw
            if wanted.keys().isdisjoint(self._channels_in.get(at, wanted)):
                continue
            for place, (number, logged, raw) in enumerate(self._messages_of(at, kind, size)):
                if number in wanted:
                    heapq.heappush(waiting, (logged, at, place, number, bytes(raw)))

    def _survey(self) -> None:
        if self._read(0, len(_MAGIC)) != _MAGIC:
            raise ValueError("it doesn't begin as MCAP does")
        at, kind, told = len(_MAGIC), 0, None
        while kind != _FOOTER:
            kind, length = _RECORD.unpack(self._read(at, _RECORD.size))
            at += _RECORD.size
            if kind in (_SCHEMA, _CHANNEL):
                self._note(kind, self._read(at, length))
            elif kind == _CHUNK_INDEX:
                index = self._read(at, length)
                numbers = {number for number, _ in struct.iter_unpack("<HQ", _part(index, 32)[0])}
                if numbers:
                    self._channels_in[int.from_bytes(index[16:24], "little") + _RECORD.size] = numbers
            elif kind == _STATISTICS:
                statistics = self._read(at, length)
                counts = dict(struct.iter_unpack("<HQ", _part(statistics, 42)[0]))
                if sum(counts.values()) == int.from_bytes(statistics[:8], "little"):  # some leave them out
                    told = Counter(counts)
            elif kind == _MESSAGE:
                number, _, logged, _ = _MESSAGE_HEAD.unpack(self._read(at, _MESSAGE_HEAD.size))
                self._pieces.append((logged, at, kind, length))
                self._counts[number] += 1
            elif kind == _CHUNK:
                self._pieces.append((_CHUNK_HEAD.unpack(self._read(at, _CHUNK_HEAD.size))[0], at, kind, length))
            at += length
        self._read(at, len(_MAGIC))
        known = {number for number, (schema, _, _) in self._channels.items() if schema in self._schemas}
        if told is not None and set(told) <= known:
            self._counts = told
            return
        for _, at, kind, length in self._pieces:
            if kind == _CHUNK:
                self._counts.update(number for number, _, _ in self._messages_of(at, kind, length))

    def _read(self, at: int, size: int) -> bytes:
        if size > self._size - at:
            raise ValueError(f"it is cut off at byte {self._size}")
        self._file.seek(at)
        return self._file.read(size)

    def _note(self, kind: int, data: bytes) -> None:
        """Notes what the record of a schema or a channel says."""
        if kind == _SCHEMA:
            name, at = _text(data, 2)
            form, at = _text(data, at)
            self._schemas[int.from_bytes(data[:2], "little")] = name, form, _part(data, at)[0]
        elif kind == _CHANNEL:
            number, schema = struct.unpack_from("<HH", data)
            topic, at = _text(data, 4)
            self._channels[number] = schema, topic, _text(data, at)[0]

    def _described(self, number: int) -> Channel:
        schema, topic, encoding = self._channels[number]
        name, form, definition = self._schemas.get(schema, ("", "", b""))
        if name and encoding in ("ros1", "cdr") and form in _ROS_SCHEMAS:
            package, _, last = name.rpartition("/")
            name = f"{package.removesuffix('/msg')}/msg/{last}"
        elif encoding not in ("protobuf", "json") or name not in FOXGLOVE_KINDS:
            name = f"{name or 'of no type'} in {encoding or 'no encoding'}"
        return Channel(number, topic, name, encoding, form, definition)

    def _messages_of(self, at: int, kind: int, size: int) -> Iterator[tuple[int, int, memoryview]]:
        """Yields the messages of a chunk, or the one that lies outside of chunks: channel, time of recording, bytes. What a
        chunk says of schemas and channels is noted.
        """
        data = memoryview(self._read(at, size))
        for one, body in _records(memoryview(_unpacked(data))) if kind == _CHUNK else [(kind, data)]:
            if one == _MESSAGE:
                number, _, logged, _ = _MESSAGE_HEAD.unpack_from(body)
                yield number, logged, body[_MESSAGE_HEAD.size :]
            else:
                self._note(one, bytes(body))


def _records(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    at = 0
    while at < len(data):
        kind, size = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if size > len(data) - at:
            raise ValueError("a chunk ends inside of a record")
        yield kind, data[at : at + size]
        at += size


def _unpacked(chunk: memoryview) -> bytes | memoryview:
    """Returns the records of a chunk. Raises ValueError where it is packed by other means, or not what it was."""
    _, _, size, check = _CHUNK_HEAD.unpack_from(chunk)
    packing, at = _text(chunk, _CHUNK_HEAD.size)
    packed = chunk[at + 8 : at + 8 + int.from_bytes(chunk[at : at + 8], "little")]
    if packing == "lz4":
        packed = import_module("lz4.frame").decompress(packed)
    elif packing == "zstd":
        packed = _zstd().decompress(packed)
    elif packing:
        raise ValueError(f"its chunks are packed by {packing}")
    if len(packed) != size or (check and zlib.crc32(packed) != check):
        raise ValueError("a chunk is damaged")
    return packed


@cache
def _zstd() -> Any:
    """Returns a library that unpacks zstd: Python's own, or the one that comes with rosbags."""
    for name in ("compression.zstd", "backports.zstd"):
        try:
            return import_module(name)
        except ImportError:
            continue
    return import_module("zstandard").ZstdDecompressor()


def _part(data: bytes | memoryview, at: int) -> tuple[bytes, int]:
    """Returns the bytes behind their number at a place, and where they end."""
    (size,) = struct.unpack_from("<I", data, at)
    return bytes(data[at + 4 : at + 4 + size]), at + 4 + size


def _text(data: bytes | memoryview, at: int) -> tuple[str, int]:
    part, end = _part(data, at)
    return part.decode("utf-8", "replace"), end
