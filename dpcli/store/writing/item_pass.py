"""One pass over many items into one file: worked on in processes or on machines, written in order by the one writer.

Every command that makes a file of many items runs through this, so that all give the same promises: any number of
processes and any cut into shards give the same bytes, a stopped or killed run continues, and an item that takes down
whoever works on it is passed over by name.
"""

from __future__ import annotations

import signal
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from dpcli.errors import DataError, DpcError, UsageError
from dpcli.runtime.machines.shards import WHOLE, Shard
from dpcli.runtime.machines.spread import Workers
from dpcli.runtime.pool import LostWorker, on_second, ordered_map
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.signals import StopRequest, answering, stop_requested
from dpcli.store.writing.resumable_writer import ResumableWriter

_LISTED = 20  # skipped items named one by one at the end; -v names all as they come


def skipped_lines(skipped: Sequence[tuple[str, str]]) -> list[str]:
    """Returns what was passed over, (name, reason), in words; nothing goes unmentioned."""
    if not skipped:
        return []
    lines = [f"{len(skipped)} skipped:", *(f"  {name}: {reason}" for name, reason in skipped[:_LISTED])]
    return [*lines, f"  ... and {len(skipped) - _LISTED} more; -v names every one"] if len(skipped) > _LISTED else lines


@dataclass(frozen=True)
class Wording:
    """Holds the words in which a pass is told of: the command, one item, what is done with it, and the advice for a bad one."""

    task: str
    unit: str
    done: str
    advice: str = ""


class ItemPass:
    """Passes once over the items that `writer` lacks, of all `names` or of a shard of them.

    skips: errors that pass an item over, which is then named in the file with the reason; others end the pass, and what
    was written is kept unless the error is a DataError.
    """

    def __init__(
        self,
        writer: ResumableWriter,
        names: Sequence[str],
        words: Wording,
        shard: Shard | None = None,
        skips: tuple[type[Exception], ...] = (LostWorker,),
    ) -> None:
        self.writer, self.names, self.words, self.skips = writer, names, words, skips
        self.places = (shard or WHOLE).places(len(names))
        writer.expected = len(self.places)
        done = set(writer.written_names)
        if done:
            log.info(f"continuing: {len(done)} of {len(self.places)} {words.unit}s were {words.done} before")
        self.written = array("q", (place for place in self.places if done and names[place] in done))
        self._refuse_others()
        self.skipped = array("q")
        self.last = self.written[-1] if done else -1
        if shard:
            writer.positions = (self.written, self.skipped)

    def _refuse_others(self) -> None:
        """Raises UsageError when a stopped run left other samples than this pass would have written; they stay."""
        left = self.writer.written_names
        if left != [self.names[place] for place in self.written]:
            self.writer.keep = True
            raise UsageError(
                f"{self.writer.path}: a stopped run left {len(left)} other samples for it; go on with that run, write to "
                "another file, or --force to start over"
            )

    def run(
        self,
        work: Callable[[Any], Any],
        load: Callable[[int], Any],
        write: Callable[[int, Any], dict[str, float]],
        workers: Workers,
    ) -> None:
        """Gives `work` what `load` returns for each place, and `write` the place and the result.

        `write` returns what the progress bar counts beside items. Raises what `load`, `work` and `write` raise, DataError
        when every item of the whole was passed over, and Stopped after a stop signal, with what is done kept.
        """
        with stop_requested() as stop:
            try:
                self._pass(work, load, write, workers, stop)
            except KeyboardInterrupt:
                kept = f"{self._kept()}; run again to continue" if self.writer.resume else "nothing was kept"  # a pipe
                log.warn(f"interrupted; {kept}")
                raise
        if not len(self.writer) and self.writer.positions is None:
            reason = self.writer.skipped[0][1] if self.writer.skipped else "the index is empty"
            raise DataError(f"none of the {len(self.places)} {self.words.unit}s is good; the first: {reason}")

    def _pass(
        self,
        work: Callable[[Any], Any],
        load: Callable[[int], Any],
        write: Callable[[int, Any], dict[str, float]],
        workers: Workers,
        stop: StopRequest,
    ) -> None:
        written = set(self.written)
        todo = [place for place in self.places if place not in written]
        with Progress(self.words.task, len(self.places), self.words.unit) as bar:
            bar.skip(len(written))
            slots = min(workers.slots, len(todo))
            items = ((place, load(place)) for place in todo)
            try:
                with closing(
                    ordered_map(partial(on_second, work), items, slots, workers.executor, workers.apart)
                ) as results:
                    for (place, _), result in results:
                        self._take(place, result, write, bar)
                        self._check(stop)
            except Exception as error:
                if isinstance(error, DpcError) or workers.executor is not None:
                    self._check(stop)  # a signal to the whole process group takes the workers down as well
                self.writer.keep = not isinstance(error, DataError)  # it says nothing about the items
                raise

    def _check(self, stop: StopRequest) -> None:
        if self.writer.resume:
            stop.check(self._kept())
        else:  # a pipe
            stop.check("nothing was kept", again="to start over")

    def _kept(self) -> str:
        return f"{len(self.writer)} of {len(self.places)} {self.words.unit}s are kept"

    def _take(self, place: int, result: Any, write: Callable[[int, Any], dict[str, float]], bar: Progress) -> None:
        """Writes a result, or notes what was raised instead of one."""
        if not isinstance(result, Exception) and place > self.last:
            with _interrupted_after():
                counted = write(place, result)
            self.written.append(place)
            bar.advance(1, **counted)
            return
        if not isinstance(result, Exception):
            # a stopped run had passed it over as bad; putting it in now would break the order of the file
            self._skip(place, "is good now but was skipped before the stop; --force starts over and includes it")
        elif isinstance(result, self.skips):
            self._skip(place, str(result))
        elif isinstance(result, DataError):
            raise DataError(f"{self.names[place]}: {result}{self.words.advice}") from None
        else:
            log.error(f"{self.names[place]}: failed in an unforeseen way")
            raise result
        bar.advance(1)

    def _skip(self, place: int, reason: str) -> None:
        self.writer.skipped.append((self.names[place], reason))
        self.skipped.append(place)
        log.detail(f"skipped {self.names[place]}: {reason}")


@contextmanager
def _interrupted_after() -> Iterator[None]:
    """Delays Ctrl-C until the block has ended, because a half-appended sample would be lost."""
    pending: list[int] = []
    with answering([signal.SIGINT], pending.append):
        yield
    if pending:
        raise KeyboardInterrupt
