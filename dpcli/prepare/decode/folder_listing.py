"""Files of a folder, and links: one that leads out of the data is an error, because the file may not be what it seems."""

from __future__ import annotations

import errno
import os
import stat
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from dpcli.errors import DataError


def leads_out(path: Path, root: Path) -> str:
    """Returns where a link takes ``path`` outside ``root``, "" when it stays inside or is no link at all."""
    target = os.path.realpath(path)
    inside = os.path.realpath(root)
    return "" if target == inside or target.startswith(inside.rstrip(os.sep) + os.sep) else target


def folder_files(folder: Path, root: Path, suffix: str) -> Iterator[tuple[str, Path]]:
    """Yields (name, path) of the files in a folder that end in ``suffix``, in no order.

    Raises DataError at a link out of ``root``.
    """
    with os.scandir(folder) as entries:
        for entry in entries:
            if not entry.name.lower().endswith(suffix):
                continue
            if entry.is_symlink() and (target := leads_out(Path(entry.path), root)):
                raise DataError(f"{entry.path}: a link that leads out of the data, to {target}; copy the file here")
            yield entry.name, Path(entry.path)


def why_unreadable(path: Path) -> str:
    """Returns why a path must not be opened, "" where it may be: it is a file, a folder, or nothing that exists.

    Opening a FIFO waits for ever, and a device has no end; a link to nowhere is told from a name that is missing.
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
    return f"{kind}, expected a regular file" if kind else ""


_refusing = False  # whether this process is inside `regular_files_only`


@contextmanager
def regular_files_only() -> Iterator[None]:
    """Raises DataError in the block where something opens a FIFO, which would wait for ever; pipes of the shell are let be.

    So no reader and no library (NumPy, Pillow, zipfile) needs to ask first about the files that lie in a sample's folder.
    """
    global _refusing
    if _refuse_fifo not in _installed:
        sys.addaudithook(_refuse_fifo)
        _installed.add(_refuse_fifo)
    before, _refusing = _refusing, True
    try:
        yield
    finally:
        _refusing = before


def _refuse_fifo(event: str, arguments: tuple) -> None:
    if _refusing and event == "open" and isinstance(arguments[0], (str, bytes)):
        path = os.fsdecode(arguments[0])
        if not path.startswith(("/dev/", "/proc/")) and (reason := why_unreadable(Path(path))).startswith("a FIFO"):
            raise DataError(f"{path}: {reason}; it was not opened")


_installed: set[Callable[[str, tuple], None]] = set()  # audit hooks stay for good


def unreadable_entries(root: Path, taken: Collection[Path]) -> list[tuple[Path, str]]:
    """Returns (path, reason), sorted, of all that lies below a folder and can't be data: what `why_unreadable` refuses,
    folders that may not be entered, links to a folder above, and folders named like the files in ``taken``.

    taken: the paths that are listed as samples already; they are left to those who read them. Hidden names are passed over.
    """
    found: list[tuple[Path, str]] = []
    suffixes = {path.suffix.lower() for path in taken if path.suffix and path.is_file()}

    def closed(error: OSError) -> None:
        found.append((Path(error.filename), f"cannot be listed ({error.strerror})"))

    for place, folders, names in os.walk(root, onerror=closed):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for path in (Path(place, name) for name in folders):
            if path.is_symlink() and os.path.realpath(place).startswith(os.path.realpath(path)):
                found.append((path, "a link to a folder above it"))
            elif path.suffix.lower() in suffixes and not any(path == one or path in one.parents for one in taken):
                found.append((path, "a folder, though named like a file of data"))
        odd = ((Path(place, name), why_unreadable(Path(place, name))) for name in names if not name.startswith("."))
        found += [(path, reason) for path, reason in odd if reason]
    return sorted((path, reason) for path, reason in found if path not in taken)
