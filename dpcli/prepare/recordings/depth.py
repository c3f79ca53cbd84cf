"""Depth of a recording: the images of one topic, with the camera that its camera_info describes."""

from __future__ import annotations

import re
from pathlib import Path

from dpcli.errors import DataError
from dpcli.prepare.decode.pinhole_camera import Calibration
from dpcli.prepare.recordings.messages import CAMERA_KINDS, IMAGE_KINDS, calibration_of_message, depth_of_message
from dpcli.prepare.recordings.recording import Recording, open_recording
from dpcli.prepare.recordings.topic_frames import TopicFrames, read_topic

_SAYS_DEPTH = re.compile(r"depth|range|(?<![a-z])(tof|z16)(?![a-z])", re.IGNORECASE)
_OTHER_IMAGES = re.compile(
    r"colou?r|rgb|infra|mask|conf|amplitude|intensity|(?<![a-z])(ir|mono|gray|grey)(?![a-z])", re.IGNORECASE
)
_UNITS = "/option/Depth_Units/value"  # behind a sensor's name, as the SDK of RealSense writes it: meters per raw unit
CHANGES = "recordings whose camera_info changes on the way, of which the first counts"
_DISPARITY = re.compile("disp(arity|_?map)?(?![a-z])", re.IGNORECASE)


def read_recorded_depth(
    path: Path, topic: str = "", stride: int = 1, *, with_camera: bool = True
) -> tuple[TopicFrames, Calibration | None, float | None]:
    """Returns the frames, each (H,W) as stored and all alike, the camera or None, and raw units per meter or None.

    topic: of the images, "" for the only one of depth. with_camera: whether the camera is asked for, which may be of a kind
    that is refused. Raises DataError when there is none or it can't be read.
    """
    with open_recording(path) as recording:
        name = _depth_topic(recording, topic)
        if _DISPARITY.search(name) and not _SAYS_DEPTH.search(name):
            raise DataError(
                f"{path}: {name} holds disparities, not depth; depth is focal length x baseline / disparity"
            )
        read = read_topic(recording, name, stride, lambda one: depth_of_message(path, one.kind, one.content))
        if len({(frame.shape, frame.dtype) for frame in read.frames}) > 1:
            found = ", ".join(sorted({f"{f.shape[1]}x{f.shape[0]} {f.dtype}" for f in read.frames}))
            raise DataError(f"{path}: images of {name} differ in size or type: {found}; expected one kind")
        if read.frames[0].itemsize == 1 and not topic and not _SAYS_DEPTH.search(name):
            raise DataError(f"{path}: {name} holds 8-bit images, hardly depth; if they are, name it with --topic")
        cameras = _cameras(recording, name) if with_camera else []
        read.notes[CHANGES] = int(any(one != cameras[0] for one in cameras))
        return read, cameras[0] if cameras else None, _raw_units(recording, name)


def _depth_topic(recording: Recording, topic: str) -> str:
    """Returns the topic that was asked for, or the only one of images that may be depth: by its name, or none is better.

    A topic that repeats another one in compressed form is passed over.
    """
    images = [name for name, (kind, count) in recording.topics.items() if kind in IMAGE_KINDS and count]
    images = [name for name in images if name.rpartition("/")[0] not in images]
    named = [name for name in images if _SAYS_DEPTH.search(name)]
    possible = named or [name for name in images if not _OTHER_IMAGES.search(name)]
    if not topic and len(possible) == 1:
        return possible[0]
    if not topic and images and not possible:
        raise DataError(
            f"{recording.path}: by their names, no topic holds depth: {', '.join(images)}; if one does, name it with --topic"
        )
    return recording.choose(topic, IMAGE_KINDS, "images")


def _cameras(recording: Recording, topic: str) -> list[Calibration]:
    """Returns the cameras of the camera_info that lies nearest above the topic, such as ``/camera/depth/camera_info``; of
    several there the one whose name says depth. Drivers that aren't ready say zeros, which are passed over.
    """
    parts = _folder(topic, "")
    infos = [name for name, (kind, count) in recording.topics.items() if kind in CAMERA_KINDS and count]
    depth = {name: len(_folder(name)) for name in infos if parts[: len(_folder(name))] == _folder(name)}
    nearest = [name for name in depth if depth[name] == max(depth.values())]
    if len(nearest) > 1:
        nearest = [name for name in nearest if _SAYS_DEPTH.search(name.rpartition("/")[2])]
    if len(nearest) != 1:
        return []
    lens = _lens(recording, nearest[0])
    found = recording.messages(nearest[0], lambda one: calibration_of_message(recording.path, topic, one.content, lens))
    return [camera for camera in found if camera]


def _lens(recording: Recording, info: str) -> str:
    """Returns the model of the lens from the text that the SDK of RealSense writes above a camera_info, in which every model is
    called plumb_bob; "" where there is none.
    """
    above = "/" + "/".join([*_folder(info)[:-1], "camera_info"])
    if recording.topics.get(above, ("", 0))[0] != "std_msgs/msg/String":
        return ""
    said = next(recording.messages(above, lambda one: str(one.content.data)), "")
    return next(iter(re.findall(r"model=([^;]+)", said)), "")


def _folder(topic: str, info: str = "info") -> list[str]:
    """Returns the names above a topic's own, without the last where that is ``info``, in which RealSense puts its camera."""
    *above, _ = topic.strip("/").split("/")
    return above[:-1] if info and above[-1:] == [info] else above


def _raw_units(recording: Recording, topic: str) -> float | None:
    """Returns the raw units per meter that the topic's sensor is set to; None where nothing says it.

    Raises DataError where they change on the way.
    """
    all_units = [name for name in recording.topics if name.endswith(_UNITS)]
    own = [name for name in all_units if topic.startswith(f"{name.removesuffix(_UNITS)}/")]
    told = {unit for name in own for unit in recording.messages(name, lambda one: float(one.content.data))}
    if len(told) > 1:
        raise DataError(
            f"{recording.path}: {own[0]} changes on the way ({', '.join(f'{value:g}' for value in sorted(told))}); expected"
            " one unit of depth in a recording"
        )
    return next((float(f"{1 / value:.6g}") for value in told if value > 0), None)
