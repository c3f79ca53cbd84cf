"""Points drawn in plain numpy, as square dots or as small shaded balls: no window system and no GPU is needed.

Both kinds go through `nearest_writes`, which decides what of each point is seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.draw.palette import DARK, RGB

FINE = 2  # each pixel of a picture of balls is the mean of this many in both directions
_FAR = np.float32(np.inf)
_LIGHT = np.array([-0.37, -0.56, -0.74])  # right, down, away: from the upper left, behind the viewer
_AMBIENT, _FOG = 0.5, 0.42  # the least light on a ball; how far the farthest ball fades into the background
_SMALLEST, _LARGEST = 1.3, 0.03  # radius in fine pixels; as a share of the picture's height


@dataclass(frozen=True)
class Raster:
    """Holds a picture's size in pixels and where it looks: the (right, down) in its middle, and pixels per unit."""

    width: int
    height: int
    center: np.ndarray  # [2]
    scale: float

    def place(self, points: np.ndarray, fine: int = 1) -> np.ndarray:  # [N, 3] -> [N, 2]
        """Returns where points are in pixels from the upper left corner; fine: parts of a pixel in each direction."""
        return (points[:, :2] - self.center) * (self.scale * fine) + np.array([self.width, self.height]) * fine / 2


def nearest_writes(
    pixels: np.ndarray,  # [N, 2] whole numbers: column, row
    away: np.ndarray,  # [N]
    stamp: np.ndarray,  # [K, 2] offsets
    size: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # each [W]
    """Returns columns, rows, indices of points and of offsets of all writes inside a picture, the farthest point first.

    Written in this order, each pixel ends with the nearest point, among equally near ones the later.
    """
    order = np.argsort(-away, kind="stable")
    spread = (pixels[order, None] + stamp).reshape(-1, 2)
    inside = ((spread >= 0) & (spread < size)).all(axis=1)
    point, offset = np.repeat(order, len(stamp)), np.tile(np.arange(len(stamp)), len(order))
    return spread[inside, 0], spread[inside, 1], point[inside], offset[inside]


def draw_dots(
    points: np.ndarray,  # [N, 3] right, down, away
    colors: np.ndarray,  # [N, 3]
    raster: Raster,
    side: int | None = None,
    relief: bool = True,
    background: RGB = DARK.background,
) -> np.ndarray:  # [H, W, 3]
    """Returns an image u8 of points as square dots, colors u8; the nearest dot wins.

    side: of a dot in pixels, by default larger where points lie apart. relief: closes gaps of one pixel and shades
    what lies behind its neighbors.
    """
    height, width = raster.height, raster.width
    image = np.empty((height, width, 3), np.uint8)
    image[:] = background
    pixels = np.floor(raster.place(points)).astype(np.int64)
    side = side or _dot_side(pixels)
    stamp = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2) - side // 2
    columns, rows, point, _ = nearest_writes(pixels, points[:, 2], stamp, (width, height))
    image[rows, columns] = colors[point]
    if not relief:
        return image
    depth = np.full((height, width), _FAR, np.float32)
    depth[rows, columns] = points[point, 2] * np.float32(raster.scale)
    return _shade_relief(*_fill_gaps(image, depth))


def _dot_side(pixels: np.ndarray) -> int:
    """Returns the side of a dot in pixels, 1 to 4: larger when the points lie apart."""
    if len(pixels) < 2:
        return 3
    low, high = np.percentile(pixels, [5, 95], axis=0)
    area = float(np.prod(np.maximum(high - low, 1)))
    return int(np.clip(np.round(np.sqrt(0.5 * area / len(pixels)) + 0.6), 1, 4))


def _fill_gaps(image: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Closes gaps one pixel wide, left where points on a grid are drawn a little apart."""
    for _ in range(2):  # rows, then columns
        left, right = depth[:, :-2], depth[:, 2:]
        gap = ~np.isfinite(depth[:, 1:-1]) & np.isfinite(left) & np.isfinite(right)
        rows, columns = np.nonzero(gap)
        image[rows, columns + 1], depth[rows, columns + 1] = image[rows, columns], depth[rows, columns]
        image, depth = image.transpose(1, 0, 2), depth.T
    return image, depth


def _shade_relief(image: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Darkens pixels that lie behind their neighbors (eye-dome lighting, Boucheny 2009), so that shape shows."""
    padded = np.pad(depth, 1, constant_values=_FAR)
    drop = np.zeros_like(depth)
    drawn = np.isfinite(depth)
    for dy, dx in ((0, 1), (2, 1), (1, 0), (1, 2)):
        beside = padded[dy : dy + depth.shape[0], dx : dx + depth.shape[1]]
        step = np.where(drawn & np.isfinite(beside), depth, 0) - np.where(drawn & np.isfinite(beside), beside, 0)
        drop += np.clip(step, 0, 8)
    shade = np.exp(-0.05 * drop)[..., None]
    return np.where(drawn[..., None], (image * shade).astype(np.uint8), image)


def draw_balls(
    points: np.ndarray,  # [N, 3] right, down, away
    colors: np.ndarray,  # [N, 3]
    raster: Raster,
    background: RGB,
    depth: tuple[float, float] | None = None,
) -> np.ndarray:  # [H, W, 3]
    """Returns an image u8 of points as lit balls, colors u8, orthographic; the nearest ball wins.

    depth: the nearest and farthest "away" for the fading, by default the points' own. The radius follows from the density.
    """
    width, height = raster.width * FINE, raster.height * FINE
    canvas = np.full((height, width, 3), background, np.float32)
    if len(points) == 0:
        return _mean_pixels(canvas)
    place = raster.place(points, FINE)
    disc, light = _lit_ball(ball_radius(place, height))
    pixels = np.floor(place).astype(np.int64)
    columns, rows, point, offset = nearest_writes(pixels, points[:, 2], disc, (width, height))
    canvas[rows, columns] = _fade(colors, points[:, 2], background, depth)[point] * light[offset, None]
    return _mean_pixels(canvas)


def ball_radius(place: np.ndarray, height: int) -> float:  # [N, 2]
    """Returns the radius in pixels with which balls at these places overlap a little, in a picture of that height."""
    low, high = np.percentile(place, [2, 98], axis=0)
    area = float(np.prod(np.maximum(high - low, 1)))
    return float(np.clip(0.65 * np.sqrt(area / len(place)), _SMALLEST, max(_LARGEST * height, _SMALLEST)))


def _lit_ball(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pixels (K,2) of a ball around its center's, and the light on each, f32 (K), 0..1."""
    reach = int(radius)
    offsets = np.stack(np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1)), -1).reshape(-1, 2)
    offsets = offsets[(offsets**2).sum(1) <= radius**2]
    flat = offsets / radius
    normal = np.concatenate([flat, -np.sqrt(np.maximum(1 - (flat**2).sum(1, keepdims=True), 0))], 1)
    light = _AMBIENT + (1 - _AMBIENT) * np.clip(normal @ _LIGHT / np.linalg.norm(_LIGHT), 0, 1)
    return offsets, light.astype(np.float32)


def _fade(colors: np.ndarray, away: np.ndarray, background: RGB, depth: tuple[float, float] | None) -> np.ndarray:
    """Returns colors f32 (N,3), mixed with the background the more the farther away."""
    near, far = depth or (float(away.min()), float(away.max()))
    share = _FOG * np.clip((away - near) / max(far - near, 1e-9), 0, 1)[:, None]
    return (colors * (1 - share) + np.array(background) * share).astype(np.float32)


def _mean_pixels(canvas: np.ndarray) -> np.ndarray:
    height, width, _ = canvas.shape
    blocks = canvas.reshape(height // FINE, FINE, width // FINE, FINE, 3)
    return np.rint(blocks.mean((1, 3))).astype(np.uint8)
