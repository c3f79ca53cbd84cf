"""The invariant segmentation head: an hourglass decoder to every point, learned part queries, and their match (B.1.2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dpcli.ops import three_nn_interpolate
from dpcli.runtime.mixed_precision import full_precision
from dpcli.segment.network.config import PartConfig
from dpcli.segment.network.encoder import CanonicalFrames, Level


class PointMLP(nn.Module):
    """Applies 1x1 convolutions without bias, each with group norm (4 groups) and ReLU: (B,N,C) -> (B,N,C')."""

    def __init__(self, channels: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.layers, self.norms = nn.ModuleList(), nn.ModuleList()
        for width in widths:
            linear = nn.Linear(channels, width, bias=False)
            nn.init.kaiming_normal_(linear.weight)
            self.layers.append(linear)
            self.norms.append(nn.GroupNorm(4, width))
            channels = width

    def forward(self, features: Tensor) -> Tensor:
        """Returns features (B,N,C')."""
        for linear, norm in zip(self.layers, self.norms):
            features = torch.relu(norm(linear(features).transpose(1, 2))).transpose(1, 2)
        return features


class SlotLayer(nn.Module):
    """Lets queries look at the memory, then at one another, then each at itself; norms come before, as in the release."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(3))
        self.cross = nn.MultiheadAttention(width, heads, batch_first=True)
        self.own = nn.MultiheadAttention(width, heads, batch_first=True)
        self.mlp = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width))

    def forward(self, slots: Tensor, memory: Tensor) -> Tensor:
        """Returns slots (B,S,W) after they have looked at the memory (B,P,W)."""
        slots = slots + self.cross(self.norms[0](slots), memory, memory, need_weights=False)[0]
        normed = self.norms[1](slots)
        slots = slots + self.own(normed, normed, normed, need_weights=False)[0]
        return slots + self.mlp(self.norms[2](slots))


class SegmentationHead(nn.Module):
    """Computes soft part masks (B,N,S), whose rows sum to 1, from the invariant features of all levels."""

    def __init__(self, config: PartConfig) -> None:
        super().__init__()
        self.config = config
        heads = config.pool_heads
        fine, coarse = (block[-1].channels * heads for block in config.layers)
        extra = 3 * config.canonical_heads
        self.frames = CanonicalFrames(config.layers[-1][-1].channels, config) if extra else None
        self.up_coarse = PointMLP(coarse + fine + extra, config.decoder[0])
        self.up_fine = PointMLP(config.decoder[0][-1] + (extra or 3), config.decoder[1])
        width = config.slot_width
        self.queries = nn.Parameter(torch.randn(config.slots, width) * 0.5)
        self.memory = nn.Sequential(
            nn.Linear(coarse + extra, width), nn.ReLU(), nn.Linear(width, width), nn.LayerNorm(width)
        )
        self.layers = nn.ModuleList(SlotLayer(width, config.slot_heads) for _ in range(config.slot_layers))
        self.slot_mlp = PointMLP(width, (width,))
        self.slot_out = nn.Linear(width, config.embedding)
        if config.decoder[1][-1] != config.embedding:
            self.point_out = nn.Linear(config.decoder[1][-1], config.embedding)

    def forward(self, points: Tensor, levels: list[Level]) -> Tensor:
        """Returns the mask (B,N,S) of a frame's points (B,N,3)."""
        fine, coarse = levels
        here = self._coordinates(points, coarse)
        up = three_nn_interpolate(fine.points, coarse.points, coarse.invariant)
        parts = [up, fine.invariant]
        memory = [coarse.invariant]
        if self.frames is not None:
            parts.append(here(fine.points))
            memory.append(here(coarse.points))
        hidden = self.up_coarse(torch.cat(parts, -1))
        hidden = three_nn_interpolate(points, fine.points, hidden)
        hidden = self.up_fine(torch.cat([hidden, here(points)], -1))
        if hasattr(self, "point_out"):
            hidden = self.point_out(hidden)
        slots = self._slots(torch.cat(memory, -1))
        return torch.softmax(_cosine(hidden, slots) / self.config.temperature, -1)

    def _coordinates(self, points: Tensor, coarse: Level):
        """Returns a function from positions (B,P,3) to what the decoder may know of them.

        That is the positions themselves, or their coordinates in invariant frames (B,P,3H).
        """
        if self.frames is None:
            return lambda positions: positions
        maps = self.frames(coarse)
        center = points.mean(1, keepdim=True)
        return lambda positions: _read_in(maps, positions - center)

    def _slots(self, memory: Tensor) -> Tensor:
        """Returns the vectors (B,S,E) of the slots, which have looked at the memory (B,P,C)."""
        memory = self.memory(memory)
        slots = self.queries.expand(len(memory), -1, -1)
        for layer in self.layers:
            slots = layer(slots, memory)
        return self.slot_out(self.slot_mlp(slots))


@full_precision
def _cosine(hidden: Tensor, slots: Tensor) -> Tensor:
    """Returns the cosine (B,N,S) between points' and slots' vectors.

    It is divided by a small temperature, so it is not computed in bfloat16.
    """
    return nn.functional.normalize(hidden, dim=-1) @ nn.functional.normalize(slots, dim=-1).transpose(1, 2)


@full_precision
def _read_in(maps: Tensor, offsets: Tensor) -> Tensor:
    """Returns offsets (B,P,3) in every one of the frames (B,H,3,3): (B,P,3H)."""
    return torch.einsum("bhij,bpj->bphi", maps, offsets).flatten(2)
