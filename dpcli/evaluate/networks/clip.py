"""CLIP ViT-B/32 picture embeddings (Radford et al. 2021), and the CLIP scores made of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError, DpcError, UsageError, first_line
from dpcli.evaluate.networks import full_precision
from dpcli.evaluate.networks.state_dicts import fill_module, load_tensors
from dpcli.evaluate.networks.weights import whole_weights

VARIANTS = {"openai": "clip-openai", "laion": "clip-laion"}
MEAN, DEVIATION = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
_FILES = ("model.safetensors", "pytorch_model.bin")
_OUTSIDE = 0.01  # how far from 0..1 a float may lie


class Clip:
    """Embeds pictures by the vision half of CLIP. side: of the square it looks at, in pixels. width: of an embedding."""

    def __init__(self, model: Any, device: str = "cpu"):
        self.model = model.eval().requires_grad_(False).to(device)
        self.side, self.width = model.config.image_size, model.config.projection_dim

    @classmethod
    def load(cls, folder: Path, variant: str = "openai", device: str = "cpu") -> Clip:
        """Loads `openai`, or `laion` (trained on LAION-2B), from the weights folder.

        Raises DataError when the files are absent or damaged; DpcError without `transformers`; UsageError for another variant.
        """
        if variant not in VARIANTS:
            raise UsageError(f"CLIP variant {variant!r}: expected one of {', '.join(VARIANTS)}")
        return cls.open(whole_weights(VARIANTS[variant], folder).parent, device)

    @classmethod
    def open(cls, folder: Path, device: str = "cpu") -> Clip:
        """Loads any CLIP in the layout of Hugging Face: config.json and model.safetensors or pytorch_model.bin. Local only."""
        path = next((folder / name for name in _FILES if (folder / name).is_file()), None)
        if path is None or not (folder / "config.json").is_file():
            raise DataError(f"{folder}: expected config.json and {' or '.join(_FILES)}")
        model = _model(folder)
        fill_module(model, load_tensors(path), path)
        return cls(model, device)

    def embed(
        self,
        pictures: np.ndarray,  # u8 or floats [B, H, W, 3]
        *,
        bgr: bool = False,
    ) -> np.ndarray:  # f32 [B, width]
        """Returns unit embeddings of RGB pictures; floats in 0..1 are rounded to 8 bits, as CLIP's preprocessing sees files.

        bgr: swap red and blue first, as 4DGen's reader did by mistake. Raises DataError as `preprocess`.
        """
        import torch

        ready = preprocess(pictures[..., ::-1] if bgr else pictures, self.side)
        if not len(ready):
            return np.empty((0, self.width), np.float32)
        with torch.no_grad(), full_precision():
            given = torch.from_numpy(ready).to(next(self.model.parameters()))
            found = self.model(pixel_values=given).image_embeds.double().cpu().numpy()
        return _unit(found).astype(np.float32)


def _model(folder: Path) -> Any:
    try:
        from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection
    except ImportError:
        raise DpcError("CLIP needs the package transformers: pip install 'dpc-toolkit[metrics]'") from None
    try:
        return CLIPVisionModelWithProjection(CLIPVisionConfig.from_pretrained(folder, local_files_only=True))
    except (OSError, ValueError, TypeError) as error:
        raise DataError(
            f"{folder / 'config.json'}: not the configuration of a CLIP ({first_line(error)[:150]})"
        ) from None


def preprocess(
    pictures: np.ndarray,  # u8 or floats [B, H, W, 3]
    side: int = 224,
) -> np.ndarray:  # f32 [B, 3, side, side]
    """Returns RGB pictures as CLIP sees them: short side to `side` (Pillow's bicubic), center square, colors normalized.

    Raises DataError for floats that are not finite or not in 0..1; ValueError for another shape.
    """
    if pictures.ndim != 4 or pictures.shape[3] != 3:
        raise ValueError(f"pictures of shape {pictures.shape}; expected (B,H,W,3)")
    squares = [_center(_resized(picture, side), side) for picture in _eight_bits(pictures)]
    values = np.stack(squares).astype(np.float32) / 255 if squares else np.empty((0, side, side, 3), np.float32)
    values = (values - np.array(MEAN, np.float32)) / np.array(DEVIATION, np.float32)
    return np.ascontiguousarray(values.transpose(0, 3, 1, 2))


def _eight_bits(pictures: np.ndarray) -> np.ndarray:
    if pictures.dtype == np.uint8:
        return pictures
    if not np.issubdtype(pictures.dtype, np.floating):
        raise DataError(f"CLIP needs uint8, or floats in 0..1, but these are {pictures.dtype}")
    if not np.isfinite(pictures).all():
        raise DataError(f"{int((~np.isfinite(pictures)).sum())} values are NaN or infinite")
    if pictures.size and (pictures.min() < -_OUTSIDE or pictures.max() > 1 + _OUTSIDE):
        raise DataError(f"values from {pictures.min():g} to {pictures.max():g}, expected 0..1; divide by 255")
    return np.rint(pictures.clip(0, 1) * 255).astype(np.uint8)


def _resized(picture: np.ndarray, side: int) -> np.ndarray:
    from PIL import Image

    height, width = picture.shape[:2]
    short = min(height, width)
    size = (width * side // short, height * side // short)
    return np.asarray(Image.fromarray(np.ascontiguousarray(picture)).resize(size, Image.Resampling.BICUBIC))


def _center(picture: np.ndarray, side: int) -> np.ndarray:
    top, left = (picture.shape[0] - side) // 2, (picture.shape[1] - side) // 2
    return picture[top : top + side, left : left + side]


def cosines(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Returns the cosine of each pair of embeddings f (...,D), f64 (...). Raises DataError for a zero or non-finite one.

    >>> cosines(np.array([[1.0, 0.0]]), np.array([[3.0, 4.0]])).round(3).tolist()
    [0.6]
    """
    if predicted.shape != truth.shape:
        raise ValueError(f"embeddings of shapes {predicted.shape} and {truth.shape}; expected equal ones")
    return np.clip((_unit(predicted) * _unit(truth)).sum(-1), -1, 1)


def spherical(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Returns 2 asin(|x - y| / 2)^2 of unit embeddings f (...,D), f64 (...): half the squared angle, as 4DGen measures it."""
    if predicted.shape != truth.shape:
        raise ValueError(f"embeddings of shapes {predicted.shape} and {truth.shape}; expected equal ones")
    chord = np.linalg.norm(_unit(predicted) - _unit(truth), axis=-1)
    return 2 * np.arcsin(np.minimum(chord / 2, 1)) ** 2


def _unit(embeddings: np.ndarray) -> np.ndarray:
    """Returns embeddings f (...,D) as f64 of length 1."""
    embeddings = np.asarray(embeddings, np.float64)
    lengths = np.linalg.norm(embeddings, axis=-1, keepdims=True)
    if not np.isfinite(lengths).all() or not lengths.all():
        raise DataError("an embedding is zero, NaN or infinite; the weights may be another network's")
    return embeddings / lengths
