"""Features of the clips of videos by a variant's network, and the Frechet distance between those of two sides."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.video.frechet.distance import (
    FeatureStatistics,
    feature_merge,
    feature_update,
    frechet_distance,
    single_video_distance,
)
from dpcli.evaluate.video.frechet.frame_inputs import prepare_frame
from dpcli.evaluate.video.frechet.variants import FeatureVariant, feature_variant

if TYPE_CHECKING:
    import torch

LONGEST = 256  # frames of a video that is one clip: its activations take 7 MB each


def build_network(name: str) -> torch.nn.Module:
    """Returns the network of a variant with random weights. Raises UsageError for styleganv, whose network is a file."""
    from dpcli.evaluate.networks.i3d import I3D
    from dpcli.evaluate.networks.inception import FidInception
    from dpcli.evaluate.networks.resnet3d import ResNet3D50

    makers: dict[str, Callable[[], torch.nn.Module]] = {
        "videogpt": lambda: I3D(avg_pool=2, bn_eps=1e-5),
        "disco": lambda: I3D(avg_pool=1, bn_eps=1e-3),
        "consistent4d": lambda: I3D(avg_pool=1, bn_eps=1e-3),
        "r3d50": ResNet3D50,
        "inception": FidInception,
    }
    if name not in makers:
        raise UsageError(f"variant {name!r}: its network is the TorchScript file itself")
    return makers[name]()


class FeatureNetwork:
    """Holds a variant and its network, on a device."""

    def __init__(self, variant: FeatureVariant, module: torch.nn.Module, device: torch.device | str = "cpu") -> None:
        self.variant, self.device = variant, device
        self.module = module.eval().to(device)

    @classmethod
    def load(cls, name: str, folder: Path, device: torch.device | str = "cpu") -> FeatureNetwork:
        """Loads the published weights from `folder`. DataError, one line, when they are absent or damaged."""
        from dpcli.evaluate.networks.i3d import ScriptedI3D
        from dpcli.evaluate.networks.state_dicts import fill_module, load_tensors
        from dpcli.evaluate.networks.weights import weights_named, whole_weights

        variant = feature_variant(name)
        script = weights_named(variant.weights).script  # it holds code, so its digest is compared
        path = whole_weights(variant.weights, folder, digest=script)
        if script:
            return cls(variant, ScriptedI3D(path), device)
        module = build_network(name)
        fill_module(module, load_tensors(path), path)
        return cls(variant, module, device)

    def features(self, frames: Sequence[torch.Tensor]) -> np.ndarray:
        """Returns the features f64 (D) of one clip of prepared frames f32 (3,h,w)."""
        import torch

        from dpcli.evaluate.networks import full_precision

        clip = torch.stack(tuple(frames), dim=1)[None] if self.variant.clip != 1 else torch.stack(tuple(frames))
        with torch.inference_mode(), full_precision():
            return self.module(clip.to(self.device)).double().cpu().numpy()[0]


class ClipFeatures:
    """Computes the features of one video's clips while its frames stream in; holds one clip at most.

    hop: a window starts at each so many frames (1 in the published code). frames: all that came; used: those that lie
    in a clip.
    """

    def __init__(self, network: FeatureNetwork, hop: int = 1) -> None:
        if hop < 1:
            raise UsageError(f"a window every {hop} frames: expected 1 or more")
        self.network, self.hop, self.frames, self.used = network, hop, 0, 0
        self._row = self._longest = self._new = 0  # frames without a gap, at present and at most; since the last clip
        self._waiting: deque[torch.Tensor] = deque(maxlen=network.variant.clip)
        self._found: FeatureStatistics | None = None

    def add(self, picture: np.ndarray) -> None:
        """Takes the next frame, f32 (3,H,W) in 0..1. Raises as `prepare_frame`; DataError for a video too long to be one clip."""
        clip = self.network.variant.clip
        if clip is None and self.frames == LONGEST:
            raise DataError(
                f"fvd variant {self.network.variant.name} takes a whole video at once, {LONGEST} frames at "
                "most: cut it, or take variant disco, whose windows have 16 frames"
            )
        self._waiting.append(prepare_frame(self.network.variant, picture))
        self.frames, self._row, self._new = self.frames + 1, self._row + 1, self._new + 1
        self._longest = max(self._longest, self._row)
        if clip is not None and self._row >= clip and (self._row - clip) % self.hop == 0:
            self._take_clip()

    def restart(self) -> None:
        """Says that frames are missing here: no window reaches across. Raises DataError where a clip is the whole video."""
        variant = self.network.variant
        if variant.clip is None:
            raise DataError(
                f"frames are missing inside a view, and {variant.metric} variant {variant.name} takes a whole "
                "video at once: make them again, or take variant disco, whose windows have 16 frames"
            )
        if variant.clip > 1:  # single frames have no neighbors to lose
            self._waiting.clear()
            self._row = self._new = 0

    def result(self) -> FeatureStatistics:
        """Ends the video and returns the statistics of its clips. Raises DataError when it had too few frames."""
        variant = self.network.variant
        if self._longest < variant.least:
            had = f"{self._longest} frames{' in a row' if self._longest < self.frames else ''}"
            raise DataError(f"{had}: {variant.metric} ({variant.name}) needs at least {variant.least}")
        if variant.clip is None and self._waiting:
            self._take_clip()
            self._waiting.clear()
        return self._found

    def _take_clip(self) -> None:
        self.used, self._new = self.used + min(self._new, len(self._waiting)), 0  # windows overlap
        self._found = feature_update(self.network.features(self._waiting)[None], self._found)


@dataclass(frozen=True)
class VideoPair:
    """Holds the statistics of one predicted video's clips and of the true one's, and how many frames lie in them."""

    predicted: FeatureStatistics
    truth: FeatureStatistics
    frames: int


class VideoFeatures:
    """Computes the features of one predicted video and of the true one, frame by frame, for one metric."""

    def __init__(self, network: FeatureNetwork, hop: int = 1) -> None:
        self._sides = ClipFeatures(network, hop), ClipFeatures(network, hop)

    def add(self, predicted: np.ndarray, truth: np.ndarray) -> None:
        """Takes the next frame of both, f32 (3,H,W) in 0..1. Raises as `ClipFeatures.add`."""
        for side, picture in zip(self._sides, (predicted, truth), strict=True):
            side.add(picture)

    def restart(self) -> None:
        """Says that frames are missing here, on both sides. Raises as `ClipFeatures.restart`."""
        for side in self._sides:
            side.restart()

    def result(self) -> VideoPair:
        """Ends both videos and returns their statistics. Raises DataError when there were too few frames."""
        predicted, truth = (side.result() for side in self._sides)
        return VideoPair(predicted, truth, self._sides[0].used)


@dataclass(frozen=True)
class FeatureDistance:
    """Holds a distance (no unit, less is better), of how many videos, clips of a side, and frames; each video's own, if any."""

    variant: FeatureVariant
    value: float
    videos: int
    clips: int
    frames: int
    each: tuple[float, ...] = ()


def video_distance(variant: FeatureVariant, pairs: Sequence[VideoPair]) -> FeatureDistance:
    """Returns the variant's distance over videos (views, objects), as its aggregation says.

    Raises DataError for no videos, and for a single clip where a distribution is needed.
    """
    if not pairs:
        raise DataError(f"{variant.metric} ({variant.name}): no videos to compare")
    options = {"root": variant.root, "single": variant.single}
    each: tuple[float, ...] = ()
    if variant.aggregation == "pooled":
        predicted, truth = (feature_merge(getattr(pair, side) for pair in pairs) for side in ("predicted", "truth"))
        value = frechet_distance(predicted, truth, **options)
    else:
        each = tuple(_own_distance(variant, pair, options) for pair in pairs)
        value = float(np.mean(each))
    clips, frames = sum(pair.truth.samples for pair in pairs), sum(pair.frames for pair in pairs)
    return FeatureDistance(variant, value, len(pairs), clips, frames, each)


def _own_distance(variant: FeatureVariant, pair: VideoPair, options: dict[str, str]) -> float:
    if variant.aggregation == "closed form":
        return single_video_distance(pair.predicted.rows[0], pair.truth.rows[0])
    return frechet_distance(pair.predicted, pair.truth, **options)
