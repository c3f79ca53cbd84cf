"""Masks in image files and videos: soft ones as they are, and images of labels, opaque wherever there is one."""

from __future__ import annotations

from collections.abc import Sized
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.decode.cv2_import import load_cv2
from dpcli.runtime.clips.images import open_image, require_one_picture, upright
from dpcli.runtime.progress import log

_SMALL_LABEL = 64  # no mask is that dark; values below are labels
_LABELS = 64  # values at most in an image of labels
_VOID = 255  # beside small labels: in some data sets, such as PASCAL VOC, that it is undecided
_WIDE_VOIDS = (10_000, 65_535)  # the same beside other labels of 16 bits, such as KITTI MOTS has them
_COLORFUL = 48  # gray levels between channels: more than compression does to a gray mask
_NOISE = 32  # gray levels: compression leaves no more where nothing is
_RIPPLE = 24  # gray levels between neighbors within a label, after compression
_BIN, _MOST_BINS = 16, 4  # gray levels, and how many such bins hold the labels of a compressed image
_SAID: set[str] = set()


def read_mask(path: Path) -> np.ndarray:
    """Reads u8 (H,W): a gray mask as it is, an RGBA cut-out's alpha, or 255 where an image of labels isn't 0.

    Labels are palettes, colors, values below 64, and few values that fill regions, of 8 or 16 bits, and so is an alpha that
    nowhere reaches 255. Raises DataError when the file isn't readable, or when compression changed its labels.
    """
    try:
        with open_image(path) as stored:
            require_one_picture(path, stored)
            lossy = stored.format in ("JPEG", "AVIF") or stored.format == "WEBP" and not _is_lossless(path)
            image = upright(stored)
            if image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info:
                alpha = np.array(image.convert("RGBA").getchannel("A"))
                if alpha.min(initial=255) < 255:
                    return _opaque(alpha > 0) if alpha.max() < 255 and _are_labels(alpha) else alpha
            if image.mode == "1":
                return _opaque_labels(path, np.array(image))
            if image.mode == "P":
                return _of_palette(path, image)
            wide = image.mode[0] in "IF"
            values = np.array(image if wide else image.convert("RGB"))
    except (OSError, ValueError, SyntaxError) as error:
        raise DataError(f"{path}: not a readable mask ({error}); export it again") from None
    return _of_colors(path, values, lossy) if values.ndim == 3 else _of_values(path, values, lossy)


def _of_palette(path: Path, image) -> np.ndarray:  # image: PIL.Image.Image
    """Returns the mask u8 (H,W) of an image with a palette: by its numbers where 0 is the background, else by its colors.

    Tools for labels give 0 to the background. Programs that make files smaller number colors as they like: then shades of
    gray are a mask as it is drawn, and black is the background of other colors.
    """
    numbers, colors = np.array(image), np.array(image.convert("RGB"))
    used, first = np.unique(numbers, return_index=True)
    shown = colors.reshape(-1, 3)[first].astype(int)
    gray = not np.ptp(shown, axis=1).any() and len(np.unique(shown[:, 0])) == len(used)
    if gray and (shown.min() < _NOISE or len(used) == 1):
        return _of_values(path, colors[..., 0], False)
    black = ~shown.any(1)
    if black.any() and used[0] == 0 and not black[0]:
        with log.each_once(_SAID):
            log.info(
                f"{path.parent}: masks: number 0 of a palette is a color and black has another; black is the background"
            )
        return _opaque(colors.any(-1))
    return _opaque_labels(path, numbers)


def _is_lossless(path: Path) -> bool:
    """Returns whether a WebP file holds a picture as it was, in a chunk named VP8L, perhaps after those of its properties."""
    with open(path, "rb") as file:
        start = file.read(64)
    return b"VP8L" in start and b"VP8 " not in start


def mask_of_video(path: Path, rgba: np.ndarray) -> np.ndarray:
    """Returns the mask u8 (H,W) in a frame u8 (H,W,4) of a video of masks: its alpha, else white, or a color, on black.

    A frame as dark as compression leaves black is an empty mask.
    """
    if rgba[..., 3].min(initial=255) < 255:
        return rgba[..., 3]
    brightest = rgba[..., :3].max(axis=2)
    return (
        np.zeros_like(brightest) if brightest.max(initial=0) < _SMALL_LABEL else _of_colors(path, rgba[..., :3], True)
    )


def _of_colors(path: Path, values: np.ndarray, lossy: bool) -> np.ndarray:
    """Returns the mask u8 (H,W) of colors u8 (H,W,3): by their brightest channel, where they tell labels apart."""
    brightest = values.max(axis=2)
    if int(np.ptp(values, axis=2).max(initial=0)) > _COLORFUL:
        if not lossy:
            colors = values.astype(np.int64) @ [1 << 16, 1 << 8, 1]
            _tell_several(path, np.unique(colors[_among_equals(colors) & (brightest > 0)]))
        return _opaque(brightest > (_half_of_lowest(brightest) if lossy else 0))
    if brightest.max(initial=0) < _SMALL_LABEL:
        return _of_values(path, brightest, lossy)
    from PIL import Image

    return _of_values(path, np.array(Image.fromarray(values).convert("L")), lossy)


def _of_values(path: Path, values: np.ndarray, lossy: bool) -> np.ndarray:
    """Returns the mask u8 (H,W) of gray values (H,W) of any type."""
    top = values.max(initial=0)
    if values.dtype.kind == "f" and top < 2:  # up to 1, and a little beyond where a filter overshot
        return np.round(255 * values.clip(0, 1)).astype(np.uint8)
    if lossy and 0 < top < _SMALL_LABEL:
        raise DataError(
            f"{path}: labels up to {top} in a file that was compressed with loss, which changed them; export them as PNG"
        )
    if lossy and _are_compressed_labels(values):
        return _opaque(values > _half_of_lowest(values))
    if top < _SMALL_LABEL or not lossy and _are_labels(values):
        return _opaque_labels(path, values)
    if 256 <= top < 32768:
        raise DataError(f"{path}: a mask with values up to {top}; expected 255 for the object, or 65535, or labels")
    return np.clip(np.round(values / (257 if top > 255 else 1)), 0, 255).astype(np.uint8)


def _opaque(where: np.ndarray) -> np.ndarray:
    return np.where(where, 255, 0).astype(np.uint8)


def _opaque_labels(path: Path, labels: np.ndarray) -> np.ndarray:
    """Returns 255 wherever the label isn't 0. The log tells of labels that some data sets have for "undecided"."""
    found = set(np.unique(labels).tolist()) - {0}
    small, wide = {label for label in found if label < _SMALL_LABEL}, found & {*_WIDE_VOIDS}
    void = _VOID if _VOID in found and small == found - {_VOID} else min(wide, default=0)
    if void and len(found) > 1:
        beside = f"labels below {_SMALL_LABEL}" if void == _VOID else "other labels"
        with log.each_once(_SAID):
            log.info(
                f"{path.parent}: masks: {void} beside {beside} is read as the object, like every label but 0; "
                "where it means undecided, write 0"
            )
    _tell_several(path, found - {void})
    return _opaque(labels > 0)


def _tell_several(path: Path, labels: Sized) -> None:
    """Says once of a folder that labels, of which there may be several, are taken together."""
    if 1 < len(labels) <= _LABELS:
        with log.each_once(_SAID):
            log.info(
                f"{path.parent}: masks: several labels in a picture are read as one object; where they are several objects, write"
                " 0 in place of all but one"
            )


def _are_labels(values: np.ndarray) -> bool:
    """Returns whether gray values (H,W) are labels: few, and most pixels of those between the ends lie among their equals.

    The soft outline of a mask has many values, and none of them fills a square of 3 pixels.
    """
    few = np.unique(values)
    between = (values > 0) & (values != max(few[-1], 255))
    if len(few) > _LABELS or not between.any():
        return len(few) == 2 and 255 < few[-1] < 65535
    return float((_among_equals(values) & between).sum()) > 0.25 * float(between.sum())


def _among_equals(values: np.ndarray) -> np.ndarray:
    """Returns bool (H,W): whether a pixel and its eight neighbors have the same value, of whole numbers (H,W)."""
    cv2 = load_cv2()
    numbers = np.searchsorted(np.unique(values), values).astype(np.float32)  # which OpenCV takes, and exact
    square = np.ones((3, 3), np.uint8)
    return cv2.erode(numbers, square) == cv2.dilate(numbers, square)


def _are_compressed_labels(values: np.ndarray) -> bool:
    """Returns whether gray values u8 (H,W) were labels before compression: those between the ends lie among their like, and
    these are of few gray levels, where a soft mask has all.
    """
    between = (values > _NOISE) & (values < 255 - _NOISE)
    levels = values[between & _level(values)]
    if len(levels) <= 0.25 * np.count_nonzero(between):
        return False
    bins = np.sort(np.bincount(levels // _BIN))[::-1]
    return bool(bins[:_MOST_BINS].sum() > 0.8 * len(levels))


def _level(values: np.ndarray) -> np.ndarray:
    """Returns bool (H,W): whether a pixel and its eight neighbors are nearly alike."""
    cv2 = load_cv2()
    square = np.ones((3, 3), np.uint8)
    return cv2.dilate(values, square).astype(np.int16) - cv2.erode(values, square) <= _RIPPLE


def _half_of_lowest(values: np.ndarray) -> int:
    """Returns half the gray level of the darkest label that fills a region of u8 (H,W), above the noise of compression."""
    levels = values[(values > _NOISE) & _level(values)]
    return int(np.percentile(levels, 5)) // 2 if len(levels) else 127
