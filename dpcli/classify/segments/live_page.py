"""The page of a stream: what was seen and what was said of it, kept in bounded memory while frames come, written at the end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.classify.segments.recording import Cutting, WindowScores, cut
from dpcli.classify.stream.sliding_window import Prediction
from dpcli.counted import counted
from dpcli.draw.page.assemble import write_page
from dpcli.draw.page.live import LiveTrack, live_page
from dpcli.draw.page.points import PageFacts, PageSequence
from dpcli.runtime.seeds import generator

_MOST_FRAMES, _MOST_POINTS, _MOST_PREDICTIONS = 1200, 384, 4096
_CAMERA = np.diag([1.0, -1.0, -1.0])  # a camera's axes, x right, y down, z forward, as a page has them


class Thinned:
    """Keeps at most `most` rows of any number, evenly spread: when it is full, every other one goes.

    Rows lie in one array from the start: small ones of their own, made between the arrays of a network, would keep the memory
    around them from being used again (hundreds of MB in an hour).
    """

    def __init__(self, most: int, kind: np.dtype) -> None:
        self.every, self.count = 1, 0
        self._rows, self._kept = np.zeros(most + 1, kind), 0

    @property
    def rows(self) -> np.ndarray:
        """Returns the rows that are kept."""
        return self._rows[: self._kept]

    @property
    def wants_next(self) -> bool:
        """Returns whether the next row will be kept for now."""
        return self.count % self.every == 0

    def add(self, row: tuple[Any, ...] = ()) -> None:
        """Takes the next row, or passes it over, when it may be left out."""
        if self.wants_next:
            self._rows[self._kept] = row
            self._kept += 1
            if self._kept == len(self._rows):
                kept = self._rows[::2].copy()
                self._rows[: len(kept)], self._kept, self.every = kept, len(kept), 2 * self.every
        self.count += 1


class LivePage:
    """Takes what a stream shows and says (a listener of `predict_stream`), and writes the page when it ends."""

    def __init__(self, path: Path, title: str, class_names: Sequence[str], how: Cutting, command: str) -> None:
        self.path, self.title, self.class_names, self.how, self.command = path, title, list(class_names), how, command
        frame = [("number", np.int64), ("size", np.int64), ("points", np.float32, (_MOST_POINTS, 3))]
        made = [("frame", np.int64), ("scores", np.float32, (len(self.class_names),)), ("latency", np.float64)]
        self._frames = Thinned(_MOST_FRAMES, np.dtype(frame))
        self._made = Thinned(_MOST_PREDICTIONS, np.dtype(made))
        self._total, self._highest = 0.0, 0.0  # latency of all predictions, also of those that are not kept

    def see(self, points: np.ndarray, silent: float) -> None:
        """Takes a frame f32 (P,3) before it is predicted; silent: seconds since the one before."""
        if not self._frames.wants_next:
            return self._frames.add()
        number, shown = self._frames.count, np.zeros((_MOST_POINTS, 3), np.float32)
        keep = generator(0, number).permutation(len(points))[:_MOST_POINTS]
        shown[: len(keep)] = points[keep] @ _CAMERA.T
        self._frames.add((number, len(keep), shown))

    def write(self, made: Prediction, latency: float, waiting: int) -> None:
        """Takes a prediction; latency in seconds."""
        self._made.add((made.frame, made.scores[0], 1000 * latency))
        self._total, self._highest = self._total + 1000 * latency, max(self._highest, 1000 * latency)

    def finish(self, mean: np.ndarray, frames: int, clips: int, end: str) -> None:
        """Writes the page. end: how the stream ended."""
        shown = [row["points"][: row["size"]] for row in self._frames.rows]
        sequence = PageSequence(self.title, self._frames.rows["number"].tolist(), frames, shown)
        last, scores, latency = (self._made.rows[name] for name in ("frame", "scores", "latency"))
        confidence = self.how.confidence
        hop = int(last[1] - last[0]) if len(last) > 1 else self.how.hop
        how = Cutting(self.how.window, hop, max(self.how.shortest, hop), confidence)
        segments = cut(WindowScores(last, scores, frames), self.class_names, how)
        track = LiveTrack(last, confidence.of(scores), latency, self._highest, segments, confidence.threshold)
        facts = PageFacts(
            self.title,
            f"{counted(frames, 'frame')}, {counted(clips, 'prediction')}; {end}",
            self._notes(),
            self._rows(),
        )
        facts.history.append({"command": self.command})
        write_page(live_page(facts, sequence, track, self.class_names), self.path)

    def _notes(self) -> list[str]:
        thinned = ((self._frames, "frames"), (self._made, "predictions"))
        return [f"Of the {what} one in {one.every} is shown." for one, what in thinned if one.every > 1]

    def _rows(self) -> list[tuple[str, str]]:
        own = self.how.confidence
        return [
            ("window", counted(self.how.window, "frame")),
            ("temperature", f"{own.temperature:g}"),
            ("nothing below", f"{own.threshold:g}" if own.threshold else "never"),
            ("latency", f"{self._total / self._made.count:.0f} ms on average, at most {self._highest:.0f}"),
        ]
