"""Reads ROS 1 and ROS 2 bags through rosbags, whatever their topics that nobody asks for hold."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from dpcli.prepare.recordings.ros_types import Channel, RosMessages


class BagReader:
    """Reads a bag; what it has is as in `mcap.McapReader`. What a damaged file makes rosbags raise comes through.

    The AnyReader of rosbags refuses a bag where it doesn't understand the type of any topic.
    """

    def __init__(self, path: Path) -> None:
        from rosbags import rosbag1, rosbag2
        from rosbags.interfaces import MessageDefinitionFormat

        ros1 = path.is_file() and path.suffix == ".bag"  # a folder of ROS 2 may be called so, too
        self._bag: Any = (rosbag1 if ros1 else rosbag2).Reader(path)
        self._bag.open()
        self._connections = {one.id: one for one in self._bag.connections}
        self._channels = {
            one.id: Channel(
                one.id,
                one.topic,
                one.msgtype,
                "ros1" if ros1 else "cdr",
                "ros2idl" if one.msgdef.format == MessageDefinitionFormat.IDL else "ros2msg",
                one.msgdef.data.encode(),
            )
            for one in self._bag.connections
        }
        self.connections = list(self._channels.values())
        self.topics: dict[str, Any] = dict(self._bag.topics)
        self.decode = RosMessages(self.connections).decode

    def close(self) -> None:
        """Closes the files."""
        self._bag.close()

    def messages(self, connections: Collection[Channel]) -> Iterator[tuple[Channel, int, bytes]]:
        """Yields the messages of channels, sorted by when they were recorded: the channel, that in nanoseconds, the bytes."""
        wanted = [self._connections[one.id] for one in connections]
        for connection, logged, raw in self._bag.messages(connections=wanted) if wanted else ():
            yield self._channels[connection.id], logged, raw
