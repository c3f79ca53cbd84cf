"""Results of `dpc evaluate`, whatever was evaluated: samples left out, intervals, tables, one JSON object."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import Interval, Resampling
from dpcli.evaluate.text_tables import TextTable
from dpcli.path_names import first_names
from dpcli.runtime.progress import log

_NAMES_IN_NOTE = 10
_SAID: set[str] = set()
KEPT_STATISTICS = (
    "statistics that an evaluation kept; `dpc evaluate segmentation FILE --json` (or motion) makes the result of them that"
    " `runs` and `report` take, `compare` needs the parts files"
)
Statistics, Measured = TypeVar("Statistics"), TypeVar("Measured")


@dataclass
class LeftOut:
    """Holds samples of a file that don't count: `reason` says why, `names` which."""

    reason: str
    names: list[str]


def left_out(names_by_reason: Mapping[str, list[str]]) -> list[LeftOut]:
    """Returns an entry for each reason for which samples don't count."""
    return [LeftOut(reason, names) for reason, names in names_by_reason.items() if names]


@dataclass(frozen=True)
class Result:
    """Holds what a command found, in both forms it can be printed in.

    data: the object of `--json`. tables, notes: the same for a person. incomplete: why something that was asked for is
    missing, "" when nothing is; the command then ends with exit code 3 after it printed the rest.
    """

    data: dict[str, Any]
    tables: list[TextTable] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    incomplete: str = ""


@dataclass(kw_only=True)
class Report:
    """Holds what the evaluation of some samples says beside its metrics.

    names: the samples that count. truth: what they were compared with. intervals: by metric, empty without `resampling`.
    provenance: that of the predictions.
    """

    names: list[str]
    truth: str
    resampling: Resampling
    intervals: dict[str, Interval]
    left_out: list[LeftOut]
    provenance: list[dict]


def merge_statistics(parts: Iterable[Statistics]) -> Statistics:
    """Returns the statistics of all parts together: arrays one after the other, numbers summed. Raises DataError without parts."""
    parts = list(parts)
    if not parts:
        raise DataError("no statistics to merge: nothing was evaluated")
    columns = {own.name: [getattr(part, own.name) for part in parts] for own in fields(parts[0])}
    return type(parts[0])(
        **{key: np.concatenate(rows) if isinstance(rows[0], np.ndarray) else sum(rows) for key, rows in columns.items()}
    )


def measure_by_class(
    labels: Sequence[int], rows: Sequence[Statistics], measure: Callable[[list[Statistics]], Measured]
) -> dict[int, Measured]:
    """Returns what `measure` makes of the samples of each label that occurs; those without a label (-1) are in none.

    >>> measure_by_class([2, 0, -1, 2], [10, 20, 30, 40], sum)
    {0: 20, 2: 50}
    """
    members: dict[int, list[Statistics]] = {}
    for label, row in zip(labels, rows, strict=True):
        if label >= 0:
            members.setdefault(label, []).append(row)
    return {label: measure(members[label]) for label in sorted(members)}


def class_rows_json(rows: Mapping[int, dict[str, Any]], names: Sequence[str]) -> list[dict[str, Any]]:
    """Returns the values of each label as an object for `--json`, with the label and its name, "" where it has none."""
    return [
        {"label": label, "name": names[label] if label < len(names) else "", **values} for label, values in rows.items()
    ]


def counted_split(split: str | None, splits: Sequence[str]) -> str:
    """Returns the split whose samples count: the one asked for, else "test" where a sample is of it, else "all".

    splits: the split of each sample.
    """
    return split or ("test" if "test" in splits else "all")


def tell_split(path: str | Path, split: str | None, splits: Sequence[str]) -> None:
    """Warns where no split was asked for and no sample is of "test", so that those of "train" count, beside others."""
    if split is None and "test" not in splits and {"train"} < {*splits}:
        found = list_names(sorted({*splits} - {"train"}))
        with log.each_once(_SAID):  # segmentation and motion of a file may both be evaluated, beside another file's
            log.warn(
                f"{path}: no split is called 'test', so all samples count, those of 'train', too; there are {found} (--split)"
            )


def list_names(names: Sequence[str]) -> str:
    """Returns a few names in quotes, and how many more there are.

    >>> list_names(["a", "b"])
    "'a', 'b'"
    >>> list_names([str(number) for number in range(7)])
    "'0', '1', '2', '3', '4' and 2 more"
    """
    return first_names([repr(name) for name in names])


def left_out_note(entry: LeftOut, kind: str = "", *, named: bool = True) -> str:
    """Returns a sentence of how many samples (of `kind`, a noun in the singular) were left out and why, with a few names if `named`."""
    shown = first_names(entry.names, _NAMES_IN_NOTE)
    count = counted(len(entry.names), kind) if kind else str(len(entry.names))
    return f"Left out, {entry.reason}: {count}{f' ({shown})' if named else ''}."


def left_out_json(entries: Sequence[LeftOut]) -> list[dict[str, Any]]:
    """Returns the entries as `--json` prints them: reason, count and names."""
    return [{"reason": entry.reason, "count": len(entry.names), "names": entry.names} for entry in entries]


def none_if_nan(value: float) -> float | None:
    """Returns the number, or None where it is NaN (undefined): JSON has no NaN."""
    return None if np.isnan(value) else float(value)


def report_json(
    task: str,
    source: str,
    report: Report,
    kind: str,
    *,
    protocol: Mapping[str, Any],
    metrics: Mapping[str, Any],
    units: Mapping[str, str],
    denominators: Mapping[str, Any],
) -> dict[str, Any]:
    """Returns the object of `--json` of a report.

    source: the file, as it was named. kind: what the report's names are, and what was resampled.
    """
    return {
        "task": task,
        "input": source,
        "protocol": protocol,
        "metrics": metrics,
        "intervals": intervals_json(report.resampling, kind, len(report.names), report.intervals),
        "samples": samples_json(kind, report.names),
        "units": units,
        "denominators": denominators,
        "left_out": left_out_json(report.left_out),
        "provenance": report.provenance,
    }


def intervals_json(
    resampling: Resampling, of: str, number: int, intervals: Mapping[str, Interval], method: str = "bootstrap, BCa"
) -> dict[str, Any]:
    """Returns how intervals were found and, under `metrics`, the two ends of each; None = undefined.

    of: what was resampled, in words (samples, sequences, views). number: how many of them there are.
    """
    if not resampling.resamples:
        return {"resamples": 0, "metrics": {}}
    return {
        "method": method,
        "confidence": resampling.confidence,
        "resamples": resampling.resamples,
        "seed": resampling.seed,
        "resampled": of,
        "number": number,
        "metrics": ends_json(intervals),
    }


def ends_json(intervals: Mapping[str, Interval]) -> dict[str, list[float] | None]:
    """Returns [low, high] by metric; None = undefined."""
    return {key: [own.low, own.high] if own.defined else None for key, own in intervals.items()}


def samples_json(kind: str, names: Sequence[str]) -> dict[str, Any]:
    """Returns what tells whether two results are of the same samples: their number, and a digest of the sorted names."""
    digest = hashlib.sha256("\0".join(sorted(names)).encode()).hexdigest()
    return {"kind": kind, "number": len(names), "names_sha256": digest}
