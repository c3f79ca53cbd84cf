"""Several files into one: the shards of one run, whatever it made, or clouds of sources that have nothing in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from dpcli.errors import DataError
from dpcli.path_names import short_names
from dpcli.prepare.commands.copy_samples import copy_samples
from dpcli.prepare.commands.sources import open_source, warn_of_others
from dpcli.prepare.label_map import LabelMap
from dpcli.prepare.pipeline import Report, count_samples
from dpcli.runtime.machines.shards import shard_of
from dpcli.runtime.progress import log
from dpcli.runtime.provenance import record
from dpcli.store import CloudSequence, CloudsReader
from dpcli.store.file import file_kind
from dpcli.store.pipes import refuse_repeats
from dpcli.store.sequence import OF_PARTS
from dpcli.store.writing.already_made import already_made
from dpcli.store.writing.join_shards import is_shard, join_shards
from dpcli.store.writing.open_readers import OpenReaders

_OPEN = 64  # files held open at a time


@dataclass(frozen=True)
class _Source:
    """Holds a file to be joined, and what goes before its samples' names in the joined file."""

    reader: CloudsReader
    prefix: str

    def sample_name(self, index: int) -> str:
        """Returns the sample's name in the joined file."""
        return self.prefix + self.reader.names[index]


def merge(
    inputs: Sequence[Path],
    output: Path,
    *,
    labels: LabelMap | None = None,
    prefix: bool = False,
    compression: str = "none",
    force: bool = False,
    resume: bool = True,
) -> Report:
    """Joins files, one sample in memory at a time; running again continues where a stopped or killed run ended.

    All shards of one run become, byte for byte, the file of a single run: order restored, provenance the whole's. Other
    clouds files follow one another as given; their class lists must agree unless `labels` maps them.
    prefix: names become FILE/NAME, FOLDER/NAME for files of one name. resume: off where it can't be run again
    (a pipe); saves the journal's disk space. UsageError: missing, repeated or mixed shards, `output` or what a stopped
    run left of it is there and another; DataError: classes, units or fields that disagree, a name twice; Stopped after
    a stop signal.
    """
    refuse_repeats([*inputs, output])
    may_be_shards = labels is None and not prefix
    if may_be_shards and any(file_kind(path) != "clouds" for path in inputs):
        return _merge_shards(inputs, output, force, resume)
    readers = [open_source(path) for path in inputs]
    if may_be_shards and all(map(is_shard, readers)):
        return _merge_shards(inputs, output, force, resume)
    for reader in readers:
        warn_of_others(reader)
        if is_shard(reader):
            shard = shard_of(reader.provenance[-1])[0]
            log.warn(f"{reader.path}: is shard {shard} of a conversion; joined as any other file, in its own order")
    prefixes = [f"{name}/" for name in short_names(inputs)] if prefix else [""] * len(readers)
    sources = [_Source(*both) for both in zip(readers, prefixes)]
    return _merge_unlike(sources, output, labels or LabelMap(), compression, force, resume)


def _merge_shards(inputs: Sequence[Path], output: Path, force: bool, resume: bool) -> Report:
    report = Report(was_complete=output.exists() and not force)
    joined = join_shards(inputs, output, force=force, resume=resume)
    if isinstance(joined, CloudsReader):  # or one of parts
        return count_samples(report, joined)
    report.written, report.skipped = len(joined.names), joined.skipped
    return report


def _merge_unlike(
    sources: list[_Source], output: Path, labels: LabelMap, compression: str, force: bool, resume: bool
) -> Report:
    readers = [source.reader for source in sources]
    length_unit = _common_unit(readers)
    class_names, tables = labels.resolve([(reader.path, reader.class_names) for reader in readers])
    fields = _common_fields(readers)
    _refuse_equal_names(sources)
    chosen: list[tuple[_Source, int, int]] = []  # file, place in it, label in the joined file
    skipped: list[tuple[str, str]] = []
    for source, table in zip(sources, tables):
        skipped += [(source.prefix + name, why) for name, why in source.reader.skipped]
        for index, label in enumerate(source.reader.labels.tolist()):
            joined = table[label] if label >= 0 else -1
            if joined is None:
                why = f"class {source.reader.class_names[label]!r} is left out by the label map"
                skipped.append((source.sample_name(index), why))
            else:
                chosen.append((source, index, joined))
    config = {
        "merge": [reader.path.name for reader in readers],
        "labels": asdict(labels),
        "prefix": any(source.prefix for source in sources),
        "compression": compression,
        "sources": [reader.provenance for reader in readers],
    }
    entry = record(config, 0, {f"{k}": reader.path for k, reader in enumerate(readers)})
    if not force and already_made(output, entry, CloudsReader):
        return count_samples(Report(was_complete=True), CloudsReader(output))
    parts = max(map(_count_parts, readers))

    def read(place: int) -> CloudSequence:
        source, index, label = chosen[place]
        sequence = opened.use(source.reader).read(index)
        sequence.name, sequence.label = source.prefix + sequence.name, label
        for name in set(source.reader.fields) - set(fields):
            sequence.without(name)
        sequence.pad_parts(parts)
        return sequence

    with OpenReaders(_OPEN) as opened:
        copy_samples(
            output,
            [source.sample_name(index) for source, index, _ in chosen],
            read,
            task="prepare merge",
            skipped=skipped,
            source="merge",
            provenance=entry,
            compression=compression,
            force=force,
            resume=resume,
            class_names=class_names,
            length_unit=length_unit,
            fields=fields,
        )
    return count_samples(Report(), CloudsReader(output))


def _common_unit(readers: list[CloudsReader]) -> str:
    """Returns the unit of length of all files. Raises DataError where they have several."""
    units = {reader.length_unit: reader.path for reader in readers}
    if len(units) > 1:
        (a, one), (b, two), *_ = units.items()
        raise DataError(f"{two}: its length unit is {b!r}, of {one} it is {a!r}; convert to one unit (--scale) first")
    return readers[0].length_unit


def _common_fields(readers: list[CloudsReader]) -> tuple[str, ...]:
    """Returns the optional fields that all files have, and warns of those that only some have."""
    fields = tuple(name for name in readers[0].fields if all(name in reader.fields for reader in readers))
    for name in sorted({name for reader in readers for name in reader.fields} - set(fields)):
        log.warn(f"{name}: left out, not all of the files have it")
    return fields


def _count_parts(reader: CloudsReader) -> int:
    """Returns how many parts the poses and joints of a file have, 0 where it has none."""
    with reader:
        return max((reader.file[key].shape[1] for key in OF_PARTS.keys() & set(reader.fields)), default=0)


def _refuse_equal_names(sources: list[_Source]) -> None:
    seen: dict[str, Path] = {}
    for source in sources:
        for index in range(len(source.reader)):
            own = source.sample_name(index)
            if own in seen:
                advice = "files and folders of one name" if source.prefix else "--prefix puts the file's name before it"
                raise DataError(
                    f"{source.reader.path}: sample {own!r} is in {seen[own]} as well; names identify samples ({advice})"
                )
            seen[own] = source.reader.path
