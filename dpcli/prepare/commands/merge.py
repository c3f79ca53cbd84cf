"""Several files into one: the shards of one run, whatever it made, or clouds of sources that have nothing in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from dpcli.errors import DataError
from dpcli.path_names import short_names
from dpcli.prepare.commands.copy_samples import Copy, copy_samples
from dpcli.prepare.commands.sources import OpenFiles, Source, read_source
from dpcli.prepare.label_map import LabelMap
from dpcli.prepare.pipeline import Report, count_samples
from dpcli.runtime.progress import log
from dpcli.runtime.provenance import record
from dpcli.store import CloudSequence, CloudsReader
from dpcli.store.file import file_kind
from dpcli.store.pipes import refuse_repeats
from dpcli.store.writing.already_made import already_made
from dpcli.store.writing.join_shards import join_shards


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
    if labels is None and not prefix and (_no_clouds(inputs) or all(read_source(path).shard for path in inputs)):
        return _merge_shards(inputs, output, force, resume)
    sources = [read_source(path) for path in inputs]
    for source in sources:
        source.warn_of_others()
        if source.shard:
            log.warn(
                f"{source.path}: is shard {source.shard} of a conversion; joined as any other file, in its own order"
            )
    if prefix:
        for source, name in zip(sources, short_names(inputs)):
            source.prefix = f"{name}/"
    return _merge_unlike(sources, output, labels or LabelMap(), compression, force, resume)


def _no_clouds(inputs: Sequence[Path]) -> bool:
    return any(file_kind(path) != "clouds" for path in inputs)


def _merge_shards(inputs: Sequence[Path], output: Path, force: bool, resume: bool) -> Report:
    there = output.exists() and not force
    join_shards(inputs, output, force=force, resume=resume)
    return count_samples(Report(was_complete=there), output)


def _merge_unlike(
    sources: list[Source], output: Path, labels: LabelMap, compression: str, force: bool, resume: bool
) -> Report:
    units = {source.length_unit: source.path for source in sources}
    if len(units) > 1:
        (a, one), (b, two), *_ = units.items()
        raise DataError(f"{two}: its length unit is {b!r}, of {one} it is {a!r}; convert to one unit (--scale) first")
    class_names, tables = labels.resolve([(source.path, source.class_names) for source in sources])
    fields = tuple(name for name in sources[0].fields if all(name in source.fields for source in sources))
    for name in sorted({name for source in sources for name in source.fields} - set(fields)):
        log.warn(f"{name}: left out, not all of the files have it")
    _refuse_equal_names(sources)
    chosen: list[tuple[Source, int, int | None]] = []
    skipped: list[tuple[str, str]] = []
    for source, table in zip(sources, tables):
        skipped += [(source.prefix + name, why) for name, why in source.skipped]
        for index, label in enumerate(source.labels):
            if label >= 0 and table[label] is None:
                why = f"class {source.class_names[label]!r} is left out by the label map"
                skipped.append((source.sample_name(index), why))
            else:
                chosen.append((source, index, table[label] if label >= 0 else -1))
    config = {
        "merge": [source.path.name for source in sources],
        "labels": asdict(labels),
        "prefix": any(source.prefix for source in sources),
        "compression": compression,
        "sources": [source.provenance for source in sources],
    }
    entry = record(config, 0, {f"{k}": source.path for k, source in enumerate(sources)})
    unit = sources[0].length_unit
    pattern = Source(path=output, class_names=class_names, length_unit=unit, made_by="merge", fields=fields)
    pattern.parts = max(source.parts for source in sources)
    copy = Copy(
        output=output,
        pattern=pattern,
        names=[source.sample_name(index) for source, index, _ in chosen],
        provenance=entry,
        task="prepare merge",
        skipped=skipped,
        compression=compression,
        force=force,
        resume=resume,
    )
    return _write_samples(copy, chosen)


def _refuse_equal_names(sources: list[Source]) -> None:
    seen: dict[str, Path] = {}
    for source in sources:
        for index in range(len(source.names)):
            own = source.sample_name(index)
            if own in seen:
                advice = "files and folders of one name" if source.prefix else "--prefix puts the file's name before it"
                raise DataError(
                    f"{source.path}: sample {own!r} is in {seen[own]} as well; names identify samples ({advice})"
                )
            seen[own] = source.path


def _write_samples(copy: Copy, samples: list[tuple[Source, int, int | None]]) -> Report:
    """Copies (file, index, new label or None for its own), or leaves a file as it is that was made of the same."""
    if not copy.force and already_made(copy.output, copy.provenance, CloudsReader):
        return count_samples(Report(was_complete=True), copy.output)
    files = OpenFiles()

    def read(place: int) -> CloudSequence:
        source, index, label = samples[place]
        return _relabel(files.read(source.path, index), source, copy.pattern, label)

    try:
        copy_samples(copy, read)
    finally:
        files.close()
    return count_samples(Report(), copy.output)


def _relabel(sequence: CloudSequence, source: Source, pattern: Source, label: int | None) -> CloudSequence:
    """Returns the sample as the joined file has it: its label, its name, as many parts, and no field that others lack."""
    if label is not None:
        sequence.label = label
    sequence.name = source.prefix + sequence.name
    for name in set(source.fields) - set(pattern.fields):
        sequence.without(name)
    sequence.pad_parts(pattern.parts)
    return sequence
