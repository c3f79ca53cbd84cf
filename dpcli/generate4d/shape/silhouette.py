"""Layers without knowledge: the picture as a flat cut-out, and its silhouette inflated into round thickness."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from dpcli.generate4d.shape.layers import INTERVALS, NEAREST, Camera, ShapeLayers

_FAR = 1e9  # squared pixels, farther than anything in a picture
_BLUR = 4  # pixels, as far as a Gaussian of one pixel reaches
_ELEMENTS = 1 << 25  # numbers at a time
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
    pair = np.stack([middle * np.maximum(1 - half, NEAREST), middle * (1 + half)])
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


def ball_thicknesses(masks: Tensor) -> Tensor:
    """Returns `ball_thickness` f32 (N,H,W) of silhouettes bool (N,H,W), on their device.

    On a GPU thousands are made at a time: the squared distance to the outside and the union of balls are a least and a
    greatest sum of terms of rows and columns, found along one axis and then the other.
    """
    if masks.device.type == "cpu":
        found = [ball_thickness(mask) for mask in masks.numpy()]
        return torch.from_numpy(np.stack(found)).float() if found else masks.float()
    count = max(1, _ELEMENTS // (masks[0].numel() * max(masks.shape[1:])))
    return torch.cat([_ball_thicknesses(part) for part in masks.split(count)])


def _ball_thicknesses(masks: Tensor) -> Tensor:
    inside = functional.pad(masks, (1, 1, 1, 1))
    squared = -_parabolas(_parabolas(torch.where(inside, -_FAR, 0.0), 1), 2)[:, 1:-1, 1:-1]
    distance = squared.sqrt()
    ridge = masks & (distance >= functional.max_pool2d(distance[:, None], 3, 1, 1)[:, 0] - 0.5)
    balls = _parabolas(_parabolas(torch.where(ridge, squared, -_FAR), 1), 2)
    rows, columns = (_beyond(length, masks.device) for length in masks.shape[1:])
    blurred = functional.conv2d(balls.clamp(min=0.25).sqrt()[:, None, rows][..., columns], _gauss(masks.device))[:, 0]
    return torch.where(masks, blurred, 0.0)


def _parabolas(heights: Tensor, axis: int) -> Tensor:
    """Returns the upper envelope of parabolas -(x - y)^2 + heights(y) along an axis of heights (N,H,W)."""
    place = torch.arange(heights.shape[axis], device=heights.device, dtype=torch.float32)
    drop = (place[:, None] - place).square()
    moved = heights.movedim(axis, -1)
    return (moved[..., None, :] - drop).amax(-1).movedim(-1, axis)


def _beyond(length: int, device: torch.device) -> Tensor:
    """Returns the places of an axis, mirrored at both ends as far as a blur reaches."""
    return torch.from_numpy(np.pad(np.arange(length), _BLUR, mode="symmetric")).to(device)


def _gauss(device: torch.device) -> Tensor:
    """Returns a Gaussian of one pixel (1,1,K,K)."""
    place = torch.arange(-_BLUR, _BLUR + 1, device=device, dtype=torch.float32)
    row = (-0.5 * place.square()).exp()
    row = row / row.sum()
    return (row[:, None] * row)[None, None]
