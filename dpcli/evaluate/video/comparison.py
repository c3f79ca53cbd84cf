"""Comparing two videos of one object: PSNR and SSIM of each view, learned metrics, a scene's parts, tracks and surface."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import NO_INTERVALS, Interval, Resampling, means_of_samples
from dpcli.evaluate.choices import LEARNED_METRICS, PICTURE_METRICS, PICTURE_UNITS, SCENE_METRICS
from dpcli.evaluate.networks.weights import weights_folder
from dpcli.evaluate.proportions import mean_defined
from dpcli.evaluate.results import LeftOut
from dpcli.evaluate.video.frame_pass import FramePass, ViewScore, Watch
from dpcli.evaluate.video.learned.base import LearnedScore
from dpcli.evaluate.video.learned.loading import load_metrics
from dpcli.evaluate.video.mistakes import Mistakes
from dpcli.evaluate.video.protocol import VideoProtocol, video_protocol
from dpcli.evaluate.video.sources.open_source import open_source
from dpcli.evaluate.video.sources.source import Source
from dpcli.evaluate.video.sources.stored import SceneSource, ViewsSource
from dpcli.evaluate.video.view_pairing import match_views
from dpcli.runtime.progress import log

ROLES = ("reference", "test", "train")


@dataclass
class VideoReport:
    """Holds metrics of each view, their means over views (of each role, of all), and a scene's parts and tracks.

    names: of the metrics. missing: metrics that were asked for and not computed, and why. scene: "parts", "tracks" and
    "surface": scores of `part_discovery.py` and `surface.py`. intervals: of the means over all views.
    """

    protocol: VideoProtocol
    names: tuple[str, ...]
    truth: str
    size: tuple[int, int]
    views: list[ViewScore]
    left_out: list[LeftOut]
    notes: list[str]
    learned: dict[str, LearnedScore] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    scene: dict[str, Any] = field(default_factory=dict)
    length_unit: str = ""
    provenance: list[dict] = field(default_factory=list)
    resampling: Resampling = NO_INTERVALS
    intervals: dict[str, Interval] = field(default_factory=dict)

    @property
    def roles(self) -> dict[str, dict[str, float]]:
        """Returns the means over the views of each role that occurs."""
        return {role: self.mean(role) for role in ROLES if any(view.role == role for view in self.views)}

    def mean(self, role: str | None = None) -> dict[str, float]:
        """Returns the mean over the views of a role, or over all, by metric; NaN = undefined."""
        chosen = [view.metrics for view in self.views if role in (None, view.role)]
        names = [name for name in self.names if name in PICTURE_METRICS]
        return {name: mean_defined(np.array([getattr(one, name) for one in chosen])) for name in names}


def evaluate_video(
    path: str | Path,
    truth: str | Path,
    *,
    metrics: Sequence[str] | None = None,
    protocol: str | VideoProtocol = "dpc",
    intersect: bool = False,
    seed: int = 0,
    watch: Watch | None = None,
    weights: Path | None = None,
    device: str = "cpu",
    resampling: Resampling = NO_INTERVALS,
) -> VideoReport:
    """Returns the metrics of a predicted video against the true one; each of a kind that `open_source` knows.

    metrics: names of PICTURE_METRICS, LEARNED_METRICS and SCENE_METRICS; None = all that these files allow, but MS-SSIM
    and the learned ones. intersect: compare the views and first frames that both have and that are finite, list the
    rest. seed: of the k-means baseline of `parts`. watch(view, frame, frames, predicted, truth): sees every pair of
    pictures. weights: folder of the learned metrics' networks; a metric whose network is absent is listed in `missing`.
    resampling: how to find intervals of the means over views.
    Raises DataError, naming the first difference, when views, frames or sizes differ, and for NaN or infinite pixels;
    UsageError for protocols and metrics there aren't.
    """
    chosen = protocol if isinstance(protocol, VideoProtocol) else video_protocol(protocol)
    folder = weights_folder(weights)
    with closing(open_source(Path(truth))) as real, closing(open_source(Path(path), truth=real)) as predicted:
        names = _choose_metrics(metrics, predicted, real)
        pictured = [name for name in names if name in PICTURE_METRICS]
        pairs, left_out = match_views(predicted, real, chosen, intersect) if pictured else ([], [])
        mistakes = Mistakes(predicted, real, chosen)
        frames = FramePass(predicted, real, chosen, pictured, intersect, watch or (lambda *_: None), left_out, mistakes)
        views = frames.score_views(pairs)
        learned_names = [name for name in names if name in LEARNED_METRICS]
        if weights is not None and not set(learned_names) - {"warping"}:
            log.warn(f"--weights {weights}: nothing in it is read; none of the metrics asked for needs a network")
        learned, missing = _learned_scores(frames, learned_names, folder, device)
        report = VideoReport(
            protocol=chosen,
            names=tuple(names),
            truth=str(truth),
            size=frames.size,
            views=views,
            left_out=left_out,
            notes=frames.notes(),
            learned=learned,
            missing=missing,
            scene=_scene_scores(predicted, real, names, seed),
            length_unit=real.header.length_unit if real.header else "",
            provenance=list(predicted.provenance),
            resampling=resampling,
        )
        report.intervals = _intervals(report)
        return report


def _intervals(report: VideoReport) -> dict[str, Interval]:
    """Returns intervals of the means over views, views being resampled; none of a lone view."""
    values, units = view_values(report)
    if len(values) < 2:
        return {}
    columns = {key: np.array([own.get(key, np.nan) for own in values.values()]) for key in units}
    return report.resampling.intervals(means_of_samples(columns), len(values))


def _learned_scores(
    frames: FramePass, names: Sequence[str], folder: Path, device: str
) -> tuple[dict[str, LearnedScore], dict[str, str]]:
    """Returns the scores of the learned metrics, and why others have none: a pass of its own, frames in order."""
    if not names:
        return {}, {}
    made, missing = load_metrics(names, frames.protocol.networks, folder, device)
    others = replace(frames.protocol, views=frames.protocol.learned_views or frames.protocol.views)
    second = replace(frames, left_out=[], damaged=[])
    if made:
        pairs, second.left_out = match_views(frames.predicted, frames.truth, others, frames.intersect)
        second.feed(pairs, made, missing)
    frames.size = second.size
    frames.left_out.extend(entry for entry in second.left_out if entry not in frames.left_out)  # each is said once
    scores = {}
    for name, metric in made.items():
        if name not in missing:
            try:
                scores[name] = metric.score()
            except DataError as error:
                missing[name] = str(error)
    return scores, missing


def view_values(report: VideoReport) -> tuple[dict[str, dict[str, float]], dict[str, str]]:
    """Returns {view: {metric: value}} of the metrics whose value is the mean over views, and each one's unit."""
    pictured = [name for name in report.names if name in PICTURE_METRICS]
    values = {view.title: {name: getattr(view.metrics, name) for name in pictured} for view in report.views}
    units = {name: PICTURE_UNITS[name] for name in pictured}
    for name, score in report.learned.items():
        for view, value in score.per_view.items():
            values.setdefault(view, {})[name] = value
            units[name] = "1"
    return values, units


def _choose_metrics(asked: Sequence[str] | None, predicted: Source, truth: Source) -> list[str]:
    """Returns the metrics to compute. Raises DataError for those that these sources can't give."""
    scene = isinstance(predicted, SceneSource) and isinstance(truth, ViewsSource)
    fields = truth.reader.fields if scene else ()
    silhouettes = truth.has_alpha and predicted.has_alpha
    possible = ["psnr", *(["psnr_foreground"] if truth.has_alpha else []), "ssim"]
    possible += ["silhouette_iou"] if silhouettes else []
    possible += [name for name, key in zip(SCENE_METRICS, ("part", "track", "track")) if key in fields]
    if asked is None:
        return [name for name in possible if name not in SCENE_METRICS or _is_known(name, truth)]
    for name in asked:
        if name == "psnr_foreground" and not truth.has_alpha:
            raise DataError(f"{truth.path}: no alpha, so the object's pixels are unknown; leave out psnr_foreground")
        if name == "silhouette_iou" and not silhouettes:
            bare = predicted if truth.has_alpha else truth
            raise DataError(f"{bare.path}: no alpha, so it has no silhouette; leave out silhouette_iou")
        if name in SCENE_METRICS and not scene:
            raise DataError(
                f"--metrics {name} needs a gaussians file and a views file, not a {predicted.kind} and a {truth.kind}"
            )
        if name in SCENE_METRICS and name not in possible:
            raise DataError(
                f"{truth.path}: no surface {'points' if name == 'surface' else name} in it; `dpc prepare animation`, artemis and synthetic "
                f"animal write them; leave {name} out of --metrics"
            )
    return list(asked)


def _is_known(name: str, truth: ViewsSource) -> bool:
    """Returns whether the truth's data sets for a scene's metric hold anything, and warns where they don't."""
    track, part = truth.reader.track, truth.reader.part
    known = bool((part >= 0).any()) if name == "parts" else bool(track.shape[1])
    if not known:
        log.warn(
            f"{truth.path}: {'no surface point has a known part' if track.shape[1] else 'no surface points'}, {name} is left out"
        )
    return known


def _scene_scores(predicted: Source, truth: Source, names: Sequence[str], seed: int) -> dict[str, Any]:
    """Returns the scores of a Gaussian scene's parts, tracks and surface, where they are asked for."""
    if not set(names) & set(SCENE_METRICS):
        return {}
    from dpcli.evaluate.video.part_discovery import part_score, track_score
    from dpcli.evaluate.video.surface import surface_score

    track, scores = truth.reader.track, {}
    if "parts" in names:
        scores["parts"] = part_score(predicted.scene, track[0], truth.reader.part, truth.header.time[0], seed=seed)
    if "tracks" in names:
        scores["tracks"] = track_score(predicted.scene, track, truth.header.time)
    if "surface" in names:
        scores["surface"] = surface_score(predicted.scene, track, truth.header.time, seed=seed)
    return scores
