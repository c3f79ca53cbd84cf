"""Layers drawn from any side: each of their points becomes a small disc in its surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dpcli.generate4d.shape.layers import Camera, ShapeLayers, points_of
from dpcli.ops.splatting.rasterization import rasterization

_RADIUS, _THIN = 0.35, 0.2  # of a pixel's width
_STEEPEST = 8.0  # times that a disc on a steep slope is longer, at most
_OPACITY = 0.95
_INSIDE = 1.0  # of a pixel's width, from the outline's pixels to the discs that join front and back


@dataclass(frozen=True)
class Splats:
    """Holds M discs: mean and scale (M,3), quaternion w x y z (M,4), opacity (M), color (M,3) 0..1, all f32."""

    mean: Tensor
    quaternion: Tensor
    scale: Tensor
    opacity: Tensor
    color: Tensor

    def to(self, device: torch.device) -> Splats:
        """Returns the same on another device."""
        return Splats(*(getattr(self, name).to(device) for name in ("mean", "quaternion", "scale", "opacity", "color")))

    def draw(self, world_to_camera: Tensor, intrinsics: Tensor, width: int, height: int) -> Tensor:  # [H, W, 4]
        """Returns what a camera sees, f32: color times alpha, and alpha. world_to_camera (4,4), intrinsics (3,3)."""
        if not len(self.mean):
            return torch.zeros(height, width, 4, device=self.mean.device)
        arrays = (self.mean, self.quaternion, self.scale, self.opacity, self.color)
        with torch.no_grad():
            color, alpha, _ = rasterization(*arrays, world_to_camera[None], intrinsics[None], width, height)
        return torch.cat([color[0], alpha[0]], -1)


def splats_of(layers: ShapeLayers, camera: Camera) -> Splats:
    """Returns a disc for every present point of the layers, as large as its pixel and stretched down its slope."""
    from scipy.spatial.transform import Rotation

    points = points_of(layers, camera)
    ray = points.position - camera.center
    depth = ray @ camera.world_to_camera[2, :3]
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
    facing = (ray * points.normal).sum(1, keepdims=True)
    across = np.cross(points.normal, ray)
    slope = np.linalg.norm(across, axis=1, keepdims=True)
    across = np.where(slope > 1e-6, across / np.maximum(slope, 1e-6), _any_normal_to(points.normal))
    axes = np.stack([np.cross(across, points.normal), across, points.normal], -1)  # down the slope, along it, out
    stretch = (1 / np.maximum(np.abs(facing[:, 0]), 1e-6)).clip(1, _STEEPEST)
    pixel = depth / camera.intrinsics[0, 0]
    scale = np.stack([_RADIUS * pixel * stretch, _RADIUS * pixel, _THIN * pixel], 1)
    quaternion = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]] if len(axes) else np.zeros((0, 4))
    arrays = points.position, quaternion, scale, np.full(len(scale), _OPACITY), points.color
    both = [np.concatenate(pair) for pair in zip(arrays, _walls(layers, camera))]
    return Splats(*(torch.from_numpy(np.ascontiguousarray(array, np.float32)) for array in both))


def _walls(layers: ShapeLayers, camera: Camera) -> tuple[np.ndarray, ...]:  # [M, 3], [M, 4], [M, 3], [M], [M, 3]
    """Returns positions, turns, sizes, opacities and colors of discs that join front and back along each interval's outline.

    Fronts and backs end half a pixel inside of the outline, apart: from the side the object would be two open shells. The
    discs stand on the picture's plane, their thin axis across the outline, so that the stack of them widens no silhouette.
    """
    from scipy.ndimage import binary_erosion, gaussian_filter
    from scipy.spatial.transform import Rotation

    present = layers.presence >= 0.5
    rim = np.nonzero(present & ~np.stack([binary_erosion(mask) for mask in present]))
    front, back = layers.depth[::2][rim], layers.depth[1::2][rim]
    count = np.ceil(np.maximum(back - front, 0) * camera.intrinsics[0, 0] / front).astype(int)  # one a pixel's width
    which = np.repeat(np.arange(len(count)), count)
    share = (np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[which]
    interval, row, column = (index[which] for index in rim)
    depth = front[which] + share * (back - front)[which]
    smooth = present.astype(np.float32)
    inward = np.stack([gaussian_filter(smooth, (0, 1, 1), order=(0, *order))[rim][which] for order in ((0, 1), (1, 0))])
    inward /= np.maximum(np.linalg.norm(inward, axis=0), 1e-6)
    right, down = _INSIDE * inward
    position = camera.to_world(camera.pixel_points(row + down, column + right, depth))
    angle = np.arctan2(inward[1], inward[0])
    turn = Rotation.from_matrix(camera.world_to_camera[:3, :3].T) * Rotation.from_euler("z", angle[:, None])
    quaternion = turn.as_quat()[:, [3, 0, 1, 2]] if len(which) else np.zeros((0, 4))
    scale = np.array([_THIN, _RADIUS, _RADIUS]) * (depth / camera.intrinsics[0, 0])[:, None]
    color = layers.color[2 * interval + (share > 0.5), :, row, column]
    return position, quaternion, scale, np.full(len(which), _OPACITY), color


def _any_normal_to(direction: np.ndarray) -> np.ndarray:  # [M, 3] -> [M, 3]
    """Returns unit vectors at a right angle to these."""
    least = np.eye(3)[np.abs(direction).argmin(1)] if len(direction) else np.zeros((0, 3))
    found = np.cross(direction, least)
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12)
