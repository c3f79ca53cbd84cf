"""Layers without knowledge: the picture as a flat cut-out, and its silhouette inflated into round thickness."""

from __future__ import annotations

import numpy as np

from dpcli.generate4d.shape.layers import INTERVALS, Camera, ShapeLayers

_THIN = 0.005  # half the thickness of a cut-out, as a share of the camera's distance


class Flat:
    """Predicts a cut-out: every pixel of the object at the distance of the world's origin, almost without thickness."""

    name = "flat"

    def layers(
        self,
        pictures: np.ndarray,  # [T, 4, H, W]
        camera: Camera,
    ) -> list[ShapeLayers]:  # T
        """Returns the layers of each frame; see `ShapePrior.layers`."""
        return [_around_middle(picture, camera, np.full(picture.shape[1:], _THIN)) for picture in pictures]


class Inflated:
    """Predicts the thickness of `ball_thickness`, half before and half behind the distance of the world's origin.

    The far side has the colors of the near one.
    """

    name = "inflated"

    def layers(
        self,
        pictures: np.ndarray,  # [T, 4, H, W]
        camera: Camera,
    ) -> list[ShapeLayers]:  # T
        """Returns the layers of each frame; see `ShapePrior.layers`."""
        return [
            _around_middle(picture, camera, ball_thickness(picture[3] > 0.5) / camera.intrinsics[0, 0])
            for picture in pictures
        ]


def _around_middle(picture: np.ndarray, camera: Camera, half: np.ndarray) -> ShapeLayers:
    """Returns layers about the origin's distance; half: half the thickness (H,W) as a share of that distance."""
    middle = camera.distance
    pair = np.stack([middle * (1 - half), middle * (1 + half)])
    presence = np.zeros((INTERVALS, *half.shape), np.float32)
    presence[0] = picture[3]
    color = np.broadcast_to(picture[:3], (2 * INTERVALS, *picture[:3].shape))
    return ShapeLayers(np.tile(pair, (INTERVALS, 1, 1)).astype(np.float32), presence, color.astype(np.float32))


def ball_thickness(mask: np.ndarray) -> np.ndarray:
    """Returns half the thickness (H,W) in pixels of a silhouette that is the union of the balls of its medial axis.

    A disc becomes a ball, a limb a rod. The thickness is at least half a pixel inside the mask and 0 outside.
    """
    from scipy import ndimage

    distance = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    ridge = (distance > 0) & (distance >= ndimage.maximum_filter(distance, size=3) - 0.5)
    squared = np.zeros(mask.shape)
    for row, column in zip(*np.nonzero(ridge)):
        radius = distance[row, column]
        reach = int(radius)
        top, left = max(row - reach, 0), max(column - reach, 0)
        window = squared[top : row + reach + 1, left : column + reach + 1]
        dy = np.arange(top, top + window.shape[0])[:, None] - row
        dx = np.arange(left, left + window.shape[1]) - column
        np.maximum(window, radius**2 - dy**2 - dx**2, out=window)
    return np.where(mask, ndimage.gaussian_filter(np.sqrt(squared.clip(0.25)), 1.0), 0.0)
