"""Samples of finished files into another one, in an order that a stopped copy goes on with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dpcli.errors import UsageError
from dpcli.prepare.commands.sources import Source
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.signals import stop_requested
from dpcli.store import CloudSequence, CloudsWriter


@dataclass(frozen=True, kw_only=True)
class Copy:
    """Says what is copied: the samples of these names, in their order, into a file with the look of `pattern`.

    skipped: (name, reason) of samples that the file says are left out. where: the file's name in the message of a stop.
    resume: off where it can't be run again (a pipe).
    """

    output: Path
    pattern: Source
    names: list[str]
    provenance: dict[str, Any] | list[dict[str, Any]]
    task: str
    skipped: list[tuple[str, str]] = field(default_factory=list)
    compression: str = "none"
    force: bool = False
    resume: bool = True
    where: str = ""


def copy_samples(copy: Copy, read: Callable[[int], CloudSequence]) -> None:
    """Writes what `read` returns for 0, 1, ... in one pass; goes on where a stopped or killed copy ended.

    Raises UsageError when a stopped run left other samples for this output, and Stopped after a stop signal.
    """
    total = len(copy.names)
    with stop_requested() as stop, _open_writer(copy) as writer, Progress(copy.task, total=total, unit="sample") as bar:
        done = _copied_before(writer, copy.names)
        bar.skip(done)
        for place in range(done, total):
            sequence = read(place)
            writer.write(sequence)
            bar.advance(1, frames=sequence.num_frames)
            stop.check(f"{len(writer)} of {total} samples{copy.where} are kept")
        writer.skipped = copy.skipped


def _open_writer(copy: Copy) -> CloudsWriter:
    return CloudsWriter(
        copy.output,
        class_names=copy.pattern.class_names,
        length_unit=copy.pattern.length_unit,
        source=copy.pattern.made_by,
        seed=copy.pattern.seed,
        fields=copy.pattern.fields,
        compression=copy.compression,
        provenance=copy.provenance,
        force=copy.force,
        resume=copy.resume,
    )


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
