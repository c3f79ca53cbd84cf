"""The published variants of FVD and FID-VID: network, preparation of frames, clips, and how distances are put together."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from dpcli.errors import UsageError

AGGREGATIONS = {
    "pooled": "one distance between all clips of all videos",
    "mean": "a distance of each video's clips, then the mean over videos",
    "closed form": "|f - g|^2 + (std f - std g)^2 of each pair of videos, then the mean over videos",
}


@dataclass(frozen=True)
class FeatureVariant:
    """Holds a published way to a Frechet distance of videos.

    weights: entry of the weights list. picture: how a frame is prepared, in words. network: in words. clip: frames of a
    sample, a window of each frame on; None = the whole video. least: frames that a video needs. aggregation: key of
    AGGREGATIONS. root, single: as `distance.frechet_distance`.
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
    """Returns a variant by its name. Raises UsageError for names there aren't."""
    if name not in VARIANTS:
        raise UsageError(f"variant {name!r}: expected {', '.join(VARIANTS)}")
    return VARIANTS[name]


def feature_choices(variant: FeatureVariant, hop: int = 1) -> dict[str, Any]:
    """Returns every choice of a variant in words, for a result that stands alone. hop: frames between starts of windows."""
    windows = f"windows of {variant.clip} frames, one from every {hop}" if hop > 1 else f"windows of {variant.clip}"
    clips = "the whole video" if variant.clip is None else "single frames" if variant.clip == 1 else windows
    named = {key: value for key, value in asdict(variant).items() if key not in ("clip", "least", "single")}
    rule = {"mean": "distance of means alone", "error": "an error"}[variant.single]
    return {**named, "clips": clips, "aggregation": AGGREGATIONS[variant.aggregation], "one_sample": rule}
