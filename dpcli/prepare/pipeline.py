"""Leads from a reader to a file: items are read in worker processes and written in order by the one writer."""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections import Counter
from concurrent.futures import Executor
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, is_dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from dpcli.counted import counted
from dpcli.errors import DataError, reading
from dpcli.path_names import as_utf8, first_names
from dpcli.prepare.closing_line import closing_lines
from dpcli.prepare.convert_item import convert_item
from dpcli.prepare.decode.folder_listing import unreadable_entries
from dpcli.prepare.reader import ON_ERROR, Item, Reader, Sample, require_known
from dpcli.prepare.thinning import Thinning
from dpcli.runtime.device import cpu_count
from dpcli.runtime.machines.shards import Shard, describe_shard
from dpcli.runtime.machines.spread import Workers
from dpcli.runtime.progress import log
from dpcli.runtime.provenance import record
from dpcli.store import CloudsReader, CloudsWriter
from dpcli.store.heap_check import trust_heaps
from dpcli.store.writing.already_made import already_made
from dpcli.store.writing.item_pass import ItemPass, Wording, skipped_lines
from dpcli.store.writing.journal import journal_path


@dataclass(frozen=True, kw_only=True)
class Conversion:
    """Says how raw data become a file, whatever reads them; none of `jobs`, `force` and `task` changes the bytes.

    points, sampling: see Thinning. limit: only the first items. compression: that of the coordinates. on_error:
    ``skip`` bad samples or ``stop`` at one. jobs: processes, None for as many as there are CPUs. shard: only its
    items, for ``merge``; it may turn out empty. force: start over. task: what the progress bar calls it. item_seconds:
    see `convert_item`; with it a sample that was made by others is always read in a process of its own. Raises
    UsageError for another word or number.
    """

    points: int = 0
    sampling: str = "random"
    limit: int | None = None
    compression: str = "none"
    on_error: str = "skip"
    jobs: int | None = 1
    shard: Shard | None = None
    seed: int = 0
    force: bool = False
    task: str = "prepare"
    item_seconds: float = 0

    def __post_init__(self) -> None:
        require_known(self, on_error=ON_ERROR)
        Thinning(self.points, self.sampling)

    @property
    def thinning(self) -> Thinning:
        """Returns the rule by which frames lose points."""
        return Thinning(self.points, self.sampling)

    @property
    def processes(self) -> int:
        """Returns how many processes read items at a time."""
        return self.jobs or cpu_count()


@dataclass
class Report:
    """Tells what a conversion did. ``skipped`` holds (name, reason); ``notes`` counts what readers left out.

    ``closing`` is what a person can check: the lines of `closing_lines`.
    """

    written: int = 0
    frames: int = 0
    points: int = 0
    skipped: list[tuple[str, str]] = field(default_factory=list)
    notes: Counter = field(default_factory=Counter)
    was_complete: bool = False
    closing: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """Returns what was left out, in words; nothing goes unmentioned."""
        return [*(f"{what}: {count}" for what, count in sorted(self.notes.items())), *skipped_lines(self.skipped)]

    def counts(self) -> str:
        """Returns what was written, in words."""
        said = counted(self.written, "sequence" if self.points else "sample")
        inside = f", {counted(self.frames, 'frame')}, {counted(self.points, 'point')}" if self.points else ""
        return f"{said}{inside}, {len(self.skipped)} skipped"


def configuration(reader: Reader, thinning: Thinning, items: list[Item], compression: str) -> dict[str, Any]:
    """Returns everything that decides the file's content, except the seed: equal ones may continue each other."""
    digest = hashlib.sha256("\n".join(reader.class_names).encode())
    fingerprint = cache(_fingerprint)  # items may share a folder
    for item in items:
        facts = [item.name, item.split, item.label, item.subject, item.camera, fingerprint(item.path)]
        facts += map(fingerprint, item.extra.get("files", ()))
        if series := item.extra.get("series"):
            facts += map(fingerprint, series.paths[-1:])
            facts += series.beside.seconds.tolist() if series.beside else []  # they may lie in the folder above
        digest.update("\n".join(map(str, facts)).encode())
    thin = {"points": thinning.points, "sampling": thinning.sampling} if thinning.points else {"points": 0}
    reader_config = {"reader": type(reader).__name__, **reader.config}
    index = {"items": len(items), "items_digest": digest.hexdigest()[:16]}
    # through JSON, because it is compared with what a file's attribute gives back: tuples become lists
    return json.loads(json.dumps({**reader_config, **thin, "compression": compression, **index}))


def _fingerprint(path: Path) -> str:
    """Returns what tells an item's data from others of that name without reading them.

    That is a file's size, or a folder's list of names and the size of its last file: not its place or date, which
    copying changes, and not what we may be writing there.
    """
    try:
        if not path.is_dir():
            return str(path.stat().st_size)
        names = sorted(name for name in os.listdir(path) if not _may_be_ours(name))
        last = next((path / name for name in reversed(names) if (path / name).is_file()), None)
        return f"{len(names)} {hashlib.sha256(os.fsencode('/'.join(names))).hexdigest()} {last.stat().st_size if last else 0}"
    except (OSError, ValueError):  # it is made, or of a file beside others, or not there, or its name holds NUL
        return ""


def _tell_newer(kept: Path, items: list[Item]) -> None:
    """Warns of inputs that are newer than what an earlier run left: fingerprints hold few sizes, and content may change without."""
    if not kept.is_file():
        return
    (made, moved), dates = _dates(kept), cache(_dates)  # items may share a folder

    def is_newer(path: Path) -> bool:
        written, put_there = dates(path)
        return written > made or put_there > max(made, moved)

    newer = [item.name for item in items if any(map(is_newer, (item.path, *item.extra.get("files", ()))))]
    if newer:
        log.warn(
            f"newer than what an earlier run left ({kept.name}), and not read again where that had them: {first_names(newer)};"
            " --force starts over"
        )


def _dates(path: Path) -> tuple[float, float]:
    """Returns when a file, or the newest one of a folder, was written, and when it was put there; 0 where there is none.

    What an archive or `rsync -a` puts there has the date of its writing, long ago.
    """
    with suppress(OSError, ValueError):
        own = path.stat()
        with os.scandir(path) if stat.S_ISDIR(own.st_mode) else nullcontext(()) as inside:
            files = [one.stat() for one in inside if one.is_file() and not _may_be_ours(one.name)] or [own]
            return max(one.st_mtime for one in files), max(one.st_ctime for one in files)
    return 0.0, 0.0


def _may_be_ours(name: str) -> bool:
    """Returns whether a file in a folder of data may be the one that is being written."""
    return name.startswith(".") or name.lower().endswith((".h5", ".hdf5"))


def _roots(reader: Reader) -> list[Path]:
    """Returns the files and folders that a reader was given; none for one that makes its data."""
    given = getattr(reader, "inputs", ()) or (getattr(reader, "raw", None),)
    return [root for root in given if isinstance(root, Path)]


def without_index(reader: Reader) -> Reader:
    """Returns a reader of the same options that holds no index: with one, sent to a worker with every item, the work would
    grow with the square of their number.
    """
    listed = {"inputs": ()} if hasattr(reader, "inputs") else {}
    return replace(reader, **listed) if is_dataclass(reader) else reader


def all_items(reader: Reader) -> tuple[list[Item], list[Item]]:
    """Returns a reader's index, and an item with a problem for each entry below its folder that can't be opened.

    So a dangling link or a FIFO named like data is skipped by name. Raises DataError when the index can't be made.
    """
    roots = _roots(reader)
    with reading(", ".join(map(str, roots)) or type(reader).__name__):
        items = list(reader.items())
    taken = {item.path for item in items}
    odd = [(root, path, why) for root in roots if root.is_dir() for path, why in unreadable_entries(root, taken)]
    used, extra = {item.name for item in items}, []
    for root, path, why in odd:
        name = as_utf8(path.relative_to(root).as_posix())
        name = as_utf8(str(path)) if name in used else name
        used.add(name)
        extra.append(Item(name, path, problem=f"{as_utf8(str(path))}: {why}"))
    return items, extra


def convert(
    reader: Reader,
    output: Path,
    conversion: Conversion = Conversion(),
    *,
    executor: Executor | None = None,
    slots: int = 0,
    resume: bool = True,
) -> Report:
    """Converts every item of a reader into one clouds file; running again continues where a stopped or killed run
    ended.

    executor: where items are read, `slots` at a time, instead of processes on this machine; the file's bytes don't
    depend on it. resume: off where it can't be run again (a pipe); saves the journal's disk space. Raises
    UsageError when `output` was made another way and `force` is off, DataError when no sample is good, and Stopped
    after a stop signal, with what is done kept beside `output`.
    """
    items, unread = all_items(reader)
    for line in reader.summary(items):
        log.info(line)
    items = [*items, *unread][: conversion.limit]
    config = configuration(reader, conversion.thinning, items, conversion.compression)
    provenance = describe_shard(record(config, conversion.seed), conversion.shard)
    report = Report()
    for kept in (output, journal_path(output)) if _roots(reader) and not conversion.force else ():
        _tell_newer(kept, items)
    if not conversion.force and already_made(output, provenance, CloudsReader):
        report.was_complete = True
        return count_samples(report, CloudsReader(output))
    with _open_writer(output, reader, conversion, provenance, resume) as writer:
        taken = _write_items(writer, items, conversion)
        taken.run(
            partial(
                convert_item,
                without_index(reader),
                conversion.thinning,
                conversion.seed,
                item_seconds=conversion.item_seconds,
            ),
            lambda place: (place, items[place]),
            partial(_write_sample, writer, report, items),
            Workers(
                slots or conversion.processes, executor, apart=conversion.item_seconds > 0 and bool(_roots(reader))
            ),
        )
    trust_heaps(output)
    return count_samples(report, CloudsReader(output))


def _write_items(writer: CloudsWriter, items: list[Item], conversion: Conversion) -> ItemPass:
    skip = conversion.on_error == "skip"
    return ItemPass(
        writer,
        [item.name for item in items],
        Wording(conversion.task, "sample", "converted", " (--on-error skip passes bad samples over)"),
        conversion.shard,
        skips=(DataError,) if skip else (),
    )


def _write_sample(
    writer: CloudsWriter, report: Report, items: list[Item], place: int, sample: Sample
) -> dict[str, float]:
    writer.write(sample.sequence)
    report.notes.update(sample.notes)
    for what, count in sample.notes.items():
        log.detail(f"{items[place].name}: {what}: {count}")
    return {"frames": sample.sequence.num_frames}


def _open_writer(
    output: Path, reader: Reader, conversion: Conversion, provenance: dict[str, Any], resume: bool
) -> CloudsWriter:
    return CloudsWriter(
        output,
        class_names=reader.class_names,
        length_unit=reader.length_unit,
        source=type(reader).__name__,
        seed=conversion.seed,
        fields=reader.fields,
        compression=conversion.compression,
        provenance=[*reader.history, provenance],
        force=conversion.force,
        resume=resume,
    )


def count_samples(report: Report, reader: CloudsReader) -> Report:
    """Returns the report with what the finished file holds, whether this run wrote all of it or continued another."""
    with reader:
        report.written = len(reader)
        report.skipped = reader.skipped
        report.frames, report.points = int(reader.frame_counts.sum()), int(reader.point_counts.sum())
        report.closing = closing_lines(reader, report.notes)
    return report
