"""Two predictions of the same samples, paired: how far apart each metric is, and whether chance could do that.

The difference of each metric is bootstrapped over samples that count equally often on both sides, so what makes a
sample hard for both cancels. Beside it stand tests with other assumptions: Wilcoxon's signed-rank test on the values of
single samples, and McNemar's exact test on what only one of two classifiers gets right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import FEW, TOO_FEW, Interval, Resampling, interval, replicates, snapped, two_sided_p
from dpcli.evaluate.choices import LOWER_IS_BETTER
from dpcli.evaluate.compare.file_metrics import EvaluationOptions, FileMetrics
from dpcli.evaluate.compare.measure_file import kind_of_file, measure_file
from dpcli.evaluate.compare.significance_tests import McNemar, mcnemar, wilcoxon_signed_rank
from dpcli.evaluate.results import LeftOut, left_out, list_names
from dpcli.runtime.seeds import generator

MOST_CHANGED = 10  # samples named
_EQUAL = 1e-12


@dataclass(frozen=True)
class Change:
    """Holds one metric on both sides, in `unit`. difference = a - b; interval, p: of the paired bootstrap (two-sided).

    a_better, b_better, ties: samples; wilcoxon_p: of their differences; None where single samples have no value. NaN =
    undefined.
    """

    unit: str
    a: float
    b: float
    interval: Interval
    p: float
    a_better: int | None = None
    b_better: int | None = None
    ties: int | None = None
    wilcoxon_p: float | None = None

    @property
    def difference(self) -> float:
        """Returns the value of A less that of B, in `unit`; 0 where they differ by rounding, as sums in another order do."""
        return _difference(self.a, self.b)


def _difference(a: float, b: float) -> float:
    return 0.0 if abs(a - b) <= _EQUAL * max(1.0, abs(a)) else a - b


@dataclass(frozen=True)
class Paired:
    """Holds one task on both sides. changed: the samples that differ most in `changed_by`, (name, a, b), largest first."""

    task: str
    kind: str
    names: list[str]
    changes: dict[str, Change]
    changed_by: str
    changed: list[tuple[str, float, float]]
    mcnemar: McNemar | None
    values: tuple[np.ndarray, np.ndarray]
    left_out: list[LeftOut]


@dataclass(frozen=True)
class CompareReport:
    """Holds all tasks that the two files have in common."""

    sources: tuple[str, str]
    options: EvaluationOptions
    resampling: Resampling
    parts: list[Paired]
    provenance: tuple[list[dict], list[dict]]
    notes: list[str] = field(default_factory=list)


def evaluate_compare(
    first: Path, second: Path, options: EvaluationOptions, resampling: Resampling, sources: tuple[str, str]
) -> CompareReport:
    """Compares two scores files, parts files or videos with a truth. Raises DataError where they aren't of the same samples.

    sources: how the files were named, for messages.
    """
    kinds = [kind_of_file(path, source) for path, source in zip((first, second), sources, strict=True)]
    if kinds[0] != kinds[1]:
        raise DataError(f"{sources[0]}: {kinds[0]}, {sources[1]}: {kinds[1]}; nothing to compare")
    sides = [measure_file(path, source, options) for path, source in zip((first, second), sources, strict=True)]
    tasks = [{one.task: one for one in side} for side in sides]
    if not set(tasks[0]) & set(tasks[1]):
        raise DataError(f"{sources[0]} is for {min(tasks[0])}, {sources[1]} for {min(tasks[1])}: nothing to compare")
    parts = [
        pair_metrics(one, tasks[1][task], resampling, intersect=options.intersect)
        for task, one in tasks[0].items()
        if task in tasks[1]
    ]
    notes = ["A and B are the same file, so nothing can differ."] if first.samefile(second) else []
    notes += [
        f"{task.capitalize()}: only {source} can be evaluated, so it isn't compared."
        for source, own, other in zip(sources, tasks, tasks[::-1], strict=True)
        for task in own
        if task not in other
    ]
    notes += [f"{letter}: {note}" for letter, side in zip("AB", sides) for one in side for note in one.notes]
    notes += _few_samples(parts[0], resampling)
    return CompareReport(sources, options, resampling, parts, (sides[0][0].provenance, sides[1][0].provenance), notes)


def _few_samples(part: Paired, resampling: Resampling) -> list[str]:
    """Returns a sentence where so few samples were resampled that the bootstrap makes p too small, else none."""
    count = len(part.names)
    if not resampling.resamples or not 2 <= count < FEW:
        return []
    return [
        f"{count} {part.kind} are few for a bootstrap: its intervals are too narrow and its p too small. {TOO_FEW} "
        f"Wilcoxon's p can't be below {2 / 2**count:.2g} here."
    ]


def pair_metrics(a: FileMetrics, b: FileMetrics, resampling: Resampling, *, intersect: bool = False) -> Paired:
    """Compares the metrics of two predictions of one task.

    Raises DataError when tasks, units or facts differ, when a sample isn't the same on both sides, or when the samples differ
    (with `intersect` the common ones are compared and the rest listed).
    """
    _check_facts(a, b)
    a, b, others = _common_samples(a, b, intersect)
    rng, keys, found = generator(resampling.seed), list(a.units), {}
    if resampling.resamples and len(a.names) > 1:
        found = replicates(lambda counts: _differences(a, b, counts), len(a.names), rng, resampling.resamples)
    ours, theirs = a.values(), b.values()
    changes = {key: _change(key, a, b, (ours[key], theirs[key]), found.get(key), resampling) for key in keys}
    by = next((key for key in ("accuracy", "miou", "epe3d", *keys) if key in a.per_sample and key in keys), "")
    values = (a.per_sample[by], b.per_sample[by]) if by else (np.zeros(0), np.zeros(0))
    return Paired(a.task, a.kind, a.names, changes, by, _most_changed(a.names, *values), _mcnemar(a, b), values, others)


def _differences(a: FileMetrics, b: FileMetrics, counts: np.ndarray) -> dict[str, np.ndarray]:
    first, second = a.metric(counts), b.metric(counts)
    return {key: first[key] - second[key] for key in a.units}


def _check_facts(a: FileMetrics, b: FileMetrics) -> None:
    if a.task != b.task:
        raise DataError(f"{a.source} is for {a.task}, {b.source} for {b.task}: nothing to compare")
    for what, one, other in (
        ("metrics", list(a.units), list(b.units)),
        *((f"unit of {key}", a.units[key], b.units.get(key)) for key in a.units),
        *((what, own, b.must_equal.get(what)) for what, own in a.must_equal.items()),
    ):
        if one != other:
            raise DataError(f"{what}: {_first_difference(one, other, a.source, b.source)}; they can't be compared")


def _first_difference(one: object, other: object, source: str, another: str) -> str:
    if isinstance(one, list) and isinstance(other, list):
        if len(one) != len(other):
            return f"{len(one)} in {source}, {len(other)} in {another}"
        row = next(index for index, (x, y) in enumerate(zip(one, other, strict=True)) if x != y)
        return f"number {row} is {one[row]!r} in {source}, {other[row]!r} in {another}"
    return f"{one!r} in {source}, {other!r} in {another}"


def _common_samples(a: FileMetrics, b: FileMetrics, intersect: bool) -> tuple[FileMetrics, FileMetrics, list[LeftOut]]:
    only_a, only_b = (
        [name for name in one.names if name not in set_of] for one, set_of in ((a, set(b.names)), (b, set(a.names)))
    )
    if (only_a or only_b) and not intersect:
        lacking, having, names = (b, a, only_a) if only_a else (a, b, only_b)
        raise DataError(
            f"{lacking.source}: has no {list_names(names)}, which {having.source} has; --intersect compares what both have"
        )
    common = [name for name in a.names if name not in set(only_a)]
    if not common:
        raise DataError(f"{a.source} and {b.source} have not one of their {a.kind} in common")
    one_sided = {*only_a, *only_b}  # the side that lacks them leaves them out, too
    told = [
        LeftOut(entry.reason, [name for name in entry.names if name not in one_sided])
        for entry in (*a.left_out, *b.left_out)
    ]
    others = [entry for entry in _without_repeats(told) if entry.names]
    others += left_out({f"only in {a.source}": only_a, f"only in {b.source}": only_b})
    a, b = a.restricted(common), b.restricted(common)
    for what in a.must_equal_by_sample:
        _check_facts_of_samples(a, b, what)
    return a, b, others


def _without_repeats(entries: Sequence[LeftOut]) -> list[LeftOut]:
    """Returns the entries, one of each where both sides leave out the same for the same reason."""
    kept: list[LeftOut] = []
    for entry in entries:
        if entry not in kept:
            kept.append(entry)
    return kept


def _check_facts_of_samples(a: FileMetrics, b: FileMetrics, what: str) -> None:
    for name, one, other in zip(a.names, a.must_equal_by_sample[what], b.must_equal_by_sample[what], strict=True):
        if one != other:
            raise DataError(
                f"{what} of {name!r}: {_first_difference(one, other, a.source, b.source)}; "
                "predict both from the same file"
            )


def _change(
    key: str,
    a: FileMetrics,
    b: FileMetrics,
    exact: tuple[float, float],
    found: np.ndarray | None,
    resampling: Resampling,
) -> Change:
    one, other = exact
    ends, p = Interval(np.nan, np.nan), float("nan")
    if found is not None:
        apart = _difference(one, other)
        ends = interval(apart, found, resampling.confidence)
        p = two_sided_p(snapped(found, apart)) if ends.defined else p
    counts = _compare_samples(key, a, b) if key in a.per_sample else ()
    return Change(a.units[key], one, other, ends, p, *counts)


def _compare_samples(key: str, a: FileMetrics, b: FileMetrics) -> tuple[int, int, int, float]:
    """Returns the samples where A, where B is better, ties, and Wilcoxon's p."""
    apart = a.per_sample[key] - b.per_sample[key]
    apart = apart[~np.isnan(apart)]
    apart = np.where(np.abs(apart) <= _EQUAL, 0.0, apart)
    more, less = int((apart > 0).sum()), int((apart < 0).sum())
    better, worse = (less, more) if key in LOWER_IS_BETTER else (more, less)
    return better, worse, len(apart) - more - less, wilcoxon_signed_rank(apart)


def _mcnemar(a: FileMetrics, b: FileMetrics) -> McNemar | None:
    if a.correct is None or b.correct is None:
        return None
    return mcnemar(int((a.correct & ~b.correct).sum()), int((b.correct & ~a.correct).sum()))


def _most_changed(names: Sequence[str], a: np.ndarray, b: np.ndarray) -> list[tuple[str, float, float]]:
    apart = np.nan_to_num(np.abs(a - b))
    order = np.argsort(-apart, kind="stable")[:MOST_CHANGED]
    return [(names[row], float(a[row]), float(b[row])) for row in order if apart[row] > _EQUAL]
