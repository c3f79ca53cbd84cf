"""A backbone of one stage: the nearest neighbors of every point, one layer shared by all of them, two poolings."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dpcli.classify.network.backbones.interface import Backbone, Grouping, Stage
from dpcli.classify.network.config import KinetConfig
from dpcli.ops import knn


class TinyBackbone(Backbone):
    """max over the clip of max over the neighbors j of relu(W (x_j - x_i)), then a linear layer."""

    def __init__(self, config: KinetConfig) -> None:
        super().__init__()
        self.tap_widths = ((32,),)  # one stage with one layer
        self.neighbors = config.neighbors
        self.shared, self.classify = nn.Linear(3, 32), nn.Linear(32, config.num_classes)

    def group(self, points: Tensor, times: Tensor) -> list[Grouping]:
        """All points of all frames are centroids; their neighbors may lie in any frame."""
        idx = knn(points, points, self.neighbors)[1]
        return [Grouping(points, times, centers=points, center_times=times, idx=idx)]

    def forward(self, groups: list[Grouping]) -> Tensor:
        return self._logits(self._activations(groups[0]))

    @torch.no_grad()
    def taps(self, groups: list[Grouping]) -> tuple[list[Stage], Tensor]:
        activations = self._activations(groups[0])
        return [Stage(groups[0], [activations])], self._logits(activations)

    def _activations(self, group: Grouping) -> Tensor:
        return torch.relu(self.shared(group.relative()))  # (B,M,K,32), before any pooling

    def _logits(self, activations: Tensor) -> Tensor:
        return self.classify(activations.amax(2).amax(1))
