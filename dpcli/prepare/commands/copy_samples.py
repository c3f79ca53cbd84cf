"""Samples of finished files into another one, in an order that a stopped copy goes on with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from dpcli.errors import UsageError
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.signals import stop_requested
from dpcli.store import CloudSequence, CloudsWriter


def copy_samples(
    output: Path,
    names: list[str],
    read: Callable[[int], CloudSequence],
    *,
    task: str,
    skipped: Sequence[tuple[str, str]],
    where: str = "",
    **options: Any,
) -> None:
    """Writes what `read` returns for 0, 1, ..., the samples of these names, in one pass; goes on where a stopped or killed copy
    ended.

    skipped: (name, reason) of samples that the file says are left out. where: the file's name in the message of a stop.
    options: those of `CloudsWriter`. Raises UsageError when a stopped run left other samples for this output, and Stopped after
    a stop signal.
    """
    total = len(names)
    with (
        stop_requested() as stop,
        CloudsWriter(output, **options) as writer,
        Progress(task, total=total, unit="sample") as bar,
    ):
        done = _copied_before(writer, names)
        bar.skip(done)
        for place in range(done, total):
            sequence = read(place)
            writer.write(sequence)
            bar.advance(1, frames=sequence.num_frames)
            stop.check(f"{len(writer)} of {total} samples{where} are kept")
        writer.skipped = list(skipped)


def _copied_before(writer: CloudsWriter, names: list[str]) -> int:
    """Returns how many samples, from the first on, a stopped run left.

    Raises UsageError when it left others, which stay.
    """
    done = len(writer.written_names)
    if writer.written_names != names[:done]:
        writer.keep = True
        raise UsageError(
            f"{writer.path}: a stopped run left {done} other samples for it; go on with that run, write to "
            "another file, or --force to start over"
        )
    if done:
        log.info(f"continuing: {done} of {len(names)} were copied before")
    return done
