"""Large arrays from a worker process to its parent, through memory both see, instead of through a pipe.

A pipe takes 64 KiB at a time and copies twice. Here the worker copies the arrays once, into a memory file that it uses
again and again, and the parent's arrays are views of it; the first byte says whether the parent still has any.
"""

from __future__ import annotations

import mmap
import os
import pickle
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

_SMALL = 256 << 10  # bytes; below, a pipe is as fast
_HEAD = 64  # bytes: whether it is in use, and a mark that says which result it holds
_FREE, _USED = b"\0", b"\1"
_MOST = 8  # memory files of one worker; a parent that keeps more results than that gets copies
_SPARE = 2
POSSIBLE = hasattr(os, "memfd_create") and os.path.isdir("/proc/self/fd")


@dataclass(frozen=True)
class Parcel:
    """Holds a pickled result and where its arrays are: lengths in bytes, each on a multiple of _HEAD, in order."""

    path: str
    mark: bytes
    pickled: bytes
    lengths: tuple[int, ...]


class _MemoryFile:
    """Holds a memory file of this process and a view of it: copying into that takes a third of the time of writing to a file."""

    def __init__(self) -> None:
        self.number, self._view = os.memfd_create("dpc result"), None

    def view(self, size: int) -> mmap.mmap:
        """Returns a view of at least its first `size` bytes. OSError: no memory left."""
        if self._view is None or len(self._view) < size:
            size = -(-size // mmap.PAGESIZE) * mmap.PAGESIZE
            os.posix_fallocate(self.number, 0, size)  # or the first touch without memory would kill the process
            self._view = mmap.mmap(self.number, size)
        return self._view

    def in_use(self) -> bool:
        return self._view is not None and self._view[:1] == _USED

    def close(self) -> None:
        os.close(self.number)
        if self._view is not None:
            self._view.close()


class _MemoryFiles:
    """Holds the memory files of this process: taken for a result, free again when the parent says so."""

    def __init__(self) -> None:
        self._files: list[_MemoryFile] = []
        self._process = 0

    def take(self) -> _MemoryFile | None:
        """Returns a memory file that nobody reads, a new one where all are read; None when there are too many."""
        if self._process != os.getpid():  # after a fork they are another's
            self._files, self._process = [], os.getpid()
        free = [file for file in self._files if not file.in_use()]
        for file in free[_SPARE:]:
            file.close()
            self._files.remove(file)
        if free:
            return free[0]
        if len(self._files) >= _MOST:
            return None
        self._files.append(_MemoryFile())
        return self._files[-1]


_files = _MemoryFiles()


def packed(function: Callable[[Any], Any], item: Any) -> Any:
    """Returns `function(item)`, its large arrays in a Parcel. Runs in a worker process."""
    result = function(item)
    buffers: list[pickle.PickleBuffer] = []
    pickled = pickle.dumps(result, protocol=5, buffer_callback=buffers.append)
    arrays = [buffer.raw() for buffer in buffers]
    if sum(len(array) for array in arrays) < _SMALL:
        return result
    try:
        file = _files.take()
        if file is None:
            return result
        mark, at = os.urandom(_HEAD - 1), _HEAD
        view = file.view(_HEAD + sum(_aligned(len(array)) for array in arrays))
    except OSError:  # no memory left for it, too many open files
        return result
    whole = np.frombuffer(view, np.uint8)
    for array in arrays:
        whole[at : at + len(array)] = array
        at += _aligned(len(array))
    view[:_HEAD] = _USED + mark
    return Parcel(f"/proc/{os.getpid()}/fd/{file.number}", mark, pickled, tuple(len(array) for array in arrays))


def unpacked(parcel: Parcel) -> Any:
    """Returns the result in a Parcel; its arrays are views of the memory file. Raises OSError when that can't be opened."""
    number = os.open(parcel.path, os.O_RDWR | os.O_CLOEXEC)
    try:
        # all of it will be read: its pages are found once, instead of one fault after the other
        memory = mmap.mmap(number, 0, flags=mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0))
    except ValueError:
        raise OSError(f"{parcel.path}: is empty") from None
    finally:
        os.close(number)
    if memory[1:_HEAD] != parcel.mark:
        raise OSError(f"{parcel.path}: holds another result")
    whole = np.frombuffer(memory, np.uint8)
    weakref.finalize(whole, _release, memory).atexit = False
    views, at = [], _HEAD
    for length in parcel.lengths:
        views.append(whole[at : at + length])
        at += _aligned(length)
    return pickle.loads(parcel.pickled, buffers=views)


def _release(memory: mmap.mmap) -> None:
    memory[:1] = _FREE


def _aligned(length: int) -> int:
    return -(-length // _HEAD) * _HEAD
