"""Metrics of pictures in sequence, most of them by published networks: LPIPS, CLIP, Frechet distances, warping error.

One pass over the views that a protocol compares. A metric whose weights are absent is left out and its reason kept, so
that the others are still computed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError, DpcError
from dpcli.evaluate.proportions import mean_defined

FRECHET = ("fvd", "fid_vid_r3d50", "fid_vid_inception")
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
LEARNED = tuple(TITLES)


@dataclass(frozen=True)
class LearnedScore:
    """A metric without unit. per_view: the mean is of these, empty where it is of all views at once. truth: what the
    truth itself scores, None where it is compared with. counts: denominators. choices: network, clips, ... in words."""

    name: str
    value: float
    per_view: dict[str, float] = field(default_factory=dict)
    truth: float | None = None
    counts: dict[str, int] = field(default_factory=dict)
    choices: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Networks:
    """Which published network stands for a metric; `protocol` values of `VideoProtocol`. every: FVD windows start at
    each so many frames."""

    lpips: str = "alex"
    lpips_range01: bool = False
    fvd: str = "consistent4d"
    clip: str = "openai"
    every: int = 1


class LearnedMetric(ABC):
    """Fed view by view, frames in order, some of them perhaps left out: `start`, `add` for each, `end`; then `score`."""

    @abstractmethod
    def start(self, view: str) -> None:
        """A view begins."""

    @abstractmethod
    def add(self, predicted: np.ndarray, truth: np.ndarray, frame: int) -> None:
        """The view's next frame and its number, both f32 (3,H,W), RGB in 0..1."""

    @abstractmethod
    def end(self) -> None:
        """The view is over. DataError when it had too few frames."""

    @abstractmethod
    def score(self) -> LearnedScore:
        """Of all views seen. DataError when there were too few."""


class _Gap:
    """Tells whether frames of a view were left out before the one at hand: it then has no neighbor before it."""

    def __init__(self) -> None:
        self._next: int | None = None

    def before(self, frame: int) -> bool:
        """Of frames in rising order; never before the first one."""
        expected, self._next = self._next, frame + 1
        return expected not in (None, frame)


class _PerFrame(LearnedMetric):
    """The mean over frames, then over views, of a number for each frame."""

    name: str

    def __init__(self) -> None:
        self._found: dict[str, list[float]] = {}

    def start(self, view: str) -> None:
        self._view = view
        self._found[view] = []

    def add(self, predicted: np.ndarray, truth: np.ndarray, frame: int) -> None:
        self._found[self._view].append(self.measure(predicted, truth))

    def end(self) -> None:
        pass

    @abstractmethod
    def measure(self, predicted: np.ndarray, truth: np.ndarray) -> float:
        """The number of one frame."""

    def choices(self) -> dict[str, Any]:
        return {}

    def score(self) -> LearnedScore:
        means = {view: mean_defined(np.array(values)) for view, values in self._found.items() if values}
        counts = {"views": len(means), "frames": sum(map(len, self._found.values()))}
        value = mean_defined(np.array(list(means.values())))
        return LearnedScore(self.name, value, means, counts=counts, choices=self.choices())


class LpipsMetric(_PerFrame):
    """`networks.lpips.Lpips` of each frame."""

    name = "lpips"

    def __init__(self, networks: Networks, folder: Path, device: str) -> None:
        super().__init__()
        from dpcli.evaluate.networks.lpips import Lpips

        self._network, self._networks, self._device = Lpips.load(networks.lpips, folder).to(device), networks, device

    def measure(self, predicted: np.ndarray, truth: np.ndarray) -> float:
        import torch

        pair = (torch.from_numpy(np.ascontiguousarray(p))[None].to(self._device) for p in (predicted, truth))
        return float(self._network.distance(*pair, range01_mistake=self._networks.lpips_range01)[0])

    def choices(self) -> dict[str, Any]:
        given = "0..1, as DisCo gives them by mistake" if self._networks.lpips_range01 else "-1..1"
        return {"network": f"{self._networks.lpips}, v0.1", "colors": given}


class _Embedded:
    """CLIP embeddings of the current pair of frames, computed once for all metrics that want them."""

    def __init__(self, networks: Networks, folder: Path, device: str, bgr: bool = False) -> None:
        from dpcli.evaluate.networks.clip import VARIANTS, Clip

        self.variant, self.bgr = networks.clip, bgr
        self.clip, self.weights = Clip.load(folder, networks.clip, device), VARIANTS[networks.clip]
        self._of: tuple[np.ndarray | None, np.ndarray | None] = None, None
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    def pair(self, predicted: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit embeddings f32 (D) of both."""
        if self._of[0] is not predicted or self._of[1] is not truth:
            both = np.stack([predicted, truth]).transpose(0, 2, 3, 1).clip(0, 1)
            self._last, self._of = tuple(self.clip.embed(both, bgr=self.bgr)), (predicted, truth)  # type: ignore
        return self._last  # type: ignore[return-value]

    def choices(self) -> dict[str, Any]:
        return {"network": f"CLIP ViT-B/32, {self.variant}", "colors": "BGR by mistake" if self.bgr else "RGB"}


class ClipMetric(_PerFrame):
    """Cosine of each frame with its truth (Consistent4D), or half the squared angle between them (4DGen)."""

    def __init__(self, name: str, embedded: _Embedded) -> None:
        super().__init__()
        self.name, self._embedded = name, embedded

    def measure(self, predicted: np.ndarray, truth: np.ndarray) -> float:
        from dpcli.evaluate.networks.clip import cosines, spherical

        pair = self._embedded.pair(predicted, truth)
        return float((cosines if self.name == "clip" else spherical)(*pair))

    def choices(self) -> dict[str, Any]:
        return self._embedded.choices()


class ClipTemporal(LearnedMetric):
    """Mean cosine of a view's consecutive frames; the truth's own beside it."""

    def __init__(self, embedded: _Embedded) -> None:
        self._embedded, self._before = embedded, None
        self._found: dict[str, list[np.ndarray]] = {}

    def start(self, view: str) -> None:
        self._before, self._gap, self._view = None, _Gap(), view
        self._found[view] = []

    def add(self, predicted: np.ndarray, truth: np.ndarray, frame: int) -> None:
        from dpcli.evaluate.networks.clip import cosines

        now = np.stack(self._embedded.pair(predicted, truth))
        if not self._gap.before(frame) and self._before is not None:
            self._found[self._view].append(cosines(self._before, now))
        self._before = now

    def end(self) -> None:
        if not self._found[self._view]:
            raise DataError(f"view {self._view!r}: no two frames in a row; clip_temporal compares consecutive ones")

    def score(self) -> LearnedScore:
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
    """Mean cosine over all pairs of views at the same time (thesis C.1.4); the truth's own beside it.

    Holds the sum of the views' embeddings for each frame: sum over pairs = (|sum|^2 - V) / 2 of unit vectors. Of the
    frames that all views have: the mean of fewer views would be another number.
    """

    def __init__(self, embedded: _Embedded) -> None:
        self._embedded, self._views = embedded, 0
        self._sums: dict[int, np.ndarray] = {}  # by the number of the frame, f64 (2,D)
        self._seen: Counter[int] = Counter()  # views by the number of the frame

    def start(self, view: str) -> None:
        self._views += 1

    def add(self, predicted: np.ndarray, truth: np.ndarray, frame: int) -> None:
        self._sums[frame] = self._sums.get(frame, 0) + np.stack(self._embedded.pair(predicted, truth)).astype(
            np.float64
        )
        self._seen[frame] += 1

    def end(self) -> None:
        pass

    def score(self) -> LearnedScore:
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


class FrechetMetric(LearnedMetric):
    """A Frechet distance of `video_features.VARIANTS`, a view being a video."""

    def __init__(self, name: str, networks: Networks, folder: Path, device: str) -> None:
        from dpcli.evaluate.video.frechet_features import FeatureNetwork

        variant = networks.fvd if name == "fvd" else name.removeprefix("fid_vid_")
        self.name, self._every, self._views, self._pairs = name, networks.every, [], []
        self._network = FeatureNetwork.load(variant, folder, device)

    def start(self, view: str) -> None:
        from dpcli.evaluate.video.frechet_features import VideoFeatures

        self._video, self._gap = VideoFeatures(self._network, self._every), _Gap()
        self._views.append(view)

    def add(self, predicted: np.ndarray, truth: np.ndarray, frame: int) -> None:
        if self._gap.before(frame):
            self._video.restart()
        self._video.add(predicted, truth)

    def end(self) -> None:
        self._pairs.append(self._video.result())

    def score(self) -> LearnedScore:
        from dpcli.evaluate.video.frechet_features import feature_choices, video_distance

        found = video_distance(self._network.variant, self._pairs)
        each = dict(zip(self._views, found.each, strict=True)) if found.each else {}
        counts = {"videos": found.videos, "clips": found.clips, "frames": found.frames}
        choices = feature_choices(found.variant, self._every)
        return LearnedScore(self.name, found.value, each, counts=counts, choices=choices)


class WarpingMetric(LearnedMetric):
    """Mean squared warping error along the truth's flow, then over views; the truth's own beside it.

    A view counts the same whatever its share of occluded pixels, as it does in comparisons and intervals.
    """

    def __init__(self) -> None:
        self._parts: dict[str, Any] = {}

    def start(self, view: str) -> None:
        from dpcli.evaluate.video.warping import Warping

        self._warping, self._gap, self._view = Warping(), _Gap(), view

    def add(self, predicted: np.ndarray, truth: np.ndarray, frame: int) -> None:
        if self._gap.before(frame):
            self._warping.restart()
        self._warping.add(predicted, truth)

    def end(self) -> None:
        self._parts[self._view] = self._warping.result()

    def score(self) -> LearnedScore:
        from dpcli.evaluate.video.warping import warping_compute, warping_merge

        each = {view: warping_compute(part) for view, part in self._parts.items()}
        value, own = (
            mean_defined(np.array([getattr(one, key) for one in each.values()])) for key in ("squared", "truth_squared")
        )
        shown = [one for one in each.values() if not np.isnan(one.squared)]
        counts = {"views": len(shown), "pairs": sum(one.pairs for one in shown)}
        choices = {
            "flow": "OpenCV DIS of the truth, forward-backward check",
            "error": "mean square, colors in 0..1",
            "mean": "over the pixels of each view, then over views",
            "occluded": round(warping_compute(warping_merge(self._parts.values())).occluded, 4),
        }
        return LearnedScore("warping", value, {view: one.squared for view, one in each.items()}, own, counts, choices)


def load_metrics(
    names: Sequence[str], networks: Networks, folder: Path, device: str = "cpu"
) -> tuple[dict[str, LearnedMetric], dict[str, str]]:
    """The metrics by name, and the reason of each that can't be had: weights or a package that are absent."""
    made: dict[str, LearnedMetric] = {}
    missing: dict[str, str] = {}
    embedded: dict[tuple[str, bool], _Embedded] = {}
    for name in names:
        try:
            made[name] = _load(name, networks, folder, device, embedded)
        except DpcError as error:
            missing[name] = str(error)
    return made, missing


def _load(name: str, networks: Networks, folder: Path, device: str, embedded: dict) -> LearnedMetric:
    if name == "lpips":
        return LpipsMetric(networks, folder, device)
    if name in FRECHET:
        return FrechetMetric(name, networks, folder, device)
    if name == "warping":
        return WarpingMetric()
    if name == "clip_spherical":  # 4DGen's: other weights, colors swapped by its reader
        networks = Networks(clip="laion")
    key = networks.clip, name == "clip_spherical"
    if key not in embedded:
        embedded[key] = _Embedded(networks, folder, device, bgr=key[1])
    if name == "clip_temporal":
        return ClipTemporal(embedded[key])
    return ClipViews(embedded[key]) if name == "clip_views" else ClipMetric(name, embedded[key])
