"""The names of metrics as people write them."""

from __future__ import annotations

TITLES = {
    "ap": "AP",
    "pq": "PQ",
    "f1": "F1",
    "f1_10": "F1@10",
    "f1_25": "F1@25",
    "f1_50": "F1@50",
    "pre": "precision",
    "rec": "recall",
    "miou": "mIoU",
    "ri": "Rand index",
    "ari": "adjusted Rand index",
    "epe3d": "EPE3D",
    "epe3d_no_motion": "EPE3D of no motion",
    "accs": "AccS",
    "accr": "AccR",
    "outlier": "Outlier",
    "psnr": "PSNR",
    "psnr_foreground": "PSNR on object",
    "ssim": "SSIM",
    "ms_ssim": "MS-SSIM",
    "silhouette_iou": "IoU of silhouettes",
    "f_score_1": "F-score at 1 %",
    "f_score_2": "F-score at 2 %",
    "chamfer": "Chamfer distance",
    "lpips": "LPIPS",
    "fvd": "FVD",
    "fid_vid": "FID-VID",
    "fid_vid_r3d50": "FID-VID (3D ResNet-50)",
    "fid_vid_inception": "FID-VID (Inception)",
    "clip": "CLIP",
    "clip_spherical": "CLIP spherical distance",
    "clip_views": "CLIP across views",
    "clip_temporal": "CLIP over time",
    "macro_f1": "macro F1",
    "top5_accuracy": "top-5 accuracy",
    "adjusted_rand_index": "adjusted Rand index",
    "epe": "EPE",
}


def title_of(key: str) -> str:
    """Returns a metric's name as people write it; of a key that has none, its words.

    >>> title_of("miou"), title_of("part_rotation")
    ('mIoU', 'part rotation')
    """
    return TITLES.get(key, str(key).replace("_", " "))


def metric_title(key: str, unit: str) -> str:
    """Returns a metric's name as tables have it, with its unit; fractions are shown in percent.

    >>> metric_title("miou", "fraction"), metric_title("epe3d", "m"), metric_title("ssim", "1")
    ('mIoU (%)', 'EPE3D (m)', 'SSIM')
    """
    shown = "%" if unit == "fraction" else unit
    return title_of(key) + (f" ({shown})" if shown and shown != "1" else "")
