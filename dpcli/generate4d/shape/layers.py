"""Layers of one frame: where the ray of each pixel enters and leaves the object, and what color it has there.

A ray meets an object at front_1, back_1, front_2, back_2, ...; the pairs are intervals inside of it. Two hold a body and
the legs behind it. A `ShapePrior` predicts the layers of a clip from the pictures of one camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

NEAREST = 0.1  # of the camera's distance: no layer is nearer, where a wide picture tells of an object around the camera
INTERVALS = 2  # K, intervals of a ray: nine rays in ten that hit an animal need one, nearly all others two


@dataclass(frozen=True)
class Camera:
    """Holds a pinhole camera: intrinsics f64 (3,3) of its pictures and world_to_camera f64 (4,4), OpenCV axes."""

    intrinsics: np.ndarray
    world_to_camera: np.ndarray

    def to_world(self, points: np.ndarray) -> np.ndarray:  # [..., 3] -> [..., 3]
        """Returns points that are given in the camera's axes in those of the world."""
        return (points - self.world_to_camera[:3, 3]) @ self.world_to_camera[:3, :3]

    def ray_points(self, depth: np.ndarray) -> np.ndarray:  # [..., H, W] -> [..., H, W, 3]
        """Returns the points, in the camera's axes, at these depths on the rays through the pixels' centers."""
        row, column = np.indices(depth.shape[-2:])
        return self.pixel_points(row, column, depth)

    def pixel_points(self, row: np.ndarray, column: np.ndarray, depth: np.ndarray) -> np.ndarray:  # [...] -> [..., 3]
        """Returns the points, in the camera's axes, at these depths on the rays through these pixels' centers."""
        x = (column + 0.5 - self.intrinsics[0, 2]) / self.intrinsics[0, 0]
        y = (row + 0.5 - self.intrinsics[1, 2]) / self.intrinsics[1, 1]
        return np.stack([x * depth, y * depth, depth], -1)

    @property
    def center(self) -> np.ndarray:
        """Returns where the camera stands in the world, f64 (3)."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    @property
    def distance(self) -> float:
        """Returns the depth of the world's origin, about which the object is centered."""
        return float(self.world_to_camera[2, 3])


@dataclass(frozen=True)
class ShapeLayers:
    """Holds the layers of one frame, seen by one camera.

    depth: f32 (2K,H,W), along the camera's z, world units: front_1, back_1, front_2, back_2, ... Of an interval that
    isn't present, depth and color mean nothing. presence: f32 (K,H,W), probability of each interval, 0..1. color: f32
    (2K,3,H,W), straight, 0..1. confidence: trust in the whole frame, 0..1.
    """

    depth: np.ndarray
    presence: np.ndarray
    color: np.ndarray
    confidence: float = 1.0


@dataclass(frozen=True)
class SurfacePoints:
    """Holds M points of a surface: position, outward unit normal and color (0..1), f32 (M,3) each.

    layer: i64 (M), which of the 2K layers each comes from; pixel: i64 (M,2), row and column.
    """

    position: np.ndarray
    normal: np.ndarray
    color: np.ndarray
    layer: np.ndarray
    pixel: np.ndarray


class ShapePrior(Protocol):
    """Predicts the layers of every frame of a clip from the pictures of one camera that stands still."""

    name: str

    def layers(
        self,
        pictures: np.ndarray,  # [T, 4, H, W]
        camera: Camera,
    ) -> list[ShapeLayers]:  # T
        """Returns the layers of each frame; pictures: f32 RGBA of straight color, 0..1. Empty frames have no presence."""


def points_of(layers: ShapeLayers, camera: Camera, least_presence: float = 0.5) -> SurfacePoints:
    """Returns the oriented points of all layers whose presence is at least `least_presence`, in the world's axes."""
    present = np.repeat(layers.presence >= least_presence, 2, axis=0)
    found = np.nonzero(present)
    layer, row, column = found
    points = camera.ray_points(np.where(present, layers.depth, 1.0))
    normals = np.stack([_normals(grid, own, index % 2 == 1) for index, (grid, own) in enumerate(zip(points, present))])
    rotation = camera.world_to_camera[:3, :3]
    return SurfacePoints(
        camera.to_world(points[found]).astype(np.float32),
        (normals[found] @ rotation).astype(np.float32),
        layers.color[layer, :, row, column].astype(np.float32),
        layer,
        np.stack([row, column], 1),
    )


def _normals(points: np.ndarray, present: np.ndarray, back: bool) -> np.ndarray:  # [H, W, 3] -> [H, W, 3]
    """Returns unit normals of a grid of points, toward the camera, or away from it at the back; present: bool (H,W).

    Neighbors that aren't present don't count; a point without neighbors faces the camera.
    """
    down, right = (_slope(points, present, axis) for axis in (0, 1))
    normal = np.cross(down, right)  # x right, y down, z forward: down x right looks back at the camera
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    toward = -points / np.linalg.norm(points, axis=-1, keepdims=True)
    normal = np.where(length > 1e-12, normal / np.maximum(length, 1e-12), toward)
    away = (normal * points).sum(-1, keepdims=True) > 0
    return np.where(away != back, -normal, normal)


def _slope(points: np.ndarray, present: np.ndarray, axis: int) -> np.ndarray:  # [H, W, 3] -> [H, W, 3]
    """Returns the mean difference of each point to its present neighbors along an axis; where there are none, that of the
    rays at the point's own depth.
    """
    step = np.diff(points, axis=axis)
    both = present.take(range(1, present.shape[axis]), axis) & present.take(range(present.shape[axis] - 1), axis)
    step, both = step * both[..., None], both[..., None].astype(points.dtype)
    edge = [(0, 0)] * 3
    total, count = 0.0, 0.0
    for edge[axis] in ((0, 1), (1, 0)):
        total, count = total + np.pad(step, edge), count + np.pad(both, edge)
    rays = points / points[..., 2:]
    return np.where(count > 0, total / np.maximum(count, 1), np.gradient(rays, axis=axis) * points[..., 2:])
