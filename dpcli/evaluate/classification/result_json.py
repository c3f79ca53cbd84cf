"""The classification report as the object that `--json` prints."""

from __future__ import annotations

from typing import Any

from dpcli.evaluate.choices import TOP_K
from dpcli.evaluate.classification.calibration import BINS, Calibration
from dpcli.evaluate.classification.metrics import ClassificationMetrics
from dpcli.evaluate.classification.protocol import ClassificationReport
from dpcli.evaluate.results import ends_json, intervals_json, left_out_json, none_if_nan, samples_json


def classification_json(report: ClassificationReport, source: str) -> dict[str, Any]:
    """Returns the report with its numbers under `metrics`, None where a number is undefined (0/0).

    source: the scores file, as it was named.
    """
    main = report.main
    name = list(report.streams)[-1]
    shares = _shares(report, name)
    intervals = intervals_json(report.resampling, "samples", main.samples, report.intervals[name])
    return {
        "task": "classification",
        "input": source,
        "protocol": _protocol(report),
        "metrics": shares
        | {
            "streams": {name: _shares(report, name) for name in report.streams},
            "reliability": _reliability(report.calibration.get(name)),
            "per_class": [_class_row(main, label, name) for label, name in enumerate(report.class_names)],
            "confusion": main.confusion.tolist(),
        },
        "intervals": intervals | {"streams": {name: ends_json(own) for name, own in report.intervals.items()}},
        "samples": samples_json("samples", report.names),
        "units": {
            **{key: "fraction" for key in (*shares, "recall", "precision", "f1")},
            "confusion": "samples",
            **dict.fromkeys(("confidence", "calibration_error_by_chance"), "fraction"),
        },
        "denominators": {
            "samples": main.samples,
            "correct": {name: values.correct for name, values in report.streams.items()},
            "classes": len(report.class_names),
            "classes_that_occur": int((main.support > 0).sum()),
        },
        "accepted": dict(zip(("samples", "correct"), report.accepted)) if report.accepted else None,
        "left_out": left_out_json(report.left_out),
        "provenance": report.provenance,
    }


def _protocol(report: ClassificationReport) -> dict[str, str]:
    return {
        "split": report.split,
        "truth": report.truth,
        "prediction": "best score, a tie goes to the lowest label",
        "accuracy_interval": f"Wilson score, {100 * report.resampling.confidence:.4g} %",
        "balanced_accuracy": "mean recall of the classes that occur",
        "macro_f1": "mean F1 of the classes that occur or were predicted",
        "confusion": "rows truth, columns prediction",
        "calibration_error": f"mean |share right - probability| of the best class, {BINS} bins of equal width",
    }


def _shares(report: ClassificationReport, name: str) -> dict[str, Any]:
    """Returns the headline numbers of a stream; its calibration error is None where the scores are no probabilities."""
    metrics, calibration = report.streams[name], report.calibration.get(name)
    shares: dict[str, Any] = {"accuracy": metrics.accuracy, "accuracy_interval": list(metrics.interval)}
    if metrics.top_accuracy is not None:
        shares[f"top{TOP_K}_accuracy"] = metrics.top_accuracy
    return shares | {
        "balanced_accuracy": none_if_nan(metrics.balanced_accuracy),
        "macro_f1": none_if_nan(metrics.macro_f1),
        "calibration_error": calibration.error if calibration else None,
    }


def _reliability(calibration: Calibration | None) -> dict[str, Any] | None:
    """Returns the bins of the main scores, lowest probability first."""
    if calibration is None:
        return None
    return {
        "samples": calibration.samples.tolist(),
        "confidence": [none_if_nan(value) for value in calibration.confidence],
        "accuracy": [none_if_nan(value) for value in calibration.accuracy],
        "calibration_error_by_chance": calibration.by_chance,
    }


def _class_row(metrics: ClassificationMetrics, label: int, name: str) -> dict[str, Any]:
    counts = {key: int(getattr(metrics, key)[label]) for key in ("support", "predicted", "hits")}
    shares = {key: none_if_nan(getattr(metrics, key)[label]) for key in ("recall", "precision", "f1")}
    return {"label": label, "name": name, **counts, **shares}
