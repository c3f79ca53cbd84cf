"""PointNet++ over space-time neighbourhoods: the static stream, and the activations the dynamic stream taps."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dpcli.classify.config import KinetConfig
from dpcli.ops import fps, gather_points, space_time_ball_query
from dpcli.ops.grouped_mlp import Norm, grouped_activations, grouped_mlp


@dataclass
class Grouping:
    """Centroids of one stage and their neighbours in the stage before. Frame numbers are float."""

    points: Tensor  # (B,N,3) what is grouped
    times: Tensor  # (B,N)
    centers: Tensor  # (B,M,3)
    center_times: Tensor  # (B,M)
    idx: Tensor  # (B,M,K) i64 into the N points

    def neighbor_times(self) -> Tensor:
        """Frame number of each neighbour, (B,M,K)."""
        return gather_points(self.times[..., None], self.idx)[..., 0]

    def relative(self) -> Tensor:
        """Neighbour minus centroid, (B,M,K,3)."""
        return gather_points(self.points, self.idx) - self.centers[:, :, None]


@torch.no_grad()
def group_clip(points: Tensor, times: Tensor, config: KinetConfig) -> list[Grouping]:
    """Both stages' centroids (farthest points of the union of frames) and space-time neighbours. points (B,N,3), times (B,N)."""
    stages = []
    for stage, count in enumerate(config.centroids):
        # centroids are in the order of farthest point sampling, so any first few of them are such a sample, too
        chosen = fps(points, count) if stage == 0 else torch.arange(count, device=points.device).expand(len(points), -1)
        centers = gather_points(points, chosen)
        center_times = gather_points(times[..., None], chosen)[..., 0]
        idx = _neighbors(points, times, centers, center_times, config, stage)
        stages.append(Grouping(points, times, centers, center_times, idx))
        points, times = centers, center_times
    return stages


def _neighbors(
    points: Tensor, times: Tensor, centers: Tensor, center_times: Tensor, config: KinetConfig, stage: int
) -> Tensor:
    # `first` fills all slots from the earliest frame when frames are dense, and then no surface in time can be fitted:
    # so every frame gets an equal share. Points come in random order, hence the first hits of a frame are a random draw.
    order = "first" if config.temporal_radius == 0 and config.grouping == "balanced" else config.grouping
    radii = config.radius_table(stage)
    return space_time_ball_query(points, times, centers, center_times, radii, config.neighbors, order=order)[0]


class SharedLayers(nn.Module):
    """Two linear layers shared by all neighbours, each with batch norm and ReLU, over [relative xyz, feature]."""

    def __init__(self, inputs: int, widths: tuple[int, int]) -> None:
        super().__init__()
        self.linear1, self.norm1 = nn.Linear(3 + inputs, widths[0]), nn.BatchNorm1d(widths[0], eps=1e-3)
        self.linear2, self.norm2 = nn.Linear(widths[0], widths[1]), nn.BatchNorm1d(widths[1], eps=1e-3)

    def _arguments(self) -> tuple:
        return tuple((layer.weight, layer.bias) if isinstance(layer, nn.Linear) else self._norm(layer)
                     for layer in (self.linear1, self.norm1, self.linear2, self.norm2))  # fmt: skip

    def _norm(self, norm: nn.BatchNorm1d) -> Norm:
        mean, var = (None, None) if self.training else (norm.running_mean, norm.running_var)
        return Norm(norm.weight, norm.bias, mean, var, norm.eps)

    def pool(self, points: Tensor, centers: Tensor, idx: Tensor, features: Tensor | None) -> Tensor:
        """Maximum over the neighbours, (B,M,C2); arguments as `grouped_mlp`. Training updates the running statistics."""
        pooled, statistics = grouped_mlp(points, centers, idx, features, *self._arguments())
        if self.training:
            self._update(statistics, idx.numel())
        return pooled

    def _update(self, statistics: list[Tensor], rows: int) -> None:
        with torch.no_grad():
            for norm, mean, var in zip((self.norm1, self.norm2), statistics[::2], statistics[1::2]):
                norm.num_batches_tracked += 1
                norm.running_mean.lerp_(mean, norm.momentum)
                norm.running_var.lerp_(var * (rows / max(rows - 1, 1)), norm.momentum)


class SetAbstraction(SharedLayers):
    """The shared layers, max-pooled over each centroid's neighbours."""

    def forward(self, group: Grouping, features: Tensor | None) -> Tensor:
        """(B,M,C2) from features (B,N,F) of the points that were grouped."""
        return self.pool(group.points, group.centers, group.idx, features)

    def taps(self, group: Grouping, features: Tensor | None) -> list[Tensor]:
        """Both layers' activations before pooling with running statistics: (B,M,K,C1), (B,M,K,C2)."""
        assert not self.training, "the dynamic stream reads a frozen static network"
        return grouped_activations(group.points, group.centers, group.idx, features, *self._arguments())[0]


class GlobalHead(SharedLayers):
    """[xyz, feature] of every centroid -> two shared layers -> max over the clip -> class logits."""

    def __init__(self, inputs: int, widths: tuple[int, int], classes: int, dropout: float) -> None:
        super().__init__(inputs, widths)
        self.dropout = nn.Dropout(dropout)
        self.classify = nn.Linear(widths[1], classes)

    def embed(self, centers: Tensor, features: Tensor) -> Tensor:
        """The clip's feature vector, (B, widths[1])."""
        batch, count = centers.shape[:2]
        if self.training:  # as one group: its centre is the origin, its neighbours are all centroids
            everyone = torch.arange(count, device=centers.device).expand(batch, 1, count)
            return self.pool(centers, centers.new_zeros(batch, 1, 3), everyone, features)[:, 0]
        values = torch.cat([centers, features], -1)
        hidden = torch.relu_(self.norm1(self.linear1(values.view(batch * count, -1))))
        return torch.relu_(self.norm2(self.linear2(hidden))).view(batch, count, -1).amax(1)

    def forward(self, centers: Tensor, features: Tensor) -> Tensor:
        return self.classify(self.dropout(self.embed(centers, features)))


class PointNet2(nn.Module):
    """The static backbone: two set abstractions and a global head. `group`, `taps`, `forward` are what Kinet asks of it."""

    def __init__(self, config: KinetConfig) -> None:
        super().__init__()
        first, second, last = config.widths
        self.config = config
        self.stage1, self.stage2 = SetAbstraction(0, first), SetAbstraction(first[1], second)
        self.head = GlobalHead(second[1], last, config.num_classes, config.dropout)
        he_init(self)

    def group(self, points: Tensor, times: Tensor) -> list[Grouping]:
        return group_clip(points, times, self.config)

    def forward(self, groups: list[Grouping]) -> Tensor:
        """Class logits (B,C)."""
        features = self.stage2(groups[1], self.stage1(groups[0], None))
        return self.head(groups[1].centers, features)

    @torch.no_grad()
    def taps(self, groups: list[Grouping]) -> tuple[list[list[Tensor]], Tensor]:
        """Activations per stage and layer before pooling, and the logits, in one pass of the frozen network."""
        first = self.stage1.taps(groups[0], None)
        second = self.stage2.taps(groups[1], first[-1].amax(2))
        return [first, second], self.head(groups[1].centers, second[-1].amax(2))


def he_init(module: nn.Module) -> None:
    """Variance-scaling initialisation of every linear layer (fan-in, factor 2, truncated normal), zero biases."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            nn.init.trunc_normal_(layer.weight, std=(2 / layer.in_features) ** 0.5)
            nn.init.zeros_(layer.bias)
    for layer in module.modules():
        if isinstance(layer, GlobalHead):  # logits near zero, so that the first steps don't unlearn large random ones
            nn.init.trunc_normal_(layer.classify.weight, std=0.01)
