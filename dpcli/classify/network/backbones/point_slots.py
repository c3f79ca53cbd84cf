"""A network for sparse clouds, such as a radar's: the points of each slot of time become one feature, and layers over
time read the slots in their order.

A slot is a set of points as PointNet (Qi et al., 2017) reads it. A few points say little about a surface, so this backbone
has no neighborhoods and nothing that a dynamic stream could fit: what moves how is in the points' columns (a radar's
Doppler speed) and in the order of the slots.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dpcli.classify.network.backbones.interface import Backbone, Grouping, Stage
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.layers import ClipLinear
from dpcli.errors import UsageError

_REACH = 3  # slots that a layer over time sees
_STEPS = (1, 2, 4)  # between these slots, a layer each
_DROPPED = 0.1  # after each layer over time


class PointSlots(Backbone):
    """Classifies by the mean of `members` equal networks.

    In training each learns from its own share of a batch, so that all of them cost what one network costs; their errors
    differ, and the mean of their scores has fewer. Reads of the config: num_frames (slots), points_per_frame, widths (the
    layers of a point; the width of a slot), columns, members, dropout.
    """

    def __init__(self, config: KinetConfig) -> None:
        super().__init__()
        self.config, self.tap_widths = config, ()
        self.members = nn.ModuleList(_Member(config) for _ in range(config.members))

    def group(self, points: Tensor, times: Tensor) -> list[Grouping]:
        """Returns the points (B,N,3) as they are: one grouping without neighborhoods."""
        nothing = times.new_zeros((len(points), 0, 0), dtype=torch.long)
        return [Grouping(points, times, points[:, :0], times[:, :0], nothing)]

    def forward(self, groups: list[Grouping]) -> Tensor:
        """Class logits (B,C): of one member each in training, else the logarithm of all members' mean scores."""
        clips = torch.cat([groups[0].points, groups[0].columns], -1)
        clips = clips.unflatten(1, (self.config.num_frames, self.config.points_per_frame))
        if self.training and len(clips) >= len(self.members):
            count = len(self.members)
            logits = [member(clips[k::count]) for k, member in enumerate(self.members)]
            order = torch.cat([torch.arange(k, len(clips), count) for k in range(count)])
            return torch.cat(logits)[order.argsort().to(clips.device)]
        scores = torch.stack([torch.log_softmax(member(clips), -1) for member in self.members])
        return torch.logsumexp(scores, 0) - torch.log(scores.new_tensor(float(len(scores))))

    def taps(self, groups: list[Grouping]) -> tuple[list[Stage], Tensor]:
        """Raises UsageError: there are no neighborhoods to look at."""
        raise UsageError("the backbone slots has no neighborhoods and no dynamic stream; ask for what its scores say")


class _Member(nn.Module):
    """Classifies clips (B,T,P,5+F): place, 1 where there is a point, time within the slot, columns."""

    def __init__(self, config: KinetConfig) -> None:
        super().__init__()
        first, second = config.widths[0]
        width = config.widths[1][0]
        self.points = nn.Sequential(*_layer(4 + len(config.columns), first), *_layer(first, second))
        self.slots = nn.Sequential(*_layer(2 * second + 1, width))
        self.position = nn.Parameter(torch.zeros(config.num_frames, width))
        self.over_time = nn.ModuleList(_OverTime(width, step) for step in _STEPS)
        self.dropout, self.classify = nn.Dropout(config.dropout), ClipLinear(2 * width, config.num_classes)

    def forward(self, clips: Tensor) -> Tensor:
        """Returns the logits (B,C)."""
        here = clips[..., 3].flatten().nonzero()[:, 0]
        known = self.points(torch.cat([clips[..., :3], clips[..., 4:]], -1).flatten(0, 2).index_select(0, here))
        values = known.new_zeros(clips[..., 3].numel(), known.shape[-1]).index_copy(0, here, known)
        values, count = values.view(*clips.shape[:3], -1), clips[..., 3:4].sum(2)
        pooled = [values.sum(2) / count.clamp(min=1), values.amax(2), torch.log1p(count)]  # values are not below 0
        found = self.slots(torch.cat(pooled, -1)) + self.position
        for layer in self.over_time:
            found = found + layer(found)
        return self.classify(self.dropout(torch.cat([found.mean(1), found.amax(1)], -1)))


class _OverTime(nn.Module):
    """Reads each slot together with the slots before and after it, `step` apart: (B,T,W) to the same shape."""

    def __init__(self, width: int, step: int) -> None:
        super().__init__()
        self.mix = nn.Conv1d(width, width, _REACH, padding=step * (_REACH // 2), dilation=step)
        self.norm, self.dropout = nn.LayerNorm(width), nn.Dropout(_DROPPED)

    def forward(self, slots: Tensor) -> Tensor:
        """Returns what is added to the slots."""
        return self.dropout(torch.relu(self.norm(self.mix(slots.transpose(1, 2)).transpose(1, 2))))


def _layer(inputs: int, outputs: int) -> tuple[nn.Module, ...]:
    return nn.Linear(inputs, outputs), nn.LayerNorm(outputs), nn.ReLU()
