"""A shape prior in a fit: where its first Gaussians are, and pictures of every frame from sides that nobody filmed."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from dpcli.errors import DataError
from dpcli.generate4d.shape.layers import Camera, ShapeLayers, ShapePrior, points_of
from dpcli.generate4d.shape.splats import Splats, splats_of
from dpcli.generate4d.targets import Targets

SIDE = 128  # pixels at most of the pictures that a prior looks at in a fit
_OBLONG = 1.02  # pixels that are longer one way by less are taken for squares
_OUTERMOST = 0.01, 0.99  # quantiles of points that lie at the ends of an object


class ShapeGuidance:
    """Holds the layers that a prior predicts for every frame of the reference view, ready to be drawn."""

    def __init__(self, prior: ShapePrior, targets: Targets, side: int = SIDE) -> None:
        pictures, self.camera = reference_pictures(targets, side)
        self.name = prior.name
        self.layers = prior.layers(pictures, self.camera)

    @cached_property
    def splats(self) -> list[Splats]:
        """Returns the Gaussians of every frame's layers."""
        return [splats_of(frame, self.camera) for frame in self.layers]

    @property
    def confidence(self) -> float:
        """Returns the median confidence, 0..1, of the frames that show the object, of all where none does."""
        shown = [frame.confidence for frame in self.layers if frame.presence.any()]
        return float(np.median(shown or [frame.confidence for frame in self.layers]))

    @property
    def depth_share(self) -> float:
        """Returns how deep the object is along the line of sight, as a share of its larger side in the picture: the median frame's."""
        clouds = [points_of(frame, self.camera).position for frame in self.layers]
        turn = self.camera.world_to_camera[:3, :3]
        sizes = [np.ptp(np.quantile(cloud @ turn.T, _OUTERMOST, axis=0), axis=0) for cloud in clouds if len(cloud)]
        return float(np.median([depth / max(width, height, 1e-9) for width, height, depth in sizes])) if sizes else 0.0

    def pictures(self, frames: list[int], poses: Tensor, intrinsics: Tensor, size: int) -> Tensor:  # [B, S, S, 4]
        """Returns the frames seen by square cameras, f32: color times alpha, and alpha; poses (B,4,4), intrinsics (B,3,3)."""
        drawn = [
            self.splats[frame].to(poses.device).draw(pose, matrix, size, size)
            for frame, pose, matrix in zip(frames, poses, intrinsics)
        ]
        return torch.stack(drawn)


def reference_pictures(targets: Targets, side: int) -> tuple[np.ndarray, Camera]:  # [T, 4, H, W]
    """Returns the reference view f32 RGBA of straight color, 0..1, about `side` pixels long, and its camera.

    Its pixels are as wide as high, whatever the clip's: a prior takes the thickness of things from distances in the picture.
    """
    focal = targets.intrinsics[targets.reference][[0, 1], [0, 1]]
    share = focal.min() / focal if focal.max() > _OBLONG * focal.min() else np.ones(2)
    shrink = max(1, round(max(share * targets.size) / side))
    frames = list(range(targets.num_frames))
    chosen, matrices, poses = targets.at([targets.reference] * len(frames), frames, shrink)
    pictures, lens = chosen.permute(0, 3, 1, 2), matrices[0].double().numpy()
    if share.min() < 1:
        height, width = pictures.shape[2:]
        size = max(1, round(height * share[1])), max(1, round(width * share[0]))
        pictures = torch.nn.functional.interpolate(pictures, size, mode="area")
        lens = np.diag([size[1] / width, size[0] / height, 1.0]) @ lens
    pictures = pictures.numpy()
    pictures[:, :3] /= np.maximum(pictures[:, 3:], 1e-3)
    return pictures.clip(0, 1), Camera(lens, poses[0].double().numpy())


def sample_surface(
    layers: ShapeLayers, camera: Camera, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions and colors (count,3) f32 on the layers' surface, spread by its area.

    Points are moved by up to half a pixel along the surface. Raises DataError where no interval is present.
    """
    points = points_of(layers, camera)
    if not len(points.position):
        if layers.presence.any():
            raise DataError(
                f"the object is too thin or too clear: at {max(layers.presence.shape[1:])} pixels no alpha of the frame to"
                f" start from is above {layers.presence.max():.2f}, expected 0.5; take --prior none --set start=sphere"
            )
        raise DataError(
            "the reference view shows nothing in the frame to start from (alpha is zero); prepare the clip again"
        )
    ray = points.position - camera.center
    depth = ray @ camera.world_to_camera[2, :3]
    facing = np.abs((ray * points.normal).sum(1)) / np.linalg.norm(ray, axis=1)
    area = depth**2 / facing.clip(0.15)
    picked = rng.choice(len(area), count, p=area / area.sum())
    shift = rng.uniform(-0.5, 0.5, (count, 3)) * (depth[picked] / camera.intrinsics[0, 0])[:, None]
    shift -= (shift * points.normal[picked]).sum(1, keepdims=True) * points.normal[picked]
    return (points.position[picked] + shift).astype(np.float32), points.color[picked]
