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
    """Keeps at most `most` items of a row of any length, evenly spread: when it is full, every other one goes."""

    def __init__(self, most: int) -> None:
        self.most, self.every, self.count = most, 1, 0
        self.items: list[Any] = []

    def add(self, item: Any) -> None:
        """Takes the next item of the row, or passes it over."""
        if self.count % self.every == 0:
            self.items.append(item)
            if len(self.items) > self.most:
                self.items, self.every = self.items[::2], 2 * self.every
        self.count += 1


class LivePage:
    """Takes what a stream shows and says (a listener of `predict_stream`), and writes the page when it ends."""

    def __init__(self, path: Path, title: str, class_names: Sequence[str], how: Cutting, command: str) -> None:
        self.path, self.title, self.class_names, self.how, self.command = path, title, list(class_names), how, command
        self._frames, self._made = Thinned(_MOST_FRAMES), Thinned(_MOST_PREDICTIONS)

    def see(self, points: np.ndarray, silent: float) -> None:
        """Takes a frame f32 (P,3) before it is predicted; silent: seconds since the one before."""
        number, shown = self._frames.count, None
        if number % self._frames.every == 0:
            keep = generator(0, number).permutation(len(points))[:_MOST_POINTS]
            shown = (number, points[keep] @ _CAMERA.T)
        self._frames.add(shown)

    def write(self, made: Prediction, latency: float, waiting: int) -> None:
        """Takes a prediction; latency in seconds."""
        self._made.add((made.frame, made.scores[0], 1000 * latency))

    def finish(self, mean: np.ndarray, frames: int, clips: int, end: str) -> None:
        """Writes the page. end: how the stream ended."""
        numbers, shown = zip(*self._frames.items)
        sequence = PageSequence(self.title, list(numbers), frames, list(shown))
        last, scores, latency = (np.array(column) for column in zip(*self._made.items))
        confidence = self.how.confidence
        hop = int(last[1] - last[0]) if len(last) > 1 else self.how.hop
        how = Cutting(self.how.window, hop, max(self.how.shortest, hop), confidence)
        segments = cut(WindowScores(last, scores, frames), self.class_names, how)
        track = LiveTrack(last, confidence.of(scores), latency, segments, confidence.threshold)
        facts = PageFacts(
            self.title,
            f"{counted(frames, 'frame')}, {counted(clips, 'prediction')}; {end}",
            self._notes(),
            self._rows(latency),
        )
        facts.history.append({"command": self.command})
        write_page(live_page(facts, sequence, track, self.class_names), self.path)

    def _notes(self) -> list[str]:
        thinned = ((self._frames, "frames"), (self._made, "predictions"))
        return [f"Of the {what} one in {one.every} is shown." for one, what in thinned if one.every > 1]

    def _rows(self, latency: np.ndarray) -> list[tuple[str, str]]:
        own = self.how.confidence
        return [
            ("window", counted(self.how.window, "frame")),
            ("temperature", f"{own.temperature:g}"),
            ("nothing below", f"{own.threshold:g}" if own.threshold else "never"),
            ("latency", f"{latency.mean():.0f} ms on average, at most {latency.max():.0f}"),
        ]
