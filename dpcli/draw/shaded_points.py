"""Points drawn as small shaded balls, in plain numpy: few points still show a shape, and no window system is needed."""

from __future__ import annotations

import numpy as np

FINE = 2  # each pixel is the mean of this many in both directions
_LIGHT = np.array([-0.37, -0.56, -0.74])  # right, down, away: from the upper left, behind the viewer
_AMBIENT, _FOG = 0.5, 0.42  # the least light on a ball; how far the farthest ball fades into the background
_SMALLEST, _LARGEST = 1.3, 0.03  # radius in fine pixels; as a share of the picture's height


def view_matrix(azimuth: float, elevation: float, up: str = "z") -> np.ndarray:
    """Rows right, down and away, f64 (3,3), of a camera that looks at the origin.

    azimuth: radians about `up` (x, y, z or one with a minus), elevation: radians above the horizon.
    """
    axis = "xyz".index(up[-1])
    first, second, upright = np.eye(3)[[(axis + 1) % 3, (axis + 2) % 3, axis]]
    if up[0] == "-":
        second, upright = -second, -upright
    ahead = np.cos(azimuth) * first + np.sin(azimuth) * second
    away = np.cos(elevation) * ahead - np.sin(elevation) * upright
    right = np.cross(ahead, upright)
    return np.stack([right, np.cross(away, right), away])


def draw_balls(
    points: np.ndarray,  # [N, 3]
    colors: np.ndarray,  # [N, 3]
    size: tuple[int, int],
    center: np.ndarray,  # [2]
    scale: float,
    background: tuple[int, int, int],
    depth: tuple[float, float] | None = None,
) -> np.ndarray:  # [H, W, 3]
    """Image u8 (H,W,3) of points (right, down, away) with colors u8 (N,3), orthographic; the nearest ball wins.

    size: width and height in pixels; center: the (right, down) in the middle; scale: pixels per unit; depth: the
    nearest and farthest "away" for the fading, by default the points' own. The radius follows from the density.
    """
    width, height = size[0] * FINE, size[1] * FINE
    canvas = np.full((height, width, 3), background, np.float32)
    if len(points) == 0:
        return _mean_pixels(canvas)
    place = (points[:, :2] - center) * (scale * FINE) + np.array([width, height]) / 2
    radius = ball_radius(place, height)
    order = np.argsort(-points[:, 2], kind="stable")  # far to near: of several writes to a pixel the last one stays
    disc, light = _ball(radius)
    pixels = np.floor(place[order]).astype(np.int64)[:, None] + disc  # [N, disc, 2]
    paint = _faded(colors[order], points[order, 2], background, depth)[:, None] * light[:, None]
    inside = ((pixels >= 0) & (pixels < [width, height])).all(-1)
    columns, rows = pixels[inside].T
    canvas[rows, columns] = paint[inside]
    return _mean_pixels(canvas)


def ball_radius(place: np.ndarray, height: int) -> float:
    """Radius in pixels such that balls at `place` (N,2) overlap a little."""
    low, high = np.percentile(place, [2, 98], axis=0)
    area = float(np.prod(np.maximum(high - low, 1)))
    return float(np.clip(0.65 * np.sqrt(area / len(place)), _SMALLEST, max(_LARGEST * height, _SMALLEST)))


def _ball(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (K,2) of a ball around its center's, and the light on each, f32 (K), 0..1."""
    reach = int(radius)
    offsets = np.stack(np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1)), -1).reshape(-1, 2)
    offsets = offsets[(offsets**2).sum(1) <= radius**2]
    flat = offsets / radius
    normal = np.concatenate([flat, -np.sqrt(np.maximum(1 - (flat**2).sum(1, keepdims=True), 0))], 1)
    light = _AMBIENT + (1 - _AMBIENT) * np.clip(normal @ _LIGHT / np.linalg.norm(_LIGHT), 0, 1)
    return offsets, light.astype(np.float32)


def _faded(
    colors: np.ndarray, away: np.ndarray, background: tuple[int, int, int], depth: tuple[float, float] | None
) -> np.ndarray:
    """Colors f32 (N,3), mixed with the background the more the farther away."""
    near, far = depth or (float(away.min()), float(away.max()))
    share = _FOG * np.clip((away - near) / max(far - near, 1e-9), 0, 1)[:, None]
    return (colors * (1 - share) + np.array(background) * share).astype(np.float32)


def _mean_pixels(canvas: np.ndarray) -> np.ndarray:
    height, width, _ = canvas.shape
    blocks = canvas.reshape(height // FINE, FINE, width // FINE, FINE, 3)
    return np.rint(blocks.mean((1, 3))).astype(np.uint8)
