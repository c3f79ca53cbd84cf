"""One pass over the frames of two videos: pictures are checked, scored in threads, and shown to learned metrics."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.evaluate.results import LeftOut, merge_statistics
from dpcli.evaluate.video.learned.base import LearnedMetric
from dpcli.evaluate.video.mistakes import Mistakes
from dpcli.evaluate.video.picture_statistics import PictureMetrics, PictureStatistics, picture_compute
from dpcli.evaluate.video.protocol import VideoProtocol, check_size, scaled, score_frame
from dpcli.evaluate.video.sources.source import Picture, Source, View
from dpcli.evaluate.video.sources.stored import SceneSource
from dpcli.runtime.device import cpu_count
from dpcli.runtime.progress import Progress

Watch = Callable[[View, int, int, Picture, Picture], None]


@dataclass
class ViewScore:
    """Holds the metrics of one view; `title` and `role` are the truth's."""

    title: str
    role: str
    metrics: PictureMetrics


@dataclass
class FramePass:
    """Goes over all pairs of pictures of a predicted and a true video, which must have the same frames and sizes.

    watch(view, frame, frames, predicted, truth) sees every pair. left_out: gets what is not compared, and why. mistakes: looks
    at every pair, too.
    Raises DataError, naming the first difference, where frames or sizes differ and for NaN or infinite pixels; with
    `intersect` the first frames that both have are compared, and predicted frames that are not finite left out.
    """

    predicted: Source
    truth: Source
    protocol: VideoProtocol
    metrics: list[str]
    intersect: bool
    watch: Watch
    left_out: list[LeftOut]
    mistakes: Mistakes
    size: tuple[int, int] = (0, 0)
    damaged: list[str] = field(default_factory=list)  # predicted frames that are not finite

    def score_views(self, pairs: Iterable[tuple[int, int]]) -> list[ViewScore]:
        """Returns the picture metrics of each pair of views, (index in the prediction, index in the truth)."""
        counts = [(ours, theirs, self._common_frames(ours, theirs)) for ours, theirs in pairs]
        scores = []
        with Progress("evaluate", sum(count for *_, count in counts), "frame") as progress:
            for ours, theirs, count in counts:
                found = list(in_threads(self._frame_jobs(ours, theirs, count), progress))
                if found:
                    view = self.truth.views[theirs]
                    scores.append(ViewScore(view.title, view.role, picture_compute(merge_statistics(found))))
        self._refuse_damaged()
        self._check_plausible(scores, counts)
        return scores

    def feed(self, pairs: list[tuple[int, int]], metrics: dict[str, LearnedMetric], missing: dict[str, str]) -> None:
        """Shows every usable frame of every pair of views to the metrics, with its number: others may be missing before it.

        A metric that can't go on leaves its reason in `missing`.
        """
        counts = [(ours, theirs, self._common_frames(ours, theirs)) for ours, theirs in pairs]
        with Progress("learned metrics", sum(count for *_, count in counts), "frame") as progress:
            for ours, theirs, count in counts:
                self._call_each(metrics, missing, "start", self.truth.views[theirs].title)
                for frame, predicted, truth in self._finite_frames(ours, theirs, count):
                    self.mistakes.look(predicted, truth, self.truth.views[theirs].title, frame)
                    pair = (scaled(picture, self.protocol) for picture in (predicted, truth))
                    self._call_each(metrics, missing, "add", *pair, frame)
                    progress.advance()
                self._call_each(metrics, missing, "end")
        self._refuse_damaged()
        self.mistakes.refuse_dim()

    @staticmethod
    def _call_each(metrics: dict[str, LearnedMetric], missing: dict[str, str], verb: str, *given: Any) -> None:
        for name, metric in metrics.items():
            if name not in missing:
                try:
                    getattr(metric, verb)(*given)
                except DataError as error:
                    missing[name] = str(error)

    def _refuse_damaged(self) -> None:
        if self.damaged and not self.intersect:
            raise DataError(
                f"{self.predicted.path}: {counted(len(self.damaged), 'frame')} with NaN or infinite pixels, the first "
                f"{self.damaged[0]}; make them again, or leave them out with --intersect"
            )
        if self.damaged:
            self.left_out.append(LeftOut("frames in which the prediction has NaN or infinite pixels", self.damaged))

    def _common_frames(self, ours: int, theirs: int) -> int:
        """Returns how many frames of a pair of views are compared."""
        own, other = (s.frames[i] if s.frames else None for s, i in ((self.predicted, ours), (self.truth, theirs)))
        misnumbered = self.mistakes.compare_numbers(ours, theirs)
        if own is None or own == other:
            return int(other)
        if not self.intersect:
            title = self.truth.views[theirs].title
            raise DataError(
                f"{self.predicted.path}: view {title!r} has {own} frames, {other} in {self.truth.path}; the first "
                f"without a partner is frame {min(own, other)}; --intersect compares the first {min(own, other)}"
                + (f", though their names number them otherwise ({misnumbered})" if misnumbered else "")
            )
        self.left_out.append(
            LeftOut(
                f"frames of view {self.truth.views[theirs].title!r} that one side lacks",
                [str(frame) for frame in range(min(own, other), max(own, other))],
            )
        )
        return min(own, other)

    def _frame_jobs(self, ours: int, theirs: int, count: int) -> Iterator[Callable[[], PictureStatistics]]:
        """Yields a function that scores a frame for each frame; pictures are read as they are needed."""
        view = self.truth.views[theirs]
        for frame, predicted, truth in self._finite_frames(ours, theirs, count, self.watch):
            check_size(truth.size, self.protocol, self.metrics, str(self.truth.path))
            self.mistakes.look(predicted, truth, view.title, frame)
            yield lambda f=frame, p=predicted, t=truth: score_frame(f, p, t, self.protocol, self.metrics)

    def _finite_frames(
        self, ours: int, theirs: int, count: int, watch: Watch = lambda *_: None
    ) -> Iterator[tuple[int, Picture, Picture]]:
        """Yields frame, predicted and true picture of a pair of views; frames not finite in the prediction go to `damaged`."""
        frames, view = range(count), self.truth.views[theirs]
        pairs = zip(frames, self.predicted.pictures(ours, frames), self.truth.pictures(theirs, frames), strict=True)
        for frame, predicted, truth in pairs:
            self._check_size(predicted, truth, f"view {view.title!r}, frame {frame}")
            if truth.unusable:
                raise DataError(
                    f"{self.truth.path}: view {view.title!r}, frame {frame}: {counted(truth.unusable, 'pixel')} "
                    "that are NaN or infinite; make the truth again"
                )
            watch(view, frame, count, predicted, truth)
            if predicted.unusable:
                self.damaged.append(f"view {view.title} frame {frame} ({counted(predicted.unusable, 'pixel')})")
            else:
                yield frame, predicted, truth

    def _check_size(self, predicted: Picture, truth: Picture, where: str) -> None:
        if self.protocol.size is None and predicted.size != truth.size:
            ours, theirs = (f"{width}x{height}" for width, height in (predicted.size, truth.size))
            raise DataError(
                f"{self.predicted.path}: {where} is {ours}, but {theirs} in {self.truth.path}; render or resize "
                "to that size, or --protocol consistent4d resizes both"
            )
        self.size = truth.size

    def _check_plausible(self, scores: list[ViewScore], counts: list) -> None:
        if not scores and counts:
            raise DataError(f"{self.predicted.path}: every frame has NaN or infinite pixels; nothing to compare")
        self.mistakes.refuse_dim()
        if "psnr_foreground" in self.metrics and scores and not any(score.metrics.object_pixels for score in scores):
            raise DataError(
                f"{self.truth.path}: no frame has an object (alpha is below one half everywhere); mask it "
                "(`dpc prepare video`), or leave out psnr_foreground"
            )

    def notes(self) -> list[str]:
        """Returns sentences on how pictures were compared, and on what looks like a mistake in the prediction."""
        lines = []
        if isinstance(self.predicted, SceneSource) and self.metrics:
            lines.append("The scene is rendered at the truth's cameras and times, in float32.")
        if not self.predicted.has_alpha:
            lines.append(f"The prediction ({self.predicted.kind}) has no alpha: its colors are compared as they are.")
        if not self.truth.has_alpha:
            lines.append(f"The truth ({self.truth.kind}) has no alpha: background and object are compared alike.")
        return lines + self.mistakes.notes()


def in_threads(work: Iterator[Callable[[], PictureStatistics]], progress: Progress) -> Iterator[PictureStatistics]:
    """Yields the results in order; reading goes on while earlier frames are scored, a few pictures in memory at a time."""
    workers = min(8, cpu_count())
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
