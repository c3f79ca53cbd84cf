"""`dpc classify predict --stream`: from frames that arrive to lines that leave."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np

from dpcli.classify.network.model_file import find_model, load_model
from dpcli.classify.stream.frame_source import CloudFiles, open_frames
from dpcli.classify.stream.read_ahead import Feed
from dpcli.classify.stream.sliding_window import Prediction, StreamPredictor
from dpcli.errors import DataError, DpcError, Stopped
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.progress import log
from dpcli.runtime.signals import StopRequest, stop_requested
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.standard_streams import printable
from dpcli.store import ScoresWriter

_CTRL_C = "SIGINT"


class Lines:
    """Writes a line per prediction to stdout, at once, and one with the whole at the end. JSON or for people."""

    def __init__(self, class_names: list[str], streams: Sequence[str], as_json: bool) -> None:
        self.class_names, self.streams, self.as_json = class_names, tuple(streams), as_json
        self.count, self.seconds, self.highest = 0, 0.0, 0.0

    def write(self, made: Prediction, arrived: float, waiting: int) -> None:
        """One prediction. Latency: from the arrival of its last frame to this line, waiting behind earlier ones included."""
        seconds = time.monotonic() - arrived
        self.count, self.seconds, self.highest = self.count + 1, self.seconds + seconds, max(self.highest, seconds)
        latency = round(1000 * seconds, 1)
        if self.as_json:
            row = {
                "frame": made.frame,
                **self._tops(made.scores),
                "mean": self._top(made.mean[0]),
                "clips": made.clips,
                "latency_ms": latency,
                "waiting": waiting,
            }
            print(json.dumps(row), flush=True)
            return
        behind = f", {waiting} frames waiting" if waiting else ""
        print(
            f"frame {made.frame}: {self._text(made.scores)}; so far {self._name(made.mean[0])}; "
            f"{latency:.0f} ms{behind}",
            flush=True,
        )

    def finish(self, mean: np.ndarray, frames: int, clips: int, end: str) -> None:
        """The mean over all clips, (1+S,C), and how it ended."""
        average, highest = 1000 * self.seconds / max(self.count, 1), 1000 * self.highest
        if self.as_json:
            scores = {name: round(float(value), 6) for name, value in zip(self.class_names, mean[0])}
            row = {
                "end": end,
                "frames": frames,
                "clips": clips,
                **self._tops(mean),
                "scores": scores,
                "latency_ms": {"mean": round(average, 1), "highest": round(highest, 1)},
            }
            print(json.dumps(row), flush=True)
            return
        plural = "" if clips == 1 else "s"
        print(
            f"{end}: {frames} frames, {clips} clip{plural}: {self._text(mean)}; "
            f"latency {average:.0f} ms on average, at most {highest:.0f}",
            flush=True,
        )

    def _top(self, scores: np.ndarray) -> dict:
        best = int(scores.argmax())
        return {"class": self.class_names[best], "probability": round(float(scores[best]), 6)}

    def _tops(self, scores: np.ndarray) -> dict:
        return {**self._top(scores[0]), **{name: self._top(row) for name, row in zip(self.streams, scores[1:])}}

    def _name(self, scores: np.ndarray) -> str:
        return f"{printable(self.class_names[int(scores.argmax())])} {scores.max():.2f}"

    def _text(self, scores: np.ndarray) -> str:
        single = ", ".join(f"{name} {self._name(row)}" for name, row in zip(self.streams, scores[1:]))
        return f"{self._name(scores[0])} ({single})"


def run_stream(
    data: str,
    model_name: str,
    output: str | None,
    *,
    hop: int,
    window: int | None,
    follow: float,
    seed: int,
    device: str,
    force: bool,
    json_output: bool,
    files: CloudFiles,
    backbone: str | None = None,
) -> None:
    """Predict until the stream ends, a frame is bad or a signal comes; what was predicted is kept and summed up each time."""
    weights = find_model(model_name)
    model, info = load_model(weights, backbone)
    predictor = StreamPredictor(model, info, window=window, hop=hop, seed=seed, device=choose_device(device))
    frames = open_frames(data, follow, files)
    source = "stdin" if data == "-" else Path(data).name
    keep_freed_memory()
    target = None
    if output:
        target = ScoresWriter(
            output, class_names=info.class_names, seed=seed, source=source, streams=predictor.streams, force=force
        )
    with target if target is not None else nullcontext(), stop_requested() as stop, _interrupt_asks(stop):
        problem = _follow(predictor, frames, Lines(info.class_names, predictor.streams, json_output), stop)
        if not predictor.clips:
            raise problem or DataError(f"{source}: not one frame came; the program before the pipe wrote nothing")
        if target is not None:
            config = {
                "stream": True,
                "hop": hop,
                "window": predictor.window.size,
                "frames": predictor.window.count,
                "model": info.notes,
                "weights": provenance.file_digest(weights),
                "fusion": info.config.fusion,
            }
            target.provenance.append(provenance.record(config, seed))
            fused, *single = predictor.mean
            target.write(Path(source).stem, fused, streams=dict(zip(predictor.streams, single)))
    if output:
        log.info(f"{output}: the stream's mean scores in {len(info.class_names)} classes")
    if problem is not None:
        raise problem


@contextmanager
def _interrupt_asks(stop: StopRequest) -> Iterator[None]:
    """The first Ctrl-C ends the stream between two frames; raised anywhere, it could be lost in a library's callback."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: object) -> None:
        if stop.requested:
            raise KeyboardInterrupt
        stop.requested, stop.name = True, _CTRL_C

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _follow(
    predictor: StreamPredictor, frames: Iterator[np.ndarray], lines: Lines, stop: StopRequest
) -> BaseException | None:
    """Predict as frames come and write the last line. What ended it before its end, if anything did."""
    feed = Feed(frames, 2 * predictor.window.size)
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
