"""Two videos of one object side by side: the same views, frames and sizes, or an error that says where they differ."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.image_metrics import PictureMetrics, PictureStatistics, picture_compute, picture_merge
from dpcli.evaluate.protocol import LeftOut
from dpcli.evaluate.ratio import mean_defined
from dpcli.evaluate.video_pairing import match_views
from dpcli.evaluate.video_protocol import (
    PICTURE_METRICS,
    SCENE_METRICS,
    VideoProtocol,
    check_size,
    score_frame,
    video_protocol,
)
from dpcli.evaluate.video_sources import Picture, SceneSource, Source, View, ViewsSource, open_source
from dpcli.runtime.progress import Progress

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
    scene: dict[str, Any] = field(default_factory=dict)  # "parts", "tracks": scores of discovery.py
    length_unit: str = ""
    history: list[dict] = field(default_factory=list)

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
    path: str | Path, truth: str | Path, *, metrics: Sequence[str] | None = None, protocol: str = "dpc",
    background: str | None = None, intersect: bool = False, seed: int = 0,
    watch: Callable[[View, int, int, Picture, Picture], None] | None = None,
) -> VideoReport:  # fmt: skip
    """Metrics of a predicted video against the true one; each of the kinds `video_sources.open_source` knows.

    metrics: names of PICTURE_METRICS and SCENE_METRICS; None = all that these files allow, but MS-SSIM. intersect:
    compare the views and first frames that both have, list the rest. seed: of the k-means baseline of `parts`.
    watch(view, frame, frames, predicted, truth): sees every pair of pictures. Frames in which the prediction has NaN
    are left out and listed. DataError, naming the first difference, when views, frames or sizes differ; UsageError for
    protocols, metrics and backgrounds there aren't.
    """
    chosen = video_protocol(protocol, background)
    with closing(open_source(Path(truth))) as real, closing(open_source(Path(path), truth=real)) as said:
        names = _metrics(metrics, said, real)
        pictured = [name for name in names if name in PICTURE_METRICS]
        left_out: list[LeftOut] = []
        pairs = match_views(said, real, chosen, intersect, left_out) if pictured else []
        run = _Run(said, real, chosen, pictured, intersect, watch or (lambda *_: None), left_out)
        views = run.views(pairs)
        scene = _scene_scores(said, real, names, seed)
        unit = real.header.length_unit if real.header else ""
        return VideoReport(chosen, tuple(names), str(truth), run.size, views, left_out, run.notes(), scene, unit,
                           list(said.history))  # fmt: skip


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
            raise DataError(f"--metrics {name} needs a gaussians file and a views file, not a {said.kind} "
                            f"and a {real.kind}")  # fmt: skip
        if name in SCENE_METRICS and name not in possible:
            raise DataError(f"{real.path}: no surface {name} in it; `dpc prepare animation`, artemis and synthetic "
                            f"animal write them; leave {name} out of --metrics")  # fmt: skip
    return list(asked)


def _scene_scores(said: Source, real: Source, names: Sequence[str], seed: int) -> dict[str, Any]:
    if not set(names) & set(SCENE_METRICS):
        return {}
    from dpcli.evaluate.discovery import part_score, track_score

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
    brightest: tuple[int, int] = (0, 0)  # 8-bit colour of the prediction, of the truth, until one is plausible
    hollow: int = 0  # predicted pictures without an object

    def views(self, pairs: Iterable[tuple[int, int]]) -> list[ViewScore]:
        counts = [(ours, theirs, self._frames(ours, theirs)) for ours, theirs in pairs]
        scores, damaged = [], []
        with Progress("evaluate", sum(count for *_, count in counts), "frame") as progress:
            for ours, theirs, count in counts:
                found = list(_in_threads(self._work(ours, theirs, count, damaged), progress))
                if found:
                    view = self.real.views[theirs]
                    scores.append(ViewScore(view.title, view.role, picture_compute(picture_merge(found))))
        if damaged:
            self.left_out.append(LeftOut("frames in which the prediction has NaN or infinite pixels", damaged))
        self._plausible(scores, counts)
        return scores

    def _frames(self, ours: int, theirs: int) -> int:
        """How many frames of a pair of views are compared."""
        own, other = (s.frames[i] if s.frames else None for s, i in ((self.said, ours), (self.real, theirs)))
        if own is None or own == other:
            return int(other)
        if not self.intersect:
            title = self.real.views[theirs].title
            raise DataError(f"{self.said.path}: view {title!r} has {own} frames, {other} in {self.real.path}; the first "
                            f"without a partner is frame {min(own, other)}; --intersect compares the first {min(own, other)}")  # fmt: skip
        self.left_out.append(LeftOut(f"frames of view {self.real.views[theirs].title!r} that one side lacks",
                                     [str(frame) for frame in range(min(own, other), max(own, other))]))  # fmt: skip
        return min(own, other)

    def _work(
        self, ours: int, theirs: int, count: int, damaged: list[str]
    ) -> Iterator[Callable[[], PictureStatistics]]:
        """A scoring to do for each frame, pictures read as they are needed."""
        frames, view = range(count), self.real.views[theirs]
        pairs = zip(frames, self.said.pictures(ours, frames), self.real.pictures(theirs, frames), strict=True)
        for frame, predicted, truth in pairs:
            self._same_size(predicted, truth, f"view {view.title!r}, frame {frame}")
            if truth.unusable:
                raise DataError(f"{self.real.path}: view {view.title!r}, frame {frame}: {truth.unusable} pixels are NaN "
                                "or infinite; make the truth again")  # fmt: skip
            self.watch(view, frame, count, predicted, truth)
            if predicted.unusable:
                damaged.append(f"view {view.title} frame {frame} ({predicted.unusable} pixels)")
                continue
            self._look(predicted, truth)
            yield lambda f=frame, p=predicted, t=truth: score_frame(f, p, t, self.protocol, self.metrics)

    def _same_size(self, predicted: Picture, truth: Picture, where: str) -> None:
        if self.protocol.size is None and predicted.size != truth.size:
            ours, theirs = (f"{width}x{height}" for width, height in (predicted.size, truth.size))
            raise DataError(f"{self.said.path}: {where} is {ours}, but {theirs} in {self.real.path}; render or resize "
                            "to that size, or --protocol consistent4d resizes both")  # fmt: skip
        if self.size == (0, 0):
            check_size(truth.size, self.protocol, self.metrics, str(self.real.path))
        self.size = truth.size

    def _look(self, predicted: Picture, truth: Picture) -> None:
        """Note what tells a broken prediction: 0..1 saved as 8 bits, or pictures without an object."""
        if self.brightest[0] <= 1 and predicted.rgba is not None and truth.rgba is not None:
            pair = (int(p.rgba[..., :3].max()) for p in (predicted, truth))
            self.brightest = tuple(max(*both) for both in zip(self.brightest, pair, strict=True))  # type: ignore
        if self.said.has_alpha:
            self.hollow += not (predicted.rgba if predicted.values is None else predicted.values)[..., 3].any()

    def _plausible(self, scores: list[ViewScore], counts: list) -> None:
        if not scores and counts:
            raise DataError(f"{self.said.path}: every frame has NaN or infinite pixels; nothing to compare")
        if self.brightest[0] == 1 < self.brightest[1]:
            raise DataError(f"{self.said.path}: 8-bit pictures with no value above 1; colours in 0..1 were saved without "
                            "multiplying by 255")  # fmt: skip
        if "psnr_foreground" in self.metrics and scores and not any(score.metrics.object_pixels for score in scores):
            raise DataError(f"{self.real.path}: no frame has an object (alpha is below one half everywhere); mask it "
                            "(`dpc prepare video`), or leave out psnr_foreground")  # fmt: skip

    def notes(self) -> list[str]:
        lines = []
        if isinstance(self.said, SceneSource) and self.metrics:
            lines.append("The scene is rendered at the truth's cameras and times, in float32.")
        if not self.said.has_alpha:
            lines.append(f"The prediction ({self.said.kind}) has no alpha: its colours are compared as they are.")
        if not self.real.has_alpha:
            lines.append(f"The truth ({self.real.kind}) has no alpha: background and object are compared alike.")
        if self.hollow:
            lines.append(f"Predicted pictures without an object (alpha 0 everywhere): {self.hollow}.")
        return lines


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
