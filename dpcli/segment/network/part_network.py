"""The part network: encoder, segmentation head, motion head (thesis figure 4.1)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from dpcli.ops import gather_points, knn
from dpcli.runtime.mixed_precision import reduced_products
from dpcli.segment.network.config import PartConfig
from dpcli.segment.network.encoder import Encoder, Level
from dpcli.segment.network.motion_head import MotionHead, choose_motion
from dpcli.segment.network.segmentation_head import SegmentationHead


@dataclass
class FrameParts:
    """Holds soft rigid masks (B,N,S) of single frames and the coarsest level, which the motion head reads."""

    mask: Tensor
    level: Level


class PartNetwork(nn.Module):
    """Computes masks of single frames, and the parts' rotations between two frames."""

    def __init__(self, config: PartConfig) -> None:
        super().__init__()
        self.config = config
        self.mixed = False  # products in bfloat16: see `runtime.mixed_precision`
        self.encoder = Encoder(config)
        self.segmentation = SegmentationHead(config)
        self.motion = MotionHead(config) if config.motion_width else None

    def forward(self, points: Tensor) -> FrameParts:
        """Returns masks (B,N,S) and features of points (B,N,3) f32, N >= 2.

        The cloud's place doesn't matter: it is centered first.
        """
        if self.config.canonical_heads:  # far from the origin, float32 would blur the neighbors' distances
            points = points - points.mean(1, keepdim=True)
        with reduced_products(points.device, self.mixed):
            levels = self.encoder(points)
            mask = self.segmentation(points, levels)
        return FrameParts(mask.float(), levels[-1])

    def pair(self, points: Tensor, frames: FrameParts, matched: Tensor) -> tuple[Tensor, Tensor]:
        """Returns confidence and residuals of the motion head.

        points (2B,N,3): frames 1, then frames 2; matched (2B,N,S): masks with the slots of frames 2 in the order of
        frames 1.
        """
        coarse = self._coarse_mask(points, frames, matched)
        features = self.motion.part_features(frames.level.equivariant, frames.level.points, coarse)
        return self.motion(*features.chunk(2))

    def motions(
        self, points: Tensor, frames: FrameParts, matched: Tensor, answer: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Returns every part's rotation (B,S,3,3) and translation (B,S,3) from frames 1 to 2.

        answer: what `pair` gives for the other arguments.
        """
        candidates = self.motion.candidates(*answer)
        coarse = self._coarse_mask(points, frames, matched)
        shift = (points.mean(1) if self.config.canonical_heads else points.new_zeros(len(points), 3))[:, None]
        places = frames.level.points + shift
        (first, second), (mask1, mask2) = places.chunk(2), coarse.chunk(2)
        return choose_motion(candidates, first, mask1, second, mask2)

    def _coarse_mask(self, points: Tensor, frames: FrameParts, mask: Tensor) -> Tensor:
        """Returns the masks at the coarsest level's points, which are some of the frame's own."""
        centered = points - points.mean(1, keepdim=True) if self.config.canonical_heads else points
        _, own = knn(frames.level.points, centered, 1)
        return gather_points(mask, own[..., 0])
