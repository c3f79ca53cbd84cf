"""`-` for stdin and stdout. HDF5 needs random access, so a pipe is spooled to a temporary file and then read as usual."""

from __future__ import annotations

import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from typing import BinaryIO

from dpcli.errors import DataError, UsageError

PICTURES = (".png", ".jpg", ".jpeg")
FIGURES = (*PICTURES, ".pdf", ".svg")
_PIECE = 1 << 20  # pieces of 1 MiB: a closed pipe is then noticed early


@contextmanager
def input_file(argument: str | Path, stdin: BinaryIO | None = None) -> Iterator[Path]:
    """A readable path for `argument`: itself, or for `-` a temporary copy of stdin (a redirected file is used directly).

    Raises UsageError when stdin is a terminal, DataError when it is empty or the path doesn't exist.
    """
    if str(argument) != "-":
        path = Path(argument)
        if not path.exists():
            raise DataError(f"{path}: no such file")
        yield path
        return
    stream = stdin or sys.stdin.buffer
    if stream.isatty():
        raise UsageError(
            "- reads from a pipe, but stdin is a terminal; pipe a dpc command into this one or name a file"
        )
    direct = _regular_file(stream)
    if direct is not None:
        yield direct
        return
    with tempfile.TemporaryDirectory(prefix="dpc-") as folder:
        path = Path(folder) / "stdin.h5"
        with open(path, "wb") as spool:
            shutil.copyfileobj(stream, spool, _PIECE)
        if path.stat().st_size == 0:
            raise DataError("stdin: empty; the command before the pipe wrote nothing (see its message above)")
        yield path


def check_target(path: Path, option: str, kinds: Sequence[str]) -> None:
    """Say before the work that no file of one of these kinds (`.png` ...) can be written there: UsageError, DataError."""
    if path.suffix.lower() not in kinds:
        raise UsageError(f"{option} {path}: unknown kind {path.suffix!r}; expected {', '.join(kinds)}")
    if not path.absolute().parent.is_dir():
        raise DataError(f"{option} {path}: the folder {path.parent} does not exist; create it first")
    if path.is_dir():
        raise DataError(f"{option} {path}: is a folder; name a file in it")


def check_replaced(folder: Path, own: Sequence[str]) -> None:
    """Before --force replaces a folder whole: UsageError where it holds what no name pattern of the command's own covers."""
    if folder.is_dir():
        others = [one.name for one in folder.iterdir() if one.is_dir() or not any(fnmatch(one.name, name) for name in own)]
        if others:
            raise UsageError(f"{folder}: holds other things, too, such as {min(others)}; name another folder, or empty it yourself")


def _regular_file(stream: BinaryIO) -> Path | None:
    """The path of a redirected regular file (`dpc ... - < a.h5`), else None."""
    try:
        number = stream.fileno()
        if stat.S_ISREG(os.fstat(number).st_mode) and stream.tell() == 0 and os.path.exists(f"/proc/self/fd/{number}"):
            return Path(os.readlink(f"/proc/self/fd/{number}"))
    except (OSError, ValueError):
        pass
    return None


@contextmanager
def output_file(argument: str | Path, stdout: BinaryIO | None = None) -> Iterator[Path]:
    """A path to write to: `argument` itself, or for `-` a temporary file copied to stdout when the block succeeds.

    Raises UsageError when stdout is a terminal: binary data would only garble it.
    """
    if str(argument) != "-":
        yield Path(argument)
        return
    stream = stdout or sys.stdout.buffer
    if stream.isatty():
        raise UsageError("refusing to write HDF5 to a terminal; use -o FILE, or pipe into another dpc command")
    with tempfile.TemporaryDirectory(prefix="dpc-") as folder:
        path = Path(folder) / "stdout.h5"
        yield path
        with open(path, "rb") as spool:
            shutil.copyfileobj(spool, stream, _PIECE)
        stream.flush()
