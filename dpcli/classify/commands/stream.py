"""`dpc classify predict --stream`: from frames that arrive to predictions that leave."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dpcli.classify.commands.model_task import ModelTask
from dpcli.classify.network.model_file import ModelInfo, find_model, load_model
from dpcli.classify.stream.frame_source import CloudFiles, open_frames
from dpcli.classify.stream.read_ahead import ReadAhead
from dpcli.classify.stream.sliding_window import Prediction, StreamPredictor
from dpcli.errors import DataError, DpcError, Stopped
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.progress import log
from dpcli.runtime.signals import StopRequest, stop_requested
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.store import ScoresWriter

_CTRL_C = "SIGINT"


class Listener(Protocol):
    """Takes predictions as they are made."""

    def write(self, made: Prediction, arrived: float, waiting: int) -> None:
        """Takes one prediction, when its last frame arrived (time.monotonic()), and how many frames wait."""

    def finish(self, mean: np.ndarray, frames: int, clips: int, end: str) -> None:
        """Takes the mean over all clips f32 (1+S,C), the numbers of frames and clips, and how the stream ended."""


@dataclass(frozen=True)
class StreamOptions:
    """Says how a stream is predicted.

    hop: frames between predictions. window: frames to look back at, None for a clip's. follow: seconds to wait for more
    at the end of a file or folder. files: how a folder's files are read.
    """

    hop: int
    window: int | None
    follow: float
    files: CloudFiles


def predict_stream(
    task: ModelTask, options: StreamOptions, new_listener: Callable[[list[str], Sequence[str]], Listener]
) -> int:
    """Predicts until the stream ends, a frame is bad or a signal comes; what was predicted is kept and summed up each time.

    new_listener: makes, from class names and streams, the one who takes the predictions. Returns the number of frames.
    Raises what ended the stream early.
    """
    weights = find_model(task.model)
    model, info = load_model(weights, task.backbone)
    device = choose_device(task.device)
    predictor = StreamPredictor(model, info, window=options.window, hop=options.hop, seed=task.seed, device=device)
    frames = open_frames(task.data, options.follow, options.files)
    keep_freed_memory()
    target = _writer(task, info, predictor) if task.output else None
    with target if target is not None else nullcontext(), stop_requested() as stop, _interrupt_asks(stop):
        problem = _follow(predictor, frames, new_listener(info.class_names, predictor.streams), stop)
        if not predictor.clips:
            raise problem or DataError(f"{task.source}: not one frame came; the program before the pipe wrote nothing")
        if target is not None:
            target.provenance.append(provenance.record(_record(weights, options, info, predictor), task.seed))
            fused, *single = predictor.mean
            target.write(Path(task.source).stem, fused, streams=dict(zip(predictor.streams, single)))
    if task.output:
        log.info(f"{task.output}: the stream's mean scores in {len(info.class_names)} classes")
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


def _record(weights: Path, options: StreamOptions, info: ModelInfo, predictor: StreamPredictor) -> dict[str, Any]:
    """Returns what shapes the scores, for the file's provenance."""
    return {
        "stream": True,
        "hop": options.hop,
        "window": predictor.window.size,
        "frames": predictor.window.count,
        "model": info.notes,
        "weights": provenance.file_digest(weights),
        "fusion": info.config.fusion,
    }


@contextmanager
def _interrupt_asks(stop: StopRequest) -> Iterator[None]:
    """Lets the first Ctrl-C end the stream between two frames; raised anywhere, it could be lost in a library's callback."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: object) -> None:
        """Asks for a stop at the first signal, and interrupts at the second."""
        if stop.requested:
            raise KeyboardInterrupt
        stop.requested, stop.name = True, _CTRL_C

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _follow(
    predictor: StreamPredictor, frames: Iterator[np.ndarray], lines: Listener, stop: StopRequest
) -> BaseException | None:
    """Predicts as frames come and sums up; returns what ended the stream before its end, if anything did."""
    feed = ReadAhead(frames, 2 * predictor.window.size)
    problem: BaseException | None = None
    arrived, empty = time.monotonic(), False
    try:
        predictor.warm_up()  # the first frames come in meanwhile
        for points, arrived in feed.frames(stop):
            if len(points) == 0 and not empty:
                log.warn(f"frame {predictor.window.count} has no points: they are taken to be at the origin; told once")
                empty = True
            made = predictor.add(points)
            if made is not None:
                lines.write(made, arrived, feed.waiting)
    except BrokenPipeError:  # nobody reads the lines any more
        raise
    except (DpcError, OSError, KeyboardInterrupt) as error:
        problem = error
    finally:
        feed.close()
    if (made := predictor.finish()) is not None:
        log.info(f"{predictor.window.count} frames are fewer than the window's {predictor.window.size}")
        lines.write(made, arrived, feed.waiting)
    count = predictor.window.count
    if stop.requested and problem is None and stop.name == _CTRL_C:
        problem = KeyboardInterrupt()
    elif stop.requested and problem is None:
        problem = Stopped(f"stopped by {stop.name} after {count} frames; what came before is predicted")
    if predictor.clips:
        lines.finish(predictor.mean, count, predictor.clips, _ending(problem, stop))
    return problem


def _ending(problem: BaseException | None, stop: StopRequest) -> str:
    if problem is None:
        return "end of stream"
    return {Stopped: f"stopped by {stop.name}", KeyboardInterrupt: "interrupted"}.get(type(problem), "bad frame")
