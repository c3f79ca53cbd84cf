"""Video protocols: how two frames are made comparable, and what range, border and views a number stands for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.choices import (
    BACKGROUNDS,
    FRECHET_METRICS,
    FVD_VARIANTS,
    LPIPS_NETWORKS,
    PICTURE_METRICS,
    SCENE_METRICS,
)
from dpcli.evaluate.video.picture_statistics import PSNR_CAP, PictureStatistics, picture_update
from dpcli.evaluate.video.sources.source import Picture

SMALLEST = {"ssim": 11, "ms_ssim": 176}  # pixels a side


@dataclass(frozen=True)
class Networks:
    """Says which published network stands for a metric. hop: windows of FVD and FID-VID start at each so many frames.

    lpips_range01: LPIPS gets colors in 0..1 where it expects -1..1, as DisCo's evaluation does.
    """

    lpips: str = "alex"
    lpips_range01: bool = False
    fvd: str = "consistent4d"
    clip: str = "openai"
    hop: int = 1


@dataclass(frozen=True)
class VideoProtocol:
    """Holds all choices that a number of a video stands for.

    views: which of the truth's are compared, all | reference | test (all when there is no test view).
    size: side that both pictures are resized to by PIL's default (bicubic), None = as they are, and equal. eight_bit:
    colors are rounded to 0..255 after compositing. data_range: None = of each frame, as torchmetrics without one: the
    truth's largest less smallest value for PSNR, the wider of both pictures' for SSIM. border: as `ssim.ssim`.
    gray: SSIM of luminance instead of each color. networks: those of the learned metrics; learned_views: which of the
    truth's they compare, if others than `views`.
    """

    name: str
    views: str = "all"
    size: int | None = None
    eight_bit: bool = False
    data_range: float | None = 1.0
    border: str = "valid"
    gray: bool = False
    networks: Networks = Networks()
    learned_views: str | None = None
    background: str = "white"


_LINEAGE = Networks(lpips="vgg")
PROTOCOLS = {
    protocol.name: protocol
    for protocol in (
        VideoProtocol("dpc"),
        VideoProtocol(
            "thesis", views="reference", eight_bit=True, data_range=255.0, networks=_LINEAGE, learned_views="all"
        ),
        VideoProtocol(
            "consistent4d", views="test", size=512, eight_bit=True, data_range=None, border="reflect", networks=_LINEAGE
        ),
        VideoProtocol(
            "disco",
            size=256,
            eight_bit=True,
            data_range=255.0,
            gray=True,
            networks=Networks(lpips="vgg", lpips_range01=True, fvd="disco"),
        ),
        VideoProtocol("torchmetrics", border="reflect"),
    )
}


def video_protocol(
    name: str, background: str | None = None, *, lpips: str | None = None, fvd: str | None = None, hop: int = 1
) -> VideoProtocol:
    """Returns a protocol by its name, over another background or with other networks when they are given.

    lpips: alex | vgg | squeeze; fvd: a variant of `frechet/variants.py`; hop: its windows start each so many
    frames. Raises UsageError for names there aren't.
    """
    if name not in PROTOCOLS:
        raise UsageError(f"--protocol {name}: expected {', '.join(PROTOCOLS)}")
    if background is not None and background not in BACKGROUNDS:
        raise UsageError(f"--background {background}: expected {' or '.join(BACKGROUNDS)}")
    for option, value, known in (("lpips", lpips, LPIPS_NETWORKS), ("fvd", fvd, FVD_VARIANTS)):
        if value is not None and value not in known:
            raise UsageError(f"--{option} {value}: expected {', '.join(known)}")
    found = PROTOCOLS[name]
    given = {"lpips": lpips, "fvd": fvd}
    networks = replace(found.networks, hop=hop, **{key: value for key, value in given.items() if value})
    return replace(found, networks=networks, background=background or found.background)


def check_picture_of(metrics: Sequence[str] | None, picture: object) -> None:
    """Raises UsageError when a picture is asked for, but only metrics that compare none."""
    if picture is not None and metrics is not None and not set(metrics) & set(PICTURE_METRICS):
        raise UsageError(f"--picture shows pictures: ask for one of {','.join(PICTURE_METRICS)}, or leave it out")


def check_choices_of(
    metrics: Sequence[str] | None, background: str | None, *, lpips: str | None, fvd: str | None, hop: int
) -> None:
    """Raises UsageError for a choice, as in `video_protocol`, that none of the metrics depends on; None: the default ones."""
    asked = set(metrics or PICTURE_METRICS)
    for option, given, readers in (
        ("--lpips", lpips is not None, ("lpips",)),
        ("--fvd", fvd is not None, ("fvd",)),
        ("--hop", hop != 1, FRECHET_METRICS),
    ):
        if given and not asked & set(readers):
            raise UsageError(f"{option} is of {', '.join(readers)}: name it in --metrics, too, or leave {option} out")
    if background is not None and asked <= set(SCENE_METRICS):
        raise UsageError(f"--background {background}: {', '.join(sorted(asked))} compare no pictures; leave it out")


def comparable(picture: Picture, protocol: VideoProtocol) -> np.ndarray:
    """Returns the colors f32 (3,H,W) of a picture as the protocol compares them: in 0..1, or 0..255 when it rounds to 8 bits."""
    colors = picture.over(BACKGROUNDS[protocol.background])
    if not protocol.eight_bit:
        return colors
    rounded = (colors * 255 + 0.5).astype(np.uint8)
    return np.ascontiguousarray(_resized(rounded.transpose(1, 2, 0), protocol.size).transpose(2, 0, 1), np.float32)


def _resized(image: np.ndarray, side: int | None, nearest: bool = False) -> np.ndarray:
    if side is None or image.shape[:2] == (side, side):
        return image
    from PIL import Image

    return np.asarray(Image.fromarray(image).resize((side, side), *([Image.Resampling.NEAREST] if nearest else [])))


def score_frame(
    frame: int, predicted: Picture, truth: Picture, protocol: VideoProtocol, metrics: Sequence[str]
) -> PictureStatistics:
    """Returns the statistics of one frame. An object is where alpha is one half or more; psnr_foreground: the truth's."""
    ours, theirs = comparable(predicted, protocol), comparable(truth, protocol)
    silhouettes = "silhouette_iou" in metrics
    mask = _mask(truth, protocol) if silhouettes or "psnr_foreground" in metrics else None
    other = _mask(predicted, protocol) if silhouettes else None
    peak = own = protocol.data_range
    if protocol.data_range is None:
        peak = float(np.ptp(theirs)) or np.nan  # a frame of one color has no range, so no PSNR
        own = max(float(np.ptp(ours)), float(np.ptp(theirs)))
    if not own:
        metrics = [name for name in metrics if name not in ("ssim", "ms_ssim")]
    options = {"data_range": peak, "similarity_range": own, "border": protocol.border}
    options |= {"mask": mask, "predicted_mask": other}
    if not protocol.gray:
        return picture_update(frame, ours, theirs, metrics=metrics, **options)
    found = picture_update(frame, ours, theirs, metrics=(), **options)
    gray = picture_update(frame, _luminance(ours), _luminance(theirs), metrics=metrics, **options)
    return replace(found, similarity=gray.similarity, windows=gray.windows, multi_scale=gray.multi_scale)


def _mask(picture: Picture, protocol: VideoProtocol) -> np.ndarray:
    return _resized(picture.mask(), protocol.size, nearest=True)


def _luminance(colors: np.ndarray) -> np.ndarray:
    """Returns RGB f32 (3,H,W) as luminance f32 (1,H,W), with scikit-image's weights."""
    return np.tensordot(np.float32([0.2125, 0.7154, 0.0721]), colors, 1)[None]


def scaled(picture: Picture, protocol: VideoProtocol) -> np.ndarray:
    """Returns `comparable` colors f32 (3,H,W), always in 0..1: what the learned metrics look at."""
    colors = comparable(picture, protocol)
    return colors / np.float32(255) if protocol.eight_bit else colors


def check_size(size: tuple[int, int], protocol: VideoProtocol, metrics: Sequence[str], where: str) -> None:
    """Raises DataError when pictures of this (width, height) are too small for a metric."""
    side = protocol.size or min(size)
    for name, least in SMALLEST.items():
        if name in metrics and side < least:
            raise DataError(
                f"{where}: pictures of {size[0]}x{size[1]}; {name} needs at least {least} pixels a side: "
                "leave it out of --metrics"
            )


def describe_protocol(protocol: VideoProtocol) -> dict[str, Any]:
    """Returns every choice of a protocol in words, for a result that stands alone."""
    ranges = "of each frame: truth's max - min (PSNR), the wider of both pictures' (SSIM)"
    borders = {"valid": "windows inside the picture", "reflect": "a window per pixel, picture mirrored at its edges"}
    of = "of luminance" if protocol.gray else "of each color"
    return {
        "name": protocol.name,
        "views": protocol.views,
        "views_of_learned_metrics": protocol.learned_views or protocol.views,
        "background": protocol.background,
        "size": f"both resized to {protocol.size} (bicubic)" if protocol.size else "as they are, equal",
        "colors": "RGB, 8 bits" if protocol.eight_bit else "RGB, float32",
        "data_range": ranges if protocol.data_range is None else protocol.data_range,
        "psnr": f"of each frame over all its values, at most {PSNR_CAP:g} dB",
        "psnr_foreground": "psnr over the pixels where the truth's alpha is at least one half",
        "ssim": f"Gaussian window 11x11, sigma 1.5, {of}, mean over {borders[protocol.border]}",
        "silhouette_iou": "pixels in both objects over pixels in either, alpha of one half or more",
        "ms_ssim": "5 scales; weights .0448 .2856 .3001 .2363 .1333",
        "mean": "over the frames of a view, then over views",
    }
