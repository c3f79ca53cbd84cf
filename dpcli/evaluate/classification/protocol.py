"""The classification protocol: which samples of a scores file count, against which labels, and the result as data."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import Interval, Resampling
from dpcli.evaluate.classification.metrics import ClassificationMetrics, classification_metrics
from dpcli.evaluate.compare.resampled import classification_weighted
from dpcli.store import CloudsReader, ScoresReader

FUSED = "fused"  # the file's main scores, when it also holds those of single streams
_SHOWN = 5  # names in a message


@dataclass
class LeftOut:
    """Samples of the file that don't count, and why."""

    reason: str
    names: list[str]


@dataclass
class ClassificationReport:
    """Metrics of every stream on the same samples; `streams` ends with the main scores.

    names, labels i (S): the samples that count; scores f (S,C): what the main scores say of them. intervals: by stream
    and metric, empty without `resampling`.
    """

    class_names: list[str]
    split: str
    truth: str
    streams: dict[str, ClassificationMetrics]
    left_out: list[LeftOut] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    labels: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    scores: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    resampling: Resampling = field(default_factory=lambda: Resampling(0))
    intervals: dict[str, dict[str, Interval]] = field(default_factory=dict)

    @property
    def main(self) -> ClassificationMetrics:
        return list(self.streams.values())[-1]


def evaluate_classification(
    path: str | Path,
    truth: str | Path | None = None,
    split: str | None = None,
    *,
    intersect: bool = False,
    resampling: Resampling | None = None,
) -> ClassificationReport:
    """Metrics of a scores file.

    `split`: only its samples; "all" takes every one; None takes "test" when the file has such samples, else all.
    `truth`: a clouds file whose labels and splits, matched by name, replace those of the scores file. Samples with
    label -1 (unknown) are left out and listed. DataError when nothing is left, the split doesn't exist, or truth and
    scores don't hold the same samples (with `intersect` those on one side only are left out) and classes.
    `resampling`: how to find the intervals; without it there are none but that of the accuracy.
    """
    scores, resampling = ScoresReader(path), resampling or Resampling(0)
    if not scores.names:
        raise DataError(f"{path}: holds no samples; predict again")
    labels, splits = np.asarray(scores.labels), list(scores.splits)
    found, one_sided = np.ones(len(labels), bool), []
    if truth is not None:
        labels, splits, found, one_sided = _matched_truth(scores, truth, split, intersect)
    split = _counted(split, splits)
    chosen = found & np.array([split in ("all", own) for own in splits], bool)
    if not chosen.any():
        found = ", ".join(sorted({own or '""' for own in splits})) or "no samples"
        raise DataError(f"{path}: no sample of split {split!r}; the file has {found} (--split all takes every one)")
    known = labels >= 0
    left_out = [
        *one_sided,
        LeftOut(f"not of split {split!r}", _names(scores, found & ~chosen)),
        LeftOut("unknown label (-1)", _names(scores, chosen & ~known)),
    ]
    keep = chosen & known
    if not keep.any():
        raise DataError(f"{path}: none of {int(chosen.sum())} samples has a label; give the truth with --truth FILE")
    streams = {name: rows[keep] for name, rows in _streams(scores).items()}
    labels = labels[keep]
    return ClassificationReport(
        class_names=scores.class_names,
        split=split,
        truth=str(truth) if truth is not None else "labels in the scores file",
        streams={name: _metrics(rows, labels, resampling.confidence) for name, rows in streams.items()},
        left_out=[entry for entry in left_out if entry.names],
        names=_names(scores, keep),
        labels=labels,
        scores=scores.scores[keep],
        resampling=resampling,
        intervals={
            name: resampling.intervals(classification_weighted(rows, labels), len(labels))
            for name, rows in streams.items()
        },
    )


def _metrics(scores: np.ndarray, labels: np.ndarray, confidence: float) -> ClassificationMetrics:
    found = classification_metrics(scores, labels)
    if confidence == 0.95:
        return found
    from scipy.stats import binomtest

    ends = binomtest(found.correct, found.samples).proportion_ci(confidence, method="wilson")
    return replace(found, interval=(float(ends.low), float(ends.high)))


def _counted(split: str | None, splits: Sequence[str]) -> str:
    return split or ("test" if "test" in splits else "all")


def _names(scores: ScoresReader, chosen: np.ndarray) -> list[str]:
    return [scores.names[index] for index in np.flatnonzero(chosen)]


def _streams(scores: ScoresReader) -> dict[str, np.ndarray]:
    """Single streams in the order they are trained (static, dynamic, others), then the main scores."""
    order = sorted(scores.streams, key=lambda name: (name != "static", name != "dynamic", name))
    single = {name: scores.streams[name] for name in order if name != FUSED}
    return {**single, FUSED if single else "scores": scores.scores}


def _matched_truth(
    scores: ScoresReader, truth: str | Path, split: str | None, intersect: bool
) -> tuple[np.ndarray, list[str], np.ndarray, list[LeftOut]]:
    """Labels i64 (S) and splits of a clouds file in the order of the scores, and which it has, bool (S).

    DataError when the samples differ; with `intersect` those on one side only are listed instead.
    """
    with CloudsReader(truth) as clouds:
        names, labels, splits = list(clouds.names), np.asarray(clouds.labels), list(clouds.splits)
        _same_classes(scores, truth, clouds.class_names)
    where = {name: index for index, name in enumerate(names)}
    unknown = [name for name in scores.names if name not in where]
    if unknown and not intersect:
        raise DataError(
            f"{truth}: has no {listing(unknown)}, which {scores.path} scores; was it predicted from another? "
            "--intersect evaluates what both have"
        )
    wanted = _counted(split, splits)
    scored = set(scores.names)
    unscored = [name for name, own in zip(names, splits, strict=True) if wanted in ("all", own) and name not in scored]
    if unscored and not intersect:
        kind = "samples" if wanted == "all" else f"{wanted} samples"
        raise DataError(
            f"{scores.path}: scores no {listing(unscored)} among the {kind} of {truth}; "
            "predict them too, or choose another --split"
        )
    if len(unknown) == len(scores.names):
        raise DataError(f"{scores.path}: scores {listing(unknown)}, of which {truth} has none")
    found = np.array([name in where for name in scores.names])
    rows = np.array([where.get(name, 0) for name in scores.names], np.int64)
    labels = np.where(found, labels[rows], -1).astype(np.int64)
    if labels.max() >= len(scores.class_names):
        worst = int(labels.argmax())
        raise DataError(
            f"{truth}: label {labels[worst]} of {scores.names[worst]!r}; "
            f"{scores.path} has the classes 0..{len(scores.class_names) - 1}"
        )
    left_out = [LeftOut("the truth doesn't have", unknown), LeftOut("not scored", unscored)]
    return labels, [splits[row] for row in rows], found, left_out


def _same_classes(scores: ScoresReader, truth: str | Path, class_names: Sequence[str]) -> None:
    if not class_names or list(class_names) == list(scores.class_names):
        return
    if len(class_names) != len(scores.class_names):
        raise DataError(f"{truth}: {len(class_names)} classes, but {scores.path} scores {len(scores.class_names)}")
    pairs = enumerate(zip(class_names, scores.class_names, strict=True))
    label, (ours, theirs) = next(pair for pair in pairs if pair[1][0] != pair[1][1])
    raise DataError(f"{truth}: class {label} is {ours!r}, in {scores.path} it is {theirs!r}")


def listing(names: Sequence[str]) -> str:
    """A few names in quotes, and how many more there are."""
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(repr(name) for name in names[:_SHOWN]) + more


def as_json(report: ClassificationReport, source: str, provenance: Sequence[dict] = ()) -> dict[str, Any]:
    """One object for `--json`: numbers under `metrics`, None where a number is undefined (0/0)."""
    main = report.main
    metrics = _shares(main) | {
        "streams": {name: _shares(values) for name, values in report.streams.items()},
        "per_class": [_class_row(main, label, name) for label, name in enumerate(report.class_names)],
        "confusion": main.confusion.tolist(),
    }
    shares = [key for key in _shares(main)]
    return {
        "task": "classification",
        "input": source,
        "protocol": {
            "split": report.split,
            "truth": report.truth,
            "prediction": "best score, a tie goes to the lowest label",
            "accuracy_interval": f"Wilson score, {100 * report.resampling.confidence:.4g} %",
            "balanced_accuracy": "mean recall of the classes that occur",
            "macro_f1": "mean F1 of the classes that occur or were predicted",
            "confusion": "rows truth, columns prediction",
        },
        "metrics": metrics,
        "intervals": intervals_json(
            report.resampling, "samples", main.samples, report.intervals[list(report.streams)[-1]]
        )
        | {"streams": {name: ends_json(own) for name, own in report.intervals.items()}},
        "samples": samples_json("samples", report.names),
        "units": {**{key: "fraction" for key in (*shares, "recall", "precision", "f1")}, "confusion": "samples"},
        "denominators": {
            "samples": main.samples,
            "correct": {name: values.correct for name, values in report.streams.items()},
            "classes": len(report.class_names),
            "classes_that_occur": int((main.support > 0).sum()),
        },
        "left_out": [{"reason": e.reason, "count": len(e.names), "names": e.names} for e in report.left_out],
        "provenance": list(provenance),
    }


def intervals_json(
    resampling: Resampling, of: str, number: int, intervals: Mapping[str, Interval], method: str = "bootstrap, BCa"
) -> dict[str, Any]:
    """How intervals were found, and under `metrics` the two ends of each; None = undefined."""
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
    """[low, high] by metric; None = undefined."""
    return {key: [own.low, own.high] if own.defined else None for key, own in intervals.items()}


def samples_json(kind: str, names: Sequence[str]) -> dict[str, Any]:
    """What tells whether two results are of the same samples: how many, and a digest of their sorted names."""
    digest = hashlib.sha256("\0".join(sorted(names)).encode()).hexdigest()
    return {"kind": kind, "number": len(names), "names_sha256": digest}


def _shares(metrics: ClassificationMetrics) -> dict[str, Any]:
    shares: dict[str, Any] = {"accuracy": metrics.accuracy, "accuracy_interval": list(metrics.interval)}
    if metrics.top_accuracy is not None:
        shares[f"top{metrics.top_k}_accuracy"] = metrics.top_accuracy
    return shares | {"balanced_accuracy": _defined(metrics.balanced_accuracy), "macro_f1": _defined(metrics.macro_f1)}


def _class_row(metrics: ClassificationMetrics, label: int, name: str) -> dict[str, Any]:
    counts = {key: int(getattr(metrics, key)[label]) for key in ("support", "predicted", "hits")}
    shares = {key: _defined(getattr(metrics, key)[label]) for key in ("recall", "precision", "f1")}
    return {"label": label, "name": name, **counts, **shares}


def _defined(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
