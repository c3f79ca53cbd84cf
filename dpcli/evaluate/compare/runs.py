"""Several runs of one experiment (seeds): each run's metrics, their mean, standard deviation and t interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.bootstrap import Interval
from dpcli.evaluate.compare.file_metrics import EvaluationOptions, FileMetrics, history_seed
from dpcli.evaluate.compare.measure_file import measure_file
from dpcli.evaluate.results import LeftOut, left_out_note, samples_json
from dpcli.evaluate.video.sources.open_source import is_media
from dpcli.store.file import is_hdf5
from dpcli.text_files import parse_json, read_text

_OPTIONAL = {"samples": dict, "denominators": dict, "notes": list, "left_out": list}
_COUNTS = ("samples", "sequences", "views", "frames", "videos")  # denominators that a prediction doesn't change


@dataclass(frozen=True)
class Run:
    """Holds the metrics of one run, None = undefined; `identity`: what must be equal in all runs, most telling first;
    `notes`: on how it was evaluated, and what was left out; `seed`: of its training, None where nothing says it.
    """

    title: str
    source: str
    task: str
    metrics: dict[str, float | None]
    units: dict[str, str]
    identity: dict[str, Any]
    notes: list[str] = field(default_factory=list)
    seed: int | None = None


@dataclass(frozen=True)
class Spread:
    """Holds over runs the mean, standard deviation (n - 1 in the denominator) and t interval of the mean; NaN = undefined."""

    mean: float
    sd: float
    interval: Interval


@dataclass(frozen=True)
class RunsReport:
    """Holds runs of one task on the same samples: `number` of `kind` ("" where the files don't say)."""

    task: str
    runs: list[Run]
    units: dict[str, str]
    confidence: float
    kind: str
    number: int

    @property
    def notes(self) -> list[str]:
        """Returns what is to know of the runs: of all of them together where all say the same, and which may be one run twice."""
        shared = [
            note for note in self.runs[0].notes if len(self.runs) > 1 and all(note in run.notes for run in self.runs)
        ]
        own = [f"{run.title}: {note}" for run in self.runs for note in run.notes if note not in shared]
        return [*(f"All runs: {note}" for note in shared), *own, *_repeated(self.runs)]

    @property
    def spreads(self) -> dict[str, Spread]:
        """Returns the spread over runs of each metric; undefined where a run has no number."""
        columns = {key: [run.metrics[key] for run in self.runs] for key in self.units}
        return {
            key: mean_with_t_interval(
                [math.nan if v is None else v for v in column], self.confidence, self.units[key] == "fraction"
            )
            for key, column in columns.items()
        }


def mean_with_t_interval(values: Sequence[float], confidence: float = 0.95, share: bool = False) -> Spread:
    """Returns mean, standard deviation (ddof 1) and Student's t interval of the mean of independent runs.

    share: the interval of values from 0 to 1 ends there, as their mean does. One run has no deviation and no interval.

    >>> found = mean_with_t_interval([0.8, 0.9, 1.0])
    >>> round(found.mean, 3), round(found.sd, 3), round(found.interval.low, 3), round(found.interval.high, 3)
    (0.9, 0.1, 0.652, 1.148)
    """
    column = np.asarray(values, np.float64)
    mean = float(column.mean())
    if len(column) < 2:
        return Spread(mean, math.nan, Interval(math.nan, math.nan))
    from scipy.special import stdtrit

    sd = float(column.std(ddof=1))
    half = float(stdtrit(len(column) - 1, (1 + confidence) / 2)) * sd / math.sqrt(len(column))
    ends = np.array([mean - half, mean + half])
    if share and 0 <= column.min() and column.max() <= 1:
        ends = ends.clip(0, 1)
    return Spread(mean, sd, Interval(*map(float, ends)))


def evaluate_runs(
    paths: Sequence[Path], options: EvaluationOptions, confidence: float, sources: Sequence[str]
) -> RunsReport:
    """Evaluates several files in the same way: scores files, parts files, or files of JSON objects, one a line, that
    `dpc evaluate ... --json` printed.

    Raises DataError when they are of different kinds, tasks, protocols, units or samples.
    """
    runs = [
        run
        for path, source in zip(paths, sources, strict=True)
        for run in (_file_runs if is_media(path) or is_hdf5(path) else _json_runs)(path, source, options)
    ]
    for run in runs[1:]:
        _check_same_experiment(runs[0], run)
    runs = _distinct_titles(runs)
    samples = runs[0].identity.get("samples") or {}
    number = samples.get("number")
    return RunsReport(
        runs[0].task,
        runs,
        runs[0].units,
        confidence,
        str(samples.get("kind", "")),
        number if isinstance(number, int) else 0,
    )


def _file_runs(path: Path, source: str, options: EvaluationOptions) -> list[Run]:
    found = measure_file(path, source, options)
    values = {key: value for one in found for key, value in one.values().items()}
    units = {key: unit for one in found for key, unit in one.units.items()}
    identity = {"kind": "file", "samples": samples_json(found[0].kind, found[0].names), **_facts(found)}
    title = f"seed {found[0].seed}" if found[0].seed is not None else Path(source).stem
    metrics = {key: None if math.isnan(value) else value for key, value in values.items()}
    notes = [note for one in found for note in one.notes]
    notes += dict.fromkeys(left_out_note(entry, one.kind.removesuffix("s")) for one in found for entry in one.left_out)
    return [Run(title, source, " and ".join(one.task for one in found), metrics, units, identity, notes, found[0].seed)]


def _facts(found: Sequence[FileMetrics]) -> dict[str, Any]:
    facts = {key: value for one in found for key, value in one.must_equal.items()}
    return facts | {
        what: dict(zip(one.names, own, strict=True)) for one in found for what, own in one.must_equal_by_sample.items()
    }


def _json_runs(path: Path, source: str, options: EvaluationOptions) -> list[Run]:
    try:
        lines = [line for line in read_text(path).splitlines() if line.strip()]
        objects = [parse_json(line, source) for line in lines]
    except DataError:
        raise DataError(
            f"{source}: neither a file of this program nor JSON objects, one a line; expected what "
            "`dpc evaluate ... --json` prints"
        ) from None
    if not objects:
        raise DataError(f"{source}: empty; the command that should have filled it failed")
    return [
        _json_run(own, source if len(objects) == 1 else f"{source}:{row}", options.metrics)
        for row, own in enumerate(objects, 1)
    ]


def _json_run(own: Any, source: str, asked: Sequence[str] | None) -> Run:
    if not isinstance(own, dict) or not all(isinstance(own.get(key), dict) for key in ("metrics", "units", "protocol")):
        raise DataError(f"{source}: not an object of `dpc evaluate ... --json` (no metrics, units and protocol)")
    wrong = [key for key, kind in _OPTIONAL.items() if not isinstance(own.get(key) or kind(), kind)]
    if wrong:
        raise DataError(f"{source}: {wrong[0]} is a {type(own[wrong[0]]).__name__}; evaluate again")
    metrics = {key: own["metrics"][key] for key in own["units"] if _is_number(own["metrics"].get(key, ""))}
    missing = [key for key in asked or () if key not in metrics]
    if missing:
        raise UsageError(f"--metrics {missing[0]}: {source} has {', '.join(metrics) or 'none'}")
    metrics = {key: metrics[key] for key in asked or metrics}
    if not metrics:
        raise DataError(f"{source}: no metric in it is a number")
    bad = [key for key, value in metrics.items() if value is not None and not math.isfinite(value)]
    if bad:
        raise DataError(f"{source}: {', '.join(bad)} of {len(metrics)} metrics not finite; evaluate again")
    counts = own.get("denominators") or {}
    notes = [note for note in own.get("notes") or [] if isinstance(note, str)]
    kind = str((own.get("samples") or {}).get("kind", "")).removesuffix("s")
    notes += [left_out_note(LeftOut(*entry), kind) for entry in map(_left_out, own.get("left_out") or []) if entry]
    identity = {
        "kind": "JSON",
        "protocol": own["protocol"],
        "samples": own.get("samples"),
        "denominators": {key: counts[key] for key in _COUNTS if key in counts},
    }
    return Run(
        title=_title(own, source),
        source=source,
        task=str(own.get("task", "")),
        metrics=metrics,
        units={key: str(own["units"][key]) for key in metrics},
        identity=identity,
        notes=notes,
        seed=_seed(own),
    )


def _left_out(entry: Any) -> tuple[str, list[str]] | None:
    """Returns the reason and the names of an entry of `left_out_json`, None for anything else."""
    if not isinstance(entry, dict) or not isinstance(entry.get("names"), list):
        return None
    return str(entry.get("reason", "")), list(map(str, entry["names"]))


def _is_number(value: Any) -> bool:
    return value is None or (isinstance(value, (int, float)) and not isinstance(value, bool))


def _title(own: dict[str, Any], source: str) -> str:
    seed = _seed(own)
    return f"seed {seed}" if seed is not None else Path(str(own.get("input", source))).stem


def _seed(own: dict[str, Any]) -> int | None:
    history = own.get("provenance")
    return history_seed([entry for entry in history if isinstance(entry, dict)]) if isinstance(history, list) else None


def _check_same_experiment(first: Run, other: Run) -> None:
    for what, one, two in (
        ("task", first.task, other.task),
        ("metrics", list(first.units), list(other.units)),
        *((f"unit of {key}", first.units[key], other.units.get(key)) for key in first.units),
        *((key, own, other.identity.get(key)) for key, own in first.identity.items()),
    ):
        if one != two:
            raise DataError(
                f"{other.source}: another {what} than {first.source}: {_differing(one, two)}; "
                "runs are the same experiment on the same samples"
            )


def _differing(one: Any, two: Any) -> str:
    """Returns the first entry in which two values differ, in words."""
    if isinstance(one, dict) and isinstance(two, dict):
        key = next(key for key in [*one, *two] if one.get(key) != two.get(key))
        return f"{key} {_short(two.get(key))}, not {_short(one.get(key))}"
    return f"{_short(two)}, not {_short(one)}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _repeated(runs: Sequence[Run]) -> list[str]:
    """Returns a sentence where runs have one seed and equal metrics, as copies of a file and a training repeated have."""
    groups: dict[tuple[Any, ...], list[str]] = {}
    for run in runs:
        groups.setdefault((run.seed, *run.metrics.values()), []).append(run.title)
    return [
        f"{', '.join(titles[:-1])} and {titles[-1]} have {'no known seed' if seed is None else 'the same seed'} and equal metrics: if they"
        " are copies of one run, or a run repeated, it counts more than once, and sd and interval are too small."
        for (seed, *_), titles in groups.items()
        if len(titles) > 1
    ]


def _distinct_titles(runs: Sequence[Run]) -> list[Run]:
    """Returns the runs, those of equal titles numbered by their place."""
    titles = [run.title for run in runs]
    return [
        run if titles.count(run.title) == 1 else replace(run, title=f"{run.title} #{place}")
        for place, run in enumerate(runs, 1)
    ]
