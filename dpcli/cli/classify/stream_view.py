"""The view of a stream on a terminal: what is happening now, how sure that is, what it was before, how long it took."""

from __future__ import annotations

import sys
import time
from collections import deque
from typing import TYPE_CHECKING

from dpcli.cli.classify.stream_lines import NOTHING, Lines
from dpcli.counted import counted
from dpcli.standard_streams import printable, rich_console

if TYPE_CHECKING:
    import numpy as np
    from rich.console import RenderableType

    from dpcli.classify.commands.stream import StreamModel
    from dpcli.classify.stream.sliding_window import Prediction

_BEST, _BAR, _MEMORY = 5, 30, 400
_COLORS = ("cyan", "magenta", "yellow", "green", "blue", "red", "bright_cyan", "bright_magenta", "bright_yellow")
_QUIET = 1.0  # seconds without a frame after which the view says that it waits


class View:
    """Shows the newest prediction in place; at the end the view stays, and the line that `Lines` prints follows."""

    def __init__(self, model: StreamModel, lines: Lines) -> None:
        from rich.live import Live

        self.model, self.lines = model, lines
        self.names = [printable(name) for name in model.class_names]
        self.frames, self.last_seen = 0, time.monotonic()
        self.newest: tuple[np.ndarray, float, int] | None = None  # calibrated probabilities, latency, frames waiting
        self.history: deque[int] = deque(maxlen=_MEMORY)  # class of each prediction, -1 = nothing
        self.live = Live(get_renderable=self.render, console=rich_console(sys.stdout), refresh_per_second=8)

    def see(self, points: np.ndarray, silent: float) -> None:
        """Counts a frame; the first one opens the view."""
        if not self.frames:
            self.live.start()
        self.frames, self.last_seen = self.frames + 1, time.monotonic()

    def write(self, made: Prediction, latency: float, waiting: int) -> None:
        """Takes a prediction to show."""
        probabilities = self.model.confidence.of(made.scores[0])
        best = int(probabilities.argmax())
        self.newest = probabilities, latency, waiting
        self.history.append(best if probabilities[best] >= self.model.confidence.threshold else -1)
        self.lines.count_latency(latency)

    def finish(self, mean: np.ndarray, frames: int, clips: int, end: str) -> None:
        """Ends the view and prints the line about the whole stream."""
        self.live.stop()
        self.lines.finish(mean, frames, clips, end)

    def render(self) -> RenderableType:
        """Returns what the terminal shows now."""
        from rich.console import Group
        from rich.panel import Panel
        from rich.text import Text

        silent = time.monotonic() - self.last_seen
        told = f"frame {self.frames - 1}" + (f", waiting for frames since {silent:.0f} s" if silent > _QUIET else "")
        if self.newest is None:
            return Panel(
                Text(f"the window of {counted(self.model.window, 'frame')} is not full yet"), title=told, width=72
            )
        probabilities, latency, waiting = self.newest
        behind = f", {counted(waiting, 'frame')} waiting" if waiting else ""
        foot = Text(f"latency {1000 * latency:.0f} ms{behind}", style="dim")
        return Panel(Group(self._headline(), *self._bars(probabilities), self._strip(), foot), title=told, width=72)

    def _headline(self) -> RenderableType:
        from rich.text import Text

        label = self.history[-1]
        return Text(NOTHING if label < 0 else self.names[label], style="dim" if label < 0 else f"bold {_color(label)}")

    def _bars(self, probabilities: np.ndarray) -> list[RenderableType]:
        from rich.text import Text

        rows: list[RenderableType] = []
        for label in probabilities.argsort()[::-1][:_BEST].tolist():
            share = float(probabilities[label])
            row = Text(f"{self.names[label][:24]:24} {share:4.2f} ")
            rows.append(row.append("█" * round(_BAR * share), style=_color(label)))
        return rows

    def _strip(self) -> RenderableType:
        """Returns the last predictions as a strip of colors, the newest at its end."""
        from rich.text import Text

        strip = Text()
        for label in list(self.history)[-66:]:
            strip.append("·" if label < 0 else "█", style="dim" if label < 0 else _color(label))
        return strip


def _color(label: int) -> str:
    return _COLORS[label % len(_COLORS)]
