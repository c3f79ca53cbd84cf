"""One clouds file into its splits, or into the same file with other splits."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.prepare.commands.copy_samples import copy_samples
from dpcli.prepare.commands.sources import open_source, warn_of_others
from dpcli.prepare.name_tables import places_of, read_rows, warn_of_splits
from dpcli.prepare.reader import SPLITS, split_called
from dpcli.runtime.provenance import record
from dpcli.runtime.seeds import PrepareStream, generator
from dpcli.runtime.whole_file import make_folder
from dpcli.standard_streams import printable
from dpcli.store import CloudSequence, CloudsReader
from dpcli.store.pipes import check_output
from dpcli.store.writing.already_made import already_made


@dataclass(frozen=True)
class SplitChoice:
    """Says how samples are divided: one of the three ways, or none, which keeps the splits that the file tells.

    subjects: per split the subject numbers, `{"train": (1, 3)}`; others are test. listed: a CSV `name,split`.
    fractions: of train, validation and test, drawn from `seed`; stratify: each class in these fractions; by_subject:
    all samples of a subject fall into one split.
    """

    subjects: dict[str, tuple[int, ...]] | None = None
    listed: Path | None = None
    fractions: tuple[float, float, float] | None = None
    stratify: bool = True
    by_subject: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        ways = [way for way in (self.subjects, self.listed, self.fractions) if way is not None]
        if len(ways) > 1:
            raise UsageError("--list, --train-subjects and --fractions were given together; use one")
        if self.fractions is not None:
            low, total = min(self.fractions), sum(self.fractions)
            if not (low >= 0 and abs(total - 1) <= 1e-6):  # NaN, too
                raise UsageError(f"--fractions {self.fractions}: expected three numbers from 0 that sum to 1")

    def assign(self, source: CloudsReader) -> list[str]:
        """Returns the split of each sample, "" for those that go nowhere.

        Raises DataError when the file lacks what is asked for.
        """
        splits, subjects = source.splits, source.subjects.tolist()
        if self.listed is not None:
            return splits_by_list(source, self.listed)
        if self.subjects is not None:
            return splits_by_subject(source, self.subjects)
        if self.fractions is not None:
            if self.by_subject and min(subjects) < 0:
                raise DataError(
                    f"{source.path}: --by-subject: subjects are not known of all samples; `dpc prepare ... --labels FILE.csv`"
                    " takes them from a column subject"
                )
            groups = subjects if self.by_subject else list(range(len(splits)))
            strata = source.labels.tolist() if self.stratify and not self.by_subject else [0] * len(splits)
            return draw_splits(groups, strata, self.fractions, self.seed)
        if not any(splits):
            raise DataError(f"{source.path}: has no splits; choose --list, --train-subjects or --fractions")
        return list(splits)


def splits_by_list(source: CloudsReader, path: Path) -> list[str]:
    """Returns splits from a table of name,split as `read_rows` reads it, with or without that header, those of ours in any
    spelling. Raises DataError for names of samples that are not there.
    """
    rows = read_rows(path, "split")
    places = places_of(path, rows, source.names)
    chosen = {places[written]: split_called(row["split"]) or row["split"] for written, row in rows.items()}
    warn_of_splits(path, chosen.values())
    return [chosen.get(name, "") for name in source.names]


def splits_by_subject(source: CloudsReader, wanted: dict[str, tuple[int, ...]]) -> list[str]:
    """Returns the named subjects' splits, test for the others.

    Raises DataError for an unknown subject, UsageError for two splits.
    """
    where: dict[int, str] = {}
    for split, numbers in wanted.items():
        for number in numbers:
            if where.setdefault(number, split) != split:
                raise UsageError(f"subject {number} is to be {where[number]} and {split}")
    subjects = source.subjects.tolist()
    absent = sorted(set(where) - set(subjects))
    if absent or -1 in subjects:
        found = ",".join(map(str, sorted(set(subjects) - {-1}))) or "none"
        what = f"subject {absent[0]} is not there" if absent else "the subject of some samples is unknown"
        raise DataError(f"{source.path}: {what}; subjects of the file: {found}")
    return [where.get(subject, "test") for subject in subjects]


def draw_splits(
    groups: Sequence[int], strata: Sequence[int], fractions: tuple[float, float, float], seed: int
) -> list[str]:
    """Draws a split per sample: equal `groups` stay together, each of `strata` is divided in these fractions.

    Of n groups in a stratum each split gets its share rounded down; the rest goes to the splits that lag most behind
    their share of all so far. The draw depends on the seed and the strata alone.
    """
    members: dict[int, list[int]] = defaultdict(list)
    for group, stratum in dict(zip(groups, strata)).items():
        members[stratum].append(group)
    share, given, where = np.array(fractions), np.zeros(3), {}
    for stratum in sorted(members):
        own = members[stratum]
        sizes = np.floor(share * len(own) + 1e-9).astype(int)
        while sizes.sum() < len(own):
            lag = np.where(share > 0, share * (given.sum() + len(own)) - given - sizes, -np.inf)
            sizes[int(lag.argmax())] += 1
        given += sizes
        order = generator(seed, PrepareStream.SPLIT, stratum + 1).permutation(len(own))
        for name, places in zip(SPLITS, np.split(order, np.cumsum(sizes)[:2])):
            where |= {own[k]: name for k in places}
    return [where[group] for group in groups]


def split(
    path: Path, output: Path, choice: SplitChoice, *, compression: str = "none", force: bool = False
) -> dict[str, int]:
    """Writes `output/SPLIT.h5` for each split, or, when `output` ends in .h5, one file whose samples have new splits.

    -> samples of each split; "" counts those in none, which are named in the file when `output` is one. Streams;
    stopped or killed, it goes on from the last sample when run again.
    """
    with open_source(path) as source:
        warn_of_others(source)
        splits = choice.assign(source)
        counts = {name: splits.count(name) for name in dict.fromkeys((*SPLITS, *splits)) if name in splits}
        said = {key: str(value) if isinstance(value, Path) else value for key, value in asdict(choice).items()}
        inputs = {"clouds": path, **({"list": choice.listed} if choice.listed else {})}
        entry = record({"split": said, "compression": compression}, choice.seed, inputs)
        if output.suffix.lower() in (".h5", ".hdf5"):
            wanted = [name for name in counts if name]
            _write_split(source, splits, wanted, output, entry, compression, force)
            return counts
        make_folder(output)
        for name in filter(None, counts):
            part = {**entry, "config": {**entry["config"], "part": name}}
            _write_split(source, splits, [name], output / f"{_file_name(name)}.h5", part, compression, force)
    return counts


def _file_name(split_name: str) -> str:
    if "/" in split_name or split_name.startswith(".") or printable(split_name) != split_name or len(split_name) > 60:
        raise DataError(f"split {split_name[:80]!r} can't be a file name; -o FILE.h5 writes all into one file")
    return split_name


def _write_split(
    source: CloudsReader,
    splits: list[str],
    wanted: list[str],
    output: Path,
    entry: dict[str, Any],
    compression: str,
    force: bool,
) -> None:
    """Copies the samples of the wanted splits, or leaves a file as it is that was made the same way: `entry` says how."""
    check_output(output, "-o", [source.path])
    if not force and already_made(output, entry, CloudsReader):
        return
    chosen = [index for index, name in enumerate(splits) if name in wanted]

    def read(place: int) -> CloudSequence:
        sequence = source.read(chosen[place])
        sequence.split = splits[chosen[place]]
        return sequence

    copy_samples(
        output,
        [source.names[index] for index in chosen],
        read,
        task=f"prepare split {output.stem}",
        skipped=source.skipped,
        where=f" of {output}",
        provenance=[*source.provenance, entry],
        compression=compression,
        force=force,
        resume=True,
        class_names=source.class_names,
        length_unit=source.length_unit,
        source=str(source.attributes.get("source", "")),
        seed=int(source.attributes.get("seed", 0)),
        fields=source.fields,
    )
