"""Preparation of a frame for the network of each published variant of FVD and FID-VID."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.video.frechet.variants import FeatureVariant

if TYPE_CHECKING:
    import torch

SIDE, SIDE_R3D = 224, 112  # pixels
MEAN_R3D = (114.7748, 107.7354, 99.4750)  # of RGB in 0..255, Kinetics


def prepare_frame(variant: FeatureVariant, picture: np.ndarray) -> torch.Tensor:
    """Returns a frame f32 (3,H,W), RGB in 0..1, as f32 (3,h,w) that the variant's network takes.

    Raises DataError for values that are not finite or far above 1, ValueError for another shape.
    """
    check_picture_values(picture)
    return _PREPARE[variant.name](np.ascontiguousarray(picture, np.float32))


def check_picture_values(picture: np.ndarray) -> None:
    """Raises ValueError unless (3,H,W); DataError for NaN, infinite values, and 0..255 where 0..1 is expected."""
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
    """Prepares a frame as VideoGPT does: to 8 bits by cutting off, as the code that calls it does, not by rounding."""
    return _short_side((picture.clip(0, 1) * 255).astype(np.uint8).astype(np.float32) / 255)


def _eight_bit(picture: np.ndarray) -> np.ndarray:
    """Returns colors of 0..1 as u8 0..255, rounded: what a saved picture holds."""
    return (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def _bicubic(picture: np.ndarray, side: int) -> torch.Tensor:
    """Returns f32 (3,side,side) by PIL's antialiased bicubic per channel, in floats: overshoots stay (DisCo's resizer)."""
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
