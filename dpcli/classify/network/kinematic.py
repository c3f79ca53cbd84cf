"""The dynamic stream: kinematic learning units that fit space-time surfaces to a frozen static network's activations.

A unit (thesis figure 3.4) reduces the features of a neighborhood, splits them into groups, fits one surface a group with
weights from the previous unit's deviations, and hands on the normals. `Kinematics` runs one unit after another, the
thesis's iterative normal refinement; how their normals become one feature per centroid is the business of `merge`.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dpcli.classify.network.backbones.interface import Grouping, Stage
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.layers import GlobalHead, he_init
from dpcli.classify.network.normal_merge import build_merge
from dpcli.classify.network.st_surface import along_normal, surface_normal
from dpcli.classify.network.st_surface_cpu import Fit, fit_reduced
from dpcli.ops import gather_points


class DeviationWeights(nn.Module):
    """Computes the logits of weighted neighbors from deviations, by one linear map over groups (eq. 3.8)."""

    def __init__(self, previous: int, groups: int) -> None:
        super().__init__()
        self.linear = nn.Linear(previous, groups)

    def forward(self, deviations: Tensor) -> Tensor:
        """Returns logits (B,M,n,K) of deviations (B,M,n,K'); the weights are their sigmoid.

        >>> _ = torch.manual_seed(0)
        >>> weigh = DeviationWeights(previous=2, groups=3)
        >>> torch.sigmoid(weigh(torch.zeros(1, 5, 4, 2))).shape
        torch.Size([1, 5, 4, 3])
        """
        return self.linear(deviations)


class ProjectionWeights(nn.Module):
    """Computes the logits as the published code does: over groups, then over the projected deviation vector (d+1 -> 2d -> 1)."""

    def __init__(self, previous: int, groups: int, group_size: int) -> None:
        super().__init__()
        self.over_groups = nn.Linear(previous, groups)
        self.hidden = nn.Linear(group_size + 1, 2 * group_size)
        self.out = nn.Linear(2 * group_size, 1)

    def forward(self, deviations: Tensor) -> Tensor:
        """Returns logits (B,M,n,K) of deviations (B,M,n,K',d+1)."""
        mixed = torch.relu(self.over_groups(deviations.transpose(-1, -2))).transpose(-1, -2)
        return self.out(torch.relu(self.hidden(mixed)))[..., 0]


@dataclass
class Surface:
    """Holds what a unit found: normals (B,M,K*(d+1)), or pooled features for Table 3.1 v; deviations (B,M,n,K[,d+1]) or None."""

    normals: Tensor
    deviations: Tensor | None


class KinematicUnit(nn.Module):
    """Fits surfaces to one tapped layer: reduce (D_l), group, weight (H_l), fit, normal (thesis, figure 3.4)."""

    def __init__(self, config: KinetConfig, width: int, previous: int) -> None:
        super().__init__()
        self.config, self.groups = config, config.groups(width)
        learned = self.groups - 1 if config.xyz_group else self.groups
        with warnings.catch_warnings():  # a narrow layer may have no group of its own beside the coordinates'
            warnings.filterwarnings("ignore", "Initializing zero-element tensors")
            self.reduce = nn.Linear(width + int(config.time_input), learned * config.group_size)
        self.weigh: nn.Module | None = None
        if previous and config.weighting == "deviation":
            self.weigh = DeviationWeights(previous, self.groups)
        elif previous and config.weighting == "projection":
            self.weigh = ProjectionWeights(previous, self.groups, config.group_size)

    @property
    def channels(self) -> int:
        """Returns the width of `Surface.normals`."""
        return self.groups * (self.config.group_size + 1)

    def forward(
        self,
        activation: Tensor,
        relative: Tensor,
        times: Tensor,
        center_times: Tensor,
        previous: Tensor | None,
        last: bool = False,
    ) -> Surface:
        """Returns the surfaces through the neighbors.

        activation (B,M,n,w), relative (B,M,n,3), times (B,M,n), center_times (B,M), previous: deviations of the unit before;
        last: no unit follows that uses deviations.
        """
        config = self.config
        values = torch.cat([activation, times[..., None]], -1) if config.time_input else activation
        if not config.normals:
            return self._pooled(values, relative)
        logits = self.weigh(previous) if self.weigh is not None and previous is not None else None
        # Measuring time from the centroid's frame only shifts b, so normals and deviations stay; float32 keeps more digits. A
        # ridge holds b down, too, so that with one the absolute frame number would count: the release has none.
        absolute = config.variant == "release" and config.solver == "inverse"
        target = times if absolute else times - center_times[..., None]
        fit = Fit(config.group_size, config.solver, config.guard, not last and config.weighting != "none")
        near = relative if config.xyz_group else None
        surface, away = fit_reduced(values, (self.reduce.weight, self.reduce.bias), near, target, logits, fit)
        if away is not None and config.weighting == "projection":
            away = along_normal(surface, away)
        return Surface(surface_normal(surface).flatten(2), away)

    def _pooled(self, values: Tensor, relative: Tensor) -> Surface:
        """Returns the reduced features' maximum, and the coordinates', in place of normals (row v of table 3.1)."""
        features = torch.relu(self.reduce(values))
        if self.config.xyz_group:
            features = torch.cat([features, relative], -1)
        pooled = features.amax(2)
        return Surface(torch.nn.functional.pad(pooled, (0, self.channels - pooled.shape[-1])), None)


class Kinematics(nn.Module):
    """Classifies by motion: the dynamic branch over a frozen backbone's stages, with a unit for each tapped layer, merge, head."""

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
        """Returns class logits (B,C) from the backbone's neighborhoods and activations."""
        return self.head(stages[-1].grouping.centers, self.features(stages))

    def features(self, stages: list[Stage]) -> Tensor:
        """Returns the merged dynamic feature of every centroid of the last stage, (B,M,C)."""
        surfaces: list[Surface] = []
        previous, units, before = None, iter(self.units), None
        for stage in stages:
            group = stage.grouping
            relative, times = group.relative(), group.neighbor_times()
            if before is not None and previous is not None:
                previous = self._to_next_stage(previous, before, group)
            for activation in stage.activations:
                unit = next(units)
                last = unit is self.units[-1]
                surface = unit(activation, relative, times, group.center_times, previous, last)
                surfaces.append(surface)
                previous = surface.deviations
            before = group
        return self.merge([stage.grouping for stage in stages], [surface.normals for surface in surfaces])

    def _to_next_stage(self, deviations: Tensor, before: Grouping, group: Grouping) -> Tensor:
        """Returns the deviations of the next stage's neighbors: those are centroids here, each with a deviation of its own.

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
