"""Evaluating one file for a comparison: a scores file, a parts file, or a video."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.bootstrap import WeightedMetric
from dpcli.evaluate.choices import CLASSIFICATION_METRICS, MOTION_METRICS, SEGMENTATION_METRICS, TOP_K, VIDEO_METRICS
from dpcli.evaluate.classification.metrics import classification_weighted, predicted_labels, top_hits
from dpcli.evaluate.classification.protocol import evaluate_classification
from dpcli.evaluate.compare.file_metrics import EvaluationOptions, FileMetrics, metrics_of_values
from dpcli.evaluate.results import KEPT_STATISTICS
from dpcli.evaluate.segmentation.motion_protocol import MotionReport, evaluate_motion
from dpcli.evaluate.segmentation.protocol import SegmentationReport, evaluate_segmentation
from dpcli.evaluate.video.sources.open_source import is_media
from dpcli.store import CloudsReader, PartsReader, file_kind

# metrics that are no mean over views can't be compared view by view
_VIDEO_METRICS = tuple(
    name
    for name in VIDEO_METRICS
    if name not in ("clip_views", "fid_vid_r3d50", "fid_vid_inception", "parts", "tracks", "surface")
)
_VIDEO_FILES = ("views", "gaussians")
_ROWS = 256


def kind_of_file(path: Path, source: str) -> str:
    """Returns scores, parts or video. source: the path as named, for the message. Raises DataError for another kind of file."""
    kind = "views" if is_media(path) else file_kind(path)
    if kind == "statistics":
        raise DataError(f"{source}: {KEPT_STATISTICS}")
    if kind not in ("scores", "parts", *_VIDEO_FILES):
        raise DataError(
            f"{source}: a {kind} file; expected scores or parts (`dpc classify predict`, `dpc segment "
            "predict`), a scene (`dpc generate4d fit`) or a video"
        )
    return "video" if kind in _VIDEO_FILES else kind


def measure_file(path: Path, source: str, options: EvaluationOptions) -> list[FileMetrics]:
    """Returns the metrics of a scores file or a video (one entry), or of a parts file: its segmentation and its motion.

    Without `metrics`, motion is measured where the truth has poses or scene flow and the file has frame pairs. Raises
    UsageError for metrics that the file can't have, or a parts file without a truth; DataErrors as `evaluate_*`.
    """
    kind = kind_of_file(path, source)
    _check_metrics(options, kind)
    if kind == "scores":
        return [_measure_scores(path, source, options)]
    if options.truth is None:
        noun, truth = ("a video", "the true one") if kind == "video" else ("a parts file", "the clouds file")
        raise UsageError(f"{source}: {noun} holds no truth; name {truth} with --truth FILE")
    if kind == "video":
        return [_measure_video(path, source, options)]
    names = options.metrics or (*SEGMENTATION_METRICS, *(MOTION_METRICS if _has_motion(path, options.truth) else ()))
    if options.ignore_below and not set(names) & set(SEGMENTATION_METRICS):
        raise UsageError(f"{source}: --ignore-below is of {', '.join(SEGMENTATION_METRICS)}, and --metrics names none")
    tasks = ((_measure_segmentation, SEGMENTATION_METRICS), (_measure_motion, MOTION_METRICS))
    return [
        measure(path, source, options, asked)
        for measure, own in tasks
        if (asked := [name for name in names if name in own])
    ]


def _check_metrics(options: EvaluationOptions, kind: str) -> None:
    parts = (*SEGMENTATION_METRICS, *MOTION_METRICS)
    legal = {"scores": CLASSIFICATION_METRICS, "parts": parts, "video": _VIDEO_METRICS}[kind]
    wrong = [name for name in options.metrics or () if name not in legal]
    if wrong:
        raise UsageError(f"--metrics {wrong[0]}: of {kind} expected some of {', '.join(legal)}")


def _has_motion(path: Path, truth: Path) -> bool:
    with PartsReader(path) as parts, CloudsReader(truth) as clouds:
        return bool({"pose", "scene_flow"} & set(clouds.fields)) and bool(parts.pair_counts.any())


def _measure_scores(path: Path, source: str, options: EvaluationOptions) -> FileMetrics:
    if options.protocol != "dpc" or options.ignore_below:
        raise UsageError(f"{source}: a scores file; --protocol and --ignore-below are for parts files")
    report = evaluate_classification(path, options.truth, options.split, intersect=options.intersect)
    correct = predicted_labels(report.scores) == report.labels
    hits = {"accuracy": correct, f"top{TOP_K}_accuracy": top_hits(report.scores, report.labels)}
    absent = {f"top{TOP_K}_accuracy"} if len(report.class_names) <= TOP_K else set()
    asked = [name for name in options.metrics or CLASSIFICATION_METRICS if name not in absent]
    if not asked:
        raise UsageError(f"{source}: top-{TOP_K} accuracy of {len(report.class_names)} classes is always 1")
    return FileMetrics(
        source=source,
        task="classification",
        kind="samples",
        names=report.names,
        metric=classification_weighted(report.scores, report.labels),
        per_sample={key: hit.astype(np.float64) for key, hit in hits.items() if key in asked},
        units=dict.fromkeys(asked, "fraction"),
        must_equal={"split": report.split, "class names": report.class_names},
        must_equal_by_sample={"true label": report.labels.tolist()},
        left_out=report.left_out,
        provenance=report.provenance,
        correct=correct,
    )


def _measure_segmentation(path: Path, source: str, options: EvaluationOptions, asked: Sequence[str]) -> FileMetrics:
    report = evaluate_segmentation(
        path,
        options.truth,
        protocol=options.protocol,
        ignore_below=options.ignore_below,
        split=options.split,
        intersect=options.intersect,
    )
    return _of_sequences(report, source, "segmentation", dict.fromkeys(asked, "fraction"), {})


def _measure_motion(path: Path, source: str, options: EvaluationOptions, asked: Sequence[str]) -> FileMetrics:
    report = evaluate_motion(
        path, options.truth, protocol=options.protocol, split=options.split, intersect=options.intersect
    )
    lengths = {"epe3d": report.length_unit, "part_rotation": "degree", "part_displacement": report.length_unit}
    units = {name: lengths.get(name, "fraction") for name in asked}
    return _of_sequences(report, source, "motion", units, {"frame pairs": [pairs.tolist() for pairs in report.pairs]})


def _of_sequences(
    report: SegmentationReport | MotionReport,
    source: str,
    task: str,
    units: dict[str, str],
    must_equal_by_sample: dict[str, list],
) -> FileMetrics:
    return FileMetrics(
        source=source,
        task=task,
        kind="sequences",
        names=report.names,
        metric=report.metric,
        per_sample=_values_of_single_samples(report.metric, len(report.names), units),
        units=units,
        must_equal={"split": report.split},
        must_equal_by_sample=must_equal_by_sample,
        left_out=report.left_out,
        provenance=report.provenance,
    )


def _measure_video(path: Path, source: str, options: EvaluationOptions) -> FileMetrics:
    """Returns the metrics of a video; a view is a sample, since its frames look alike."""
    from dpcli.evaluate.video.comparison import evaluate_video, view_values
    from dpcli.evaluate.video.frechet.variants import feature_variant
    from dpcli.evaluate.video.protocol import describe_protocol, video_protocol

    if options.ignore_below or options.split:
        raise UsageError(f"{source}: a video; --ignore-below and --split are for parts files")
    asked, chosen = options.metrics or ("psnr", "ssim"), video_protocol(options.protocol)
    if "fvd" in asked and feature_variant(chosen.networks.fvd).aggregation == "pooled":
        raise UsageError(
            f"--metrics fvd: protocol {options.protocol} takes it of all views at once, so views can't be compared by it"
        )
    report = evaluate_video(path, options.truth, metrics=asked, protocol=chosen, intersect=options.intersect)
    for name, reason in report.missing.items():
        raise DataError(f"{source}: {name} not computed: {reason}")
    values, units = view_values(report)
    protocol = {"protocol": describe_protocol(report.protocol)}
    found = metrics_of_values(source, values, units, protocol)
    return replace(found, left_out=report.left_out, provenance=report.provenance, notes=report.notes)


def _values_of_single_samples(metric: WeightedMetric, samples: int, asked: Sequence[str]) -> dict[str, np.ndarray]:
    """Returns the value of each sample by itself, f64 (samples) by metric."""
    blocks = []
    for start in range(0, samples, _ROWS):
        rows = np.arange(start, min(start + _ROWS, samples))
        blocks.append(metric((rows[:, None] == np.arange(samples)).astype(np.float64)))
    return {key: np.concatenate([block[key] for block in blocks]) for key in asked}
