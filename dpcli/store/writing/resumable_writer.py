"""Writing a file that is whole or not there, by a writer that may be stopped or killed and go on later.

What every such writer does around its samples: the unfinished file, the journal, and which of them stays when it ends
early. What a sample is and where it goes is its subclass's.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from dpcli.config_diff import differences
from dpcli.counted import counted
from dpcli.errors import DpcError, Stopped, UsageError
from dpcli.runtime.whole_file import DiskFull, disk_full, not_writable, refuse_existing
from dpcli.store.file import history_of, write_positions, write_root, write_skipped
from dpcli.store.writing.atomic_file import AtomicFile
from dpcli.store.writing.journal import Journal, Placed, data_suffix, journal_path, second_path

_STILL_KEPT = (
    "what an earlier run had done is kept. Make room for that once more and for the rest, then run the same command again to"
    " continue"
)


class ResumableWriter(ABC):
    """Writes `path` through a file beside it that is renamed when whole, as a context manager.

    Leaving the block without an exception finishes the file; an exception leaves nothing. With `resume=True` what was
    written survives a stop (Stopped, KeyboardInterrupt, a full disk, or any exception once `keep` is set) and a kill at any
    moment: the next writer with the same provenance continues, and `written_names` lists what is already there. Until the file
    is whole that takes a journal (`.NAME.part`). Raises UsageError when `path` exists, or what another provenance kept for
    it, and `force` is off.

    Set before the block ends: `skipped`, (name, reason) of samples left out, and `positions` of a shard (see
    write_positions), both kept in the file; a shard may be empty. `expected`, how many samples will come, lets a full disk
    be told with how much room they need.

    A subclass has its own state ready before it calls this constructor, which opens the file and has `_create` and, to
    continue, `write_again` called. It calls `_record` for each sample that is written, and writes the rest in `_complete`.
    """

    kind = ""

    def __init__(
        self,
        path: str | Path,
        *,
        class_names: Sequence[str] = (),
        length_unit: str = "",
        source: str = "",
        seed: int = 0,
        provenance: dict | Sequence[dict] | None = None,
        force: bool = False,
        resume: bool = False,
    ) -> None:
        refuse_existing(path, force)
        self.path, self.resume, self.keep = Path(path), resume, False
        self.skipped: list[tuple[str, str]] = []
        self.positions: tuple[Sequence[int], Sequence[int]] | None = None
        self.class_names, self._root = list(class_names), {"length_unit": length_unit, "source": source, "seed": seed}
        self.provenance = history_of(provenance)
        self.written_names: list[str] = []
        self._journal: Journal | None = None
        self._recorded, self.expected = 0, 0
        self._open(force)

    def _about(self) -> dict[str, Any]:
        """Returns what decides whether a journal is of this very work: not the words of the command, which may be spelled otherwise."""
        work = [{key: value for key, value in entry.items() if key != "command"} for entry in self.provenance]
        return {"kind": self.kind, "provenance": work}

    def _create(self) -> None:  # noqa: B027 (not every subclass has any)
        """Makes the data sets that a subclass fills as samples come; none for one that writes them all in `_complete`."""

    @abstractmethod
    def write_again(self, given: list[Any]) -> str:
        """Writes a sample from the values that `_record` is given for it, and returns its name."""

    @abstractmethod
    def _complete(self) -> None:
        """Writes into the HDF5 file what is still missing."""

    @abstractmethod
    def __len__(self) -> int:
        """Counts the samples written so far."""

    def _open(self, force: bool) -> None:
        before = None
        # AtomicFile explains what is wrong otherwise
        if self.resume and self.path.parent.is_dir() and not self.path.is_dir():
            try:
                before = Journal(journal_path(self.path), self._about())
            except DpcError:  # it names the journal, which nobody knows
                raise DpcError(f"{self.path}: cannot write (another dpc is writing it)") from None
            except OSError as error:
                raise disk_full(self.path, error) or not_writable(self.path, error) from None
        earlier = bool(before and before.data_name)  # of this very work; a new journal has a name from its begin on
        try:
            if before and before.other and not force:
                raise self._kept_of(before.other, before.about)
            self._atomic = AtomicFile(self.path, suffix=data_suffix(before.data_name) if before else ".part")
            self._file = self._atomic.file
            self._create()
            if before:
                self._continue(before, force)
        except BaseException as error:
            full = earlier and not force and disk_full(self.path, error, _STILL_KEPT)
            self._give_up(before)
            try:
                self._leave(error)
            except DiskFull:
                if not full:
                    raise
            if full:
                raise full from None
            raise

    def _kept_of(self, other: dict[str, Any], mine: dict[str, Any]) -> UsageError:
        """Returns the error that says that what was kept is of other work; it stays."""
        old, new = ({**about, **(about.get("provenance") or [{}])[-1], "provenance": None} for about in (other, mine))
        said = "; ".join(differences(old, new)[:3]) or "an earlier step of its files differs"
        return UsageError(
            f"{self.path}: a stopped run with other settings or inputs ({said}) left its work here; run that command again to continue it,"
            " write to another file, or --force to start over"
        )

    def _continue(self, before: Journal, force: bool) -> None:
        """Writes what an earlier run had written, if it was the same work."""
        if force or not before.data_name:
            self._journal = before
            before.begin(self._atomic.part, self._atomic.handle)
            before.remove_others(self._atomic.part.name)
            return
        self._journal = Journal(second_path(before.path), self._about())
        self._journal.begin(self._atomic.part, self._atomic.handle)
        for given in before.samples():
            self.written_names.append(self.write_again(given))
        self._journal.replace(before)

    def _give_up(self, before: Journal | None) -> None:
        """Leaves all of an earlier run as it was, since opening failed."""
        if self._journal not in (None, before):
            self._journal.path.unlink(missing_ok=True)
            self._journal.close()
        self._journal = None
        if before and before.was_there:
            before.keep()
        elif before:
            before.discard()

    def _record(self, given: list[Any], placed: Placed | None = None) -> None:
        """Makes the sample count as written. given, placed: as `Journal.append`."""
        if self._journal:
            self._journal.append(given, placed)
            self._recorded += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self._finish()
        else:
            self._leave(error)

    def _leave(self, error: BaseException) -> None:
        """Removes all but, after a stop, the journal and the file it points into."""
        stopped = isinstance(error, (Stopped, KeyboardInterrupt)) or self.keep or disk_full(self.path, error)
        kept = self._kept() if stopped else ""
        if hasattr(self, "_atomic"):
            self._atomic.needed = self._needed()
            try:
                self._atomic.failed(error, kept)
            finally:
                self._leave_journal(bool(kept))

    def _kept(self) -> str:
        """Returns what a run that continues finds, in words; "" where that is nothing."""
        # not `len`, which counts the sample that found no room, too
        return f"what is done, {counted(self._recorded, 'sample')}, is kept" if self._journal and self._recorded else ""

    def _needed(self) -> int:
        """Returns about how many bytes all samples take, journal and all, estimated from those done; 0 where unknown."""
        files = [self._atomic.part, self._journal.path] if self._journal and self._recorded else []
        return sum(one.stat().st_size for one in files if one.exists()) * self.expected // max(self._recorded, 1)

    def _leave_journal(self, kept: bool) -> None:
        if self._journal and kept:
            self._journal.keep()
        elif self._journal:
            self._journal.discard()

    def _finish(self) -> None:
        try:
            self._complete()
            write_skipped(self._file, self.skipped)
            write_positions(self._file, self.positions)
            self._file.flush()
            # last, since a stream knows only at its end how many frames its provenance has to name
            write_root(self._file, self.kind, class_names=self.class_names, provenance=self.provenance, **self._root)
        except BaseException as error:
            self._leave(error)
            raise
        self._atomic.needed = self._needed()
        try:
            self._atomic.commit(self._kept())
        except DpcError as error:
            # unless the disk was full, the HDF5 file is gone, and with it what the journal points to
            self._leave_journal(isinstance(error, DiskFull) and bool(self._kept()))
            raise
        self._leave_journal(kept=False)
