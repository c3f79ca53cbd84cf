"""Frames as they arrive: `.npy` arrays one after another in a pipe or a growing file, or files dropped into a folder."""

from __future__ import annotations

import os
import stat
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.runtime.progress import log
from dpcli.store.pipes import standard_input

_POLL = 0.02  # seconds between looks at a file or folder that may grow
_SETTLED = 0.1  # seconds a folder's newest file must stay unchanged to count as whole
_PIECE = 1 << 20
_ROUNDED = 1e-8  # what remains of 0 where points were turned
_MOST_POINTS = 10_000_000  # in one frame: a damaged header must not ask for all memory
_MOST_NUMBERS = 64  # of a point
_BEGIN, _HDF5 = b"\x93NUMPY\x01\x00", b"\x89HDF"
_TELLING = 3  # bytes of such a beginning, by which coordinates don't end
_RECIPE = "expected frames written one after another by numpy.save(pipe, points)"


@dataclass(frozen=True)
class CloudFiles:
    """Says how to read the files of a folder: which suffixes, in which order, and the points (N,3+F) of one, with F columns of
    these names beside their places."""

    suffixes: tuple[str, ...]
    order: Callable[[Path], list]
    read: Callable[[Path, tuple[str, ...]], np.ndarray]


def open_frames(argument: str, follow: float, files: CloudFiles, columns: tuple[str, ...] = ()) -> Iterator[np.ndarray]:
    """Yields frames f32 (P,3+F) of `-` (stdin), a file or a folder, each as soon as it is whole.

    `columns`: what is read of a point beside its place, F names in order. `follow`: seconds to wait for more at the end of
    a file, a folder or a named pipe, whose writer may come back; stdin ends when its writer closes it. Raises UsageError or
    DataError at once for what can't be read, DataError from the iterator for a bad frame.
    """
    if argument == "-":
        stream = standard_input()
        if stream.isatty():
            raise UsageError("- reads frames from a pipe, but stdin is a terminal; pipe a program into this one")
        if follow:
            raise UsageError(
                "--follow is for files, folders and named pipes (mkfifo); this one ends when its writer closes it"
            )
        return read_arrays(stream.fileno(), "stdin", columns=columns)
    path = Path(argument)
    if not path.exists():
        raise DataError(f"{path}: no such file or folder")
    return _folder_frames(path, follow, files, columns) if path.is_dir() else _file_frames(path, follow, columns)


def _file_frames(path: Path, follow: float, columns: tuple[str, ...]) -> Iterator[np.ndarray]:
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0))
    try:
        yield from read_arrays(descriptor, str(path), follow, columns)
    finally:
        os.close(descriptor)


class _Bytes:
    """Reads a descriptor with the `read(count)` that numpy's header parser needs. Unbuffered: a buffer's lock would be held while
    waiting, and the interpreter can't end while another thread holds stdin's."""

    def __init__(self, descriptor: int, follow: float) -> None:
        self.descriptor, self.follow, self.ended, self.position = descriptor, follow, False, 0
        self._again, self._frame = b"", [b""]

    def begin_frame(self) -> int:
        """Returns at which byte the next frame begins."""
        self._frame = []
        return self.position

    def read(self, count: int) -> bytes:
        """Returns `count` bytes; fewer, with `ended` set, when no more came for `follow` seconds."""
        pieces, self._again = [self._again[:count]], self._again[count:]
        missing, last = count - len(pieces[0]), time.monotonic()
        while missing and not self.ended:
            piece = os.read(self.descriptor, min(missing, _PIECE))
            if piece:
                pieces.append(piece)
                missing -= len(piece)
                last = time.monotonic()
            elif time.monotonic() - last >= self.follow:
                self.ended = True
            elif not self._begins_anew():
                time.sleep(_POLL)
        self.position += count - missing
        self._frame.append(b"".join(pieces))
        return self._frame[-1]

    def _begins_anew(self) -> bool:
        """Goes to the start of a file that became shorter than what was read of it; returns whether it did."""
        facts = os.fstat(self.descriptor)
        if not stat.S_ISREG(facts.st_mode) or facts.st_size >= os.lseek(self.descriptor, 0, os.SEEK_CUR):
            return False
        log.warn("the file that is followed became shorter, as its writer began it anew; it is read from its start")
        os.lseek(self.descriptor, 0, os.SEEK_SET)
        return True

    def back_to_next(self, least: int) -> int:
        """Goes back to where another frame begins within this one, whose writer stopped in it and came back; returns how many of its
        bytes came before, 0 where none begins. least: bytes at the end that are taken for a beginning until more are read."""
        read = b"".join(self._frame)
        lacking = next((len(_BEGIN) - k for k in range(len(_BEGIN) - 1, least - 1, -1) if read.endswith(_BEGIN[:k])), 0)
        more = self.read(lacking)
        cut = max((read + more).find(_BEGIN, 1), 0)
        again = (read + more)[cut:] if cut else more
        if again:
            self._again, self.ended = again + self._again, False
            self.position -= len(again)
        return cut


def read_arrays(descriptor: int, name: str, follow: float = 0.0, columns: tuple[str, ...] = ()) -> Iterator[np.ndarray]:
    """Yields the arrays of a concatenation of `.npy` files as frames f32 (P,3+F), x, y, z and the F columns.

    Raises DataError, which names the frame and what is wrong.
    """
    source, number = _Bytes(descriptor, follow), 0
    while True:
        where, start = f"{name}: frame {number}", source.begin_frame()
        try:
            array = _next_array(source, name, number, columns)
            cut = source.back_to_next(_TELLING)
        except DataError:
            cut = source.back_to_next(1)
            if not cut:
                raise
        if cut:
            log.warn(
                f"{where}, byte {start}: cut off after {counted(cut, 'byte')}, then another frame begins; its writer stopped and came"
                " back? The cut one is left out"
            )
            continue
        if array is None:
            return
        yield as_frame(array, where)
        number += 1


def _next_array(source: _Bytes, name: str, number: int, columns: tuple[str, ...]) -> np.ndarray | None:
    """Returns the array (P,3+F) of frame `number`, None where the stream ends before it. Raises DataError for anything else."""
    where, start = f"{name}: frame {number}", source.position
    magic = source.read(8)
    if not magic:
        return None
    if magic[:4] == _HDF5:
        raise DataError(f"{name}: HDF5 can't be read as it arrives; leave out --stream, or send {_RECIPE[9:]}")
    if magic[:6] != _BEGIN[:6][: len(magic)]:
        raise DataError(f"{where}, byte {start}: not a .npy array but {magic!r}; {_RECIPE}")
    shape, fortran, dtype = _header(source, magic, where)
    if 0 in shape:  # as of an empty list, [] or [[]], whatever the number of columns
        shape = (0, 3 + len(columns))
    if columns and shape[1] != 3 + len(columns):
        raise DataError(
            f"{where}: {shape[1]} numbers a point; the model reads {3 + len(columns)}: x, y, z, {', '.join(columns)}, in this order"
        )
    if number == 0 and shape[1] > 3 + len(columns):
        log.info(f"{name}: arrays of {shape[1]} columns; the first 3 are read, as x, y, z")
        if shape[0] == 3:
            log.warn(f"{where}: 3 rows of {shape[1]} numbers; if the rows are x, y and z, send the array transposed")
    body = source.read(int(np.prod(shape)) * dtype.itemsize)
    _check_whole(source, where)
    return np.frombuffer(body, dtype).reshape(shape, order="F" if fortran else "C")[:, : 3 + len(columns)]


def _header(source: _Bytes, magic: bytes, where: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Returns shape, Fortran order and dtype of the array that follows, checked before any of it is read."""
    _check_whole(source, where)
    if magic != _BEGIN:  # later versions are for headers of more than 64 kB, which no plain array has
        raise DataError(f"{where}: .npy version {magic[6]}.{magic[7]}, expected 1.0; {_RECIPE}")
    try:
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(source)
    except Exception as error:  # of a damaged one nearly any
        _check_whole(source, where)
        raise DataError(f"{where}: damaged .npy header ({error}); {_RECIPE}") from None
    if dtype.kind in "uif" and 0 in shape:
        return shape, fortran, dtype
    if len(shape) != 2 or shape[1] < 3 or dtype.kind not in "uif":
        raise DataError(f"{where}: array of shape {shape}, {dtype}, not one frame's (points, 3); {_RECIPE}")
    if shape[0] == 3 and shape[1] > _MOST_NUMBERS:
        raise DataError(
            f"{where}: array of shape {shape}; expected a row for each point, (points, 3): send it transposed"
        )
    if not 0 <= shape[0] <= _MOST_POINTS or shape[1] > _MOST_NUMBERS:
        raise DataError(
            f"{where}: its header says {shape}; expected at most {_MOST_POINTS:,} points of {_MOST_NUMBERS} numbers (a damaged"
            " stream?)"
        )
    return shape, fortran, dtype


def _check_whole(source: _Bytes, where: str) -> None:
    if source.ended:
        raise DataError(f"{where}: truncated, the stream ends inside it after {source.position:,} bytes in all")


def as_frame(points: np.ndarray, where: str) -> np.ndarray:
    """Returns points as f32 (P,3+F) of their own. Raises DataError unless their places are finite; a column may lack a value."""
    with np.errstate(over="ignore"):
        frame = np.array(points, np.float32, order="C")
    bad = int((~np.isfinite(frame[:, :3])).any(1).sum())
    if bad:
        raise DataError(f"{where}: {bad} of {counted(len(frame), 'point')} NaN or infinite; drop them before sending")
    return frame


def without_padding(points: np.ndarray) -> np.ndarray:
    """Returns a frame (P,3+F) without its points at the origin where it has several, or nothing else.

    No two measurements are at one place: these fill an array up, or stand for a frame in which nothing was seen, and
    `dpc prepare` leaves them out as well.
    """
    at_origin = (np.abs(points[:, :3]) < _ROUNDED).all(1)
    return points[~at_origin] if at_origin.sum() > 1 or at_origin.all() else points


def _folder_frames(folder: Path, follow: float, files: CloudFiles, columns: tuple[str, ...]) -> Iterator[np.ndarray]:
    """Yields files in name order, the newest once it has settled; ends when none came for `follow` seconds.

    A look costs what is new, since a folder of a day of frames is looked at as often as one of a minute.
    """
    known: set[str] = set()  # names of files in the folder that were taken or left out
    last, since, late, gone = None, time.monotonic(), 0, 0
    while True:
        with os.scandir(folder) as entries:
            there = {entry.name for entry in entries}
        known &= there  # whoever records may remove what is old
        paths = [folder / name for name in there - known]
        paths = [path for path in paths if path.suffix.lower() in files.suffixes and not path.name.startswith(".")]
        keyed = sorted((files.order(path), path) for path in paths)
        fresh = [pair for pair in keyed if last is None or pair[0] > last]
        for _, path in keyed[: len(keyed) - len(fresh)]:
            late += 1
            known.add(path.name)
            _tell_lost(folder, late, f"{path.name} came after its successor by name and is left out; names must rise")
        for position, (key, path) in enumerate(fresh):
            try:
                if position == len(fresh) - 1 and not _settled(path, since + follow):
                    break
                frame = as_frame(files.read(path, columns), str(path))
            except (OSError, DataError):
                if path.exists():
                    raise
                gone += 1
                what = f"{path.name} was removed before it was read, so its frame is lost"
                _tell_lost(folder, gone, f"{what}; keep more files, or raise --hop where predictions take too long")
                continue
            yield frame
            known.add(path.name)
            last, since = key, time.monotonic()
        if not fresh and time.monotonic() - since >= follow:
            return
        time.sleep(_POLL)


def _tell_lost(folder: Path, count: int, what: str) -> None:
    """Warns of the first file that is lost, of the tenth, of the hundredth, and so on."""
    if str(count).strip("0") == "1":
        log.warn(f"{folder}: {what}" + (f" ({count} such files so far)" if count > 1 else ""))


def _settled(path: Path, deadline: float) -> bool:
    """Returns whether the file is not empty and stays as it is for a moment; after the deadline it is taken as it is."""
    before = path.stat()
    time.sleep(_SETTLED)
    after = path.stat()
    same = (before.st_size, before.st_mtime_ns) == (after.st_size, after.st_mtime_ns)
    return (same and after.st_size > 0) or time.monotonic() > deadline
