"""Frames of one topic of a recording, in the order in which they were taken, and what of them is doubtful."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.prepare.recordings.recording import Message, Recording

_DELAY = 10**9  # ns by which the delay from taking to recording may vary where messages overtake each other
_APART = 100  # no recording is played that much faster; milli- and microseconds taken for nanoseconds are
LACKING = "messages that recordings declare and lack"
UNLISTED = "files in folders of ROS 2 bags left out, which their metadata.yaml doesn't list (ros2 bag reindex does)"
PACES = (
    "recordings whose headers' times, which count, pass a hundred times faster or slower than those of recording; if their"
    " unit is wrong, give --fps"
)
SORTED = "recordings whose frames were sorted by the times in their headers"
LOGGED = "recordings whose times are those of recording, since the times in their headers don't rise"
SEVERAL_PLACES = "recordings whose frames come from several sensors (frame_id), each around its own origin"
Frame = TypeVar("Frame")


@dataclass
class TopicFrames(Generic[Frame]):
    """Holds decoded frames in the order of their times: seconds since the first f64 (T), None where nothing tells them.

    notes: counts of what is missing or doubtful, as a Sample has them.
    """

    frames: list[Frame]
    time: np.ndarray | None
    notes: dict[str, int] = field(default_factory=dict)


def read_topic(recording: Recording, topic: str, stride: int, decode: Callable[[Message], Frame]) -> TopicFrames[Frame]:
    """Reads every ``stride``-th message of a topic. Raises DataError when none can be read."""
    frames: list[Frame] = []
    stamps: list[tuple[int | None, int]] = []
    places: set[str] = set()
    for frame, own, logged, place in recording.messages(
        topic, lambda one: (decode(one), one.stamp, one.logged, one.place), stride
    ):
        frames.append(frame)
        stamps.append((own, logged))
        places.add(place)
    declared = recording.topics[topic][1]
    if not frames:
        raise DataError(f"{recording.path}: {topic} declares {counted(declared, 'message')} and holds none")
    order, time, notes = message_times(stamps)
    notes |= {LACKING: max(declared - recording.read, 0), UNLISTED: len(recording.unlisted)}
    notes[SEVERAL_PLACES] = int(len(places) > 1)
    return TopicFrames([frames[place] for place in order], time, notes)


def message_times(stamps: Sequence[tuple[int | None, int]]) -> tuple[list[int], np.ndarray | None, dict[str, int]]:
    """Returns the order of messages, their seconds since the first f64 (T) or None, and notes.

    stamps: (nanoseconds in the header or None, nanoseconds of recording). Headers count where all have a time and these
    rise, or differ and only overtook each other on their way; else the times of recording, where they rise.
    """
    order = list(range(len(stamps)))
    own, logged = [own for own, _ in stamps], [logged for _, logged in stamps]
    known = [time for time in own if time is not None]
    if len(known) == len(own):
        if _rise(known):
            spans = known[-1] - known[0], max(logged) - min(logged)
            return order, _seconds(known), {PACES: 1} if max(spans) >= _APART * min(spans) > 0 else {}
        delays = [late - time for time, late in zip(known, logged)]
        if len(set(known)) == len(known) and max(delays) - min(delays) <= _DELAY:
            order.sort(key=lambda place: known[place])
            return order, _seconds(sorted(known)), {SORTED: 1}
    notes = {LOGGED: 1} if known else {}
    return (order, _seconds(logged), notes) if _rise(logged) else (order, None, {})


def _rise(times: Sequence[int]) -> bool:
    return all(a < b for a, b in zip(times, times[1:]))


def _seconds(times: Sequence[int]) -> np.ndarray:
    return np.array([time - times[0] for time in times], np.float64) * 1e-9
