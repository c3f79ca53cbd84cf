"""Recordings of robots: which files are some, which topics they hold, and their messages one after the other."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import yaml

from dpcli.errors import DataError, DpcError, UsageError
from dpcli.path_names import first_names, path_inside
from dpcli.prepare.decode.folder_listing import walk_folders
from dpcli.prepare.reader import natural_key
from dpcli.prepare.recordings.bags import BagReader
from dpcli.prepare.recordings.foxglove import FOXGLOVE_KINDS, as_ros
from dpcli.prepare.recordings.mcap import McapReader
from dpcli.prepare.recordings.ros_types import Channel
from dpcli.prepare.series import is_beside, is_hidden
from dpcli.regular_files import why_unreadable

SUFFIXES = (".bag", ".mcap", ".db3")
_IN_FOLDERS = (*SUFFIXES, *(f"{suffix}.zstd" for suffix in SUFFIXES))
_UNREAD = re.compile(r"\.(bag|mcap|db3)\.(?!(bag|mcap|db3)$)\w+$", re.IGNORECASE)
_METADATA = "metadata.yaml"  # beside the files of a ROS 2 bag
_LISTED = 12
_REPAIR_TOOLS = {".bag": "rosbag reindex", ".mcap": "mcap recover"}  # for recordings that were cut off
Decoded = TypeVar("Decoded")


@dataclass(frozen=True)
class Message:
    """Holds one message with its type, such as ``sensor_msgs/msg/Image``, and when it was recorded, in nanoseconds."""

    content: Any
    kind: str
    logged: int

    @property
    def stamp(self) -> int | None:
        """Returns the nanoseconds that its header tells, None when it has none or they are 0."""
        stamp = getattr(getattr(self.content, "header", None), "stamp", None)
        return (stamp.sec * 10**9 + stamp.nanosec or None) if stamp is not None else None

    @property
    def place(self) -> str:
        """Returns the name of the coordinate frame that its header tells, "" when it has none."""
        return str(getattr(getattr(self.content, "header", None), "frame_id", "")).strip("/")


def is_recording(path: Path) -> bool:
    """Returns whether a path is a recording: a file of its kind, or the folder of a ROS 2 bag."""
    if path.is_dir():
        listed = os.path.isfile(path / _METADATA)  # unlike Path's, it says no of a folder that nobody may enter
        return listed and any(one.name.lower().endswith(_IN_FOLDERS) for one in path.iterdir())
    return path.suffix.lower() in SUFFIXES


def find_recordings(path: Path) -> list[Path]:
    """Returns the recordings at or below a path, in natural order; the files of a ROS 2 bag count as one."""
    if is_recording(path):
        return [path]
    found: list[Path] = []
    for folder, below, names in walk_folders(path):
        bags = [name for name in below if is_recording(Path(folder, name))]
        found += [Path(folder, name) for name in bags]
        below[:] = [name for name in below if name not in bags]
        files = (Path(folder, name) for name in names if name.lower().endswith(SUFFIXES) and not is_hidden(name))
        found += [file for file in files if is_recording(file)]
    return sorted(found, key=lambda one: natural_key(one.relative_to(path).as_posix()))


def holds_only_recordings(path: Path, others: tuple[str, ...]) -> bool:
    """Returns whether a path is a recording, or a folder with recordings and no file that ends in one of ``others``."""
    if is_recording(path):
        return True
    if not path.is_dir() or not find_recordings(path):
        return False
    names = (name.lower() for _, _, files in walk_folders(path) for name in files if not is_hidden(name))
    return not any(name.endswith(others) and not is_beside(name) for name in names)


def unread_recordings(path: Path) -> list[str]:
    """Returns the names of files below a path that are recordings by the middle of their names alone, sorted: those still
    being written, packed or kept by another program (``.bag.active``, ``.mcap.gz``), which nobody reads.
    """
    if is_recording(path):
        return []
    taken = [str(one) for one in find_recordings(path)]
    below = ((folder, name) for folder, _, names in walk_folders(path) for name in names if folder not in taken)
    return sorted(name for _, name in below if _UNREAD.search(name) and not is_hidden(name))


class Recording:
    """Reads one open recording; `open_recording` makes it. ``read``: how many messages the latest pass found. ``unlisted``:
    the files in the folder of a ROS 2 bag that its metadata.yaml doesn't name, so that they aren't read.
    """

    def __init__(
        self, path: Path, reader: McapReader | BagReader, topics: Mapping[str, tuple[str | None, int]]
    ) -> None:
        self.path, self._reader, self.read = path, reader, 0
        self.topics = {
            name: (kind or "several types", count) for name, (kind, count) in topics.items()
        }  # name -> (type, number of messages)
        self.unlisted = _unlisted(path) if path.is_dir() else []

    def choose(self, topic: str, kinds: tuple[str, ...], what: str) -> str:
        """Returns the topic that was asked for, or the only one of these kinds.

        what: what is looked for, in words. Raises DataError that lists the topics when it isn't there, or several are.
        """
        fitting = [name for name, (kind, count) in self.topics.items() if kind in kinds and count]
        if topic:
            wanted = [name for name in self.topics if name.strip("/") == topic.strip("/")]
            if wanted and self.topics[wanted[0]][0] not in kinds:
                raise DataError(
                    f"{self.path}: {topic} is of type {self.topics[wanted[0]][0]}; {self._list(fitting, what)}"
                )
            if wanted:
                return wanted[0]
            raise DataError(f"{self.path}: no topic {topic}; {self._list(fitting, what)}")
        if len(fitting) != 1:
            raise DataError(f"{self.path}: {self._list(fitting, what)}")
        return fitting[0]

    def _list(self, fitting: list[str], what: str) -> str:
        if fitting:
            return f"choose one that holds {what} with --topic: {first_names(fitting, _LISTED)}"
        told = [f"{name} ({kind}{'' if count else ', no messages'})" for name, (kind, count) in self.topics.items()]
        held = first_names(told, _LISTED)
        said = f"no topic holds {what}; it has {held or 'no messages'}"
        tool = _repair_tool(self.path)
        return f"{said}; if its index is not whole, {tool} makes it" if tool and not held else said

    def messages(self, topic: str, decode: Callable[[Message], Decoded], stride: int = 1) -> Iterator[Decoded]:
        """Yields what ``decode`` makes of every ``stride``-th message of a topic, in the order they were recorded.

        Raises DataError at damage, and where a message can't be decoded.
        """
        connections = [one for one in self._reader.connections if one.topic == topic]
        with _damage_named(self.path):
            raw_messages = self._reader.messages(connections=connections)
        self.read = 0
        while True:
            with _damage_named(self.path):
                found = next(raw_messages, None)
            if found is None:
                return
            connection, logged, raw = found
            taken = self.read % stride == 0
            self.read += 1
            if taken:
                with _damage_named(self.path, topic):
                    decoded = decode(Message(self._content(raw, connection), connection.msgtype, logged))
                yield decoded

    def _content(self, raw: bytes, connection: Channel) -> Any:
        content = self._reader.decode(connection, raw)
        return as_ros(content, connection.msgtype) if connection.msgtype in FOXGLOVE_KINDS else content


def _unlisted(folder: Path) -> list[str]:
    text = (folder / _METADATA).read_text("utf-8", "replace")
    names = sorted(one.name for one in folder.iterdir() if one.name.lower().endswith(_IN_FOLDERS))
    return [name for name in names if not re.search(rf"(?<![\w.-]){re.escape(name.removesuffix('.zstd'))}", text)]


def _packs_messages(folder: Path) -> bool:
    """Returns whether a folder is a ROS 2 bag in which every message is packed by itself, as only its metadata.yaml says."""
    text = (folder / _METADATA).read_text("utf-8", "replace") if is_recording(folder) else ""
    return re.search(r"compression_mode:\W*message", text, re.IGNORECASE) is not None


def _plain_mcap(folder: Path) -> list[Path]:
    """Returns the files of a ROS 2 bag where all are MCAP and no message in them is packed by itself, else none."""
    if not folder.is_dir() or _packs_messages(folder):
        return []
    unlisted = _unlisted(folder)
    listed = [one for one in folder.iterdir() if one.name.lower().endswith(_IN_FOLDERS) and one.name not in unlisted]
    return sorted(listed) if all(one.suffix == ".mcap" for one in listed) else []


def _repair_tool(path: Path) -> str | None:
    """Returns the program that repairs recordings of this kind, None where there is none."""
    kind = path.suffix.lower() if not path.is_dir() else ".mcap" if _plain_mcap(path) else ""
    return _REPAIR_TOOLS.get(kind)


def _declared(folder: Path) -> dict[str, tuple[str, int]]:
    """Returns the topics of a ROS 2 bag, name -> (type, number of messages), as its metadata.yaml has them.

    Raises ValueError where it is damaged, or a file that it lists isn't there.
    """
    try:
        told = yaml.safe_load((folder / _METADATA).read_bytes())["rosbag2_bagfile_information"]
        names = [Path(one).name for one in told["relative_file_paths"]]
        every = [(one["topic_metadata"], int(one["message_count"])) for one in told["topics_with_message_count"] or ()]
        topics = {str(topic["name"]): (str(topic["type"]), count) for topic, count in every}
    except Exception as error:
        raise ValueError(f"its {_METADATA} is damaged: {type(error).__name__} {error}") from None
    if lacking := [name for name in names if not (folder / name).exists()]:
        raise ValueError(f"its {_METADATA} lists files that are not there: {first_names(lacking, _LISTED)}")
    return topics


@contextmanager
def open_recording(path: Path) -> Iterator[Recording]:
    """Opens a recording. Raises DataError when it is damaged or of a kind that can't be read."""
    try:
        import_module("rosbags.typesys")  # here, where its lack is not taken for damage
    except ImportError:
        raise UsageError("recordings of robots need rosbags: pip install 'dpc-toolkit[recordings]'") from None
    if path.is_dir():  # metadata.yaml names files of the folder; they may be links
        for one in path.iterdir():
            path_inside(path, path, one.name)
            if reason := why_unreadable(one):
                raise DataError(f"{one}: {reason}; it was not opened")
    with _small_suffix(path) as called:
        with _damage_named(path):
            declared = {}
            if files := _plain_mcap(called) if called.is_dir() else [called] if called.suffix == ".mcap" else []:
                declared = _declared(called) if called.is_dir() else {}
            reader = McapReader(files) if files else BagReader(called)
            topics = {name: (info.msgtype, info.msgcount) for name, info in reader.topics.items()}
            for name, (kind, count) in declared.items():
                held = topics.get(name, (kind, 0))
                topics[name] = held[0], max(held[1], count)
        try:
            yield Recording(path, reader, topics)
        finally:
            reader.close()


@contextmanager
def _small_suffix(path: Path) -> Iterator[Path]:
    """Gives a file a name whose suffix is in small letters, as rosbags wants it: itself, or a link for as long."""
    if path.is_dir() or path.suffix == path.suffix.lower():
        yield path
        return
    with TemporaryDirectory() as folder:
        link = Path(folder, path.stem + path.suffix.lower())
        link.symlink_to(path.absolute())
        yield link


@contextmanager
def _damage_named(path: Path, topic: str = "") -> Iterator[None]:
    """Turns whatever a parser of recordings raises into a DataError: damaged files make it stumble over anything.

    topic: the one whose message is decoded, "" where none is yet.
    """
    try:
        yield
    except DataError as error:
        raise DataError(f"{error} (topic {topic})" if topic else str(error)) from None
    except DpcError:
        raise
    except MemoryError:  # of a long recording, or of a count in a damaged one
        raise DataError(
            f"{path}: too large for the memory there is, or damaged; free memory, or copy it again"
        ) from None
    except Exception as error:
        said = " ".join(str(error).split())[:200] or type(error).__name__
        tool = _repair_tool(path)
        hint = f"; if it was cut off or lacks its index, {tool} repairs it" if tool else ""
        expected = "expected a ROS 1 bag, a ROS 2 bag, or an MCAP file"
        if topic:
            expected, hint = "it is damaged, or the file describes its type wrongly", ""
        if not path.is_dir() and _packs_messages(path.parent):
            hint = f"; as the {_METADATA} beside it says, its messages are packed: name the folder {path.parent}"
        what = f"a message of {topic} can't be decoded" if topic else "not a readable recording"
        raise DataError(f"{path}: {what} ({said}); {expected}{hint}") from None
