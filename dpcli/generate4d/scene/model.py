"""The whole 4D model (deformation function, eq. 5.2): canonical Gaussians, motion field, in the sparse stage control points."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from dpcli.generate4d.config import FitConfig
from dpcli.generate4d.scene.canonical_gaussians import CanonicalGaussians
from dpcli.generate4d.scene.control_points import ControlPoints, turn_frames
from dpcli.generate4d.scene.motion import Motion, MotionField
from dpcli.ops.splatting.rasterization import rasterization


@dataclass
class Instant:
    """Holds the Gaussians at B times, and the motion of their carriers: themselves, or the control points."""

    mean: Tensor  # [B, N, 3]
    quaternion: Tensor  # [B, N, 4]
    motion: Motion
    carriers: Tensor  # [M, 3] canonical positions that `motion` is about


class Model4D(nn.Module):
    """Answers where every Gaussian is at any time in 0..1, and what a camera sees of them."""

    def __init__(self, gaussians: CanonicalGaussians, config: FitConfig) -> None:
        super().__init__()
        self.config = config
        self.gaussians = gaussians
        self.field = MotionField(
            config.blended_parts, config.width, config.depth, config.rigid, config.fusion, config.partition == "time"
        )
        self.control: ControlPoints | None = None
        self.nearest: Tensor | None = None  # [N, k] control points that move each Gaussian

    def start_control(self) -> None:
        """Lets K control points, chosen among the Gaussians, carry them all from now on."""
        own = self.gaussians.mean
        self.control = ControlPoints.among(own, self.config.control_points, self.config.neighbors).to(own.device)
        self.nearest = None

    def refresh_neighbors(self) -> None:
        """Searches again for the control points nearest to each Gaussian."""
        self.nearest = self.control.nearest(self.gaussians.mean) if self.control is not None else None

    def at(self, times: Tensor) -> Instant:  # [B]
        """Returns positions and orientations at times in 0..1: eq. 5.6 in the dense stage, eq. 5.8 in the sparse one."""
        own = self.gaussians
        if self.control is None:
            motion = self.field(own.mean, times)
            return Instant(
                own.mean + motion.displacement, turn_frames(motion.quaternion, own.quaternion), motion, own.mean
            )
        if self.nearest is None or len(self.nearest) != len(own):
            self.refresh_neighbors()
        motion = self.field(self.control.position, times)
        mean, turn = self.control.carry(own.mean, self.nearest, motion)
        return Instant(mean, turn_frames(turn, own.quaternion), motion, self.control.position)

    def require_finite(self, instant: Instant) -> None:
        """Raises FloatingPointError where a Gaussian can't be drawn at an instant: its numbers became NaN or infinite."""
        own = self.gaussians
        drawn = {"places": instant.mean, "turns": instant.quaternion, "sizes": own.log_scale.exp(), "colors": own.color}
        for name, values in drawn.items():
            if not values.detach().isfinite().all():
                raise FloatingPointError(f"the Gaussians' {name} became NaN or infinite")

    def render(
        self, instant: Instant, viewmats: Tensor, intrinsics: Tensor, width: int, height: int, backgrounds: Tensor
    ) -> tuple[Tensor, Tensor, dict]:
        """Returns colors (C,H,W,3) on the backgrounds (C,3), alphas (C,H,W,1), the rasterizer's notes; camera c sees time c."""
        own = self.gaussians
        return rasterization(
            instant.mean,
            instant.quaternion,
            own.log_scale.exp(),
            own.opacity_logit.sigmoid(),
            own.color,
            viewmats,
            intrinsics,
            width,
            height,
            backgrounds=backgrounds,
        )
