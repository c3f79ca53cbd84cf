"""Two predictions of the same samples, paired: how far apart each metric is, and whether chance could do that.

The difference of each metric is bootstrapped over samples that count equally often on both sides, so what makes a
sample hard for both cancels. Beside it stand tests with other assumptions: Wilcoxon's signed-rank test on the values of
single samples, and McNemar's exact test on what only one of two classifiers gets right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import Interval, Resampling, interval, replicates, snapped, two_sided_p
from dpcli.evaluate.classification.protocol import LeftOut, ends_json, intervals_json, listing, samples_json
from dpcli.evaluate.compare.sample_metrics import LOWER_IS_BETTER, Measured, Question, measure, measured_kind
from dpcli.runtime.seeds import generator

MOST_CHANGED = 10  # samples named
_EQUAL = 1e-12


@dataclass(frozen=True)
class Change:
    """One metric on both sides, in `unit`. difference = a - b; interval, p: of the paired bootstrap (two-sided).

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
        return self.a - self.b


@dataclass(frozen=True)
class McNemar:
    """Samples that only A, only B gets right, and the exact two-sided p value of "equally many" (McNemar 1947)."""

    only_a: int
    only_b: int
    p: float


@dataclass(frozen=True)
class Paired:
    """One task on both sides. changed: the samples that differ most in `changed_by`, (name, a, b), largest first."""

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
    """All tasks that the two files have in common."""

    sources: tuple[str, str]
    question: Question
    resampling: Resampling
    parts: list[Paired]
    provenance: tuple[list[dict], list[dict]]
    notes: list[str] = field(default_factory=list)


def evaluate_compare(
    first: Path, second: Path, question: Question, resampling: Resampling, sources: tuple[str, str] | None = None
) -> CompareReport:
    """Compare two scores files, or two parts files or videos with a truth. DataError where they aren't of the same samples."""
    sources = sources or (str(first), str(second))
    kinds = [measured_kind(path, source) for path, source in zip((first, second), sources, strict=True)]
    if kinds[0] != kinds[1]:
        raise DataError(f"{sources[0]}: {kinds[0]}, {sources[1]}: {kinds[1]}; nothing to compare")
    sides = [measure(path, source, question) for path, source in zip((first, second), sources, strict=True)]
    tasks = [{one.task: one for one in side} for side in sides]
    if not set(tasks[0]) & set(tasks[1]):
        raise DataError(f"{sources[0]} is for {min(tasks[0])}, {sources[1]} for {min(tasks[1])}: nothing to compare")
    parts = [
        pair(one, tasks[1][task], resampling, intersect=question.intersect)
        for task, one in tasks[0].items()
        if task in tasks[1]
    ]
    notes = [
        f"{task.capitalize()}: only {source} can be evaluated, so it isn't compared."
        for source, own, other in zip(sources, tasks, tasks[::-1], strict=True)
        for task in own
        if task not in other
    ]
    return CompareReport(sources, question, resampling, parts, (sides[0][0].provenance, sides[1][0].provenance), notes)


def compare_measured(
    a: Measured, b: Measured, resampling: Resampling, question: Question | None = None, *, intersect: bool = False
) -> CompareReport:
    """The report of two measured predictions, such as the tables of two videos that `of_values` takes."""
    part = pair(a, b, resampling, intersect=intersect)
    return CompareReport((a.source, b.source), question or Question(), resampling, [part], (a.provenance, b.provenance))


def pair(a: Measured, b: Measured, resampling: Resampling, *, intersect: bool = False) -> Paired:
    """Compare two measured predictions; tables of values come in by `of_values`.

    DataError when tasks, units or facts differ, when a sample isn't the same on both sides, or when the samples differ
    (with `intersect` the common ones are compared and the rest listed).
    """
    _same_facts(a, b)
    a, b, left_out = _same_samples(a, b, intersect)
    rng, keys = generator(resampling.seed), list(a.units)
    ones, found = np.ones((1, len(a.names))), {}
    if resampling.resamples and len(a.names) > 1:
        found = replicates(lambda counts: _differences(a, b, counts), len(a.names), rng, resampling.resamples)
    exact = [{key: float(side.metric(ones)[key][0]) for key in keys} for side in (a, b)]
    changes = {key: _change(key, a, b, (exact[0][key], exact[1][key]), found.get(key), resampling) for key in keys}
    by = next((key for key in ("accuracy", "miou", "epe3d", *keys) if key in a.alone and key in keys), "")
    values = (a.alone[by], b.alone[by]) if by else (np.zeros(0), np.zeros(0))
    return Paired(
        a.task, a.kind, a.names, changes, by, _most_changed(a.names, *values), _mcnemar(a, b), values, left_out
    )


def _differences(a: Measured, b: Measured, counts: np.ndarray) -> dict[str, np.ndarray]:
    first, second = a.metric(counts), b.metric(counts)
    return {key: first[key] - second[key] for key in a.units}


def _same_facts(a: Measured, b: Measured) -> None:
    if a.task != b.task:
        raise DataError(f"{a.source} is for {a.task}, {b.source} for {b.task}: nothing to compare")
    for what, one, other in (
        ("metrics", list(a.units), list(b.units)),
        *((f"unit of {key}", a.units[key], b.units.get(key)) for key in a.units),
        *((what, own, b.same.get(what)) for what, own in a.same.items()),
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


def _same_samples(a: Measured, b: Measured, intersect: bool) -> tuple[Measured, Measured, list[LeftOut]]:
    only_a, only_b = (
        [name for name in one.names if name not in set_of] for one, set_of in ((a, set(b.names)), (b, set(a.names)))
    )
    if (only_a or only_b) and not intersect:
        lacking, having, names = (b, a, only_a) if only_a else (a, b, only_b)
        raise DataError(
            f"{lacking.source}: has no {listing(names)}, which {having.source} has; --intersect compares what both have"
        )
    common = [name for name in a.names if name not in set(only_a)]
    if not common:
        raise DataError(f"{a.source} and {b.source} have not one of their {a.kind} in common")
    left_out = [
        *_once([*a.left_out, *b.left_out]),
        LeftOut(f"only in {a.source}", only_a),
        LeftOut(f"only in {b.source}", only_b),
    ]
    a, b = a.restricted(common), b.restricted(common)
    for what in a.of_sample:
        _same_of_samples(a, b, what)
    return a, b, [entry for entry in left_out if entry.names]


def _once(entries: Sequence[LeftOut]) -> list[LeftOut]:
    """Without what both sides leave out for the same reason."""
    kept: list[LeftOut] = []
    for entry in entries:
        if entry not in kept:
            kept.append(entry)
    return kept


def _same_of_samples(a: Measured, b: Measured, what: str) -> None:
    for name, one, other in zip(a.names, a.of_sample[what], b.of_sample[what], strict=True):
        if one != other:
            raise DataError(
                f"{what} of {name!r}: {_first_difference(one, other, a.source, b.source)}; "
                "predict both from the same file"
            )


def _change(
    key: str, a: Measured, b: Measured, exact: tuple[float, float], found: np.ndarray | None, resampling: Resampling
) -> Change:
    one, other = exact
    ends, p = Interval(np.nan, np.nan), float("nan")
    if found is not None:
        ends = interval(one - other, found, resampling.confidence)
        p = two_sided_p(snapped(found, one - other)) if ends.defined else p
    counts = _single(key, a, b) if key in a.alone else ()
    return Change(a.units[key], one, other, ends, p, *counts)


def _single(key: str, a: Measured, b: Measured) -> tuple[int, int, int, float]:
    """Samples where A, where B is better, ties, and Wilcoxon's p."""
    apart = a.alone[key] - b.alone[key]
    apart = apart[~np.isnan(apart)]
    apart = np.where(np.abs(apart) <= _EQUAL, 0.0, apart)
    more, less = int((apart > 0).sum()), int((apart < 0).sum())
    better, worse = (less, more) if key in LOWER_IS_BETTER else (more, less)
    return better, worse, len(apart) - more - less, _wilcoxon(apart)


def _wilcoxon(apart: np.ndarray) -> float:
    """p of the signed-rank test (Wilcoxon 1945), ties with zero left out; 1 where nothing differs, NaN of nothing."""
    if len(apart) == 0:
        return float("nan")
    apart = apart[apart != 0]
    if len(apart) == 0:
        return 1.0
    from scipy.stats import wilcoxon

    return float(wilcoxon(apart).pvalue)


def _mcnemar(a: Measured, b: Measured) -> McNemar | None:
    if a.right is None or b.right is None:
        return None
    return mcnemar(int((a.right & ~b.right).sum()), int((b.right & ~a.right).sum()))


def mcnemar(only_a: int, only_b: int) -> McNemar:
    """Exact test of the samples on which two classifiers disagree: binomial with share 1/2; p = 1 without any."""
    from scipy.stats import binomtest

    total = only_a + only_b
    return McNemar(only_a, only_b, float(binomtest(only_a, total, 0.5).pvalue) if total else 1.0)


def _most_changed(names: Sequence[str], a: np.ndarray, b: np.ndarray) -> list[tuple[str, float, float]]:
    apart = np.nan_to_num(np.abs(a - b))
    order = np.argsort(-apart, kind="stable")[:MOST_CHANGED]
    return [(names[row], float(a[row]), float(b[row])) for row in order if apart[row] > _EQUAL]


def compare_json(report: CompareReport) -> dict[str, Any]:
    """One object for `--json`; under `metrics`, for each metric both sides, a - b, its interval and the tests."""
    question, resampling, first = report.question, report.resampling, report.parts[0]
    changes = {key: change for part in report.parts for key, change in part.changes.items()}
    differences = {key: change.interval for key, change in changes.items()}
    return {
        "task": "compare",
        "input": list(report.sources),
        "protocol": {
            "compared": [part.task for part in report.parts],
            "name": question.protocol,
            "truth": str(question.truth) if question.truth else "labels in the files",
            "ignore_below": question.ignore_below,
            "difference": "first minus second, paired",
            "p": "two-sided, of the paired bootstrap",
            "wilcoxon_p": f"signed-rank test on the values of single {first.kind}",
            "lower_is_better": sorted(LOWER_IS_BETTER & set(changes)),
        },
        "metrics": {key: _change_json(change) for key, change in changes.items()},
        "intervals": intervals_json(
            resampling, first.kind, len(first.names), differences, "paired bootstrap, percentile"
        ),
        "mcnemar": None if first.mcnemar is None else vars(first.mcnemar),
        "most_changed": {
            part.changed_by: [{"name": name, "a": a, "b": b} for name, a, b in part.changed]
            for part in report.parts
            if part.changed_by
        },
        "samples": samples_json(first.kind, first.names),
        "units": {key: change.unit for key, change in changes.items()},
        "denominators": {part.task: {part.kind: len(part.names)} for part in report.parts},
        "left_out": [
            {"task": part.task, "reason": e.reason, "count": len(e.names), "names": e.names}
            for part in report.parts
            for e in part.left_out
        ],
        "notes": report.notes,
        "provenance": list(report.provenance),
    }


def _change_json(change: Change) -> dict[str, Any]:
    numbers = {"a": change.a, "b": change.b, "difference": change.difference, "p": change.p}
    shown = {key: None if np.isnan(value) else value for key, value in numbers.items()}
    counts = {key: getattr(change, key) for key in ("a_better", "b_better", "ties")}
    wilcoxon = change.wilcoxon_p
    return shown | {
        "interval": ends_json({"": change.interval})[""],
        **counts,
        "wilcoxon_p": None if wilcoxon is None or np.isnan(wilcoxon) else wilcoxon,
    }
