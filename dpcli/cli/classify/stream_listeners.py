"""Listeners of a stream: lines in a log or a pipe, a view that changes in place on a terminal, a page at the end."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from dpcli.cli.classify.stream_lines import Lines
from dpcli.cli.classify.stream_view import View

if TYPE_CHECKING:
    import numpy as np

    from dpcli.classify.commands.stream import Listener, StreamModel
    from dpcli.classify.stream.sliding_window import Prediction


class Several:
    """Passes all that is seen and said on to several listeners, in their order."""

    def __init__(self, listeners: list[Listener]) -> None:
        self.listeners = listeners

    def see(self, points: np.ndarray, silent: float) -> None:
        """Passes a frame on."""
        for one in self.listeners:
            one.see(points, silent)

    def write(self, made: Prediction, latency: float, waiting: int) -> None:
        """Passes a prediction on."""
        for one in self.listeners:
            one.write(made, latency, waiting)

    def finish(self, mean: np.ndarray, frames: int, clips: int, end: str) -> None:
        """Passes the end on."""
        for one in self.listeners:
            one.finish(mean, frames, clips, end)


def listener(model: StreamModel, as_json: bool, page: Path | None, source: str) -> Several:
    """Returns what shows the predictions of a stream: a view on a terminal, else lines; and the writer of a page, if asked for."""
    lines = Lines(model, as_json)
    in_place = sys.stdout.isatty() and os.environ.get("TERM") != "dumb" and not as_json
    several: list[Listener] = [View(model, lines) if in_place else lines]
    if page is not None:
        several.insert(0, _page(model, page, source))  # it is written, too, where whoever reads the lines has left
    return Several(several)


def _page(model: StreamModel, path: Path, source: str) -> Listener:
    from dpcli.classify.segments.live_page import LivePage
    from dpcli.classify.segments.recording import Cutting
    from dpcli.runtime.provenance import command_line

    how = Cutting(model.window, model.hop, max(1, model.window // 2), model.confidence)
    return LivePage(path, source, model.class_names, how, command_line())
