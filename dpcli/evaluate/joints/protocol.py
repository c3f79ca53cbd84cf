"""The joints protocol: every sequence of a parts file with joints beside the true joints of a clouds file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import NO_INTERVALS, Resampling, WeightedMetric, ratios_of_sums, values_of_all
from dpcli.evaluate.joints.metrics import JointStatistics, joint_statistics
from dpcli.evaluate.joints.visibility import VISIBLE, joint_visibility
from dpcli.evaluate.results import Report, measure_by_class
from dpcli.evaluate.segmentation.truth_pairing import PairedSequences
from dpcli.store import CloudSequence, CloudsReader

METRICS = (
    "type",
    "axis_within_5",
    "visible_type",
    "visible_axis_within_5",
    "edge_f1",
    "axis_angle",
    "axis_position",
    "state_angle",
    "state_length",
)


@dataclass(kw_only=True)
class JointReport(Report):
    """Holds the metrics of all sequences and of those of each label.

    metrics: shares 0..1 (type, axis_within_5, the same of visible joints, edge_f1), degrees (axis_angle, state_angle) and
    length_unit (axis_position, state_length); NaN where nothing counts. poses: whether the truth tells what is visible.
    """

    split: str
    length_unit: str
    metrics: dict[str, float]
    classes: dict[int, dict[str, float]]
    class_names: list[str]
    total: JointStatistics
    counts: dict[int, JointStatistics]
    poses: bool


def evaluate_joints(
    path: str | Path,
    truth: str | Path,
    *,
    split: str | None = None,
    intersect: bool = False,
    resampling: Resampling = NO_INTERVALS,
) -> JointReport:
    """Returns the metrics of the joints that a parts file holds against those of a clouds file.

    Raises DataError where one of the files has no joints, or no true joint is left to compare; other arguments and errors
    are those of `PairedSequences`.
    """
    names, labels, found = [], [], []
    with PairedSequences(path, truth, split=split, intersect=intersect, fields=("part", "joint")) as paired:
        if "joint" not in paired.predicted.fields:
            raise DataError(f"{path}: no joints in it; `dpc segment joints {path} -o joints.h5` finds them")
        for place, (row, other) in enumerate(paired.rows):
            pair = paired.pair(place)
            joint = paired.predicted.read(row, fields=("joint",)).joint
            names.append(pair.truth.name)
            labels.append(pair.truth.label)
            visible = _visibly(paired.truth, other, pair.truth)
            found.append(joint_statistics(pair.truth.part, pair.truth.joint, pair.predicted.part, joint, visible))
    total = sum(found, JointStatistics())
    if not total.joints:
        raise DataError(f"{truth}: no joint between two parts that are seen; nothing to compare")
    counts = measure_by_class(labels, found, lambda own: sum(own, JointStatistics()))
    return JointReport(
        names=names,
        split=paired.split,
        truth=str(truth),
        length_unit=paired.truth.length_unit,
        metrics=joint_metrics(total),
        classes={label: joint_metrics(one) for label, one in counts.items()},
        class_names=paired.truth.class_names,
        total=total,
        counts=counts,
        poses="pose" in paired.truth.fields,
        resampling=resampling,
        intervals=resampling.intervals(_weighted(found), len(found)),
        left_out=paired.left_out,
        provenance=paired.predicted.provenance,
    )


def _visibly(reader: CloudsReader, row: int, truth: CloudSequence) -> Callable[[int, int], bool]:
    """Returns whether a sequence's child moves visibly against its parent; without poses this is unknown, and no child does."""
    pose = reader.read(row, fields=("pose",)).pose if "pose" in reader.fields else None

    def moves(child: int, parent: int) -> bool:
        try:
            return pose is not None and joint_visibility(truth, pose, child, parent) >= VISIBLE
        except DataError as error:
            raise DataError(f"{reader.path}: {error}; make the file again") from None

    return moves


def _weighted(found: Sequence[JointStatistics]) -> WeightedMetric:
    """Returns the metrics as functions of how often the statistics of each sequence count."""
    pairs = {
        "type": [(one.types, one.joints) for one in found],
        "axis_within_5": [(one.near, one.axes) for one in found],
        "visible_type": [(one.visible_types, one.visible) for one in found],
        "visible_axis_within_5": [(one.visible_near, one.visible_axes) for one in found],
        "edge_f1": [(2 * one.edges, one.joints + one.predicted) for one in found],
        "axis_angle": [(sum(one.angles), len(one.angles)) for one in found],
        "axis_position": [(sum(one.distances), len(one.distances)) for one in found],
        "state_angle": [(sum(one.turns), len(one.turns)) for one in found],
        "state_length": [(sum(one.slides), len(one.slides)) for one in found],
    }
    tops, bottoms = ({key: np.array(rows, np.float64)[:, side] for key, rows in pairs.items()} for side in (0, 1))
    return ratios_of_sums(tops, bottoms)


def joint_metrics(found: JointStatistics) -> dict[str, float]:
    """Returns the metrics of statistics; NaN where nothing counts."""
    return values_of_all(_weighted([found]), 1)
