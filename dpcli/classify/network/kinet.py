"""Kinet: a static stream (the thesis's spatial branch), a dynamic stream (its temporal branch) on its frozen activations, their fusion."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dpcli.classify.network.backbones.interface import Grouping, Stage, build_backbone, clip_points
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.kinematic import Kinematics

STREAMS = ("static", "dynamic")


class Kinet(nn.Module):
    """Holds both streams. `static_logits` trains the first, `dynamic_logits` the second, `forward` gives both in one pass."""

    def __init__(self, config: KinetConfig) -> None:
        super().__init__()
        self.config = config
        self.static = build_backbone(config)
        # a backbone that shows no activations has no dynamic stream
        self.dynamic = Kinematics(config, self.static.tap_widths) if self.static.tap_widths else nn.Identity()

    def group(self, points: Tensor) -> list[Grouping]:
        """Returns the neighborhoods of a batch of clips: points (B,T,P,3+F), frame after frame."""
        groups = self.static.group(*clip_points(points[..., :3]))
        if points.shape[-1] > 3:
            groups[0].columns = points[..., 3:].flatten(1, 2)
        return groups

    def static_logits(self, points: Tensor) -> Tensor:
        """Returns the static stream's logits (B,C) of clips (B,T,P,3+F)."""
        return self.static(self.group(points))

    def dynamic_logits(self, points: Tensor, groups: list[Grouping] | None = None) -> Tensor:
        """Returns the dynamic stream's logits (B,C). Gradients reach the dynamic branch only; the static network must be in eval
        mode. groups: the neighborhoods, where they are known."""
        return self.dynamic(self._stages(points, groups)[0])

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Returns (static, dynamic) logits, each (B,C), from one pass of the frozen static network."""
        stages, static = self._stages(points)
        return static, self.dynamic(stages)

    @torch.no_grad()
    def _stages(self, points: Tensor, groups: list[Grouping] | None = None) -> tuple[list[Stage], Tensor]:
        return self.static.taps(self.group(points) if groups is None else groups)

    def freeze_static(self) -> None:
        """Stops the static stream's gradients and keeps its batch norms at their running statistics."""
        self.static.requires_grad_(False).eval()


def fuse(static: Tensor, dynamic: Tensor, rule: str) -> Tensor:
    """Returns the probabilities (B,C) of both streams together: mean of softmax scores (thesis), or softmax of mean logits (release)."""
    if rule == "logits":
        return torch.softmax((static + dynamic) / 2, -1)
    return (torch.softmax(static, -1) + torch.softmax(dynamic, -1)) / 2
