"""An HDF5 file that is whole or not there, also when the disk is full."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py

from dpcli.errors import DataError, DpcError
from dpcli.file_lock import open_alone
from dpcli.runtime.progress import log
from dpcli.runtime.whole_file import check_regular, disk_full, not_writable, put_in_place

_OTHER_FORMS = frozenset(
    ".png .jpg .jpeg .gif .svg .pdf .mp4 .html .htm .csv .tsv .xlsx .json .txt .md .ply .pcd .obj .npy .npz".split()
)


def _tell_other_form(target: Path) -> None:
    """Warns where a name promises a picture, a page, a table or the like, which no program would find in an HDF5 file."""
    if target.suffix.lower() in _OTHER_FORMS:
        log.warn(
            f"{target}: is written as HDF5, not as {target.suffix}; name it .h5 (pictures, pages and tables have options of their"
            " own: --help)"
        )


class _HeldOpen(h5py.File):
    """Keeps every data set that it made open until it is closed.

    HDF5 writes what it buffers when the last reference to a data set goes, where h5py can't raise: a full disk would then
    be a trace on stderr and a crash as the process ends. With all of them open, `flush` writes it and raises.
    """

    def create_dataset(self, *args: Any, **options: Any) -> h5py.Dataset:
        made = super().create_dataset(*args, **options)
        self.__dict__.setdefault("made", []).append(made)
        return made


class AtomicFile:
    """Writes an HDF5 file beside its target (`.NAME.part`, or another suffix) and renames it when whole.

    A file under the final name is therefore always complete. `commit` closes, syncs and renames; `discard` removes.
    Write errors become DpcError with the reason in words. As a context manager it gives the open HDF5 file, and commits
    it at the end of the block, or discards it when the block fails.
    """

    def __init__(self, target: str | Path, suffix: str = ".part") -> None:
        self.target, self.needed = Path(target), 0
        self.part = self.target.with_name(f".{self.target.name}{suffix}")
        if not self.target.parent.is_dir():
            raise DataError(f"{self.target}: the folder {self.target.parent} does not exist; create it first")
        if self.target.is_dir():
            raise DataError(f"{self.target}: is a folder; name a file in it")
        check_regular(self.target)
        _tell_other_form(self.target)
        self._lock = -1
        try:
            self._lock = open_alone(self.part)
            self.file = self._open()
            self.handle, self._written_out = self.file.id.get_vfd_handle(), 0
        except DpcError:
            raise DpcError(f"{self.target}: cannot write (another dpc is writing it)") from None
        except OSError as error:
            if self._lock != -1:
                with suppress(OSError):  # the first byte did not fit: an empty file would stay
                    self.part.unlink(missing_ok=True)
                self._unlock()
            raise self.problem(error) or not_writable(self.target, error) from None

    def _open(self) -> _HeldOpen:
        """Opens the locked file without HDF5's own lock: HDF5 empties a file before it asks whether another writes it."""
        try:
            return _HeldOpen(self.part, "w", locking=False)
        except BlockingIOError:  # HDF5_USE_FILE_LOCKING=TRUE: HDF5 locks all the same, and ours is in its way
            self._unlock()
            return _HeldOpen(self.part, "w")

    def _unlock(self) -> None:
        """Lets others write under this name again, once the unfinished file is renamed, removed or left to be continued."""
        if self._lock != -1:
            os.close(self._lock)
            self._lock = -1

    def __enter__(self) -> h5py.File:
        return self.file

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.commit()
        else:
            self.failed(error)

    def problem(self, error: BaseException | None, kept: str = "") -> DpcError | None:
        """Returns a DpcError for a write that found the disk full, None when `error` is something else.

        kept: what stays for a run that continues, in words. It writes that once more and the rest, `needed` bytes.
        """
        advice = (
            f"{kept}. Make room for that once more and for the rest, then run the same command again to continue"
            if kept
            else "nothing was left under that name. Free space, then run again"
        )
        return disk_full(self.target, error, advice, needed=self.needed)

    def flush(self) -> None:
        """Hands everything to the system and lets the disk start on it: else `commit` waits for all of it at the end."""
        self.file.flush()
        if hasattr(os, "posix_fadvise"):
            size = os.fstat(self.handle).st_size
            # What it says is that the pages won't be needed; as they are new, Linux begins to write them and keeps them.
            with suppress(OSError):  # a file system that takes no advice
                os.posix_fadvise(self.handle, self._written_out, size - self._written_out, os.POSIX_FADV_DONTNEED)
            self._written_out = size

    def commit(self, kept: str = "") -> None:
        """Closes the file, brings it to the disk and renames it; raises DpcError when that fails.

        kept: as `problem`; with it the unfinished file stays when there was no room.
        """
        try:
            self.file.flush()
            self.file.close()
            put_in_place(self.part, self.target)
            self._unlock()
        except (OSError, RuntimeError) as error:
            self.failed(error, kept if self.problem(error) else "")
            raise DpcError(f"{self.target}: could not be finished ({error})") from None

    def discard(self) -> None:
        """Closes and removes the unfinished file."""
        self._close()
        self.part.unlink(missing_ok=True)
        self._unlock()

    def _close(self) -> None:
        try:
            self.file.close()
        except (OSError, RuntimeError):  # closing flushes, which fails again on a full disk
            pass

    def failed(self, error: BaseException, kept: str = "") -> None:
        """Discards after an exception, or keeps the part unfinished where `kept` says why; re-raises a failed write in words."""
        worded = self.problem(error, kept)
        if worded is not None:
            self._let_go()
        if kept:
            self._close()
            self._unlock()
        else:
            self.discard()
        if worded is not None:
            raise worded from None

    def _let_go(self) -> None:
        """Sends what HDF5 still holds after a failed write to the null device instead of to the full disk.

        It would try again on every close, complain each time, and crash as the process ends.
        """
        try:
            elsewhere = os.open(os.devnull, os.O_RDWR)
            os.dup2(elsewhere, self.handle, inheritable=False)
            os.close(elsewhere)
        except OSError:  # closed already
            pass
