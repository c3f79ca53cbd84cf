"""Pictures of a scene: in its colors, by part, by rigid weight or by depth, with trails of what moves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dpcli.draw.palette import part_colors
from dpcli.generate4d.out.camera_paths import Shot
from dpcli.generate4d.out.picture_colors import weight_colors
from dpcli.generate4d.render_settings import Color
from dpcli.ops.splatting.rasterization import rasterization
from dpcli.store.gaussians import GaussianScene
from dpcli.store.views import ViewsHeader, ViewsWriter

_TRAILS = 64  # Gaussians that draw trails in a scene without control points
_TRAIL_SHARE = 0.4  # of the clip that a trail reaches back
_FINE = 4  # fractional bits of line ends
_TRAIL_SHADE = 0.45  # of the part's color, so that trails show on it


@dataclass(frozen=True)
class Look:
    """Holds what is drawn: colors, background u8 (r,g,b) or None (transparent), whether trails of control points show."""

    color: Color = "appearance"
    background: tuple[int, int, int] | None = (255, 255, 255)
    trajectories: bool = False


class Renderer:
    """Draws a scene on a device; the Gaussians are moved there once."""

    def __init__(self, scene: GaussianScene, device: str | torch.device = "cpu") -> None:
        self.scene, self.device = scene, torch.device(device)
        self._scales, self._opacities = self._tensor(scene.scale), self._tensor(scene.opacity)
        self._sh = self._tensor(scene.sh)
        self._parts = self._tensor(part_colors(scene.part) / 255)
        low, high = scene.frame_mean.min((0, 1)), scene.frame_mean.max((0, 1))
        self._center, self._reach = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
        self._near, self._trails = scene.near, _trail_points(scene)

    def _tensor(self, values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.float32(values), device=self.device)

    def picture(self, shot: Shot, look: Look = Look()) -> np.ndarray:
        """Returns one picture u8 (H,W,3), or (H,W,4) with straight alpha when the background is None."""
        color, alpha = self._draw(shot, look.color)
        if look.background is None:
            straight = np.where(alpha > 1e-6, color / np.maximum(alpha, 1e-6), 0)
            image = _bytes(np.concatenate([straight, alpha], -1))
        else:
            image = _bytes(color + (1 - alpha) * np.float32(look.background) / 255)
        return self._with_trails(image, shot) if look.trajectories else image

    @torch.no_grad()
    def _draw(self, shot: Shot, color: str) -> tuple[np.ndarray, np.ndarray]:
        """Returns premultiplied color f32 (H,W,3) and alpha f32 (H,W,1), both 0..1."""
        means, quaternions = self.scene.at(shot.time)
        values, options = self._values(shot, color)
        drawn, alpha, _ = rasterization(
            self._tensor(means),
            self._tensor(quaternions),
            self._scales,
            self._opacities,
            values,
            self._tensor(shot.world_to_camera)[None],
            self._tensor(shot.intrinsics)[None],
            *shot.size,
            near_plane=self._near,
            **options,
        )
        drawn, alpha = drawn[0].cpu().numpy(), alpha[0].cpu().numpy()
        if color == "depth":
            drawn = self._depth_colors(drawn[..., 0], shot) * alpha
        return drawn[..., :3], alpha

    def _values(self, shot: Shot, color: str) -> tuple[torch.Tensor, dict[str, Any]]:
        """Returns the colors of the Gaussians, and the rasterizer's options that go with them."""
        if color == "appearance":
            return self._sh, {"sh_degree": self.scene.sh_degree}
        if color == "rigid":
            a, b, w = self.scene.between(shot.time)
            weight = (1 - w) * self.scene.rigid_weight[a] + w * self.scene.rigid_weight[b]
            return self._tensor(weight_colors(weight) / 255), {}
        return self._parts, {"render_mode": "ED"} if color == "depth" else {}

    def _depth_colors(self, depth: np.ndarray, shot: Shot) -> np.ndarray:
        """Returns colors f32 (H,W,3), 0..1, near bright and far dark, in one scale for all pictures of this distance."""
        middle = float((shot.world_to_camera[:3, :3] @ self._center + shot.world_to_camera[:3, 3])[2])
        return weight_colors(0.5 - (depth - middle) / (2 * max(self._reach, 1e-30))).astype(np.float32) / 255

    def _with_trails(self, image: np.ndarray, shot: Shot) -> np.ndarray:
        import cv2

        a, b, w = self.scene.between(shot.time)
        tracks, colors = self._trails
        first = max(0, a - max(2, round(_TRAIL_SHARE * self.scene.num_frames)))
        now = (1 - w) * tracks[a] + w * tracks[b]
        pixels, ahead = _project(np.concatenate([tracks[first : a + 1], now[None]]), shot, self._near)
        image, thick = np.ascontiguousarray(image), max(1, round(max(shot.size) / 300))
        for track in range(tracks.shape[1]):
            if not ahead[:, track].all():
                continue
            color = tuple(int(c) for c in colors[track]) + (255,) * (image.shape[2] - 3)
            line = np.round(pixels[:, track] * 2**_FINE).astype(np.int32)
            cv2.polylines(image, [line], False, color, thick, cv2.LINE_AA, _FINE)
            cv2.circle(image, line[-1].tolist(), 2 * thick * 2**_FINE, color, -1, cv2.LINE_AA, _FINE)
        return image

    def pictures(self, shots: Sequence[Shot], look: Look = Look()) -> Iterator[np.ndarray]:
        """Yields one picture after the other."""
        return (self.picture(shot, look) for shot in shots)


def _trail_points(scene: GaussianScene) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions f32 (T,M,3) and colors u8 (M,3), a little darker than their parts', of what draws trails."""
    if len(scene.control_point):
        from scipy.spatial import cKDTree

        nearest = cKDTree(scene.mean).query(scene.control_point)[1]
        return scene.control_position, (part_colors(scene.part[nearest]) * _TRAIL_SHADE).astype(np.uint8)
    opaque = np.argsort(-scene.opacity_logit, kind="stable")[: scene.num_gaussians // 2 + 1]
    chosen = opaque[np.linspace(0, len(opaque) - 1, min(_TRAILS, len(opaque))).round().astype(int)]
    return scene.frame_mean[:, chosen], (part_colors(scene.part[chosen]) * _TRAIL_SHADE).astype(np.uint8)


def _project(points: np.ndarray, shot: Shot, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pixels (...,2) of world points (...,3), corners at integers as OpenCV draws them, and which are ahead, bool (...).

    near: the least depth of what is ahead.
    """
    camera = points @ shot.world_to_camera[:3, :3].T + shot.world_to_camera[:3, 3]
    ahead = camera[..., 2] > near
    image = camera @ shot.intrinsics.T
    return image[..., :2] / np.where(ahead, image[..., 2], 1)[..., None] - 0.5, ahead


def _bytes(image: np.ndarray) -> np.ndarray:
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def render_views(renderer: Renderer, header: ViewsHeader, path: Path, look: Look = Look(), **root: Any) -> None:
    """Writes a `views` file: the scene seen by the header's cameras at its times, RGBA on no background.

    look: what is drawn; its background is not. root: further arguments of ViewsWriter.
    """
    look = replace(look, background=None)
    with ViewsWriter(path, header, **root) as writer:
        for view, (lens, pose) in enumerate(zip(header.intrinsics, header.world_to_camera, strict=True)):
            for frame, time in enumerate(header.time.tolist()):
                shot = Shot(time, pose, lens, tuple(header.size))
                writer.add(view, frame, renderer.picture(shot, look))
