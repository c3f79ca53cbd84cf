"""Two videos of one object side by side: the same views, frames and sizes, or an error that says where they differ."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import Interval, Resampling
from dpcli.evaluate.classification.protocol import LeftOut
from dpcli.evaluate.compare.resampled import means
from dpcli.evaluate.networks.weights import weights_folder
from dpcli.evaluate.proportions import mean_defined
from dpcli.evaluate.video.image_metrics import PictureMetrics, PictureStatistics, picture_compute, picture_merge
from dpcli.evaluate.video.network_metrics import LEARNED, LearnedMetric, LearnedScore, load_metrics
from dpcli.evaluate.video.protocol import (
    PICTURE_METRICS,
    SCENE_METRICS,
    VideoProtocol,
    check_size,
    scaled,
    score_frame,
    video_protocol,
)
from dpcli.evaluate.video.sources import Picture, SceneSource, Source, View, ViewsSource, open_source
from dpcli.evaluate.video.view_pairing import match_views
from dpcli.runtime.progress import Progress

NO_INTERVALS = Resampling(0)
ROLES = ("reference", "test", "train")


@dataclass
class ViewScore:
    """Metrics of one view; `title` and `role` are the truth's."""

    title: str
    role: str
    metrics: PictureMetrics


@dataclass
class VideoReport:
    """Metrics of each view, their means over views (of each role, of all), and a scene's parts and tracks."""

    protocol: VideoProtocol
    names: tuple[str, ...]  # of the metrics
    truth: str
    size: tuple[int, int]
    views: list[ViewScore]
    left_out: list[LeftOut]
    notes: list[str]
    learned: dict[str, LearnedScore] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)  # metrics that were asked for and not computed, and why
    scene: dict[str, Any] = field(default_factory=dict)  # "parts", "tracks": scores of discovery.py
    length_unit: str = ""
    history: list[dict] = field(default_factory=list)
    resampling: Resampling = NO_INTERVALS
    intervals: dict[str, Interval] = field(default_factory=dict)  # of the means over all views

    @property
    def roles(self) -> dict[str, dict[str, float]]:
        """Means over the views of each role that occurs."""
        return {role: self.mean(role) for role in ROLES if any(view.role == role for view in self.views)}

    def mean(self, role: str | None = None) -> dict[str, float]:
        """Metric -> mean over the views of a role, or over all; NaN = undefined."""
        chosen = [view.metrics for view in self.views if role in (None, view.role)]
        names = [name for name in self.names if name in PICTURE_METRICS]
        return {name: mean_defined(np.array([getattr(one, name) for one in chosen])) for name in names}


def evaluate_video(
    path: str | Path,
    truth: str | Path,
    *,
    metrics: Sequence[str] | None = None,
    protocol: str | VideoProtocol = "dpc",
    background: str | None = None,
    intersect: bool = False,
    seed: int = 0,
    watch: Callable[[View, int, int, Picture, Picture], None] | None = None,
    weights: Path | None = None,
    device: str = "cpu",
    resampling: Resampling = NO_INTERVALS,
) -> VideoReport:
    """Metrics of a predicted video against the true one; each of the kinds `video_sources.open_source` knows.

    metrics: names of PICTURE_METRICS, LEARNED and SCENE_METRICS; None = all that these files allow, but MS-SSIM and the
    learned ones. intersect: compare the views and first frames that both have and that are finite, list the rest.
    seed: of the k-means baseline of `parts`. watch(view, frame, frames, predicted, truth): sees every pair of pictures.
    weights: folder of the learned metrics' networks; a metric whose network is absent is listed in `missing`.
    resampling: how to find intervals of the means over views.
    DataError, naming the first difference, when views, frames or sizes differ, and for NaN or infinite pixels;
    UsageError for protocols, metrics and backgrounds there aren't.
    """
    chosen = protocol if isinstance(protocol, VideoProtocol) else video_protocol(protocol, background)
    with closing(open_source(Path(truth))) as real, closing(open_source(Path(path), truth=real)) as said:
        names = _metrics(metrics, said, real)
        pictured = [name for name in names if name in PICTURE_METRICS]
        left_out: list[LeftOut] = []
        pairs = match_views(said, real, chosen, intersect, left_out) if pictured else []
        run = _Run(said, real, chosen, pictured, intersect, watch or (lambda *_: None), left_out)
        views = run.views(pairs)
        learned, missing = _learned_scores(run, [name for name in names if name in LEARNED], weights, device)
        scene = _scene_scores(said, real, names, seed)
        unit = real.header.length_unit if real.header else ""
        report = VideoReport(
            chosen,
            tuple(names),
            str(truth),
            run.size,
            views,
            left_out,
            run.notes(),
            learned,
            missing,
            scene,
            unit,
            list(said.history),
            resampling,
        )
        report.intervals = _intervals(report)
        return report


def _intervals(report: VideoReport) -> dict[str, Interval]:
    """Of the means over views, views being resampled; none of a lone view."""
    values, units = view_values(report)
    if len(values) < 2:
        return {}
    columns = {key: np.array([own.get(key, np.nan) for own in values.values()]) for key in units}
    return report.resampling.intervals(means(columns), len(values))


def _learned_scores(
    run: _Run, names: Sequence[str], weights: Path | None, device: str
) -> tuple[dict[str, LearnedScore], dict[str, str]]:
    """Scores of the learned metrics, and why others have none: a pass of its own, frames in order."""
    if not names:
        return {}, {}
    made, missing = load_metrics(names, run.protocol.networks, weights_folder(weights), device)
    others = replace(run.protocol, views=run.protocol.learned_views or run.protocol.views)
    second = replace(run, left_out=[])
    if made:
        second.feed(match_views(run.said, run.real, others, run.intersect, second.left_out), made, missing)
    run.size = second.size
    run.left_out.extend(entry for entry in second.left_out if entry not in run.left_out)  # each is said once
    scores = {}
    for name, metric in made.items():
        if name not in missing:
            try:
                scores[name] = metric.score()
            except DataError as error:
                missing[name] = str(error)
    return scores, missing


def view_values(report: VideoReport) -> tuple[dict[str, dict[str, float]], dict[str, str]]:
    """{view: {metric: value}} of metrics whose value is the mean over views, and each one's unit."""
    pictured = [name for name in report.names if name in PICTURE_METRICS]
    values = {view.title: {name: getattr(view.metrics, name) for name in pictured} for view in report.views}
    units = {name: "dB" if name.startswith("psnr") else "1" for name in pictured}
    for name, score in report.learned.items():
        for view, value in score.per_view.items():
            values.setdefault(view, {})[name] = value
            units[name] = "1"
    return values, units


def _metrics(asked: Sequence[str] | None, said: Source, real: Source) -> list[str]:
    """The metrics to compute. DataError for what these sources can't give."""
    scene = isinstance(said, SceneSource) and isinstance(real, ViewsSource)
    fields = real.reader.fields if scene else ()
    possible = ["psnr", *(["psnr_foreground"] if real.has_alpha else []), "ssim"]
    possible += [name for name, key in zip(SCENE_METRICS, ("part", "track")) if key in fields]
    if asked is None:
        return possible
    for name in asked:
        if name == "psnr_foreground" and not real.has_alpha:
            raise DataError(f"{real.path}: no alpha, so nobody knows the object's pixels; leave out psnr_foreground")
        if name in SCENE_METRICS and not scene:
            raise DataError(
                f"--metrics {name} needs a gaussians file and a views file, not a {said.kind} and a {real.kind}"
            )
        if name in SCENE_METRICS and name not in possible:
            raise DataError(
                f"{real.path}: no surface {name} in it; `dpc prepare animation`, artemis and synthetic "
                f"animal write them; leave {name} out of --metrics"
            )
    return list(asked)


def _scene_scores(said: Source, real: Source, names: Sequence[str], seed: int) -> dict[str, Any]:
    if not set(names) & set(SCENE_METRICS):
        return {}
    from dpcli.evaluate.video.part_discovery import part_score, track_score

    track, scores = real.reader.track, {}
    if "parts" in names:
        scores["parts"] = part_score(said.scene, track[0], real.reader.part, real.header.time[0], seed=seed)
    if "tracks" in names:
        scores["tracks"] = track_score(said.scene, track, real.header.time)
    return scores


@dataclass
class _Run:
    """One pass over all pairs of pictures."""

    said: Source
    real: Source
    protocol: VideoProtocol
    metrics: list[str]
    intersect: bool
    watch: Callable[[View, int, int, Picture, Picture], None]
    left_out: list[LeftOut]
    size: tuple[int, int] = (0, 0)
    brightest: tuple[int, int] = (0, 0)  # 8-bit color of the prediction, of the truth, until one is plausible
    hollow: int = 0  # predicted pictures without an object
    swapped: str = ""  # the first picture that seems to have red and blue swapped

    def views(self, pairs: Iterable[tuple[int, int]]) -> list[ViewScore]:
        counts = [(ours, theirs, self._frames(ours, theirs)) for ours, theirs in pairs]
        scores, damaged = [], []
        with Progress("evaluate", sum(count for *_, count in counts), "frame") as progress:
            for ours, theirs, count in counts:
                found = list(_in_threads(self._work(ours, theirs, count, damaged), progress))
                if found:
                    view = self.real.views[theirs]
                    scores.append(ViewScore(view.title, view.role, picture_compute(picture_merge(found))))
        self._say_damaged(damaged)
        self._plausible(scores, counts)
        return scores

    def feed(self, pairs: list[tuple[int, int]], metrics: dict[str, LearnedMetric], missing: dict[str, str]) -> None:
        """Show every usable frame of every pair of views to the metrics, with its number, since others may be missing
        before it; a metric that can't go on leaves its reason in `missing`."""
        counts = [(ours, theirs, self._frames(ours, theirs)) for ours, theirs in pairs]
        damaged: list[str] = []
        with Progress("learned metrics", sum(count for *_, count in counts), "frame") as progress:
            for ours, theirs, count in counts:
                self._each(metrics, missing, "start", self.real.views[theirs].title)
                for frame, predicted, truth in self._checked(ours, theirs, count, damaged):
                    pair = (scaled(picture, self.protocol) for picture in (predicted, truth))
                    self._each(metrics, missing, "add", *pair, frame)
                    progress.advance()
                self._each(metrics, missing, "end")
        self._say_damaged(damaged)

    @staticmethod
    def _each(metrics: dict[str, LearnedMetric], missing: dict[str, str], verb: str, *given: Any) -> None:
        for name, metric in metrics.items():
            if name not in missing:
                try:
                    getattr(metric, verb)(*given)
                except DataError as error:
                    missing[name] = str(error)

    def _say_damaged(self, damaged: list[str]) -> None:
        if damaged and not self.intersect:
            raise DataError(
                f"{self.said.path}: {len(damaged)} frames with NaN or infinite pixels, the first "
                f"{damaged[0]}; make them again, or leave them out with --intersect"
            )
        if damaged:
            self.left_out.append(LeftOut("frames in which the prediction has NaN or infinite pixels", damaged))

    def _frames(self, ours: int, theirs: int) -> int:
        """How many frames of a pair of views are compared."""
        own, other = (s.frames[i] if s.frames else None for s, i in ((self.said, ours), (self.real, theirs)))
        if own is None or own == other:
            return int(other)
        if not self.intersect:
            title = self.real.views[theirs].title
            raise DataError(
                f"{self.said.path}: view {title!r} has {own} frames, {other} in {self.real.path}; the first "
                f"without a partner is frame {min(own, other)}; --intersect compares the first {min(own, other)}"
            )
        self.left_out.append(
            LeftOut(
                f"frames of view {self.real.views[theirs].title!r} that one side lacks",
                [str(frame) for frame in range(min(own, other), max(own, other))],
            )
        )
        return min(own, other)

    def _work(
        self, ours: int, theirs: int, count: int, damaged: list[str]
    ) -> Iterator[Callable[[], PictureStatistics]]:
        """A scoring to do for each frame, pictures read as they are needed."""
        view = self.real.views[theirs]
        for frame, predicted, truth in self._checked(ours, theirs, count, damaged, self.watch):
            self._look(predicted, truth, f"view {view.title!r}, frame {frame}")
            yield lambda f=frame, p=predicted, t=truth: score_frame(f, p, t, self.protocol, self.metrics)

    def _checked(
        self,
        ours: int,
        theirs: int,
        count: int,
        damaged: list[str],
        watch: Callable[[View, int, int, Picture, Picture], None] = lambda *_: None,
    ) -> Iterator[tuple[int, Picture, Picture]]:
        """Frame, predicted, true picture of a pair of views; frames whose prediction isn't finite go to `damaged`."""
        frames, view = range(count), self.real.views[theirs]
        pairs = zip(frames, self.said.pictures(ours, frames), self.real.pictures(theirs, frames), strict=True)
        for frame, predicted, truth in pairs:
            self._same_size(predicted, truth, f"view {view.title!r}, frame {frame}")
            if truth.unusable:
                raise DataError(
                    f"{self.real.path}: view {view.title!r}, frame {frame}: {truth.unusable} pixels are NaN "
                    "or infinite; make the truth again"
                )
            watch(view, frame, count, predicted, truth)
            if predicted.unusable:
                damaged.append(f"view {view.title} frame {frame} ({predicted.unusable} pixels)")
            else:
                yield frame, predicted, truth

    def _same_size(self, predicted: Picture, truth: Picture, where: str) -> None:
        if self.protocol.size is None and predicted.size != truth.size:
            ours, theirs = (f"{width}x{height}" for width, height in (predicted.size, truth.size))
            raise DataError(
                f"{self.said.path}: {where} is {ours}, but {theirs} in {self.real.path}; render or resize "
                "to that size, or --protocol consistent4d resizes both"
            )
        if self.size == (0, 0):
            check_size(truth.size, self.protocol, self.metrics, str(self.real.path))
        self.size = truth.size

    def _look(self, predicted: Picture, truth: Picture, where: str) -> None:
        """Note what tells a broken prediction: 0..1 saved as 8 bits, no object, red and blue swapped."""
        if self.brightest[0] <= 1 and predicted.rgba is not None and truth.rgba is not None:
            pair = (int(p.rgba[..., :3].max()) for p in (predicted, truth))
            self.brightest = tuple(max(*both) for both in zip(self.brightest, pair, strict=True))  # type: ignore
        if self.said.has_alpha:
            self.hollow += not (predicted.rgba if predicted.values is None else predicted.values)[..., 3].any()
        if not self.swapped and where.endswith("frame 0"):
            self.swapped = where if _swapped(scaled(predicted, self.protocol), scaled(truth, self.protocol)) else ""

    def _plausible(self, scores: list[ViewScore], counts: list) -> None:
        if not scores and counts:
            raise DataError(f"{self.said.path}: every frame has NaN or infinite pixels; nothing to compare")
        if self.brightest[0] == 1 < self.brightest[1]:
            raise DataError(
                f"{self.said.path}: 8-bit pictures with no value above 1; colors in 0..1 were saved without "
                "multiplying by 255"
            )
        if "psnr_foreground" in self.metrics and scores and not any(score.metrics.object_pixels for score in scores):
            raise DataError(
                f"{self.real.path}: no frame has an object (alpha is below one half everywhere); mask it "
                "(`dpc prepare video`), or leave out psnr_foreground"
            )

    def notes(self) -> list[str]:
        lines = []
        if isinstance(self.said, SceneSource) and self.metrics:
            lines.append("The scene is rendered at the truth's cameras and times, in float32.")
        if not self.said.has_alpha:
            lines.append(f"The prediction ({self.said.kind}) has no alpha: its colors are compared as they are.")
        if not self.real.has_alpha:
            lines.append(f"The truth ({self.real.kind}) has no alpha: background and object are compared alike.")
        if self.swapped:
            lines.append(
                f"Red and blue look swapped in the prediction ({self.swapped}): with them exchanged it is much "
                "closer to the truth; was it saved as BGR?"
            )
        if self.hollow:
            lines.append(f"Predicted pictures without an object (alpha 0 everywhere): {self.hollow}.")
        return lines


def _swapped(predicted: np.ndarray, truth: np.ndarray) -> bool:
    """Whether exchanging red and blue takes away nearly all of the error, of pictures f32 (3,H,W) in 0..1."""
    error, other = (float(np.square(p - truth).mean()) for p in (predicted, predicted[::-1]))
    return error > 1e-3 and other < 0.1 * error


def _in_threads(work: Iterator[Callable[[], PictureStatistics]], progress: Progress) -> Iterator[PictureStatistics]:
    """Results in order; reading goes on while earlier frames are scored, a few pictures in memory at a time."""
    workers = max(1, min(8, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1))
    waiting: deque[Future] = deque()
    with ThreadPoolExecutor(workers) as pool:
        for job in work:
            waiting.append(pool.submit(job))
            if len(waiting) > workers:
                yield waiting.popleft().result()
                progress.advance()
        for future in waiting:
            yield future.result()
            progress.advance()
