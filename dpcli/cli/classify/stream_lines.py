"""The lines that `dpc classify predict --stream` prints."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from dpcli.counted import counted
from dpcli.standard_streams import printable

if TYPE_CHECKING:
    import numpy as np

    from dpcli.classify.commands.stream import StreamModel
    from dpcli.classify.stream.sliding_window import Prediction

NOTHING = "nothing happening"


class Lines:
    """Prints a line per prediction, at once, and one with the whole at the end: JSON or for people."""

    def __init__(self, model: StreamModel, as_json: bool) -> None:
        self.class_names, self.streams, self.as_json = model.class_names, tuple(model.streams), as_json
        self.confidence = model.confidence
        self.count, self.seconds, self.highest = 0, 0.0, 0.0

    def see(self, points: np.ndarray, silent: float) -> None:
        """Prints nothing of a frame."""

    def write(self, made: Prediction, latency: float, waiting: int) -> None:
        """Prints one prediction. Its latency runs from the arrival of its last frame, waiting behind earlier ones included.

        People read confidence, what the threshold is held against; plain probabilities are in the JSON beside it.
        """
        self.count_latency(latency)
        sure, nothing = self._sure(made.scores[0])
        latency = round(1000 * latency, 1)  # ms from here on
        if self.as_json:
            row = {
                "frame": made.frame,
                **self._tops(made.scores),
                "confidence": round(sure, 6),
                "nothing": nothing,
                "mean": self._top(made.mean[0]),
                "clips": made.clips,
                "latency_ms": latency,
                "waiting": waiting,
            }
            print(json.dumps(row), flush=True)
            return
        behind = f", {counted(waiting, 'frame')} waiting" if waiting else ""
        said = f"{NOTHING}; best " if nothing else ""
        print(
            f"frame {made.frame}: {said}{self._text(self.confidence.of(made.scores))}; {latency:.0f} ms{behind}",
            flush=True,
        )

    def count_latency(self, seconds: float) -> None:
        """Takes the latency of one prediction, printed or not, into the average at the end."""
        self.count, self.seconds, self.highest = self.count + 1, self.seconds + seconds, max(self.highest, seconds)

    def finish(self, mean: np.ndarray, frames: int, clips: int, end: str) -> None:
        """Prints the mean over all clips, (1+S,C), and how the stream ended. People read it as confidence, as every line before."""
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
        print(
            f"{end}: {counted(frames, 'frame')}, {counted(clips, 'clip')}: mean {self._text(self.confidence.of(mean))}; "
            f"latency {average:.0f} ms on average, at most {highest:.0f}",
            flush=True,
        )

    def _sure(self, scores: np.ndarray) -> tuple[float, bool]:
        """Returns the confidence of a prediction, and whether it is too small for anything to be recognized."""
        sure = float(self.confidence.of(scores).max())
        return sure, sure < self.confidence.threshold

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
