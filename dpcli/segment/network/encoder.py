"""The encoder: from a frame's points to equivariant features, and from these to invariant ones (thesis 4.4.3, B.1)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dpcli.ops import fps, gather_points
from dpcli.runtime.mixed_precision import full_precision
from dpcli.segment.network.config import PartConfig
from dpcli.segment.network.icosahedron import GROUPS
from dpcli.segment.network.neighborhood import RULES, Neighborhood
from dpcli.segment.network.se3_conv import SeparableConv


@dataclass
class Level:
    """Holds one block's result: points (B,P,3), equivariant features (B,P,G,C), invariant features (B,P,H*C)."""

    points: Tensor
    equivariant: Tensor
    invariant: Tensor


class InvariantPooling(nn.Module):
    """Pools over the group: u(p) = sum_a softmax_a(logit(p,a)) f(p,a) (eq. 4.2), the sum by a selection probability or several.

    logit = 1x1 convolution of [f(p,a), R_a^T (x_p - m)]. m is the cloud's mean in the release, which lets a part's
    weights depend on the other parts' poses; else the mean of the point's own neighbors. `global`: one weighting for
    all points.
    """

    def __init__(self, channels: int, config: PartConfig) -> None:
        super().__init__()
        self.config = config
        self.logit = nn.Linear(channels + 3, config.pool_heads)

    def forward(self, features: Tensor, points: Tensor, near: Neighborhood) -> Tensor:
        """Returns invariant features (B,P,H*C) from features (B,P,G,C) at points (B,P,3)."""
        rotations = GROUPS[self.config.group]().rotations_like(points)
        if self.config.canonical_heads:  # scaled by the radius, each cloud's own: of order 1, like the features
            radius = near.offsets.square().sum(-1).mean((1, 2)).sqrt().clamp(min=1e-6)
            centered = -near.offsets.mean(2) / radius[:, None, None]
        else:
            centered = points - points.mean(1, keepdim=True)
        local = _turned_back(rotations, centered).to(features.dtype)
        logits = self.logit(torch.cat([features, local], -1))
        if self.config.pooling == "global":
            logits = logits.mean(1, keepdim=True).expand_as(logits)
        weights = torch.softmax(logits.float(), 2).to(features.dtype)  # [B, P, G, H]
        return (weights.transpose(2, 3) @ features).flatten(2)


@full_precision
def _turned_back(rotations: Tensor, offsets: Tensor) -> Tensor:
    """Returns R_a^T x of offsets (B,P,3) for every rotation (G,3,3): (B,P,G,3)."""
    return torch.einsum("gij,bpi->bpgj", rotations, offsets)


class Encoder(nn.Module):
    """Extracts per-point features under all rotations (eq. 4.1) by blocks of separable SE(3) convolutions (EPN).

    The first layer's centers are farthest points; later strides keep the first of them.
    """

    def __init__(self, config: PartConfig) -> None:
        super().__init__()
        self.config = config
        self.blocks, self.pools = nn.ModuleList(), nn.ModuleList()
        channels = 1
        for block in config.layers:
            convs = []
            for layer in block:
                convs.append(SeparableConv(channels, layer, config))
                channels = layer.channels
            self.blocks.append(nn.ModuleList(convs))
            self.pools.append(InvariantPooling(channels, config))

    def forward(self, points: Tensor) -> list[Level]:
        """Returns a level per block from points (B,N,3)."""
        features, levels = None, []
        for block, pool in zip(self.blocks, self.pools):
            near, used = None, None
            for conv in block:
                layer = conv.spatial.layer
                key = (layer.radius, layer.neighbors, points.shape[1], layer.stride)
                if near is None or key != used:
                    near, used = self._neighborhood(points, layer, features is None), key
                features = conv(features, near)
                points = near.centers
            levels.append(Level(points, features, pool(features, points, near)))
        return levels

    def _neighborhood(self, points: Tensor, layer, first: bool) -> Neighborhood:
        count = -(-points.shape[1] // layer.stride)
        centers = gather_points(points, fps(points, count)) if first else points[:, :count]
        return RULES[self.config.rule](points, centers, layer.radius, layer.neighbors)


class CanonicalFrames(nn.Module):
    """Computes coordinates that no rotation of the group and no shift changes: x - mean, read in learned frames.

    w(a) = softmax over the group of a 1x1 convolution of the features' mean over points; the coordinates are sum_a w(a)
    R_a^T (x - mean), one triple per head. Turning the cloud by g moves w(a) to w(g a), and nothing else.
    """

    def __init__(self, channels: int, config: PartConfig) -> None:
        super().__init__()
        self.group = config.group
        self.logit = nn.Linear(channels, config.canonical_heads)
        nn.init.normal_(self.logit.weight, std=4 / channels**0.5)  # an even weighting of all rotations would give zero

    def forward(self, level: Level) -> Tensor:
        """Returns maps (B,H,3,3) that take centered coordinates into the canonical frames."""
        return self._maps(level.equivariant)

    @full_precision
    def _maps(self, features: Tensor) -> Tensor:
        summary = nn.functional.normalize(features.float().mean(1), dim=-1)
        weights = torch.softmax(4 * self.logit(summary), 1)  # [B, G, H]
        rotations = GROUPS[self.group]().rotations_like(weights)
        return torch.einsum("bgh,gij->bhji", weights, rotations)
