"""Learned and temporal metrics of videos: each sees the frames of every view in order, and ends in a score.

LPIPS, CLIP scores, Frechet distances (FVD, FID-VID) and the warping error are each in a file of their own beside this
one; `loading.py` makes them. They take one pass over the views that a protocol compares.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dpcli.evaluate.proportions import mean_defined

TITLES = {
    "lpips": "LPIPS",
    "clip": "CLIP similarity to the truth",
    "clip_spherical": "CLIP spherical distance to the truth",
    "clip_views": "CLIP similarity across views",
    "clip_temporal": "CLIP similarity over time",
    "fvd": "FVD",
    "fid_vid_r3d50": "FID-VID (3D ResNet-50)",
    "fid_vid_inception": "FID-VID (Inception)",
    "warping": "warping error",
}


@dataclass(frozen=True)
class LearnedScore:
    """Holds the value of a metric without unit.

    per_view: what the value is the mean of, empty where it is of all views at once. truth: what the truth itself scores,
    None where it is what the prediction is compared with. counts: denominators. choices: network, clips ... in words.
    """

    name: str
    value: float
    per_view: dict[str, float] = field(default_factory=dict)
    truth: float | None = None
    counts: dict[str, int] = field(default_factory=dict)
    choices: dict[str, Any] = field(default_factory=dict)


class LearnedMetric(ABC):
    """Takes view after view, frames in order, some of them perhaps left out: `start`, `add` for each, `end`; then `score`."""

    @abstractmethod
    def start(self, view: str) -> None:
        """Begins a view, whose title is given."""

    @abstractmethod
    def add(self, predicted: np.ndarray, truth: np.ndarray, frame: int) -> None:
        """Takes the view's next frame, predicted and true, both f32 (3,H,W), RGB in 0..1, and its number."""

    @abstractmethod
    def end(self) -> None:
        """Ends the view. Raises DataError when it had too few frames."""

    @abstractmethod
    def score(self) -> LearnedScore:
        """Returns the metric over all views seen. Raises DataError when there were too few."""


class FrameGap:
    """Tells whether frames of a view were left out before the current one, which then has no neighbor before it."""

    def __init__(self) -> None:
        self._next: int | None = None

    def before(self, frame: int) -> bool:
        """Returns whether frames are missing before this one. Frames come in rising order; nothing is missing before the first."""
        expected, self._next = self._next, frame + 1
        return expected not in (None, frame)


class PerFrameMetric(LearnedMetric):
    """Takes the mean over frames, then over views, of a number for each frame."""

    name: str

    def __init__(self) -> None:
        self._found: dict[str, list[float]] = {}

    def start(self, view: str) -> None:
        self._view = view
        self._found[view] = []

    def add(self, predicted: np.ndarray, truth: np.ndarray, frame: int) -> None:
        self._found[self._view].append(self.measure(predicted, truth))

    def end(self) -> None:
        """Ends the view; any number of frames will do."""

    @abstractmethod
    def measure(self, predicted: np.ndarray, truth: np.ndarray) -> float:
        """Returns the number of one frame."""

    def choices(self) -> dict[str, Any]:
        """Returns the choices that the number depends on, in words."""
        return {}

    def score(self) -> LearnedScore:
        """Returns the mean over frames, then over views."""
        means = {view: mean_defined(np.array(values)) for view, values in self._found.items() if values}
        counts = {"views": len(means), "frames": sum(map(len, self._found.values()))}
        value = mean_defined(np.array(list(means.values())))
        return LearnedScore(self.name, value, means, counts=counts, choices=self.choices())
