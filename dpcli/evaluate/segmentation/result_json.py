"""The segmentation and motion reports as the objects that `--json` prints."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from dpcli.evaluate.choices import SEGMENTATION_METRICS
from dpcli.evaluate.results import class_rows_json, none_if_nan, report_json
from dpcli.evaluate.segmentation.metrics import SegmentationMetrics
from dpcli.evaluate.segmentation.motion_metrics import MAIN_TAU, RELEASE_BATCH, SHARES, TAUS, MotionMetrics, tau_unit
from dpcli.evaluate.segmentation.motion_protocol import MotionReport
from dpcli.evaluate.segmentation.part_matching import IOU_THRESHOLD
from dpcli.evaluate.segmentation.protocol import FIXES, SegmentationReport


def segmentation_scores(metrics: SegmentationMetrics) -> dict[str, float | None]:
    """Returns the scores by name, in [0, 1]; None = undefined."""
    return {key: none_if_nan(getattr(metrics, key)) for key in SEGMENTATION_METRICS}


def segmentation_json(report: SegmentationReport, source: str) -> dict[str, Any]:
    """Returns the report with its numbers under `metrics`, None where a number is undefined (0/0).

    source: the parts file, as it was named.
    """
    rows = {label: segmentation_scores(own) | _segmentation_counts(own) for label, own in report.classes.items()}
    return report_json(
        "segmentation",
        source,
        report,
        "sequences",
        protocol={
            "name": report.protocol,
            "split": report.split,
            "truth": report.truth,
            "iou_threshold": IOU_THRESHOLD,
            "ignore_below": report.ignore_below,
            "fixes": list(FIXES) if report.protocol == "dpc" else [],
            "ap_pq_f1_pre_rec": "pooled over all frames of all sequences",
            "miou_ri": "mean over the frames of a sequence, then over sequences",
        },
        metrics=segmentation_scores(report.main) | {"per_class": class_rows_json(rows, report.class_names)},
        units=dict.fromkeys(SEGMENTATION_METRICS, "fraction"),
        denominators=_segmentation_counts(report.main),
    )


def _segmentation_counts(metrics: SegmentationMetrics) -> dict[str, int]:
    values = asdict(metrics)
    return {
        "sequences": values["objects"],
        "frames": values["frames"],
        "true_parts": values["truth_parts"],
        "predictions": values["predictions"],
        "true_positives": values["true_positives"],
        "frames_without_truth": values["skipped"],
        "predictions_on_ignored_ground": values["dropped"],
        "points_without_truth": values["unknown"],
    }


def motion_json(report: MotionReport, source: str) -> dict[str, Any]:
    """Returns the report with its numbers under `metrics`, None where a number is undefined (0/0).

    accs, accr, outlier are those of the protocol's own tau; `thresholds` has both. source: the parts file, as it was
    named.
    """
    unit, tau = report.length_unit, MAIN_TAU[report.protocol]
    rows = {label: _motion_numbers(own, tau) | _motion_counts(own) for label, own in report.classes.items()}
    counts = {"sequences": len(report.names), **_motion_counts(report.main)}
    return report_json(
        "motion",
        source,
        report,
        "sequences",
        protocol=_motion_protocol(report),
        metrics=_motion_numbers(report.main, tau) | {"per_class": class_rows_json(rows, report.class_names)},
        units={
            "epe3d": unit,
            "epe3d_no_motion": unit,
            **dict.fromkeys(SHARES, "fraction"),
            "tau": tau_unit(unit),
            "part_rotation": "degree",
            "part_displacement": unit,
        },
        denominators=counts | {"pairs_without_truth": report.without_truth},
    )


def _motion_protocol(report: MotionReport) -> dict[str, Any]:
    batches = f"means over the points of {RELEASE_BATCH} pairs, then over these batches"
    return {
        "name": report.protocol,
        "split": report.split,
        "truth": report.truth,
        "true_flow": "part poses" if report.from_poses else "scene_flow, frame f to f + 1",
        "tau": MAIN_TAU[report.protocol],
        "mean": batches if report.protocol == "release" else "over all points of all pairs",
        "accs": "share of points with error < tau or < 5 % of the true flow",
        "accr": "share of points with error < 2 tau or < 10 % of the true flow",
        "outlier": "share of points with error > 6 tau or > 10 % of the true flow",
        "part_motion": "mean over true parts of each pair, matched to predicted parts one to one by IoU",
    }


def _motion_numbers(metrics: MotionMetrics, tau: float) -> dict[str, Any]:
    def shares(of: float) -> dict[str, float | None]:
        return {key: none_if_nan(getattr(metrics.shares[of], key)) for key in SHARES}

    return {
        "epe3d": none_if_nan(metrics.epe3d),
        "epe3d_no_motion": none_if_nan(metrics.still),
        **shares(tau),
        "thresholds": [{"tau": of, **shares(of)} for of in TAUS],
        "part_rotation": none_if_nan(np.degrees(metrics.rotation)),
        "part_displacement": none_if_nan(metrics.displacement),
    }


def _motion_counts(metrics: MotionMetrics) -> dict[str, int]:
    return {
        "pairs": metrics.pairs,
        "points": metrics.points,
        "true_part_motions": metrics.parts,
        "unmatched_part_motions": metrics.unmatched,
        "points_without_truth": metrics.unknown,
    }
