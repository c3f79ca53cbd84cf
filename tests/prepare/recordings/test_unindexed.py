"""MCAP files whose summary leaves something out, as writers may be told to: what can't be found is said with what helps."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from dpcli.errors import DataError
from dpcli.prepare.recordings.messages import CLOUD_KINDS
from dpcli.prepare.recordings.recording import open_recording
from tests.support.recording_helpers import START

pytest.importorskip("rosbags")
_MAGIC = b"\x89MCAP0\r\n"


def _record(kind: int, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return bytes([kind]) + struct.pack("<Q", len(body)) + body


def _text(words: str) -> bytes:
    return struct.pack("<I", len(words)) + words.encode()


def _write(path: Path, repeated: str) -> None:
    """One message, not in a chunk; of what its summary should repeat, only the schema or the channel is there."""
    schema = _record(3, struct.pack("<H", 1), _text(CLOUD_KINDS[0]), _text("ros2msg"), _text("uint32 height\n"))
    channel = _record(4, struct.pack("<HH", 1, 1), _text("/points"), _text("cdr"), struct.pack("<I", 0))
    message = _record(5, struct.pack("<HIQQ", 1, 0, START, START), b"\0\1\0\0\1\0\0\0")
    data = _MAGIC + _record(1, _text("ros2"), _text("")) + schema + channel + message + _record(15, bytes(4))
    counts = struct.pack("<QHIIIIQQIHQ", 1, 1, 1, 0, 0, 0, START, START, 10, 1, 1)
    summary = {"schema": schema, "channel": channel}[repeated] + _record(11, counts)
    path.write_bytes(data + summary + _record(2, struct.pack("<QQI", len(data), 0, 0)) + _MAGIC)


@pytest.mark.parametrize(("repeated", "has"), [("schema", "no messages"), ("channel", "/points")])
def test_what_the_summary_leaves_out_is_said_with_what_helps(tmp_path, repeated, has):
    _write(tmp_path / "a.mcap", repeated)
    said = f"it has {has}.*; if its index is not whole, mcap recover makes it"
    with open_recording(tmp_path / "a.mcap") as recording, pytest.raises(DataError, match=said):
        recording.choose("", CLOUD_KINDS, "clouds")
