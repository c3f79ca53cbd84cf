"""Files of a training run: each is whole or not there, and a disk that is full ends with a sentence."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dpcli.errors import NO_ROOM, DpcError


class DiskFull(DpcError):
    """A file could not be written for want of room."""


def disk_full(path: Path, error: BaseException | None) -> DiskFull | None:
    """What a failed write to `path` says when there was no room for it; None for any other error."""
    while error is not None:
        said = re.search(r"\(os error (\d+)\)", str(error))  # safetensors has the number in its text only
        number = int(said[1]) if said else getattr(error, "errno", None)
        if number in NO_ROOM:
            return DiskFull(f"{path}: {NO_ROOM[number]}; make room, then run the same command again")
        error = error.__context__  # torch.save hides it behind an error of its own
    return None


def reserve(file: int, size: int) -> None:
    """Take the room of an open file (descriptor, bytes) now: a mapped page that finds none later ends the process by SIGBUS, unheard."""
    if not hasattr(os, "posix_fallocate"):  # macOS, Windows
        return
    try:
        os.posix_fallocate(file, 0, size)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP):  # a file system that can't reserve
            raise


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """The file to write instead, beside `path` and renamed to it at the end of the block; removed when that fails."""
    part = path.with_name(f".{path.name}.part")
    try:
        yield part
        os.replace(part, path)
    except BaseException as error:
        part.unlink(missing_ok=True)
        full = disk_full(path, error)
        if full is None:
            raise
        raise full from None
