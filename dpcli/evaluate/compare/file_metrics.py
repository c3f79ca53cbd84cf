"""The metrics of one prediction file in the form that comparisons need: as functions of how often each sample counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import WeightedMetric, means_of_samples, values_of_all
from dpcli.evaluate.results import LeftOut, list_names


@dataclass(frozen=True)
class EvaluationOptions:
    """Says how files are evaluated: `metrics` None = all that the files allow; the others as in `evaluate_segmentation`."""

    truth: Path | None = None
    metrics: tuple[str, ...] | None = None
    protocol: str = "dpc"
    split: str | None = None
    ignore_below: int = 0
    intersect: bool = False


@dataclass(frozen=True)
class FileMetrics:
    """Holds the metrics of one file as functions of how often each of its samples counts.

    names (n): the samples, of the kind `kind` (samples, sequences, views). metric: of these. per_sample f64 (n): the
    value of each sample by itself, by metric, NaN = undefined, for those metrics that have one. units: by metric.
    must_equal: facts that must be equal on both sides of a comparison, by name. must_equal_by_sample: the same sample by
    sample. correct bool (n): whether a classifier is right. left_out, notes: as in a report.
    """

    source: str
    task: str
    kind: str
    names: list[str]
    metric: WeightedMetric
    per_sample: Mapping[str, np.ndarray]
    units: Mapping[str, str]
    must_equal: Mapping[str, object] = field(default_factory=dict)
    must_equal_by_sample: Mapping[str, Sequence[object]] = field(default_factory=dict)
    left_out: list[LeftOut] = field(default_factory=list)
    provenance: list[dict] = field(default_factory=list)
    correct: np.ndarray | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def seed(self) -> int | None:
        """Returns the seed of the training behind the file; None where nothing says it."""
        return history_seed(self.provenance)

    def values(self) -> dict[str, float]:
        """Returns the metrics of all samples together; NaN = undefined."""
        found = values_of_all(self.metric, len(self.names))
        return {key: found[key] for key in self.units}

    def restricted(self, names: Sequence[str]) -> FileMetrics:
        """Returns the same of some of the samples, in the order of `names`."""
        row_of = {name: index for index, name in enumerate(self.names)}
        rows = np.array([row_of[name] for name in names], np.int64)

        def metric(counts: np.ndarray) -> dict[str, np.ndarray]:
            spread = np.zeros((len(counts), len(self.names)))
            spread[:, rows] = counts
            return self.metric(spread)

        return replace(
            self,
            names=list(names),
            metric=metric,
            per_sample={key: value[rows] for key, value in self.per_sample.items()},
            must_equal_by_sample={
                key: [value[row] for row in rows] for key, value in self.must_equal_by_sample.items()
            },
            correct=None if self.correct is None else self.correct[rows],
        )


def history_seed(provenance: Sequence[dict]) -> int | None:
    """Returns the seed of the last training in a file's history, or of the model that a command used; else of the last command.

    None when there is none.
    """
    for entry in reversed(provenance):
        config = entry.get("config")
        model = config.get("model") if isinstance(config, dict) else None
        if isinstance(model, dict) and isinstance(model.get("seed"), int):
            return model["seed"]
        if "train" in str(entry.get("command", "")).split():
            return entry["seed"] if isinstance(entry.get("seed"), int) else None
    seed = provenance[-1].get("seed") if provenance else None
    return seed if isinstance(seed, int) else None


def metrics_of_values(
    source: str,
    values: Mapping[str, Mapping[str, float]],
    units: Mapping[str, str],
    must_equal: Mapping[str, object] | None = None,
) -> FileMetrics:
    """Returns the metrics of a table {view: {metric: value}} of pictures, which are means over the views.

    must_equal: as in `FileMetrics`. NaN = the view doesn't count. Raises DataError without a view, and naming those with an
    infinite value.
    """
    names = list(values)
    if not names:
        raise DataError(f"{source}: no views to compare")
    per_sample = {key: np.array([values[name].get(key, np.nan) for name in names], np.float64) for key in units}
    for key, column in per_sample.items():
        if np.isinf(column).any():
            bad = [names[row] for row in np.flatnonzero(np.isinf(column))]
            raise DataError(f"{source}: {key} of {len(bad)} views is infinite: {list_names(bad)}")
    return FileMetrics(
        source, "video", "views", names, means_of_samples(per_sample), per_sample, units, must_equal or {}
    )
