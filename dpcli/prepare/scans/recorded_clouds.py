"""Clouds of a recording of a robot: the messages of one topic are the frames of a sequence."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.path_names import as_utf8, first_names
from dpcli.prepare.cloud_formats.cloud import without
from dpcli.prepare.reader import Item, Sample
from dpcli.prepare.recordings.messages import CLOUD_KINDS, cloud_of_message
from dpcli.prepare.recordings.recording import find_recordings, open_recording, unread_recordings
from dpcli.prepare.recordings.topic_frames import read_topic
from dpcli.prepare.scans.assembling import OwnScans
from dpcli.prepare.scans.tracked_points import identify, with_track

_WANTED = "clouds (PointCloud2, CustomMsg of Livox, PointCloud of Foxglove)"
_LISTED = 8


@dataclass(frozen=True)
class RecordedClouds(OwnScans):
    """Reads the clouds of ``topic`` in a recording, or in those below a folder; the rest as `OwnScans` has it."""

    topic: str = ""

    @property
    def fields(self) -> tuple[str, ...]:
        """Returns the optional fields that every sample has: time, color when the very first cloud has it, what is kept."""
        return self.fields_beside(time=True, color=self._first[0])

    @cached_property
    def _names(self) -> dict[str, Path]:
        """Returns the recordings by the names of their sequences."""
        if not self.raw.exists():
            raise DataError(
                f"{self.raw}: no such file or folder; expected a recording (.bag, .mcap, .db3), or a folder of some"
            )
        found = find_recordings(self.raw)
        if not found:
            raise DataError(f"{self.raw}: no recording in it; expected .bag, .mcap, .db3, or folders of ROS 2 bags")
        return {as_utf8(p.relative_to(self.raw).as_posix() if p != self.raw else p.name): p for p in found}

    def _in_folders(self) -> tuple[list[str], str]:
        return list(self._names), "CLASS/RECORDING"

    @property
    def _read(self) -> tuple[str, ...]:
        return with_track(self.keep, self.track)

    @cached_property
    def _first(self) -> tuple[bool, tuple[str, ...]]:
        """Returns whether the first good cloud that saw something has colors, and which of its fields are not read."""
        for path in self._names.values():
            try:
                with open_recording(path) as recording:
                    topic = recording.choose(self.topic, CLOUD_KINDS, _WANTED)
                    clouds = recording.messages(topic, lambda one, path=path: cloud_of_message(path, one.content))
                    first = next((cloud for cloud in clouds if len(cloud.points)), None)
            except DataError:
                continue  # a bad sample: the next one tells
            if first is not None:
                return first.color is not None, without(first.unread, self._read)
        return False, ()

    def items(self) -> list[Item]:
        color, unread = self._first
        items = [Item(name, path, extra={"color": color, "unread": unread}) for name, path in self._names.items()]
        return self._table.apply(items)

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        with open_recording(item.path) as recording:
            topic = recording.choose(self.topic, CLOUD_KINDS, _WANTED)
            read = read_topic(
                recording, topic, self.stride, lambda message: cloud_of_message(item.path, message.content, self._read)
            )
        clouds = read.frames
        identify(item.path, clouds, self.track, self.keep)
        time = np.arange(len(clouds)) * self.stride / self.fps if self.fps else read.time
        if time is None:
            raise DataError(f"{item.path}: the times of {topic} don't rise; give its rate with --fps")
        return self._assembled(item, clouds, time, read.notes)

    def summary(self, items: list[Item]) -> list[str]:
        unread = f"; not read: {first_names(self._first[1], _LISTED)} (--keep-fields)" if self._first[1] else ""
        lines = [f"{counted(len(items), 'recording')} found{unread}"]
        if others := unread_recordings(self.raw):
            lines.append(
                f"left out, not .bag, .mcap or .db3: {first_names(others, _LISTED)}; unpack or finish them first"
            )
        return lines + self._table.unnamed(items)
