"""Writing a file whole or not at all: whether its name may be written, the file beside it, and what a full disk says."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from fnmatch import fnmatch
from pathlib import Path

from dpcli.errors import DataError, DpcError, UsageError
from dpcli.path_names import as_utf8, first_names
from dpcli.regular_files import why_unreadable
from dpcli.runtime.progress import log

PICTURES = (".png", ".jpg", ".jpeg")
FIGURES = (*PICTURES, ".pdf", ".svg")
_NO_ROOM = {
    errno.ENOSPC: "no space left on the device",
    errno.EFBIG: "the file size limit is reached",
    errno.EDQUOT: "the disk quota is used up",
}  # why a write fails for want of room, by the system's number
_IN_TEXT = re.compile(r"os error (\d+)|errno = (\d+)", re.IGNORECASE)  # safetensors and HDF5 say it in words only


class DiskFull(DpcError):
    """Says that a file could not be written because the disk is full."""


def disk_full(
    path: str | Path,
    error: BaseException | None,
    advice: str = "make room, then run the same command again",
    place: str | Path | None = "",
    needed: int = 0,
) -> DiskFull | None:
    """Returns the error that a failed write to `path` ends with when the disk was full, None for any other failure.

    `error` is what the write raised; what it was raised from is looked at, too. `advice` ends the sentence. `place` lies on
    the disk that is full where `path` itself is no path; None: unknown. `needed`: bytes to be written, 0: unknown.
    """
    while error is not None:
        told = _IN_TEXT.search(str(error))
        number = int(told[1] or told[2]) if told else getattr(error, "errno", None)
        if number in _NO_ROOM:
            room = _room(path if place == "" else place, needed) if number == errno.ENOSPC else ""
            return DiskFull(f"{path}: {_NO_ROOM[number]}{room}; {advice}")
        error = error.__context__  # torch.save hides it behind an error of its own
    return None


def _room(place: str | Path | None, needed: int) -> str:
    """Returns how much is needed and how much is free now on the disk of a place, in words; "" where both are unknown."""
    from rich.filesize import decimal

    parts = [f"about {decimal(needed)} needed"] if needed else []
    named = isinstance(place, (str, Path)) and place  # the system names a file by its number, too
    above = [Path(place).absolute(), *Path(place).absolute().parents] if named else []
    with suppress(OSError):
        if folder := next((one for one in above if one.is_dir()), None):
            disk = shutil.disk_usage(folder)
            parts.append(f"{decimal(disk.free)} of {decimal(disk.total)} free in {folder}")
    return f" ({', '.join(parts)})" if parts else ""


def reserve(file: int, size: int) -> None:
    """Reserves `size` bytes on the disk for an open file (its descriptor) now.

    A mapped page that finds no room later ends the process by SIGBUS, without a word. OSError: there is no room.
    """
    if not hasattr(os, "posix_fallocate"):  # macOS, Windows
        return
    try:
        os.posix_fallocate(file, 0, size)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP):  # a file system that can't reserve
            raise


def put_in_place(part: Path, path: Path) -> None:
    """Brings `part`, a finished file or folder, to the disk and renames it to `path`, which it replaces. OSError: it can't.

    A link to a file is replaced, too, with a warning: what it leads to may be in the keeping of another program.
    """
    if not part.is_dir():
        _sync(part)
        if path.is_symlink():
            log.warn(f"{path}: was a link and is a file now; {os.path.realpath(path)}, where it led to, is as it was")
        os.replace(part, path)
        return
    for one in part.rglob("*"):
        if one.is_file():
            _sync(one)
    old = path.with_name(f".{path.name}.{os.getpid()}.old{path.suffix}")
    _remove(old)
    if path.is_dir():  # no folder can be renamed over one that holds files, and a kill must not leave one half removed
        os.replace(path, old)
    try:
        os.replace(part, path)
    except OSError:
        if old.exists():
            os.replace(old, path)
        raise
    _remove(old)


def _sync(path: Path) -> None:
    with open(path, "rb") as whole:
        os.fsync(whole.fileno())


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yields the name to write to instead of `path`: beside it, hidden, with its suffix; renamed to it when the block ends.

    The block may make a folder of that name; in the place of a link to a folder it takes that folder's. When it fails, nothing
    of it stays, and what was under `path` does. The name is this process's own: of several that write `path` at the same
    time, the last one wins. Raises DiskFull where the disk is full.
    """
    if path.is_dir():
        path = Path(os.path.realpath(path))
    part = path.with_name(_unfinished(path))
    check_regular(path)
    _remove(part)
    _remove_killed(path)
    try:
        yield part
        put_in_place(part, path)
    except BaseException as error:
        full = disk_full(path, error)
        _remove(part)
        if full is None:
            raise
        raise full from None


def _unfinished(path: Path) -> str:
    return f".{path.name}.{os.getpid()}.part{path.suffix}"


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file through `whole_file`. Raises DataError when it can't be written, DiskFull where the disk is full."""
    try:
        with whole_file(path) as part:
            part.write_bytes(content)
    except OSError as error:
        raise not_writable(path, error) from None


def _remove_killed(path: Path) -> None:
    """Removes what killed processes of this machine left of a file or folder that they were writing.

    There is nothing of them in a folder that this process is writing itself: its files, which may be many, aren't looked through.
    """
    if path.parent.name.startswith(".") and f".{os.getpid()}.part" in path.parent.name:
        return
    name = re.compile(rf"\.{re.escape(path.name)}\.(\d+)\.(part|old){re.escape(path.suffix)}")
    with suppress(OSError), os.scandir(path.absolute().parent) as beside:
        for one in beside:
            found = name.fullmatch(one.name)
            if found and not _is_running(int(found[1])):
                _remove(Path(one.path))


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # another user's, or no number of a process
        return True
    return True


def not_writable(path: Path, error: OSError) -> DataError:
    """Returns the error that tells why no file can be made under a name, for a reason other than a full disk."""
    if error.errno == errno.ENOENT and not path.absolute().parent.is_dir():
        return DataError(f"{path}: the folder {path.parent} does not exist; create it first")
    why = os.strerror(error.errno) if error.errno else str(error).partition("\n")[0]  # HDF5's own words are long
    advice = "give it a shorter name" if error.errno == errno.ENAMETOOLONG else "name a file in an existing folder"
    return DataError(f"{path}: cannot be written ({why}); {advice}")


def _remove(part: Path) -> None:
    if part.is_dir() and not part.is_symlink():
        shutil.rmtree(part, ignore_errors=True)
    elif part.exists():
        part.unlink(missing_ok=True)


def check_target(path: Path, option: str, kinds: Sequence[str]) -> None:
    """Raises, before the work, where no file of one of these kinds (`.png` ...) can be written: UsageError, DataError."""
    if path.suffix.lower() not in kinds:
        raise UsageError(f"{option} {path}: unknown kind {path.suffix!r}; expected {', '.join(kinds)}")
    if not path.absolute().parent.is_dir():
        raise DataError(f"{option} {path}: the folder {path.parent} does not exist; create it first")
    if path.is_dir():
        raise DataError(f"{option} {path}: is a folder; name a file in it")


def refuse_existing(path: str | Path, force: bool) -> None:
    """Raises, for an output that is one file, DataError where a folder is, UsageError where a file is and `force` is off."""
    if Path(path).is_dir():
        raise DataError(f"{path}: is a folder; name a file in it")
    refuse_replacing(path, force)


def refuse_replacing(path: str | Path, force: bool) -> None:
    """Raises UsageError where an output, a file or a folder, exists and `force` is off."""
    if Path(path).exists() and not force:
        raise UsageError(f"{path}: exists already; --force replaces it")


def check_writable(path: Path, option: str = "-o") -> None:
    """Raises DataError where nothing can be made or replaced in the folder that is to hold `path`, or in the folder that it is."""
    folder = next((one for one in (path, *path.absolute().parents) if one.is_dir()), Path("/"))
    if not os.access(folder, os.W_OK | os.X_OK):
        read_only = hasattr(os, "statvfs") and os.statvfs(folder).f_flag & os.ST_RDONLY
        why = "the file system is read-only" if read_only else "no permission"
        raise DataError(f"{option} {path}: the folder {folder} can't be written to ({why}); name another place")


def check_length(path: Path, option: str = "-o") -> None:
    """Raises DataError where the file system takes no name as long as that of an output, or of the unfinished file beside it."""
    folder = next((one for one in path.absolute().parents if one.is_dir()), Path("/"))
    most = os.pathconf(folder, "PC_NAME_MAX") if hasattr(os, "pathconf") else 255
    unfinished = f".{path.name}.part.new" if path.suffix.lower() == ".h5" else _unfinished(path)
    longest = len(os.fsencode(unfinished if path.suffix else path.name))
    if longest > most:
        length = len(os.fsencode(path.name))
        raise DataError(
            f"{option} {path}: the name is too long ({length} bytes); expected {most - longest + length} at most"
        )


def make_folder(folder: Path, option: str = "-o") -> None:
    """Makes a folder and those above it; nothing where it exists. Raises DataError, or DiskFull, where it can't be made."""
    if str(folder) == "-":
        check_regular(folder, option)
    refuse_broken_link(folder, option)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if full := disk_full(str(folder), error):
            raise full from None
        raise DataError(
            f"{option} {folder}: the folder cannot be made ({error.strerror}); name another place"
        ) from None


def refuse_broken_link(output: Path, option: str = "-o") -> None:
    """Raises DataError where an output, or a folder above it, is a link to nowhere: a folder can't be made there, and a file would
    take the place of the link.
    """
    for one in (output, *output.parents):
        if one.is_symlink() and (reason := why_unreadable(one)):
            raise DataError(f"{option} {output}: {one} is {reason}; remove the link, or name another place")


def check_regular(path: Path, option: str = "-o") -> None:
    """Raises UsageError where a device, pipe or socket is, or a handle such as /dev/stdout; also for ``-``, a pipe where files go
    through one, which would else become a file or folder of that name.
    """
    if str(path) == "-":
        raise UsageError(f"{option} -: goes through no pipe here; name a file or folder")
    target = os.readlink(path) if path.is_symlink() else ""
    handle = target.startswith("/proc/") or os.path.realpath(path.parent).startswith("/proc/")
    if not handle:
        refuse_broken_link(path, option)
    if handle or (path.exists() and not path.is_file() and not path.is_dir()):
        raise UsageError(f"{option} {path}: is not a regular file; to write into a pipe use `-o - | ...`")


def refuse_folder(path: Path) -> None:
    """Raises DataError for a folder where an HDF5 file is expected, which tells of such files in it."""
    if path.is_dir():
        held = sorted(as_utf8(one.name) for one in path.glob("*.h5") if not one.name.startswith("."))
        takes = f"it holds {first_names(held)}: name one, or all where a command takes several ({path}/*.h5)"
        advice = takes if held else "`dpc prepare` turns raw folders into one"
        raise DataError(f"{path}: a folder, expected an HDF5 file; {advice}")


def refuse_pipe(path: Path) -> None:
    """Raises DataError for an input such as `<(command)`: HDF5 is read at any place, a pipe only once from its begin."""
    if path.exists() and (reason := why_unreadable(path)):
        raise DataError(f"{path}: {reason}; to read from a pipe give `-`: COMMAND | dpc ... -")


def check_replaced(folder: Path, own: Sequence[str]) -> None:
    """Raises UsageError where a folder that --force replaces whole holds what no name pattern of the command's own covers.

    Also where it is the current one: whoever called from it would stand in a folder that was removed.
    """
    if folder.is_dir():
        if folder.samefile("."):
            raise UsageError(f"{folder}: is the current folder, which can't be replaced; name a new one in it")
        others = [
            one.name for one in folder.iterdir() if one.is_dir() or not any(fnmatch(one.name, name) for name in own)
        ]
        if others:
            raise UsageError(
                f"{folder}: holds other things, too, such as {min(others)}; name another folder, or empty it yourself"
            )
