"""CLIP scores of videos: against the truth, over time, and across views, by the network of `networks/clip.py`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.video.learned.base import FrameGap, LearnedMetric, LearnedScore, PerFrameMetric
from dpcli.evaluate.video.protocol import Networks


class PairEmbeddings:
    """Holds the CLIP embeddings of the current pair of frames, computed once for all metrics that want them."""

    def __init__(self, networks: Networks, folder: Path, device: str, bgr: bool = False) -> None:
        from dpcli.evaluate.networks.clip import VARIANTS, Clip

        self.variant, self.bgr = networks.clip, bgr
        self.clip, self.weights = Clip.load(folder, networks.clip, device), VARIANTS[networks.clip]
        self._of: tuple[np.ndarray | None, np.ndarray | None] = None, None
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    def pair(self, predicted: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the unit embeddings f32 (D) of both pictures, f32 (3,H,W) in 0..1."""
        if self._of[0] is not predicted or self._of[1] is not truth:
            both = np.stack([predicted, truth]).transpose(0, 2, 3, 1).clip(0, 1)
            self._last, self._of = tuple(self.clip.embed(both, bgr=self.bgr)), (predicted, truth)  # type: ignore
        return self._last  # type: ignore[return-value]

    def choices(self) -> dict[str, Any]:
        """Returns the network and the order of colors it is given."""
        return {"network": f"CLIP ViT-B/32, {self.variant}", "colors": "BGR by mistake" if self.bgr else "RGB"}


class ClipMetric(PerFrameMetric):
    """Measures the CLIP score of each frame against its truth: the cosine (Consistent4D) or half the squared angle (4DGen)."""

    def __init__(self, name: str, embedded: PairEmbeddings) -> None:
        super().__init__()
        self.name, self._embedded = name, embedded

    def measure(self, predicted: np.ndarray, truth: np.ndarray) -> float:
        from dpcli.evaluate.networks.clip import cosines, spherical

        pair = self._embedded.pair(predicted, truth)
        return float((cosines if self.name == "clip" else spherical)(*pair))

    def choices(self) -> dict[str, Any]:
        return self._embedded.choices()


class ClipTemporal(LearnedMetric):
    """Measures the mean cosine of a view's consecutive frames; the truth's own stands beside it."""

    def __init__(self, embedded: PairEmbeddings) -> None:
        self._embedded, self._before = embedded, None
        self._found: dict[str, list[np.ndarray]] = {}

    def start(self, view: str) -> None:
        self._before, self._gap, self._view = None, FrameGap(), view
        self._found[view] = []

    def add(self, predicted: np.ndarray, truth: np.ndarray, frame: int) -> None:
        """Compares the next frame with the one before, unless frames between them are missing."""
        from dpcli.evaluate.networks.clip import cosines

        now = np.stack(self._embedded.pair(predicted, truth))
        if not self._gap.before(frame) and self._before is not None:
            self._found[self._view].append(cosines(self._before, now))
        self._before = now

    def end(self) -> None:
        if not self._found[self._view]:
            raise DataError(f"view {self._view!r}: no two frames in a row; clip_temporal compares consecutive ones")

    def score(self) -> LearnedScore:
        """Returns the mean over consecutive frames, then over views."""
        means = {view: np.mean(rows, axis=0) for view, rows in self._found.items()}
        both = np.mean(list(means.values()), axis=0)
        counts = {"views": len(means), "pairs": sum(map(len, self._found.values()))}
        return LearnedScore(
            "clip_temporal",
            float(both[0]),
            {view: float(m[0]) for view, m in means.items()},
            float(both[1]),
            counts,
            self._embedded.choices(),
        )


class ClipViews(LearnedMetric):
    """Measures the mean cosine over all pairs of views at the same time (thesis C.1.4); the truth's own stands beside it.

    It holds the sum of the views' embeddings for each frame: sum over pairs = (|sum|^2 - V) / 2 of unit vectors. Frames
    that some views lack don't count: the mean of fewer views would be another number.
    """

    def __init__(self, embedded: PairEmbeddings) -> None:
        self._embedded, self._views = embedded, 0
        self._sums: dict[int, np.ndarray] = {}  # by the number of the frame, f64 (2,D)
        self._seen: Counter[int] = Counter()  # views by the number of the frame

    def start(self, view: str) -> None:
        self._views += 1

    def add(self, predicted: np.ndarray, truth: np.ndarray, frame: int) -> None:
        """Adds the embeddings of a frame, f32 (3,H,W) in 0..1, to those of the other views at that time."""
        self._sums[frame] = self._sums.get(frame, 0) + np.stack(self._embedded.pair(predicted, truth)).astype(
            np.float64
        )
        self._seen[frame] += 1

    def end(self) -> None:
        """Ends the view; which frames all views have is known at the end."""

    def score(self) -> LearnedScore:
        """Returns the mean over pairs of views and frames. Raises DataError for one view, or no frame that all have."""
        if self._views < 2:
            raise DataError("clip_views compares views, and there is one; leave it out of --metrics")
        sums = [self._sums[frame] for frame, views in self._seen.items() if views == self._views]
        if not sums:
            raise DataError("clip_views compares views at the same time, and no frame is there in all of them")
        squares = np.square(np.stack(sums)).sum(-1).mean(0)
        found = (squares - self._views) / (self._views * (self._views - 1))
        counts, choices = {"views": self._views, "frames": len(sums)}, self._embedded.choices()
        if len(sums) < len(self._seen):
            choices |= {"frames left out": f"{len(self._seen) - len(sums)}, which some views lack"}
        return LearnedScore("clip_views", float(found[0]), {}, float(found[1]), counts, choices)
