"""A stream as a page: its clouds, and on one line of time what a classifier said, how sure it was and how long it took."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dpcli.draw.page.assemble import data_blocks, data_page
from dpcli.draw.page.points import SCRIPTS, PageFacts, PageSequence, points_parts
from dpcli.draw.palette import part_colors


class Stretch(Protocol):
    """Describes a stretch of frames, `start` to `end` (one past the last), and the name of what it shows, "" for nothing."""

    start: int
    end: int
    name: str
    confidence: float


@dataclass(frozen=True)
class LiveTrack:
    """Holds predictions in order: last frame of each i64 (N), probabilities f (N,C), latency f (N) in ms; then the highest
    latency, also of predictions that are left out, the stretches that they were cut into, and the threshold of probability
    below which nothing is recognized (0: never)."""

    frames: np.ndarray
    probabilities: np.ndarray
    latency: np.ndarray
    highest: float
    segments: Sequence[Stretch]
    threshold: float


def live_page(facts: PageFacts, sequence: PageSequence, track: LiveTrack, class_names: Sequence[str]) -> str:
    """Returns the page. sequence: the frames to show, x right, y up. Probabilities are rounded to 1/65535."""
    header, blocks = points_parts(facts, [sequence], axes=np.diag([1.0, -1.0, -1.0]), unit="")
    table = np.rint(track.probabilities * 65535).astype("<u2").tobytes()
    header["live"] = {
        "bytes": len(table),
        "classes": [name or f"class {at}" for at, name in enumerate(class_names)],
        "colors": part_colors(np.arange(len(class_names))).tolist(),
        "frames": track.frames.tolist(),
        "latency": [round(float(one), 1) for one in track.latency],
        "highest": track.highest,
        "segments": [[one.start, one.end, one.name, round(one.confidence, 3)] for one in track.segments],
        "threshold": track.threshold,
    }
    return data_page(header, "live", script=(*SCRIPTS, "live"), data=data_blocks([*blocks, table]))
