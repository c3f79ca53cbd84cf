"""The pass of an evaluation over the sequences of a parts file: spread over processes and machines, and kept in a file."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.choices import PARTS_PROTOCOLS
from dpcli.evaluate.results import LeftOut
from dpcli.evaluate.segmentation.truth_pairing import PairedSequences, SequencePair
from dpcli.runtime.machines.shards import describe_shard
from dpcli.runtime.machines.spread import ALONE, Spread
from dpcli.runtime.progress import log
from dpcli.runtime.provenance import record
from dpcli.store.file import file_kind
from dpcli.store.statistics import StatisticsReader, StatisticsWriter
from dpcli.store.writing.already_made import WORK, already_made
from dpcli.store.writing.item_pass import ItemPass, Wording, skipped_lines

Statistics = TypeVar("Statistics")
Measure = Callable[[SequencePair], dict[str, Any]]

_CHOICES = {"left_out", "protocol", "split", "truth"}  # that a kept evaluation was counted with


@dataclass(frozen=True)
class Keeping:
    """Says who evaluates which sequences, and the file in which what they counted is kept, None for no file."""

    output: Path | None = None
    spread: Spread = ALONE
    force: bool = False

    def __post_init__(self) -> None:
        if self.spread.shard and self.output is None:
            raise UsageError(
                f"--shard {self.spread.shard}: -o FILE is missing; its statistics are merged with those of the other shards"
            )


NOT_KEPT = Keeping()


@dataclass(frozen=True)
class Counted:
    """Holds what was counted: the evaluation's choices and facts, and for each sequence its name and values.

    provenance: that of the parts file.
    """

    about: dict[str, Any]
    provenance: list[dict[str, Any]]
    class_names: list[str]
    length_unit: str
    names: list[str]
    rows: list[dict[str, Any]]

    @property
    def left_out(self) -> list[LeftOut]:
        """Returns the samples that don't count."""
        return [LeftOut(reason, names) for reason, names in self.about["left_out"]]

    def facts(self) -> dict[str, Any]:
        """Returns what reports of segmentation and of motion say alike of how the sequences were counted."""
        choices = {key: self.about[key] for key in ("protocol", "split", "truth")}
        return {**choices, "class_names": self.class_names, "provenance": self.provenance}


def statistics_of(kind: type[Statistics], rows: Iterable[dict[str, Any]], path: str | Path) -> list[Statistics]:
    """Returns the statistics of sequences, of a dataclass, from their rows. Raises DataError where a kept file has other fields."""
    try:
        return [kind(**row["statistics"]) for row in rows]
    except TypeError:
        raise DataError(f"{path}: counted by another version of dpc; name the parts file to count again") from None


def read_counted(
    path: str | Path, task: str, asked: dict[str, Any], truth: str | Path | None, keeping: Keeping
) -> Counted | None:
    """Returns what a statistics file holds, None where `path` is another kind.

    asked: the choices that the user named, None for those that weren't; truth: the file, if it was named. Raises DataError
    where the file is of another task, UsageError where it was counted in another way than asked for.
    """
    if file_kind(path) != "statistics":
        return None
    if keeping.output is not None:
        raise UsageError(f"-o {keeping.output}: {path} holds counts already; leave -o out, or name the parts file")
    reader = StatisticsReader(path)
    about = reader.provenance[-1].get("config", {})
    if about.get("task") != task or "shard" in about:
        what = (
            f"shard {about['shard']} of an evaluation" if "shard" in about else f"an evaluation of {about.get('task')}"
        )
        raise DataError(f"{path}: holds {what}, expected the whole of one of {task}; dpc prepare merge joins shards")
    if missing := _CHOICES - about.keys():
        raise DataError(
            f"{path}: its provenance lacks {', '.join(sorted(missing))}; name the parts file to count again"
        )
    if about["protocol"] not in PARTS_PROTOCOLS:
        raise DataError(
            f"{path}: was counted by protocol {about['protocol']!r}, expected {' or '.join(PARTS_PROTOCOLS)}; "
            "name the parts file to count again"
        )
    kept = {**about, "truth": Path(about["truth"]).name}
    for key, value in {**asked, "truth": truth and Path(truth).name}.items():
        if value is not None and value != kept.get(key):
            raise UsageError(
                f"--{key.replace('_', '-')} {value}: {path} was counted with {kept.get(key)!r}; name the parts file to count again"
            )
    return _counted(reader)


def count_sequences(paired: PairedSequences, measure: Measure, about: dict[str, Any], keeping: Keeping) -> Counted:
    """Returns what `measure`, which must be picklable, counts of every sequence that counts, or of a shard of them.

    about: the choices behind the numbers. With a file a stopped or killed evaluation goes on; raises UsageError when the
    file holds something else, and Stopped after a stop signal.
    """
    with tempfile.TemporaryDirectory(prefix="dpc-") as folder:
        kept = keeping.output is not None
        target = keeping.output if keeping.output is not None else Path(folder) / "statistics.h5"
        left_out = [[entry.reason, entry.names] for entry in paired.left_out]
        about = {**about, "split": paired.split, "truth": str(paired.truth.path), "left_out": left_out}
        inputs = {"parts": paired.predicted.path, "truth": paired.truth.path} if kept else None
        entry = describe_shard(record(about, 0, inputs), keeping.spread.shard)
        if not kept or keeping.force or not already_made(target, entry, StatisticsReader, WORK):
            with StatisticsWriter(
                target,
                class_names=paired.truth.class_names,
                length_unit=paired.truth.length_unit,
                source=paired.predicted.path.name,
                provenance=[*paired.predicted.provenance, entry],
                force=keeping.force,
                resume=kept,
            ) as writer:
                _run(paired, measure, writer, keeping.spread)
        return _counted(StatisticsReader(target))


def _run(paired: PairedSequences, measure: Measure, writer: StatisticsWriter, spread: Spread) -> None:
    names = [paired.predicted.names[own] for own, _ in paired.rows]

    def write(place: int, values: dict[str, Any]) -> dict[str, float]:
        writer.write(names[place], values)
        return {}

    taken = ItemPass(writer, names, Wording("evaluate", "sequence", "evaluated"), spread.shard)
    with spread.workers() as workers:
        taken.run(measure, paired.pair, write, workers)


def _counted(reader: StatisticsReader) -> Counted:
    for line in skipped_lines(reader.skipped):
        log.warn(line)
    *provenance, own = reader.provenance
    about = own["config"]
    about["left_out"] = [*about["left_out"], *([reason, [name]] for name, reason in reader.skipped)]
    rows = [reader.read(index) for index in range(len(reader.names))]
    return Counted(about, provenance, reader.class_names, reader.length_unit, reader.names, rows)
