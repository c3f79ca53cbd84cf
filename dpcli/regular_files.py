"""Only regular files are opened: a FIFO would be waited for, forever."""

from __future__ import annotations

import errno
import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from dpcli.errors import DataError

_EXPECTED = ", expected a regular file"


def why_unreadable(path: str | Path) -> str:
    """Returns why a path must not be opened, "" where it may be: it is a file, a folder, or nothing that exists.

    Opening a FIFO waits forever, and a device has no end; a dangling link is distinguished from a missing name.
    """
    try:
        mode = os.stat(path).st_mode
    except OSError as error:
        if not os.path.islink(path):
            return ""
        return (
            "a link in a circle" if error.errno == errno.ELOOP else f"a link to {os.readlink(path)}, which is missing"
        )
    kinds = {stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device"}
    kind = kinds.get(stat.S_IFMT(mode), "")
    return f"{kind}{_EXPECTED}" if kind else ""


_refusing = False  # whether this process is inside `regular_files_only`


@contextmanager
def regular_files_only() -> Iterator[None]:
    """Raises DataError in the block where something opens a FIFO, which would wait forever, or a link to a device, which has
    no end; pipes of the shell are let be.

    So no reader and no library (NumPy, Pillow, zipfile) needs to ask first about the files that lie in a sample's folder.
    """
    global _refusing
    _install()
    before, _refusing = _refusing, True
    try:
        yield
    finally:
        _refusing = before


def _refuse_odd(event: str, arguments: tuple) -> None:
    if _refusing and event == "open" and isinstance(arguments[0], (str, bytes)):
        path = os.fsdecode(arguments[0])
        if not path.startswith(("/dev/", "/proc/")) and (reason := why_unreadable(path)).endswith(_EXPECTED):
            raise DataError(f"{path}: {reason}; it was not opened")


@cache  # once in a process: audit hooks stay for good
def _install() -> None:
    sys.addaudithook(_refuse_odd)
