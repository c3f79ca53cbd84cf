"""Cutting an object out of a plain background, of a given mask, or of the alpha that frames bring along."""

from __future__ import annotations

from functools import reduce

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.prepare.decode.cv2_import import load_cv2

TOLERANCE = 0.06  # of the value range: compression noise of a video stays below
FAINT = 8  # alpha below is a leftover of compression or of a network, not the object
_COLORS = {"white": (255.0, 255.0, 255.0), "black": (0.0, 0.0, 0.0)}
_PLAIN = 0.5  # of the border has to be one color: an object may touch it, a scene fills it
_RIM = 2  # pixels on each side of an outline where object and background mix
HOLES = ("auto", "keep", "cut")
_GAP = 0.005  # of the object: what may be a gap between limbs
_FLAT = 4.0  # gray levels that a gap may be off the background more than the background itself: noise of compression
# alpha below, pixels at least, and correlation above, to tell colors that fade with alpha
_SOFT, _MANY, _TOGETHER = (200, 50, 0.6)
_SPECK = 1e-4  # of the picture: smaller islands are noise


def border_pixels(rgb: np.ndarray) -> np.ndarray:
    """Returns the outermost 2 % of rows and columns of u8 (H,W,3), at least one, thinned to about 4,000: u8 (B,3)."""
    ring = max(1, min(rgb.shape[:2]) // 50)
    sides = (rgb[:ring], rgb[-ring:], rgb[ring:-ring, :ring], rgb[ring:-ring, -ring:])
    pixels = np.concatenate([side.reshape(-1, 3) for side in sides])
    return pixels[:: max(1, len(pixels) // 4000)]


def plain_share(pixels: np.ndarray, color: np.ndarray, tolerance: float) -> float:
    """Returns the share of pixels u8 (B,3) that are `color` (3), 0..255, within `tolerance` of the range in every
    channel.

    >>> pixels = np.array([[255, 255, 255], [250, 255, 255], [0, 0, 0], [9, 9, 9]], np.uint8)
    >>> plain_share(pixels, np.array([255, 255, 255]), 0.06)
    0.5
    """
    off = np.abs(pixels.astype(np.float32) - color).max(axis=1)
    return float((off <= 255 * tolerance).mean())


def plain_background(borders: list[np.ndarray], names: list[str], tolerance: float) -> np.ndarray:
    """Finds the one color f32 (3) around the object in all frames.

    Raises DataError that says what to do when there is none.

    borders: `border_pixels` of each frame. The color is the mean around the fullest cell of the color cube, which an
    object that covers part of the border doesn't move.
    """
    pixels = np.concatenate(borders).astype(np.float32)
    color = _densest(pixels, 255 * tolerance)
    shares = [plain_share(border, color, tolerance) for border in borders]
    worst = int(np.argmin(shares))
    if shares[worst] < _PLAIN:
        raise DataError(
            f"{names[worst]}: the background is not plain: {shares[worst]:.0%} of the border is "
            f"{_hex(color)}, expected {_PLAIN:.0%}\n"
            "Give a mask per frame (--mask FOLDER, or mask_path in transforms.json; SAM 2 or rembg make them), RGBA frames, or"
            " --background keep"
        )
    return color


def named_background(text: str) -> np.ndarray | None:
    """Returns the color f32 (3), 0..255, of white, black or r,g,b; None for auto and keep.

    Raises UsageError on anything else.
    """
    if text in ("auto", "keep"):
        return None
    try:
        color = np.array(_COLORS.get(text) or [float(word) for word in text.split(",")], np.float32)
    except ValueError:
        color = np.zeros(0)
    if color.shape != (3,) or not ((0 <= color) & (color <= 255)).all():
        raise UsageError(f"--background {text}: expected auto, keep, white, black or r,g,b with values 0 to 255")
    return color


def background_color(borders: list[np.ndarray], names: list[str], background: str, tolerance: float) -> np.ndarray:
    """Returns the color f32 (3) that --background names, or the plain one that auto finds.

    Raises DataError when it isn't there.
    """
    named = named_background(background)
    if named is None:
        return plain_background(borders, names, tolerance)
    shares = [plain_share(border, named, tolerance) for border in borders]
    worst = int(np.argmin(shares))
    if shares[worst] < 0.1:
        raise DataError(
            f"{names[worst]}: {shares[worst]:.0%} of the border is --background {background}; "
            "try --background auto, or a larger --tolerance"
        )
    return named


def _densest(pixels: np.ndarray, reach: float) -> np.ndarray:
    cells = (pixels // 16).astype(np.int64) @ np.array([256, 16, 1])
    fullest = np.bincount(cells).argmax()
    color = pixels[cells == fullest].mean(axis=0, dtype=np.float64)
    for _ in range(2):  # the cell may cut through the color's noise
        near = pixels[np.abs(pixels - color).max(axis=1) <= reach]
        color = near.mean(axis=0, dtype=np.float64) if len(near) else color
    return color


def _hex(color: np.ndarray) -> str:
    return "#" + "".join(f"{round(float(value)):02x}" for value in color)


def key_out(
    rgb: np.ndarray, background: np.ndarray, tolerance: float = TOLERANCE, holes: str = "auto"
) -> tuple[np.ndarray, int]:
    """Cuts u8 (H,W,3) out of a plain background (3): u8 (H,W,4), straight alpha that is soft along the outline, and how
    many pixels were taken for holes.

    Background is what has its color and is connected to the border. Enclosed regions of that color are eyes, teeth,
    a shirt, or gaps between arms and legs. holes: keep (part of the object), cut (see-through), auto (see-through when
    as flat as the background itself and larger than 1/200 of the object).
    Along the outline alpha is the share of the object's color in the mixture (the projection of C - B on F - B, with
    F the nearest color safely inside), and the color is unmixed with it, so that putting the result back on the
    background gives the picture again.
    """
    cv2 = load_cv2()
    off = _difference(rgb, background)
    empty = (off <= 255 * tolerance).astype(np.uint8)
    outside = _reaches_border(empty)
    gaps = _gaps(empty.astype(bool) & ~outside, off, outside, holes)
    inside = _without_specks(~(outside | gaps))
    core = cv2.erode(inside.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=_RIM, borderValue=1)
    rim = cv2.dilate(inside.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & ~core.astype(bool)
    alpha, color = inside.astype(np.float32), rgb.copy()
    if core.any() and rim.any():
        _soften(alpha, color, core, rim, np.asarray(background, np.float32), 255 * tolerance)
    return clear_invisible(np.dstack([color, np.round(255 * alpha).astype(np.uint8)])), int(gaps.sum())


def _difference(rgb: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Returns f32 (H,W): the largest difference of a channel from the background's, channel by channel, which is
    faster.
    """
    channels = (np.abs(rgb[..., k].astype(np.float32) - np.float32(background[k])) for k in range(3))
    return reduce(np.maximum, channels)


def _gaps(enclosed: np.ndarray, off: np.ndarray, outside: np.ndarray, holes: str) -> np.ndarray:
    """Returns bool (H,W): those of the enclosed regions of the background's color that are taken for see-through."""
    if holes == "keep" or not enclosed.any():
        return np.zeros_like(enclosed)
    cv2 = load_cv2()
    count, label, stats, _ = cv2.connectedComponentsWithStats(enclosed.astype(np.uint8), connectivity=4)
    chosen = stats[:, cv2.CC_STAT_AREA] >= max(4, _SPECK * enclosed.size)
    chosen[0] = False
    if holes == "auto":
        chosen &= stats[:, cv2.CC_STAT_AREA] >= _GAP * (~outside).sum()
        flat = _FLAT + (float(np.median(off[outside])) if outside.any() else 0.0)
        for number in np.flatnonzero(chosen):
            chosen[number] = np.median(off[label == number]) <= flat
    return chosen[label]


def _soften(
    alpha: np.ndarray, color: np.ndarray, core: np.ndarray, rim: np.ndarray, background: np.ndarray, noise: float
) -> None:
    """Writes share f32 (H,W) and color u8 (H,W,3) of the object in the pixels of the rim, in place."""
    cv2 = load_cv2()
    distance, label = cv2.distanceTransformWithLabels(1 - core, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    rows, columns = np.nonzero(core)
    where = np.zeros(label.max() + 1, np.int64)
    where[label[rows, columns]] = rows * core.shape[1] + columns
    mixed = rim & (distance <= 3 * _RIM)  # farther from any core: something thin, taken as it is
    pure = color.reshape(-1, 3)[where[label[mixed]]]
    axis, seen = pure - background, color[mixed] - background
    length = (axis * axis).sum(axis=1)
    clear = length > (2 * noise) ** 2  # else the object has the background's color here
    share = np.where(clear, np.clip((axis * seen).sum(axis=1) / np.maximum(length, 1e-6), 0, 1), alpha[mixed])
    share[share < FAINT / 255] = 0
    alpha[mixed] = share
    unmixed = background + seen / np.maximum(share, FAINT / 255)[:, None]
    color[mixed] = np.clip(np.round(unmixed), 0, 255)


def _reaches_border(empty: np.ndarray) -> np.ndarray:
    """Returns bool (H,W): pixels of `empty` u8 connected to the border of the picture (4 neighbors)."""
    cv2 = load_cv2()
    framed = np.pad(empty, 1, constant_values=1)
    _, label = cv2.connectedComponents(framed, connectivity=4)
    return (label == label[0, 0])[1:-1, 1:-1]


def _without_specks(inside: np.ndarray) -> np.ndarray:
    cv2 = load_cv2()
    _, label, stats, _ = cv2.connectedComponentsWithStats(inside.astype(np.uint8), connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= max(4, _SPECK * inside.size)
    large[0] = False
    return large[label]


def opaque(rgba: np.ndarray) -> np.ndarray:
    """Returns the frame u8 (H,W,4) as a whole, alpha 255."""
    return np.dstack([rgba[..., :3], np.full(rgba.shape[:2], 255, np.uint8)])


def cut_alone(rgba: np.ndarray, name: str, background: str, tolerance: float, holes: str) -> np.ndarray:
    """Cuts one picture u8 (H,W,4) by its own alpha, else by its own plain background; whole for `keep`."""
    if background == "keep":
        return opaque(rgba)
    if (rgba[..., 3] < 255).any():
        return clear_invisible(rgba)
    color = background_color([border_pixels(rgba[..., :3])], [name], background, tolerance)
    return key_out(rgba[..., :3], color, tolerance, holes)[0]


def fades_to_black(rgba: np.ndarray) -> bool:
    """Returns whether colors of u8 (H,W,4) become dark as alpha becomes faint, as those that were multiplied by it (premultiplied).

    No channel is above alpha then. That of a black outline isn't either, but it is as dark where alpha is high.
    """
    alpha, brightest = rgba[..., 3].astype(np.float64), rgba[..., :3].max(-1)
    soft = (alpha >= 2 * FAINT) & (alpha <= _SOFT)
    alpha, brightest = alpha[soft], brightest[soft].astype(np.float64)
    if len(alpha) < _MANY or (brightest <= alpha + 2).mean() < 0.999 or not np.ptp(alpha) or not np.ptp(brightest):
        return False
    return bool(np.corrcoef(alpha, brightest)[0, 1] > _TOGETHER)


def clear_invisible(rgba: np.ndarray) -> np.ndarray:
    """Clears faint alpha to 0, and invisible color to black: equal objects give equal bytes."""
    return rgba * (rgba[..., 3:] >= FAINT)


def with_alpha(rgba: np.ndarray, alpha: np.ndarray, mask: str, name: str) -> np.ndarray:
    """Returns the frame u8 (H,W,4) with the alpha u8 (H,W) of a mask; `mask` and `name` are for messages.

    Raises DataError when sizes differ or it looks inverted.
    """
    if alpha.shape != rgba.shape[:2]:
        found, expected = (f"{shape[1]}x{shape[0]}" for shape in (alpha.shape, rgba.shape))
        turned = ", turned as its EXIF asks for" if alpha.shape == rgba.shape[1::-1] else ""
        raise DataError(f"{mask}: the mask is {found}, its frame {name} is {expected}{turned}; expected the same size")
    border = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    if (border > 127).mean() > 0.9 and (alpha <= 127).any():
        raise DataError(f"{mask}: the mask covers the whole border: inverted? White (255) has to be the object")
    return clear_invisible(np.dstack([rgba[..., :3], alpha]))
