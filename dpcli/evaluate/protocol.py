"""The classification protocol: which samples of a scores file count, against which labels, and the result as data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.classification import ClassificationMetrics, classification_metrics
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
    """Metrics of every stream on the same samples; `streams` ends with the main scores."""

    class_names: list[str]
    split: str
    truth: str
    streams: dict[str, ClassificationMetrics]
    left_out: list[LeftOut] = field(default_factory=list)

    @property
    def main(self) -> ClassificationMetrics:
        return list(self.streams.values())[-1]


def evaluate_classification(
    path: str | Path, truth: str | Path | None = None, split: str | None = None
) -> ClassificationReport:
    """Metrics of a scores file.

    `split`: only its samples; "all" takes every one; None takes "test" when the file has such samples, else all.
    `truth`: a clouds file whose labels and splits, matched by name, replace those of the scores file. Samples with
    label -1 (unknown) are left out and listed. DataError when nothing is left, the split doesn't exist, or truth and
    scores don't hold the same samples and classes.
    """
    scores = ScoresReader(path)
    labels, splits = np.asarray(scores.labels), list(scores.splits)
    if truth is not None:
        labels, splits = _matched_truth(scores, truth, split)
    split = _counted(split, splits)
    chosen = np.array([split in ("all", own) for own in splits], bool)
    if not chosen.any():
        found = ", ".join(sorted({own or '""' for own in splits})) or "no samples"
        raise DataError(f"{path}: no sample of split {split!r}; the file has {found} (--split all takes every one)")
    known = labels >= 0
    left_out = [
        LeftOut(f"not of split {split!r}", _names(scores, ~chosen)),
        LeftOut("unknown label (-1)", _names(scores, chosen & ~known)),
    ]
    keep = chosen & known
    if not keep.any():
        raise DataError(f"{path}: none of {int(chosen.sum())} samples has a label; give the truth with --truth FILE")
    return ClassificationReport(
        class_names=scores.class_names,
        split=split,
        truth=str(truth) if truth is not None else "labels in the scores file",
        streams={name: classification_metrics(rows[keep], labels[keep]) for name, rows in _streams(scores).items()},
        left_out=[entry for entry in left_out if entry.names],
    )


def _counted(split: str | None, splits: Sequence[str]) -> str:
    return split or ("test" if "test" in splits else "all")


def _names(scores: ScoresReader, chosen: np.ndarray) -> list[str]:
    return [scores.names[index] for index in np.flatnonzero(chosen)]


def _streams(scores: ScoresReader) -> dict[str, np.ndarray]:
    """Single streams in the order they are trained (static, dynamic, others), then the main scores."""
    order = sorted(scores.streams, key=lambda name: (name != "static", name != "dynamic", name))
    single = {name: scores.streams[name] for name in order if name != FUSED}
    return {**single, FUSED if single else "scores": scores.scores}


def _matched_truth(scores: ScoresReader, truth: str | Path, split: str | None) -> tuple[np.ndarray, list[str]]:
    """Labels i64 (S) and splits of a clouds file in the order of the scores. DataError when the samples differ."""
    with CloudsReader(truth) as clouds:
        names, labels, splits = list(clouds.names), np.asarray(clouds.labels), list(clouds.splits)
        _same_classes(scores, truth, clouds.class_names)
    where = {name: index for index, name in enumerate(names)}
    unknown = [name for name in scores.names if name not in where]
    if unknown:
        raise DataError(
            f"{truth}: has no {listing(unknown)}, which {scores.path} scores; was it predicted from another?"
        )
    wanted = _counted(split, splits)
    scored = set(scores.names)
    unscored = [name for name, own in zip(names, splits, strict=True) if wanted in ("all", own) and name not in scored]
    if unscored:
        kind = "samples" if wanted == "all" else f"{wanted} samples"
        raise DataError(f"{scores.path}: scores no {listing(unscored)} among the {kind} of {truth}; "
                        "predict them too, or choose another --split")  # fmt: skip
    rows = np.array([where[name] for name in scores.names], np.int64)
    labels = labels[rows].astype(np.int64)
    if labels.max() >= len(scores.class_names):
        worst = int(labels.argmax())
        raise DataError(f"{truth}: label {labels[worst]} of {scores.names[worst]!r}; "
                        f"{scores.path} has the classes 0..{len(scores.class_names) - 1}")  # fmt: skip
    return labels, [splits[row] for row in rows]


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
            "accuracy_interval": "Wilson score, 95 %",
            "balanced_accuracy": "mean recall of the classes that occur",
            "macro_f1": "mean F1 of the classes that occur or were predicted",
            "confusion": "rows truth, columns prediction",
        },
        "metrics": metrics,
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
