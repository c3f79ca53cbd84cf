"""`dpc classify predict --stream`: from frames that arrive to predictions that leave."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dpcli.classify.commands.model_task import ModelTask
from dpcli.classify.confidence import Confidence, choose_confidence
from dpcli.classify.data.likeness import like, tell_pace, tell_unlike, tell_values
from dpcli.classify.data.videos import SILENT
from dpcli.classify.network.model_file import ModelInfo, load_model
from dpcli.classify.stream.frame_source import CloudFiles, open_frames, without_padding
from dpcli.classify.stream.read_ahead import Pace, ReadAhead
from dpcli.classify.stream.sliding_window import Prediction, StreamPredictor
from dpcli.counted import counted
from dpcli.errors import DataError, DpcError, Stopped
from dpcli.path_names import first_names
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.progress import log
from dpcli.runtime.signals import StopRequest, answering, stop_requested
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.store import ScoresWriter

_CTRL_C = "SIGINT"
_SPARSE = 4  # points: fewer show no shape
# the kinds of irregular frames, as they are summed up
_EMPTY, _PADDED = "without points, left out", "with points at the origin, left out"
_THIN, _LATE = f"of fewer than {_SPARSE} points", "after a silence"


class Listener(Protocol):
    """Takes predictions as they are made."""

    def see(self, points: np.ndarray, silent: float) -> None:
        """Takes a frame f32 (P,3), before what is predicted of it, and the seconds since the one before."""

    def write(self, made: Prediction, latency: float, waiting: int) -> None:
        """Takes one prediction, the seconds since its last frame arrived, and how many frames wait."""

    def finish(self, mean: np.ndarray, frames: int, clips: int, end: str) -> None:
        """Takes the mean over all clips f32 (1+S,C), the numbers of frames and clips, and how the stream ended."""


@dataclass(frozen=True)
class StreamOptions:
    """Says how a stream is predicted.

    hop: frames between predictions. window: frames to look back at, None for a clip's. follow: seconds to wait for more
    at the end of a file or folder. files: how a folder's files are read. reject_below: see `choose_confidence`.
    """

    hop: int
    window: int | None
    follow: float
    files: CloudFiles
    reject_below: str | None = None


@dataclass(frozen=True)
class StreamModel:
    """Says what a listener has to know of the model: its classes, trained streams and confidence, window and hop in frames."""

    class_names: list[str]
    streams: Sequence[str]
    confidence: Confidence
    window: int
    hop: int


def predict_stream(task: ModelTask, options: StreamOptions, new_listener: Callable[[StreamModel], Listener]) -> int:
    """Predicts until the stream ends, a frame is bad or a signal comes; what was predicted is kept and summed up each time.

    new_listener: makes the one who takes the predictions. Returns the number of frames.
    Raises what ended the stream early.
    """
    model, info = load_model(task.model, task.backbone)
    device = choose_device(task.device)
    predictor = StreamPredictor(model, info, window=options.window, hop=options.hop, seed=task.seed, device=device)
    confidence = choose_confidence(info.notes, options.reject_below, task.model)
    told = StreamModel(info.class_names, predictor.streams, confidence, predictor.window.size, options.hop)
    frames = open_frames(task.data, options.follow, options.files, info.config.columns)
    keep_freed_memory()
    target = _writer(task, info, predictor) if task.output else None
    with target if target is not None else nullcontext(), stop_requested() as stop, _interrupt_asks(stop):
        watch = _IrregularFrames(info.timing == "slots")
        unlike = _Unlike(task, info)
        problem = _follow(predictor, frames, new_listener(told), stop, watch, unlike)
        if not predictor.clips:
            raise problem or _nothing_seen(task, options.files.suffixes, watch.counts[_EMPTY])
        if target is not None:
            target.provenance.append(provenance.record(_record(task, options, info, predictor), task.seed))
            fused, *single = predictor.mean
            target.write(Path(task.source).stem, fused, streams=dict(zip(predictor.streams, single)))
    if task.output:
        log.info(f"{task.output}: the stream's mean scores in {counted(len(info.class_names), 'class')}")
    if problem is not None:
        raise problem
    return predictor.window.count


def _writer(task: ModelTask, info: ModelInfo, predictor: StreamPredictor) -> ScoresWriter:
    return ScoresWriter(
        task.output,
        class_names=info.class_names,
        seed=task.seed,
        source=task.source,
        streams=predictor.streams,
        force=task.force,
    )


def _record(task: ModelTask, options: StreamOptions, info: ModelInfo, predictor: StreamPredictor) -> dict[str, Any]:
    """Returns what shapes the scores, for the file's provenance."""
    return {
        "stream": True,
        "hop": options.hop,
        "window": predictor.window.size,
        "frames": predictor.window.count,
        **task.model_record(info),
        "fusion": info.config.fusion,
    }


@contextmanager
def _interrupt_asks(stop: StopRequest) -> Iterator[None]:
    """Lets the first Ctrl-C end the stream between two frames; raised anywhere, it could be lost in a library's callback."""

    def handle(number: int) -> None:
        """Asks for a stop at the first signal, and interrupts at the second."""
        if stop.requested:
            raise KeyboardInterrupt
        stop.requested, stop.name = True, _CTRL_C

    with answering([signal.SIGINT], handle):
        yield


def _follow(
    predictor: StreamPredictor,
    frames: Iterator[np.ndarray],
    lines: Listener,
    stop: StopRequest,
    watch: _IrregularFrames,
    unlike: _Unlike,
) -> BaseException | None:
    """Predicts as frames come and sums up; returns what ended the stream before its end, if anything did."""
    window = predictor.window
    feed = ReadAhead(frames, 2 * window.size)
    problem: BaseException | None = None
    arrived = time.monotonic()
    try:
        predictor.warm_up()  # the first frames come in meanwhile
        for points, arrived, waited in feed.frames(stop):
            unlike.tell_pace(arrived, waited)
            silent = waited if window.count else 0.0
            points = watch.see(window.count, points, silent)
            if not len(points):  # `dpc prepare` leaves such frames out, so the model learned from videos without them
                continue
            lines.see(points[:, :3], silent)
            made = predictor.add(points)
            if window.count == window.size:
                unlike.tell_first(window.frames)
            if made is not None:
                lines.write(made, time.monotonic() - arrived, feed.waiting)
    except (DpcError, OSError, KeyboardInterrupt) as error:
        problem = error
    finally:
        feed.close()
    if (made := predictor.finish()) is not None:
        log.info(f"{counted(window.count, 'frame')}, fewer than the window's {window.size}")
        lines.write(made, time.monotonic() - arrived, feed.waiting)
    if 0 < window.count < window.size:
        unlike.tell_first(window.frames)
    watch.sum_up()
    count = window.count
    if stop.requested and problem is None and stop.name == _CTRL_C:
        problem = KeyboardInterrupt()
    elif stop.requested and problem is None:
        problem = Stopped(f"stopped by {stop.name} after {counted(count, 'frame')}; what came before is predicted")
    if predictor.clips:
        try:
            lines.finish(predictor.mean, count, predictor.clips, _ending(problem, stop))
        except BrokenPipeError as error:  # nothing reads lines any more; scores so far are still worth their file
            problem = problem or error
    return problem


class _Unlike:
    """Warns where a stream is unlike what the model learned from."""

    def __init__(self, task: ModelTask, info: ModelInfo) -> None:
        self._task, self._info, self._pace = task, info, Pace()
        self._paced = False

    def tell_first(self, frames: list[np.ndarray]) -> None:
        """Judges the first frames f32 (P,3+F), their columns too."""
        source, info, model = self._task.source, self._info, self._task.model
        tell_unlike(source, like([points[:, :3] for points in frames]), info, model)
        for place, name in enumerate(info.config.columns, start=3):
            values = np.concatenate([points[:, place] for points in frames])
            tell_values(source, name, values, info, model, resting=True)

    def tell_pace(self, arrived: float, waited: float) -> None:
        """Judges, once it is known, the rate at which frames come; takes when each arrived and for how long it was waited for."""
        if self._paced:
            return
        seconds = self._pace.see(arrived, waited)
        if seconds is not None:
            self._paced = True
            tell_pace(self._task.source, seconds, self._info, self._task.model)


class _IrregularFrames:
    """Warns of the first empty, sparse or late frame at once, and counts them at the end.

    few: whether frames of few points are what the model takes.
    """

    def __init__(self, few: bool = False) -> None:
        self.counts, self._few = dict.fromkeys((_EMPTY, _PADDED, _THIN, _LATE), 0), few

    def see(self, number: int, points: np.ndarray, silent: float) -> np.ndarray:
        """Returns a frame without what stands for nothing seen, as `dpc prepare` writes it.

        number: how many frames with points came before it; silent: the seconds since the one before.
        """
        if silent > SILENT:
            what = f"nothing came for {silent:.1f} s before frame {number}"
            self._count(_LATE, f"{what}: the frames before and after it count as neighbors")
        seen = without_padding(points)
        if 0 < len(seen) < len(points):
            what = f"frame {number} has {len(points) - len(seen)} points at the origin, which stand for nothing seen"
            self._count(_PADDED, f"{what}: they are left out, as `dpc prepare` does")
        if len(seen) == 0:
            what = f"before frame {number} came one without points"
            self._count(_EMPTY, f"{what}: such frames are left out and have no number, as in what `dpc prepare` writes")
        elif len(seen) < _SPARSE and not self._few:
            self._count(_THIN, f"frame {number} has {counted(len(seen), 'point')}, repeated to fill a clip")
        return seen

    def _count(self, kind: str, message: str) -> None:
        """Counts an irregular frame, and warns of the first of its kind."""
        if not self.counts[kind]:
            log.warn(f"{message}; reported once")
        self.counts[kind] += 1

    def sum_up(self) -> None:
        """Logs how many irregular frames there were, where there was more than one of a kind."""
        if any(count > 1 for count in self.counts.values()):
            log.warn("frames in all: " + ", ".join(f"{count} {kind}" for kind, count in self.counts.items() if count))


def _nothing_seen(task: ModelTask, suffixes: Sequence[str], empty: int) -> DataError:
    if empty:
        return DataError(f"{task.source}: none of its frames ({empty}) has a point, so there is nothing to recognize")
    if task.data != "-" and Path(task.data).is_dir():
        held = first_names(sorted(path.name for path in Path(task.data).iterdir()), 3) or "nothing"
        return DataError(
            f"{task.data}: no frame in it; expected point clouds ({first_names(suffixes, 6)}), and it holds {held}; --follow 60 waits"
            " for them"
        )
    return DataError(f"{task.source}: not one frame came; the program before the pipe wrote nothing")


def _ending(problem: BaseException | None, stop: StopRequest) -> str:
    if problem is None:
        return "end of stream"
    endings = {Stopped: f"stopped by {stop.name}", KeyboardInterrupt: "interrupted", BrokenPipeError: "reader left"}
    return endings.get(type(problem), "bad frame")
