"""The words that options of `dpc evaluate` take: protocols, metrics and networks. It loads fast, so that `--help` lists them."""

from __future__ import annotations

from dpcli.errors import UsageError

PARTS_PROTOCOLS = ("dpc", "release")
VIDEO_PROTOCOLS = ("dpc", "thesis", "consistent4d", "disco", "torchmetrics")
ALL_PROTOCOLS = tuple(dict.fromkeys((*PARTS_PROTOCOLS, *VIDEO_PROTOCOLS)))

TOP_K = 5
CLASSIFICATION_METRICS = ("accuracy", f"top{TOP_K}_accuracy", "balanced_accuracy", "macro_f1")
SEGMENTATION_METRICS = ("ap", "pq", "f1", "pre", "rec", "miou", "ri", "ari")
MOTION_METRICS = ("epe3d", "accs", "accr", "outlier", "part_rotation", "part_displacement")
PICTURE_METRICS = ("psnr", "psnr_foreground", "ssim", "ms_ssim", "silhouette_iou")
PICTURE_UNITS = {name: "dB" if name.startswith("psnr") else "1" for name in PICTURE_METRICS}
FRECHET_METRICS = ("fvd", "fid_vid_r3d50", "fid_vid_inception")
LEARNED_METRICS = ("lpips", "clip", "clip_spherical", "clip_views", "clip_temporal", *FRECHET_METRICS, "warping")
SCENE_METRICS = ("parts", "tracks", "surface")
VIDEO_METRICS = (*PICTURE_METRICS, *LEARNED_METRICS, *SCENE_METRICS)
LOWER_IS_BETTER = frozenset(
    {"epe3d", "outlier", "part_rotation", "part_displacement", "lpips", "clip_spherical", "fvd", "warping"}
)

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}  # colors in 0..1
LPIPS_NETWORKS = ("alex", "vgg", "squeeze")
FVD_VARIANTS = ("styleganv", "videogpt", "disco", "consistent4d")


def parse_video_metrics(text: str | None) -> tuple[str, ...] | None:
    """Returns the names in `psnr,ssim` in display order; None stays None. Raises UsageError for metrics there aren't.

    >>> parse_video_metrics("ssim, psnr")
    ('psnr', 'ssim')
    """
    if text is None:
        return None
    asked = {name.strip() for name in text.split(",") if name.strip()}
    unknown = sorted(asked - set(VIDEO_METRICS))
    if unknown or not asked:
        wrong = unknown[0] if unknown else "nothing"
        raise UsageError(f"--metrics {text}: {wrong}; expected some of {','.join(VIDEO_METRICS)}")
    return tuple(name for name in VIDEO_METRICS if name in asked)


def parse_metrics(text: str | None) -> tuple[str, ...] | None:
    """Returns the names in `accuracy,miou` without repeats; None stays None. Raises UsageError where none is named.

    Whether a file has them is told when its kind is known.
    """
    if text is None:
        return None
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if not names:
        raise UsageError("--metrics: names none; expected some such as accuracy or miou,ap")
    return names


def check_protocol(protocol: str) -> None:
    """Raises UsageError for a protocol that parts files aren't evaluated by."""
    if protocol not in PARTS_PROTOCOLS:
        raise UsageError(f"--protocol {protocol}: expected {' or '.join(PARTS_PROTOCOLS)}")
