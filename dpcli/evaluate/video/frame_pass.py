"""One pass over the frames of two videos: pictures are checked, scored in threads, and shown to learned metrics."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.evaluate.results import LeftOut, merge_statistics
from dpcli.evaluate.video.learned.base import LearnedMetric
from dpcli.evaluate.video.picture_statistics import PictureMetrics, PictureStatistics, picture_compute
from dpcli.evaluate.video.protocol import VideoProtocol, check_size, scaled, score_frame
from dpcli.evaluate.video.sources.source import Picture, Source, View
from dpcli.evaluate.video.sources.stored import SceneSource
from dpcli.runtime.device import cpu_count
from dpcli.runtime.progress import Progress

_RATE = 0.01  # how far apart two rates are the same
_SOFT, _MANY = (0.1, 0.9), 20  # alpha in between, and pixels of such that can tell whether colors were multiplied by it
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

    watch(view, frame, frames, predicted, truth) sees every pair. left_out: gets what is not compared, and why.
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
    size: tuple[int, int] = (0, 0)
    brightest: tuple[int, int] = (0, 0)  # 8-bit color of the prediction, of the truth, until one is plausible
    hollow: int = 0  # predicted pictures without an object
    swapped: str = ""  # the first picture that seems to have red and blue swapped
    multiplied: str = ""  # the side and the first picture whose colors seem multiplied by alpha
    misnumbered: str = ""  # the first frames whose names are numbered in different steps

    def score_views(self, pairs: Iterable[tuple[int, int]]) -> list[ViewScore]:
        """Returns the picture metrics of each pair of views, (index in the prediction, index in the truth)."""
        counts = [(ours, theirs, self._common_frames(ours, theirs)) for ours, theirs in pairs]
        scores, damaged = [], []
        with Progress("evaluate", sum(count for *_, count in counts), "frame") as progress:
            for ours, theirs, count in counts:
                found = list(in_threads(self._frame_jobs(ours, theirs, count, damaged), progress))
                if found:
                    view = self.truth.views[theirs]
                    scores.append(ViewScore(view.title, view.role, picture_compute(merge_statistics(found))))
        self._refuse_damaged(damaged)
        self._check_plausible(scores, counts)
        return scores

    def feed(self, pairs: list[tuple[int, int]], metrics: dict[str, LearnedMetric], missing: dict[str, str]) -> None:
        """Shows every usable frame of every pair of views to the metrics, with its number: others may be missing before it.

        A metric that can't go on leaves its reason in `missing`.
        """
        counts = [(ours, theirs, self._common_frames(ours, theirs)) for ours, theirs in pairs]
        damaged: list[str] = []
        with Progress("learned metrics", sum(count for *_, count in counts), "frame") as progress:
            for ours, theirs, count in counts:
                self._call_each(metrics, missing, "start", self.truth.views[theirs].title)
                for frame, predicted, truth in self._finite_frames(ours, theirs, count, damaged):
                    self._look_for_mistakes(predicted, truth, f"view {self.truth.views[theirs].title!r}, frame {frame}")
                    pair = (scaled(picture, self.protocol) for picture in (predicted, truth))
                    self._call_each(metrics, missing, "add", *pair, frame)
                    progress.advance()
                self._call_each(metrics, missing, "end")
        self._refuse_damaged(damaged)
        self._refuse_dim()

    @staticmethod
    def _call_each(metrics: dict[str, LearnedMetric], missing: dict[str, str], verb: str, *given: Any) -> None:
        for name, metric in metrics.items():
            if name not in missing:
                try:
                    getattr(metric, verb)(*given)
                except DataError as error:
                    missing[name] = str(error)

    def _refuse_damaged(self, damaged: list[str]) -> None:
        if damaged and not self.intersect:
            raise DataError(
                f"{self.predicted.path}: {counted(len(damaged), 'frame')} with NaN or infinite pixels, the first "
                f"{damaged[0]}; make them again, or leave them out with --intersect"
            )
        if damaged:
            self.left_out.append(LeftOut("frames in which the prediction has NaN or infinite pixels", damaged))

    def _common_frames(self, ours: int, theirs: int) -> int:
        """Returns how many frames of a pair of views are compared."""
        own, other = (s.frames[i] if s.frames else None for s, i in ((self.predicted, ours), (self.truth, theirs)))
        self.misnumbered = self.misnumbered or self._numbered_otherwise(ours, theirs)
        if own is None or own == other:
            return int(other)
        if not self.intersect:
            title = self.truth.views[theirs].title
            raise DataError(
                f"{self.predicted.path}: view {title!r} has {own} frames, {other} in {self.truth.path}; the first "
                f"without a partner is frame {min(own, other)}; --intersect compares the first {min(own, other)}"
                + (f", though their names number them otherwise ({self.misnumbered})" if self.misnumbered else "")
            )
        self.left_out.append(
            LeftOut(
                f"frames of view {self.truth.views[theirs].title!r} that one side lacks",
                [str(frame) for frame in range(min(own, other), max(own, other))],
            )
        )
        return min(own, other)

    def _numbered_otherwise(self, ours: int, theirs: int) -> str:
        """Returns, in words, the first frames that the names of both sides number in different steps; "" without such.

        Of sides that have not equally many, the names count themselves: the first frame may be what one lacks. Where only one
        side has numbers, these should be even.
        """
        own, other = (s.numbers[i] if s.numbers else None for s, i in ((self.predicted, ours), (self.truth, theirs)))
        if own is None or other is None:
            return _gap_in(own or other or [])
        first = (own[0], other[0]) if len(own) == len(other) else (0, 0)
        odd = [k for k, (a, b) in enumerate(zip(own, other)) if a - first[0] != b - first[1]]
        return f"{own[odd[0]]} with {other[odd[0]]}" if odd else ""

    def _timed_otherwise(self) -> str:
        """Returns, in words, the first frames that lie more than half a frame apart in time, counted from the first frame of
        each side; "" without such. Both sides have a rate, nearly the same.
        """
        own, other = (np.asarray(s.times) - s.times[0] for s in (self.predicted, self.truth))
        count = min(len(own), len(other))
        apart = own[:count] * self.predicted.rate - other[:count] * self.truth.rate  # frames: rates may differ a little
        odd = np.flatnonzero(np.abs(apart) > 0.5)
        return f"frame {odd[0]}: after {own[odd[0]]:.4g} s and {other[odd[0]]:.4g} s" if len(odd) else ""

    def _frame_jobs(
        self, ours: int, theirs: int, count: int, damaged: list[str]
    ) -> Iterator[Callable[[], PictureStatistics]]:
        """Yields a function that scores a frame for each frame; pictures are read as they are needed."""
        view = self.truth.views[theirs]
        for frame, predicted, truth in self._finite_frames(ours, theirs, count, damaged, self.watch):
            check_size(truth.size, self.protocol, self.metrics, str(self.truth.path))
            self._look_for_mistakes(predicted, truth, f"view {view.title!r}, frame {frame}")
            yield lambda f=frame, p=predicted, t=truth: score_frame(f, p, t, self.protocol, self.metrics)

    def _finite_frames(
        self, ours: int, theirs: int, count: int, damaged: list[str], watch: Watch = lambda *_: None
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
                damaged.append(f"view {view.title} frame {frame} ({counted(predicted.unusable, 'pixel')})")
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

    def _look_for_mistakes(self, predicted: Picture, truth: Picture, where: str) -> None:
        """Notes what tells broken pictures: 0..1 saved as 8 bits, no object, red and blue swapped, colors times alpha."""
        if self.brightest[0] <= 1 and predicted.rgba is not None and truth.rgba is not None:
            pair = (int(p.rgba[..., :3].max()) for p in (predicted, truth))
            self.brightest = tuple(max(*both) for both in zip(self.brightest, pair, strict=True))  # type: ignore
        if self.predicted.has_alpha:
            self.hollow += not (predicted.rgba if predicted.values is None else predicted.values)[..., 3].any()
        if not self.swapped and where.endswith("frame 0"):
            self.swapped = (
                where if _red_and_blue_swapped(scaled(predicted, self.protocol), scaled(truth, self.protocol)) else ""
            )
        if not self.multiplied and where.endswith("frame 0") and predicted.size == truth.size:
            sides = (("prediction", predicted, truth), ("truth", truth, predicted))
            found = (side for side, own, other in sides if _multiplied_by_alpha(own, other.over((1.0, 1.0, 1.0))))
            self.multiplied = next((f"{side} ({where})" for side in found), "")

    def _check_plausible(self, scores: list[ViewScore], counts: list) -> None:
        if not scores and counts:
            raise DataError(f"{self.predicted.path}: every frame has NaN or infinite pixels; nothing to compare")
        self._refuse_dim()
        if "psnr_foreground" in self.metrics and scores and not any(score.metrics.object_pixels for score in scores):
            raise DataError(
                f"{self.truth.path}: no frame has an object (alpha is below one half everywhere); mask it "
                "(`dpc prepare video`), or leave out psnr_foreground"
            )

    def _refuse_dim(self) -> None:
        if self.brightest[0] == 1 < self.brightest[1]:
            raise DataError(
                f"{self.predicted.path}: 8-bit pictures with no value above 1; colors in 0..1 were saved without "
                "multiplying by 255"
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
        rates = self.predicted.rate, self.truth.rate
        if all(rates) and abs(rates[0] / rates[1] - 1) > _RATE:
            lines.append(
                f"The prediction plays {rates[0]:.4g} frames a second, the truth {rates[1]:.4g}: compared by their number."
            )
        elif all(rates) and (odd := self._timed_otherwise()):
            lines.append(
                f"Frames are compared in their order, though they were filmed at other moments ({odd}): does one side lack some?"
            )
        if self.misnumbered:
            lines.append(
                f"Frames are compared in their order, though their names number them otherwise ({self.misnumbered}): does one "
                "side lack some, or have every second one?"
            )
        if self.swapped:
            lines.append(
                f"Red and blue look swapped in the prediction ({self.swapped}): with them exchanged it is much "
                "closer to the truth; was it saved as BGR?"
            )
        if self.multiplied:
            lines.append(
                f"Colors look multiplied by alpha in the {self.multiplied}: read so, they are much closer to the other's; "
                "straight alpha is expected."
            )
        if self.hollow:
            lines.append(f"Predicted pictures without an object (alpha 0 everywhere): {self.hollow}.")
        return lines


def _gap_in(numbers: Sequence[int]) -> str:
    """Returns, in words, the first two rising numbers that lie at least twice as far apart as the nearest; "" without such.

    >>> _gap_in([0, 1, 3, 4]), _gap_in([0, 5, 10])
    ('3 right after 1', '')
    """
    steps = np.diff(numbers)
    wide = np.flatnonzero(steps >= 2 * steps.min()) if len(steps) else []
    return f"{numbers[wide[0] + 1]} right after {numbers[wide[0]]}" if len(wide) else ""


def _red_and_blue_swapped(predicted: np.ndarray, truth: np.ndarray) -> bool:
    """Returns whether exchanging red and blue takes away nearly all of the error, of pictures f32 (3,H,W) in 0..1."""
    error, other = (float(np.square(p - truth).mean()) for p in (predicted, predicted[::-1]))
    return error > 1e-3 and other < 0.1 * error


def _multiplied_by_alpha(picture: Picture, other: np.ndarray) -> bool:
    """Returns whether colors that count as multiplied by alpha lose nearly all of their error where alpha is in between.

    other: the other side's picture on white, f32 (3,H,W) in 0..1.
    """
    values = picture.values if picture.rgba is None else picture.rgba.astype(np.float32) / 255
    alpha = values[..., 3]
    soft = (alpha > _SOFT[0]) & (alpha < _SOFT[1])
    if soft.sum() < _MANY or not np.isfinite(values).all():
        return False
    colors, alpha, other = values[soft, :3], alpha[soft, None], other[:, soft].T
    straight = colors / alpha if picture.rgba is None else colors
    if (straight > alpha + 0.01).any():
        return False
    error, read_so = (
        float(np.square(shown - other).mean()) for shown in (straight * alpha + 1 - alpha, straight + 1 - alpha)
    )
    return error > 1e-3 and read_so < 0.1 * error


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
