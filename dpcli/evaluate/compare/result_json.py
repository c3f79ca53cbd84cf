"""Comparisons and runs as the objects that `--json` prints."""

from __future__ import annotations

from typing import Any

from dpcli.evaluate.choices import LOWER_IS_BETTER
from dpcli.evaluate.compare.paired import Change, CompareReport
from dpcli.evaluate.compare.runs import RunsReport, Spread
from dpcli.evaluate.results import ends_json, intervals_json, left_out_json, none_if_nan, samples_json


def compare_json(report: CompareReport) -> dict[str, Any]:
    """Returns for each metric, under `metrics`, both sides, a - b, its interval and the tests; None = undefined."""
    first = report.parts[0]
    changes = {key: change for part in report.parts for key, change in part.changes.items()}
    differences = {key: change.interval for key, change in changes.items()}
    return {
        "task": "compare",
        "input": list(report.sources),
        "protocol": _compare_protocol(report, changes),
        "metrics": {key: _change_json(change) for key, change in changes.items()},
        "intervals": intervals_json(
            report.resampling, first.kind, len(first.names), differences, "paired bootstrap, percentile"
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
        "left_out": [{"task": part.task, **entry} for part in report.parts for entry in left_out_json(part.left_out)],
        "notes": report.notes,
        "provenance": list(report.provenance),
    }


def _compare_protocol(report: CompareReport, changes: dict[str, Change]) -> dict[str, Any]:
    options = report.options
    return {
        "compared": [part.task for part in report.parts],
        "name": options.protocol,
        "truth": str(options.truth) if options.truth else "labels in the files",
        "ignore_below": options.ignore_below,
        "difference": "first minus second, paired",
        "p": "two-sided, of the paired bootstrap",
        "wilcoxon_p": f"signed-rank test on the values of single {report.parts[0].kind}",
        "lower_is_better": sorted(LOWER_IS_BETTER & set(changes)),
    }


def _change_json(change: Change) -> dict[str, Any]:
    numbers = {"a": change.a, "b": change.b, "difference": change.difference, "p": change.p}
    shown = {key: none_if_nan(value) for key, value in numbers.items()}
    counts = {key: getattr(change, key) for key in ("a_better", "b_better", "ties")}
    wilcoxon = change.wilcoxon_p
    return shown | {
        "interval": ends_json({"": change.interval})[""],
        **counts,
        "wilcoxon_p": None if wilcoxon is None else none_if_nan(wilcoxon),
    }


def runs_json(report: RunsReport) -> dict[str, Any]:
    """Returns for each metric, under `metrics`, its mean, sd, interval and the values of the runs; None = undefined."""
    first = report.runs[0]
    each = {"each": first.identity["protocol"]} if "protocol" in first.identity else {}
    return {
        "task": "runs",
        "input": [run.source for run in report.runs],
        "runs": [run.title for run in report.runs],
        "protocol": {
            "of": report.task,
            "sd": "over runs, n - 1 in the denominator",
            "interval": f"of the mean, Student's t, {100 * report.confidence:.4g} %",
        }
        | each,
        "metrics": {
            key: _spread_json(own, [run.metrics[key] for run in report.runs]) for key, own in report.spreads.items()
        },
        "samples": first.identity.get("samples"),
        "units": report.units,
        "denominators": {"runs": len(report.runs), **({report.kind: report.number} if report.number else {})},
        "notes": report.notes,
    }


def _spread_json(own: Spread, values: list[float | None]) -> dict[str, Any]:
    return {
        "mean": none_if_nan(own.mean),
        "sd": none_if_nan(own.sd),
        "n": len(values),
        "interval": [own.interval.low, own.interval.high] if own.interval.defined else None,
        "values": values,
    }
