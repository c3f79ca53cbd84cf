"""`-` for stdin and stdout. HDF5 needs random access, so a pipe is spooled to a temporary file and then read as usual."""

from __future__ import annotations

import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from dpcli.errors import DataError, DpcError, UsageError
from dpcli.regular_files import why_unreadable
from dpcli.runtime.whole_file import DiskFull, check_length, check_regular, check_writable, disk_full, refuse_pipe

_PAGES = (".html", ".htm", ".md", ".tex")
_PIECE = 1 << 20  # pieces of 1 MiB: a closed pipe is then noticed early


@contextmanager
def input_file(argument: str | Path, stdin: BinaryIO | None = None) -> Iterator[Path]:
    """Yields a readable path for `argument`: itself, or for `-` a temporary copy of stdin (a redirected file is used directly).

    Raises UsageError when stdin is a terminal, DataError when it is empty or the path doesn't exist.
    """
    if str(argument) != "-":
        path = Path(argument)
        if not path.exists():
            raise DataError(f"{path}: {why_unreadable(path) or 'no such file'}")
        refuse_pipe(path)
        yield path
        return
    stream = stdin or standard_input()
    if stream.isatty():
        raise UsageError(
            "- reads from a pipe, but stdin is a terminal; pipe a dpc command into this one or name a file"
        )
    direct = _regular_file(stream)
    if direct is not None:
        yield direct
        return
    with _spool() as folder:
        path = folder / "stdin.h5"
        with open(path, "wb") as spool:
            shutil.copyfileobj(stream, spool, _PIECE)
        if path.stat().st_size == 0:
            raise DataError("stdin: empty; the command before the pipe wrote nothing (see its message above)")
        with _named(path, "stdin"):
            yield path


@contextmanager
def _named(path: Path, name: str) -> Iterator[None]:
    """Lets errors of the block name a stream, not its copy at `path`, which is gone when somebody reads the message."""
    try:
        yield
    except DpcError as error:
        said = str(error).replace(f"dpc info {path}", "dpc info -").replace(str(path), name)
        raise type(error)(said) from error.__cause__


@contextmanager
def _spool() -> Iterator[Path]:
    """Yields a folder in $TMPDIR for what goes through a pipe. Raises DiskFull that names $TMPDIR where that is full."""
    advice = "what goes through a pipe is kept there first; set TMPDIR to a folder with more room"
    try:
        place = tempfile.gettempdir()
    except FileNotFoundError as error:  # not one place in which a file could be written
        raise DiskFull(f"TMPDIR: {str(error).partition('] ')[2] or error}; {advice}") from None
    try:
        with tempfile.TemporaryDirectory(prefix="dpc-") as folder:
            yield Path(folder)
    except (DiskFull, OSError) as error:
        full = disk_full(f"TMPDIR ({place})", error, advice, place)
        if full is None or not (isinstance(error, DiskFull) or str(error.filename or place).startswith(place)):
            raise
        raise full from None


def standard_input() -> BinaryIO:
    """Returns stdin; raises UsageError when it is closed."""
    if sys.stdin is None:
        raise UsageError("-: standard input is closed; pipe a command into this one or name a file")
    return sys.stdin.buffer


def check_output(path: Path, option: str, inputs: Iterable[str | Path]) -> None:
    """Raises UsageError, before anything is opened, where what is there must not be replaced, --force or not.

    That is an input under whatever name (links, `-` for a redirected file); what lies in an input folder (a model, raw data)
    and is no result of dpc's own; whatever is no regular file: renaming a file over a device would put an end to the device.
    Raises DataError where the place can't be written to, or the name is too long.
    """
    check_length(path, option)
    if path.is_dir() or not os.path.lexists(path):
        check_writable(path, option)
        return
    check_regular(path, option)
    for given in filter(None, map(str, inputs)):  # an empty word, or part of one, names nothing
        name = _regular_file(sys.stdin.buffer) if given == "-" and sys.stdin is not None else Path(given)
        if name is None or not (os.path.exists(name) and path.exists()):
            continue
        if os.path.samefile(name, path):
            raise UsageError(f"{option} {path}: is an input, too ({given}), and would be replaced; name another file")
        if option == "-o" and name.is_dir() and path.resolve().is_relative_to(name.resolve()) and not _is_result(path):
            raise UsageError(f"{option} {path}: belongs to the input {given}, and would be replaced; name another file")


def refuse_repeats(names: Iterable[str | Path]) -> None:
    """Raises UsageError where two of the names, inputs and the output, are of one file."""
    seen: set[Path | tuple[int, int]] = set()
    for name in names:
        path = Path(os.path.realpath(name))  # Path.resolve raises at a link in a circle, which opening names
        own: set[Path | tuple[int, int]] = {path}
        with suppress(OSError, ValueError):  # an output that isn't there yet
            facts = path.stat()
            own.add((facts.st_dev, facts.st_ino))
        if str(name) != "-" and own & seen:
            raise UsageError(f"{path}: is named twice; every file once, and the output is another one")
        seen |= own


def _is_result(path: Path) -> bool:
    """Returns whether a command of dpc's may have written the file as its -o."""
    from dpcli.store.file import file_kind  # h5py, which most checks of an output don't need

    try:
        return path.suffix.lower() in _PAGES or bool(file_kind(path))
    except DataError:
        return False


def _regular_file(stream: BinaryIO) -> Path | None:
    """Returns the path of a redirected regular file (`dpc ... - < a.h5`), else None."""
    try:
        number = stream.fileno()
        place = Path(os.readlink(f"/proc/self/fd/{number}"))
        found = os.fstat(number)
        if stat.S_ISREG(found.st_mode) and os.path.samestat(place.stat(), found) and stream.tell() == 0:
            return place  # but a file that was removed meanwhile, whose bytes the stream has all the same
    except (OSError, ValueError):
        pass
    return None


@contextmanager
def output_file(argument: str | Path, stdout: BinaryIO | None = None) -> Iterator[Path]:
    """Yields a path to write to: `argument` itself, or for `-` a temporary file copied to stdout when the block succeeds.

    Raises UsageError when stdout is a terminal: binary data would only garble it.
    """
    if str(argument) != "-":
        yield Path(argument)
        return
    if stdout is None and sys.__stdout__ is None:
        raise UsageError("-o -: standard output is closed; use -o FILE, or pipe into another dpc command")
    stream = stdout or sys.stdout.buffer
    if stream.isatty():
        raise UsageError("refusing to write HDF5 to a terminal; use -o FILE, or pipe into another dpc command")
    with _spool() as folder:
        path = folder / "stdout.h5"
        with _named(path, "stdout"):
            yield path
        with open(path, "rb") as spool:
            shutil.copyfileobj(spool, stream, _PIECE)
        stream.flush()
