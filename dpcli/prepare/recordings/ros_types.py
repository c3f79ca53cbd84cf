"""The channels of recordings and the types of ROS that their messages have, as each recording describes them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from dpcli.prepare.recordings.livox import LIVOX_KINDS, read_livox

_IDL = re.compile(r"^={80}\nIDL: .*$", re.MULTILINE)
_NAME = re.compile(r"\w+(?:/\w+)+")  # of a type


@dataclass(frozen=True)
class Channel:
    """Holds a channel: its number, topic, the type and encoding of its messages, and the form and text that describe these.

    The type is as in ROS 2 (``sensor_msgs/msg/Image``), or Foxglove's; behind others than those, their encoding is told.
    """

    id: int
    topic: str
    msgtype: str
    encoding: str
    form: str
    definition: bytes


class RosMessages:
    """Decodes the messages of ROS in a recording. channels: all that it has."""

    def __init__(self, channels: Sequence[Channel]) -> None:
        self._channels = tuple(channels)
        self._stores: dict[Channel, Any] = {}

    def decode(self, channel: Channel, raw: bytes) -> Any:
        """Returns the content of a message, with its fields as attributes. What a damaged one makes rosbags raise comes through."""
        ros1 = channel.encoding == "ros1"
        if channel.msgtype in LIVOX_KINDS:
            return read_livox(raw, ros1=ros1)
        if channel not in self._stores:
            self._stores[channel] = _typestore(channel, self._channels)
        store = self._stores[channel]
        return (store.deserialize_ros1 if ros1 else store.deserialize_cdr)(raw, channel.msgtype)


@lru_cache(maxsize=64)  # recordings of one robot describe their types alike, and to compile these takes longest
def _typestore(channel: Channel, others: tuple[Channel, ...]) -> Any:
    """Returns what knows the type of a channel of ROS as the file describes it, else as ROS does.

    others: channels whose descriptions may hold types that the channel's own one uses and lacks.
    """
    from rosbags.typesys import Stores, get_typestore

    if not channel.definition:
        return get_typestore(Stores.ROS1_NOETIC if channel.encoding == "ros1" else Stores.LATEST)
    store = get_typestore(Stores.EMPTY)  # it holds those that ROS itself defines
    own, types = _types(channel), {}
    named = set(_NAME.findall(repr(own)))
    for other in others if named - own.keys() - store.fielddefs.keys() else ():
        with suppress(Exception):  # what is wrong with a topic that nobody asked for
            found = _types(other) if other.encoding == channel.encoding and other.definition else {}
            types |= {name: one for name, one in found.items() if name not in store.fielddefs}
    store.register(types | own)
    return store


def _types(channel: Channel) -> dict[str, Any]:
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    text = channel.definition.decode("utf-8", "replace").replace("\r\n", "\n")  # as files of Windows end their lines
    if not channel.form.endswith("idl"):
        return get_types_from_msg(text, channel.msgtype)
    parts = _IDL.split(text)  # of one type each
    return {name: one for part in parts if part.strip() for name, one in get_types_from_idl(part).items()}
