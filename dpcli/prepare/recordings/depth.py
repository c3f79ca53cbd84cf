"""Depth of a recording: the images of one topic, with the camera that its camera_info describes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.decode.calibration import Calibration
from dpcli.prepare.recordings.messages import CAMERA_KINDS, IMAGE_KINDS, calibration_of_message, depth_of_message
from dpcli.prepare.recordings.recording import Message, Recording, message_times, open_recording

_DEPTH_WORDS = ("depth", "range", "disparity")


def read_recorded_depth(
    path: Path, topic: str = "", stride: int = 1
) -> tuple[np.ndarray, np.ndarray | None, Calibration | None]:
    """Returns frames (T,H,W) as stored, seconds since the first f64 (T) or None, and the camera or None.

    topic: of the images, "" for the only one of depth. Raises DataError when there is none or it can't be read.
    """
    with open_recording(path) as recording:
        name = _depth_topic(recording, topic)
        frames, stamps = [], []
        for message in recording.messages(name, stride):
            frames.append(depth_of_message(path, message.kind, message.content))
            stamps.append((message.stamp, message.logged))
        if len({(frame.shape, frame.dtype) for frame in frames}) > 1:
            found = ", ".join(sorted({f"{f.shape[1]}x{f.shape[0]} {f.dtype}" for f in frames}))
            raise DataError(f"{path}: images of {name} differ in size or type: {found}; expected one kind")
        return np.stack(frames), message_times(stamps), _camera(recording, name)


def _depth_topic(recording: Recording, topic: str) -> str:
    """Returns the topic that was asked for, the only one of images, or the only one of these whose name says depth."""
    if not topic:
        images = [name for name, (kind, count) in recording.topics.items() if kind in IMAGE_KINDS and count]
        named = [name for name in images if any(word in name.lower() for word in _DEPTH_WORDS)]
        if len(images) > 1 and len(named) == 1:
            return named[0]
    return recording.choose(topic, IMAGE_KINDS, "images")


def _camera(recording: Recording, topic: str) -> Calibration | None:
    """Returns the camera of the camera_info that lies nearest above the topic, such as ``/camera/depth/camera_info``."""
    parts = topic.strip("/").split("/")
    infos = [name for name, (kind, count) in recording.topics.items() if kind in CAMERA_KINDS and count]
    above = [name for name in infos if parts[: name.strip("/").count("/")] == name.strip("/").split("/")[:-1]]
    if not above:
        return None
    nearest = max(above, key=lambda name: name.count("/"))
    message: Message = next(recording.messages(nearest))
    return calibration_of_message(recording.path, topic, message.content)
