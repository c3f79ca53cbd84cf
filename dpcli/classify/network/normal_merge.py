"""The merge of all units' normals into one feature per stage-2 centroid: as the thesis says, or as the published code does."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dpcli.classify.network.backbones.interface import Grouping
from dpcli.classify.network.config import KinetConfig
from dpcli.errors import UsageError
from dpcli.ops import gather_mean, three_nn_interpolate


class ResidualMerge(nn.Module):
    """Computes h_l = relu(C_l n_l + R_l h_{l-1}) (thesis, figure 3.4).

    Where a unit's centroids are the next stage's neighbors, h is averaged over the neighborhood first: a single normal
    is noisy, and a maximum would pick the noise. With `norm` the sum is batch-normalized before the ReLU.
    """

    def __init__(self, channels: list[int], tap_widths: Sequence[Sequence[int]], norm: bool) -> None:
        super().__init__()
        widths = [width for stage in tap_widths for width in stage]
        self.stage_of = [number for number, stage in enumerate(tap_widths) for _ in stage]
        self.norms = nn.ModuleList(nn.BatchNorm1d(width, eps=1e-3) if norm else nn.Identity() for width in widths)
        self.abstract = nn.ModuleList(nn.Linear(c, w) for c, w in zip(channels, widths))
        self.align = nn.ModuleList(nn.Linear(a, b) for a, b in zip(widths, widths[1:]))
        self.channels = widths[-1]

    def forward(self, groups: list[Grouping], normals: list[Tensor]) -> Tensor:
        """Returns the merged feature (B,M,C) of the last stage's centroids. normals: those of each unit, (B,M,K*(d+1))."""
        state = self._activate(0, self.abstract[0](normals[0]))
        for level in range(1, len(normals)):
            stage = self.stage_of[level]
            if stage != self.stage_of[level - 1]:
                state = gather_mean(state, groups[stage].idx)
            state = self._activate(level, self.abstract[level](normals[level]) + self.align[level - 1](state))
        return state

    def _activate(self, level: int, values: Tensor) -> Tensor:
        return torch.relu(self.norms[level](values.flatten(0, 1)).view_as(values))


class CrossMerge(nn.Module):
    """Merges as the published code does: at each level both stages see their own and, by 3-NN interpolation, the other's features.

    Every input carries its centroid's frame number as one more channel. Only stage 2's last output is used, so the weights
    `cross.1.0` never act; they stay because the released model has (and counts) them.
    """

    def __init__(self, channels: list[int]) -> None:
        super().__init__()
        first, second = channels[:2], channels[2:]
        self.current = nn.ModuleList(nn.ModuleList(nn.Linear(c + 1, c) for c in pair) for pair in zip(first, second))
        self.last = nn.ModuleList(nn.Linear(stage[0] + 1, stage[1]) for stage in (first, second))
        self.cross = nn.ModuleList(
            nn.ModuleList(nn.Linear(sum(pair) + 2, c) for c in pair) for pair in zip(first, second)
        )
        self.channels = second[-1]

    def forward(self, groups: list[Grouping], normals: list[Tensor]) -> Tensor:
        """Returns the merged feature (B,M,C) of the last stage's centroids. normals: those of each unit, (B,M,K*(d+1))."""
        times = [group.center_times[..., None] for group in groups]
        states: list[Tensor] = []
        for level in range(2):
            raw = [
                torch.relu(self.current[level][s](torch.cat([normals[2 * s + level], times[s]], -1))) for s in range(2)
            ]
            if level:
                raw = [raw[s] + torch.relu(self.last[s](torch.cat([states[s], times[s]], -1))) for s in range(2)]
            timed = [torch.cat([raw[s], times[s]], -1) for s in range(2)]
            states = [raw[0]]
            for s in range(2) if level == 0 else (1,):
                other = three_nn_interpolate(groups[s].centers, groups[1 - s].centers, timed[1 - s])
                states[s:] = [raw[s] + torch.relu(self.cross[level][s](torch.cat([other, timed[s]], -1)))]
        return states[1]


def build_merge(
    config: KinetConfig, tap_widths: Sequence[Sequence[int]], channels: list[int]
) -> ResidualMerge | CrossMerge:
    """Returns the merge that `config.merge` names, for units with these normal widths."""
    if config.merge == "residual":
        return ResidualMerge(channels, tap_widths, config.merge_norm)
    if [len(stage) for stage in tap_widths] != [2, 2]:
        raise UsageError(
            f"merge = cross with backbone = {config.backbone}: it pairs two stages of two layers; leave it out"
        )
    return CrossMerge(channels)
