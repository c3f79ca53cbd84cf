"""The dynamic stream: kinematic learning units that fit space-time surfaces to a frozen static network's activations.

A unit (thesis figure 3.4) reduces the features of a neighbourhood, splits them into groups, fits one surface a group with
weights from the previous unit's deviations, and hands on the normals. `Kinematics` runs the units; how their normals
become one feature per centroid is the business of `merge`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dpcli.classify.backbone import Grouping, Stage
from dpcli.classify.config import KinetConfig
from dpcli.classify.layers import GlobalHead, he_init
from dpcli.classify.merge import build_merge
from dpcli.classify.st_surface import deviations, fit_surface, projected_deviations, surface_normal
from dpcli.ops import gather_points


class DeviationWeights(nn.Module):
    """Neighbour weights from deviations by one linear map over groups and a sigmoid (eq. 3.8)."""

    def __init__(self, previous: int, groups: int) -> None:
        super().__init__()
        self.linear = nn.Linear(previous, groups)

    def forward(self, deviations: Tensor) -> Tensor:
        """deviations (B,M,n,K') -> weights (B,M,n,K) in (0,1)."""
        return torch.sigmoid(self.linear(deviations))


class ProjectionWeights(nn.Module):
    """The released form: over groups, then over the projected deviation vector (d+1 -> 2d -> 1), sigmoid."""

    def __init__(self, previous: int, groups: int, group_size: int) -> None:
        super().__init__()
        self.over_groups = nn.Linear(previous, groups)
        self.hidden = nn.Linear(group_size + 1, 2 * group_size)
        self.out = nn.Linear(2 * group_size, 1)

    def forward(self, deviations: Tensor) -> Tensor:
        """deviations (B,M,n,K',d+1) -> weights (B,M,n,K)."""
        mixed = torch.relu(self.over_groups(deviations.transpose(-1, -2))).transpose(-1, -2)
        return torch.sigmoid(self.out(torch.relu(self.hidden(mixed)))[..., 0])


@dataclass
class Surface:
    """What a unit found: normals (B,M,K*(d+1)), or pooled features for Table 3.1 v; deviations (B,M,n,K[,d+1]) or None."""

    normals: Tensor
    deviations: Tensor | None


class KinematicUnit(nn.Module):
    """One tapped layer: reduce (D_l), group, weight (H_l), fit, normal."""

    def __init__(self, config: KinetConfig, width: int, previous: int) -> None:
        super().__init__()
        self.config, self.groups = config, config.groups(width)
        learned = self.groups - 1 if config.xyz_group else self.groups
        self.reduce = nn.Linear(width + int(config.time_input), learned * config.group_size)
        self.weigh: nn.Module | None = None
        if previous and config.weighting == "deviation":
            self.weigh = DeviationWeights(previous, self.groups)
        elif previous and config.weighting == "projection":
            self.weigh = ProjectionWeights(previous, self.groups, config.group_size)

    @property
    def channels(self) -> int:
        """Width of `Surface.normals`."""
        return self.groups * (self.config.group_size + 1)

    def forward(
        self, activation: Tensor, relative: Tensor, times: Tensor, center_times: Tensor, previous: Tensor | None
    ) -> Surface:
        """activation (B,M,n,w), relative (B,M,n,3), times (B,M,n), center_times (B,M), previous deviations."""
        features = self._reduced(activation, relative, times)
        if not self.config.normals:
            return Surface(torch.nn.functional.pad(features.amax(2), (0, self.channels - features.shape[-1])), None)
        weights = self.weigh(previous) if self.weigh is not None and previous is not None else None
        # Measuring time from the centroid's frame only shifts b, so normals and deviations stay; float32 keeps more digits.
        target = times if self.config.variant == "release" else times - center_times[..., None]
        grouped = features.view(*features.shape[:3], self.groups, self.config.group_size)
        surface = fit_surface(grouped, target, weights, self.config.solver, self.config.guard)
        return Surface(surface_normal(surface).flatten(2), self._deviations(surface, grouped, target))

    def _reduced(self, activation: Tensor, relative: Tensor, times: Tensor) -> Tensor:
        values = torch.cat([activation, times[..., None]], -1) if self.config.time_input else activation
        features = torch.relu(self.reduce(values))
        if not self.config.xyz_group:
            return features
        padding = relative.new_zeros(*relative.shape[:-1], self.config.group_size - 3)
        return torch.cat([features, relative, padding], -1)

    def _deviations(self, surface: Tensor, grouped: Tensor, target: Tensor) -> Tensor | None:
        if self.config.weighting == "none":
            return None
        rule = projected_deviations if self.config.weighting == "projection" else deviations
        return rule(surface, grouped, target)


class Kinematics(nn.Module):
    """The dynamic branch over a frozen backbone's stages: a unit for each tapped layer, merge, head."""

    def __init__(self, config: KinetConfig, tap_widths: Sequence[Sequence[int]]) -> None:
        super().__init__()
        self.config = config
        self.units = nn.ModuleList()
        previous = 0
        for width in (width for stage in tap_widths for width in stage):
            self.units.append(KinematicUnit(config, width, previous))
            previous = self.units[-1].groups
        self.merge = build_merge(config, tap_widths, [unit.channels for unit in self.units])
        self.head = GlobalHead(self.merge.channels, config.dynamic_head, config.num_classes, config.dropout)
        he_init(self)

    def forward(self, stages: list[Stage]) -> Tensor:
        """Class logits (B,C) from the backbone's neighbourhoods and activations."""
        return self.head(stages[-1].grouping.centers, self.features(stages))

    def features(self, stages: list[Stage]) -> Tensor:
        """The merged dynamic feature of every centroid of the last stage, (B,M,C)."""
        surfaces: list[Surface] = []
        previous, units, before = None, iter(self.units), None
        for stage in stages:
            group = stage.grouping
            relative, times = group.relative(), group.neighbor_times()
            if before is not None and previous is not None:
                previous = self._to_next_stage(previous, before, group)
            for activation in stage.activations:
                surface = next(units)(activation, relative, times, group.center_times, previous)
                surfaces.append(surface)
                previous = surface.deviations
            before = group
        return self.merge([stage.grouping for stage in stages], [surface.normals for surface in surfaces])

    def _to_next_stage(self, deviations: Tensor, before: Grouping, group: Grouping) -> Tensor:
        """Deviations of the next stage's neighbours: those are centroids here, each with a deviation of its own.

        The release takes slot 0, whatever point that is; the text means the point itself: the slot nearest to the centroid.
        """
        if self.config.variant == "release":
            own = deviations[:, :, 0]
        else:
            distance = (
                before.relative().square().sum(-1) + (before.neighbor_times() - before.center_times[..., None]).square()
            )
            slot = distance.argmin(-1)
            own = deviations.flatten(3).gather(
                2, slot[..., None, None].expand(-1, -1, 1, deviations.flatten(3).shape[-1])
            )[:, :, 0]
            own = own.view(*deviations.shape[:2], *deviations.shape[3:])
        return gather_points(own.flatten(2), group.idx).view(*group.idx.shape, *own.shape[2:])
