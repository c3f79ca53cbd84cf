"""What one prediction file says, in the form that comparisons and runs need: metrics as functions of its samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.bootstrap import Weighted
from dpcli.evaluate.classification.metrics import TOP_K, predicted_labels, top_hits
from dpcli.evaluate.classification.protocol import LeftOut, evaluate_classification, listing
from dpcli.evaluate.compare.resampled import classification_weighted, means, motion_weighted, segmentation_weighted
from dpcli.evaluate.segmentation.motion_metrics import RELEASE_BATCH
from dpcli.evaluate.segmentation.motion_protocol import MAIN_TAU, evaluate_motion
from dpcli.evaluate.segmentation.protocol import SHARES, evaluate_segmentation
from dpcli.store import CloudsReader, PartsReader, ScoresReader, file_kind

CLASSIFICATION = ("accuracy", f"top{TOP_K}_accuracy", "balanced_accuracy", "macro_f1")
MOTION = ("epe3d", "accs", "accr", "outlier", "part_rotation", "part_displacement")
LOWER_IS_BETTER = frozenset(
    {"epe3d", "outlier", "part_rotation", "part_displacement", "lpips", "clip_spherical", "fvd", "warping"}
)
VIDEO = (
    "psnr",
    "psnr_foreground",
    "ssim",
    "ms_ssim",
    "lpips",
    "clip",
    "clip_spherical",
    "clip_temporal",
    "fvd",
    "warping",
)
_VIDEO_FILES = ("views", "gaussians")
_ROWS = 256


@dataclass(frozen=True)
class Question:
    """How files are evaluated: `metrics` None = all that the files allow; the others as in `evaluate_segmentation`."""

    truth: Path | None = None
    metrics: tuple[str, ...] | None = None
    protocol: str = "dpc"
    split: str | None = None
    ignore_below: int = 0
    intersect: bool = False


@dataclass(frozen=True)
class Measured:
    """Metrics of one file as functions of how often each of its samples counts.

    names (n) of the samples, of the kind `kind`; metric: `Weighted` over these; alone f64 (n): value of each sample by
    itself, by metric, NaN = undefined, for those metrics that have one; units by metric. same: facts that must be equal
    on both sides of a comparison; of_sample: what must be equal sample by sample, and its name. right bool (n): of a
    classifier. left_out as in a report.
    """

    source: str
    task: str
    kind: str
    names: list[str]
    metric: Weighted
    alone: Mapping[str, np.ndarray]
    units: Mapping[str, str]
    same: Mapping[str, object] = field(default_factory=dict)
    of_sample: Mapping[str, Sequence[object]] = field(default_factory=dict)
    left_out: list[LeftOut] = field(default_factory=list)
    seed: int | None = None
    provenance: list[dict] = field(default_factory=list)
    right: np.ndarray | None = None

    def values(self) -> dict[str, float]:
        """Metrics of all samples together; NaN = undefined."""
        found = self.metric(np.ones((1, len(self.names))))
        return {key: float(found[key][0]) for key in self.units}

    def restricted(self, names: Sequence[str]) -> Measured:
        """The same for some of the samples, in the order of `names`."""
        where = {name: index for index, name in enumerate(self.names)}
        rows = np.array([where[name] for name in names], np.int64)

        def metric(counts: np.ndarray) -> dict[str, np.ndarray]:
            spread = np.zeros((len(counts), len(self.names)))
            spread[:, rows] = counts
            return self.metric(spread)

        return Measured(
            self.source,
            self.task,
            self.kind,
            list(names),
            metric,
            {key: value[rows] for key, value in self.alone.items()},
            self.units,
            self.same,
            {key: [value[row] for row in rows] for key, value in self.of_sample.items()},
            self.left_out,
            self.seed,
            self.provenance,
            None if self.right is None else self.right[rows],
        )


def is_pictures(path: Path) -> bool:
    """Whether a path is a video that is no HDF5 file: a folder, an array, a video file."""
    from dpcli.evaluate.video.sources import VIDEO_SUFFIXES

    return path.is_dir() or path.suffix.lower() in (".npy", *VIDEO_SUFFIXES)


def measured_kind(path: Path, source: str) -> str:
    """scores | parts | video. DataError for a file that is none of them."""
    kind = "views" if is_pictures(path) else file_kind(path)
    if kind not in ("scores", "parts", *_VIDEO_FILES):
        raise DataError(
            f"{source}: a {kind} file; expected scores or parts (`dpc classify predict`, `dpc segment "
            "predict`), a scene (`dpc generate4d fit`) or a video"
        )
    return "video" if kind in _VIDEO_FILES else kind


def measure(path: Path, source: str, question: Question) -> list[Measured]:
    """A scores file or a video (one entry), or a parts file: what is asked of its segmentation and of its motion.

    Without `metrics`, motion is measured where the truth has poses or scene flow and the file has frame pairs. UsageError for metrics
    that the file can't have, or a parts file without a truth; DataErrors as `evaluate_*`.
    """
    kind = measured_kind(path, source)
    of_kind = {"scores": CLASSIFICATION, "parts": (*SHARES, *MOTION), "video": VIDEO}
    wrong = [name for name in question.metrics or () if name not in of_kind[kind]]
    if wrong:
        raise UsageError(f"--metrics {wrong[0]}: of {kind} expected some of {', '.join(of_kind[kind])}")
    if kind == "scores":
        return [_classification(path, source, question)]
    if question.truth is None:
        wanted = (
            "a video holds no truth; name the true one"
            if kind == "video"
            else ("a parts file holds no truth; name the clouds file")
        )
        raise UsageError(f"{source}: {wanted} with --truth FILE")
    if kind == "video":
        return [_video(path, source, question)]
    wanted = question.metrics or (*SHARES, *(MOTION if _has_motion(path, question.truth) else ()))
    makers = ((_segmentation, SHARES), (_motion, MOTION))
    return [
        make(path, source, question, asked)
        for make, own in makers
        if (asked := [name for name in wanted if name in own])
    ]


def _has_motion(path: Path, truth: Path) -> bool:
    with PartsReader(path) as parts, CloudsReader(truth) as clouds:
        return bool({"pose", "scene_flow"} & set(clouds.fields)) and bool(parts.pair_counts.any())


def _classification(path: Path, source: str, question: Question) -> Measured:
    if question.protocol != "dpc" or question.ignore_below:
        raise UsageError(f"{source}: a scores file; --protocol and --ignore-below are for parts files")
    report = evaluate_classification(path, question.truth, question.split, intersect=question.intersect)
    right = predicted_labels(report.scores) == report.labels
    found = {"accuracy": right, f"top{TOP_K}_accuracy": top_hits(report.scores, report.labels)}
    absent = {f"top{TOP_K}_accuracy"} if len(report.class_names) <= TOP_K else set()
    asked = [name for name in question.metrics or CLASSIFICATION if name not in absent]
    if not asked:
        raise UsageError(f"{source}: top-{TOP_K} accuracy of {len(report.class_names)} classes is always 1")
    return Measured(
        source,
        "classification",
        "samples",
        report.names,
        classification_weighted(report.scores, report.labels),
        {key: hit.astype(np.float64) for key, hit in found.items() if key in asked},
        dict.fromkeys(asked, "fraction"),
        {"split": report.split, "class names": report.class_names},
        {"true label": report.labels.tolist()},
        report.left_out,
        *_history(ScoresReader(path).provenance),
        right,
    )


def _segmentation(path: Path, source: str, question: Question, asked: Sequence[str]) -> Measured:
    report = evaluate_segmentation(
        path,
        question.truth,
        protocol=question.protocol,
        ignore_below=question.ignore_below,
        split=question.split,
        intersect=question.intersect,
    )
    metric = segmentation_weighted(report.sequences, question.protocol)
    return Measured(
        source,
        "segmentation",
        "sequences",
        report.names,
        metric,
        _alone(metric, len(report.names), asked),
        dict.fromkeys(asked, "fraction"),
        {"split": report.split},
        {},
        report.left_out,
        *_parts_history(path),
    )


def _motion(path: Path, source: str, question: Question, asked: Sequence[str]) -> Measured:
    report = evaluate_motion(
        path, question.truth, protocol=question.protocol, split=question.split, intersect=question.intersect
    )
    batch = RELEASE_BATCH if question.protocol == "release" else None
    metric = motion_weighted(report.statistics, MAIN_TAU[question.protocol], batch)
    lengths = {"epe3d": report.length_unit, "part_rotation": "degree", "part_displacement": report.length_unit}
    return Measured(
        source,
        "motion",
        "sequences",
        report.names,
        metric,
        _alone(metric, len(report.names), asked),
        {name: lengths.get(name, "fraction") for name in asked},
        {"split": report.split},
        {"frame pairs": [pairs.tolist() for pairs in report.pairs]},
        report.left_out,
        *_parts_history(path),
    )


def _video(path: Path, source: str, question: Question) -> Measured:
    """A view is a sample: its frames look alike."""
    from dpcli.evaluate.video.comparison import evaluate_video, view_values
    from dpcli.evaluate.video.protocol import choices

    if question.ignore_below or question.split:
        raise UsageError(f"{source}: a video; --ignore-below and --split are for parts files")
    report = evaluate_video(
        path,
        question.truth,
        metrics=question.metrics or ("psnr", "ssim"),
        protocol=question.protocol,
        intersect=question.intersect,
    )
    for name, reason in report.missing.items():
        raise DataError(f"{source}: {name} not computed: {reason}")
    values, units = view_values(report)
    made = of_values(source, "video", "views", values, units, {"protocol": choices(report.protocol)})
    return replace(made, left_out=report.left_out, seed=history_seed(report.history), provenance=report.history)


def _alone(metric: Weighted, samples: int, asked: Sequence[str]) -> dict[str, np.ndarray]:
    blocks = []
    for start in range(0, samples, _ROWS):
        rows = np.arange(start, min(start + _ROWS, samples))
        blocks.append(metric((rows[:, None] == np.arange(samples)).astype(np.float64)))
    return {key: np.concatenate([block[key] for block in blocks]) for key in asked}


def _parts_history(path: Path) -> tuple[int | None, list[dict]]:
    with PartsReader(path) as reader:
        return _history(reader.provenance)


def _history(provenance: list[dict]) -> tuple[int | None, list[dict]]:
    return history_seed(provenance), provenance


def history_seed(provenance: Sequence[dict]) -> int | None:
    """The seed of the last training in a file's history, or of the model that a command used; else of the last command.

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


def of_values(
    source: str,
    task: str,
    kind: str,
    values: Mapping[str, Mapping[str, float]],
    units: Mapping[str, str],
    same: Mapping[str, object] | None = None,
) -> Measured:
    """The same of a table {sample name: {metric: value}} whose metrics are means over the samples (pictures, views).

    DataError naming the samples with an infinite value, or without a sample; NaN = the sample doesn't count.
    """
    names = list(values)
    if not names:
        raise DataError(f"{source}: no {kind} to compare")
    alone = {key: np.array([values[name].get(key, np.nan) for name in names], np.float64) for key in units}
    for key, column in alone.items():
        if np.isinf(column).any():
            bad = [names[row] for row in np.flatnonzero(np.isinf(column))]
            raise DataError(f"{source}: {key} of {len(bad)} {kind} is infinite: {listing(bad)}")
    return Measured(source, task, kind, names, means(alone), alone, units, same or {})
