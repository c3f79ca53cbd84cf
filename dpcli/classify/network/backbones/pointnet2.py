"""PointNet++ over space-time neighborhoods: the default backbone."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dpcli.classify.network.backbones.interface import Backbone, Grouping, Stage, require_frozen
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.layers import GlobalHead, SharedLayers, he_init
from dpcli.ops import fps, gather_points, space_time_ball_query
from dpcli.ops.grouped_mlp import frozen_activations


@torch.no_grad()
def group_clip(points: Tensor, times: Tensor, config: KinetConfig, reaches: Sequence[int]) -> list[Grouping]:
    """Returns both stages' centroids (farthest points of the union of frames) and space-time neighbors. points (B,N,3), times (B,N).

    reaches: frames before and after that neighbors may come from; for each of them both stages, one after the other, about
    the same centroids.
    """
    found: list[list[Grouping]] = [[] for _ in reaches]
    for stage, count in enumerate(config.centroids):
        # centroids are in the order of farthest point sampling, so any first few of them are such a sample, too
        chosen = fps(points, count) if stage == 0 else torch.arange(count, device=points.device).expand(len(points), -1)
        centers = gather_points(points, chosen)
        center_times = gather_points(times[..., None], chosen)[..., 0]
        for stages, reach in zip(found, reaches):
            idx = _neighbors(points, times, centers, center_times, config, stage, reach)
            stages.append(Grouping(points, times, centers, center_times, idx))
        points, times = centers, center_times
    return [group for stages in found for group in stages]


def _neighbors(
    points: Tensor, times: Tensor, centers: Tensor, center_times: Tensor, config: KinetConfig, stage: int, reach: int
) -> Tensor:
    # `first` fills all slots from the earliest frame when frames are dense, and then no surface in time can be fitted:
    # so every frame gets an equal share. Points come in random order, hence the first hits of a frame are a random draw.
    order = "first" if reach == 0 and config.grouping == "balanced" else config.grouping
    radii = config.radius_table(stage, reach)
    return space_time_ball_query(points, times, centers, center_times, radii, config.neighbors, order=order)[0]


class SetAbstraction(SharedLayers):
    """Applies the shared layers to each centroid's neighbors and takes the maximum."""

    def forward(self, group: Grouping, features: Tensor | None) -> Tensor:
        """Returns (B,M,C2) from features (B,N,F) of the points that were grouped."""
        return self.pool(group.points, group.centers, group.idx, features)

    def taps(self, group: Grouping, features: Tensor | None) -> tuple[list[Tensor], Tensor]:
        """Returns both layers' activations before pooling with running statistics, (B,M,K,C1), (B,M,K,C2), and pooled, (B,M,C2)."""
        require_frozen(self)
        return frozen_activations(group.points, group.centers, group.idx, features, *self._arguments())


class PointNet2(Backbone):
    """Classifies by two set abstractions and a global head (Qi et al., 2017).

    Reads of the config: centroids, neighbors, radii, grouping, widths.

    With `static_temporal_radius` the static stream pools neighborhoods of its own, such as those within a frame, and sees no
    motion (the text's "identical to common static models"; the release pools what the dynamic stream fits). The dynamic
    stream then reads the same layers at its neighborhoods, over what the static stream pooled. `group` gives the static
    stream's two stages first, then the dynamic stream's; while the static stream is in training, only its own.
    """

    def __init__(self, config: KinetConfig) -> None:
        super().__init__()
        first, second, last = config.widths
        self.config, self.tap_widths = config, (first, second)
        self.stage1, self.stage2 = SetAbstraction(0, first), SetAbstraction(first[1], second)
        self.head = GlobalHead(second[1], last, config.num_classes, config.dropout)
        he_init(self)

    def group(self, points: Tensor, times: Tensor) -> list[Grouping]:
        """Returns the neighborhoods of both stages, of the static stream's own first where it has such and is in eval mode."""
        config = self.config
        reaches = [config.static_radius]
        if config.own_static_groups and not self.training:
            reaches.append(config.temporal_radius)
        return group_clip(points, times, config, reaches)

    def forward(self, groups: list[Grouping]) -> Tensor:
        features = self.stage2(groups[1], self.stage1(groups[0], None))
        return self.head(groups[1].centers, features)

    @torch.no_grad()
    def taps(self, groups: list[Grouping]) -> tuple[list[Stage], Tensor]:
        """Returns both stages with their two layers' activations, and the logits, in one pass of the frozen network."""
        first, features = self.stage1.taps(groups[0], None)
        second, pooled = self.stage2.taps(groups[1], features)
        logits = self.head(groups[1].centers, pooled)
        shown = groups[2:] or groups
        if shown is not groups:  # the same layers, at the dynamic stream's neighbors
            first, second = self.stage1.taps(shown[0], None)[0], self.stage2.taps(shown[1], features)[0]
        return [Stage(group, taps) for group, taps in zip(shown, (first, second))], logits

    def macs_as_written(self) -> int:
        """Returns multiply-adds of one clip as papers count them: each layer on every gathered neighbor, once."""
        last = (self.head.linear1, self.head.linear2)
        total = (
            self.config.centroids[1] * sum(layer.weight.numel() for layer in last) + self.head.classify.weight.numel()
        )
        for count, stage in zip(self.config.centroids, (self.stage1, self.stage2)):
            total += count * self.config.neighbors * (stage.linear1.weight.numel() + stage.linear2.weight.numel())
        return total
