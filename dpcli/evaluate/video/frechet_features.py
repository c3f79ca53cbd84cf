"""Frechet distances between videos: how each published variant turns frames into a network's input, clips and a number."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.video.frechet import (
    FeatureStatistics,
    feature_merge,
    feature_update,
    frechet_distance,
    single_video_distance,
)

if TYPE_CHECKING:
    import torch

SIDE, SIDE_R3D = 224, 112  # pixels
MEAN_R3D = (114.7748, 107.7354, 99.4750)  # of RGB in 0..255, Kinetics
LONGEST = 256  # frames of a video that is one clip: its activations take 7 MB each
AGGREGATIONS = {
    "pooled": "one distance between all clips of all videos",
    "mean": "a distance of each video's clips, then the mean over videos",
    "closed form": "|f - g|^2 + (std f - std g)^2 of each pair of videos, then the mean over videos",
}


@dataclass(frozen=True)
class FeatureVariant:
    """A published way to a Frechet distance of videos.

    weights: entry of the weights list. picture: how a frame is prepared, in words. network: in words. clip: frames of a
    sample, a window of each frame on; None = the whole video. least: frames that a video needs. aggregation: key of
    AGGREGATIONS. root, single: as `frechet.frechet_distance`.
    """

    name: str
    metric: str
    weights: str
    picture: str
    network: str
    clip: int | None
    least: int
    aggregation: str = "pooled"
    root: str = "eig"
    single: str = "error"


_SHORT = "short side 224 bilinear, no antialias, center crop, -1..1"
_WHOLE = "8 bits, 224x224 PIL bicubic in floats, aspect not kept, -1..1"
_DISCO = "I3D, average pool 1x7x7, batch norm eps 1e-3, 400 logits"
VARIANTS = {
    variant.name: variant
    for variant in (
        FeatureVariant(
            "styleganv",
            "fvd",
            "i3d-torchscript",
            _SHORT,
            "i3d_torchscript.pt as it is, 400 logits",
            None,
            10,
            root="scipy",
            single="mean",
        ),
        FeatureVariant(
            "videogpt",
            "fvd",
            "i3d-400",
            f"8 bits, cut off; {_SHORT}",
            "I3D, average pool 2x7x7, batch norm eps 1e-5, 400 logits",
            None,
            10,
            root="svd",
            single="mean",
        ),
        FeatureVariant("disco", "fvd", "i3d-400", _WHOLE, _DISCO, 16, 16, root="scipy"),
        FeatureVariant("consistent4d", "fvd", "i3d-400", _WHOLE, _DISCO, None, 2, aggregation="closed form"),
        FeatureVariant(
            "r3d50",
            "fid_vid_r3d50",
            "resnet50-kinetics",
            "8 bits, 112x112 PIL bicubic in floats, aspect not kept, 0..255 less the mean color",
            "3D ResNet-50, 2048 features",
            16,
            16,
        ),
        FeatureVariant(
            "inception",
            "fid_vid_inception",
            "inception",
            "8 bits, 299x299 bilinear, antialias, (x - 128) / 128 (torchmetrics)",
            "Inception-v3 (TensorFlow 2015-12-05), 2048 features of each frame",
            1,
            2,
            aggregation="mean",
        ),
    )
}


def feature_variant(name: str) -> FeatureVariant:
    """A variant by its name. UsageError for names there aren't."""
    if name not in VARIANTS:
        raise UsageError(f"variant {name!r}: expected {', '.join(VARIANTS)}")
    return VARIANTS[name]


def prepare(variant: FeatureVariant, picture: np.ndarray) -> torch.Tensor:
    """Frame f32 (3,H,W), RGB in 0..1 -> f32 (3,h,w) as the variant's network takes it.

    DataError for values that are not finite or far above 1, ValueError for another shape.
    """
    check_picture_values(picture)
    return _PREPARE[variant.name](np.ascontiguousarray(picture, np.float32))


def check_picture_values(picture: np.ndarray) -> None:
    """ValueError unless (3,H,W); DataError for NaN, infinite values, and 0..255 where 0..1 is expected."""
    if picture.ndim != 3 or len(picture) != 3:
        raise ValueError(f"a frame must have shape (3,H,W), but has {picture.shape}")
    if not np.isfinite(picture).all():
        raise DataError(f"a frame has {int((~np.isfinite(picture)).sum())} values that are NaN or infinite")
    if picture.max(initial=0) > 1.5 or picture.min(initial=0) < -0.5:
        raise DataError(
            f"a frame has values from {picture.min():g} to {picture.max():g}; expected 0..1: divide by 255?"
        )


def _short_side(picture: np.ndarray) -> torch.Tensor:
    import torch
    import torch.nn.functional as F

    height, width = picture.shape[1:]
    scale = SIDE / min(height, width)
    size = (SIDE, math.ceil(width * scale)) if height < width else (math.ceil(height * scale), SIDE)
    scaled = F.interpolate(torch.from_numpy(picture)[None], size=size, mode="bilinear", align_corners=False)[0]
    top, left = ((side - SIDE) // 2 for side in scaled.shape[1:])
    return (scaled[:, top : top + SIDE, left : left + SIDE] - 0.5) * 2


def _short_side_cut_off(picture: np.ndarray) -> torch.Tensor:
    """VideoGPT's: to 8 bits by cutting off, as the code that calls it does, not by rounding."""
    return _short_side((picture.clip(0, 1) * 255).astype(np.uint8).astype(np.float32) / 255)


def _eight_bit(picture: np.ndarray) -> np.ndarray:
    """0..1 -> 0..255 rounded, u8: what a saved picture holds."""
    return (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def _bicubic(picture: np.ndarray, side: int) -> torch.Tensor:
    """8 bits -> f32 (3,side,side), PIL's antialiased bicubic per channel in floats: overshoots stay (DisCo's resizer)."""
    import torch
    from PIL import Image

    channels = [Image.fromarray(channel.astype(np.float32)) for channel in _eight_bit(picture)]
    found = [np.asarray(channel.resize((side, side), Image.Resampling.BICUBIC)) for channel in channels]
    return torch.from_numpy(np.stack(found))


def _bicubic_i3d(picture: np.ndarray) -> torch.Tensor:
    return _bicubic(picture, SIDE) / 127.5 - 1


def _bicubic_r3d(picture: np.ndarray) -> torch.Tensor:
    import torch

    return _bicubic(picture, SIDE_R3D) - torch.tensor(MEAN_R3D)[:, None, None]


def _inception(picture: np.ndarray) -> torch.Tensor:
    import torch

    from dpcli.evaluate.networks.inception import inception_input

    return inception_input(torch.from_numpy(_eight_bit(picture))[None])[0]


_PREPARE: dict[str, Callable[[np.ndarray], torch.Tensor]] = {
    "styleganv": _short_side,
    "videogpt": _short_side_cut_off,
    "disco": _bicubic_i3d,
    "consistent4d": _bicubic_i3d,
    "r3d50": _bicubic_r3d,
    "inception": _inception,
}


def build_network(name: str) -> torch.nn.Module:
    """The network of a variant with random weights. UsageError for styleganv, whose network is a file."""
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
    """A variant and its network, on a device."""

    def __init__(self, variant: FeatureVariant, module: torch.nn.Module, device: torch.device | str = "cpu") -> None:
        self.variant, self.device = variant, device
        self.module = module.eval().to(device)

    @classmethod
    def load(cls, name: str, folder: Path, device: torch.device | str = "cpu") -> FeatureNetwork:
        """With the published weights in `folder`. DataError, one line, when they are absent or damaged."""
        from dpcli.evaluate.networks.weights import check, fill, find, named, state_of

        variant = feature_variant(name)
        path = find(variant.weights, folder)
        if not named(variant.weights).script:
            module = build_network(name)
            fill(module, state_of(variant.weights, folder), path)
            return cls(variant, module, device)
        from dpcli.evaluate.networks.i3d import ScriptedI3D

        found = check(path, named(variant.weights))
        if found.state != "present":
            raise DataError(f"{path}: damaged weights ({found.said}); delete it and fetch it again")
        return cls(variant, ScriptedI3D(path), device)

    def features(self, frames: Sequence[torch.Tensor]) -> np.ndarray:
        """Prepared frames f32 (3,h,w) of one clip -> f64 (D)."""
        import torch

        clip = torch.stack(tuple(frames), dim=1)[None] if self.variant.clip != 1 else torch.stack(tuple(frames))
        with torch.inference_mode():
            return self.module(clip.to(self.device)).double().cpu().numpy()[0]


class ClipFeatures:
    """Features of one video's clips while its frames stream in; holds one clip at most.

    every: a window starts at each so many frames (1 in the published code). frames: all that came; used: those that lie
    in a clip.
    """

    def __init__(self, network: FeatureNetwork, every: int = 1) -> None:
        if every < 1:
            raise UsageError(f"a window every {every} frames: expected 1 or more")
        self.network, self.every, self.frames, self.used = network, every, 0, 0
        self._row = self._longest = self._new = 0  # frames without a gap, at present and at most; since the last clip
        self._waiting: deque[torch.Tensor] = deque(maxlen=network.variant.clip)
        self._found: FeatureStatistics | None = None

    def add(self, picture: np.ndarray) -> None:
        """The next frame, f32 (3,H,W) in 0..1. Raises as `prepare`; DataError for a video too long to be one clip."""
        clip = self.network.variant.clip
        if clip is None and self.frames == LONGEST:
            raise DataError(
                f"fvd variant {self.network.variant.name} takes a whole video at once, {LONGEST} frames at "
                "most: cut it, or take variant disco, whose windows have 16 frames"
            )
        self._waiting.append(prepare(self.network.variant, picture))
        self.frames, self._row, self._new = self.frames + 1, self._row + 1, self._new + 1
        self._longest = max(self._longest, self._row)
        if clip is not None and self._row >= clip and (self._row - clip) % self.every == 0:
            self._look()

    def restart(self) -> None:
        """Frames are missing here: no window reaches across. DataError for a variant whose clip is the whole video."""
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
        """Statistics of the clips; ends the video. DataError when it had too few frames."""
        variant = self.network.variant
        if self._longest < variant.least:
            had = f"{self._longest} frames{' in a row' if self._longest < self.frames else ''}"
            raise DataError(f"{had}: {variant.metric} ({variant.name}) needs at least {variant.least}")
        if variant.clip is None and self._waiting:
            self._look()
            self._waiting.clear()
        return self._found

    def _look(self) -> None:
        self.used, self._new = self.used + min(self._new, len(self._waiting)), 0  # windows overlap
        self._found = feature_update(self.network.features(self._waiting)[None], self._found)


@dataclass(frozen=True)
class VideoPair:
    """Statistics of one predicted video's clips and of the true one's, and how many frames lie in them."""

    predicted: FeatureStatistics
    truth: FeatureStatistics
    frames: int


class VideoFeatures:
    """One predicted video beside the true one, frame by frame, for one metric."""

    def __init__(self, network: FeatureNetwork, every: int = 1) -> None:
        self._sides = ClipFeatures(network, every), ClipFeatures(network, every)

    def add(self, predicted: np.ndarray, truth: np.ndarray) -> None:
        """The next frame of both, f32 (3,H,W) in 0..1. Raises as `ClipFeatures.add`."""
        for side, picture in zip(self._sides, (predicted, truth), strict=True):
            side.add(picture)

    def restart(self) -> None:
        """Frames are missing here, on both sides. Raises as `ClipFeatures.restart`."""
        for side in self._sides:
            side.restart()

    def result(self) -> VideoPair:
        """DataError when there were too few frames."""
        predicted, truth = (side.result() for side in self._sides)
        return VideoPair(predicted, truth, self._sides[0].used)


@dataclass(frozen=True)
class FeatureDistance:
    """A distance (no unit, less is better); of how many videos, clips of a side, and frames; each video's own, if any."""

    variant: FeatureVariant
    value: float
    videos: int
    clips: int
    frames: int
    each: tuple[float, ...] = ()


def video_distance(variant: FeatureVariant, pairs: Sequence[VideoPair], root: str | None = None) -> FeatureDistance:
    """The variant's distance over videos (views, objects), as its aggregation says. root: another than the variant's.

    DataError for no videos, and for a single clip where a distribution is needed.
    """
    if not pairs:
        raise DataError(f"{variant.metric} ({variant.name}): no videos to compare")
    options = {"root": root or variant.root, "single": variant.single}
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


def feature_choices(variant: FeatureVariant, every: int = 1) -> dict[str, Any]:
    """Every choice of a variant in words, for a result that stands alone."""
    windows = f"windows of {variant.clip} frames, one from every {every}" if every > 1 else f"windows of {variant.clip}"
    clips = "the whole video" if variant.clip is None else "single frames" if variant.clip == 1 else windows
    named = {key: value for key, value in asdict(variant).items() if key not in ("clip", "least", "single")}
    rule = {"mean": "distance of means alone", "error": "an error"}[variant.single]
    return {**named, "clips": clips, "aggregation": AGGREGATIONS[variant.aggregation], "one_sample": rule}


def feature_report(found: FeatureDistance, every: int = 1) -> dict[str, Any]:
    """A distance with its denominators and choices, for JSON."""
    counts = {key: getattr(found, key) for key in ("value", "videos", "clips", "frames")}
    return {**counts, "each": list(found.each), "unit": "", "choices": feature_choices(found.variant, every)}
