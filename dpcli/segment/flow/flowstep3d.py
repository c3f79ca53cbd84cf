"""A scene-flow network: a coarse global match, then a recurrent unit that corrects it (after FlowStep3D, 2021).

Kittenplon, Eldar, Raviv: FlowStep3D, CVPR 2021. Features of both frames are set abstractions of nearest neighbors;
the first flow is a soft assignment by cosine similarity of deep features (as in FLOT); every further iteration warps
the first frame, compares it with its new neighbors, and lets a gated unit say by how much to go on.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from dpcli.ops import fps, gather_points, knn, three_nn_interpolate
from dpcli.segment.flow.config import FlowConfig


class _Norm(nn.Module):
    """Normalizes the last axis by batch or by layer, whatever stands before it."""

    def __init__(self, kind: str, channels: int) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(channels) if kind == "batch" else nn.LayerNorm(channels)

    def forward(self, x: Tensor) -> Tensor:
        return self.norm(x.reshape(-1, x.shape[-1])).view_as(x)


def _mlp(channels: list[int], norm: str) -> nn.Sequential:
    """Returns linear layers of these widths, each with a norm and ReLU."""
    layers: list[nn.Module] = []
    for before, after in zip(channels, channels[1:]):
        layers += [nn.Linear(before, after, bias=False), _Norm(norm, after), nn.ReLU()]
    return nn.Sequential(*layers)


class SetConv(nn.Module):
    """Computes the maximum over neighbors of an MLP of [offset, feature].

    (B,N,3), (B,N,C), idx (B,M,k), centers (B,M,3) -> (B,M,C'). The first layer is linear, so it runs before the
    gathering, on N points rather than M k neighbors. `own` (B,M,C'), if given, is added to it at every center.
    """

    def __init__(self, before: int, after: int, norm: str, depth: int = 3) -> None:
        super().__init__()
        self.feature = nn.Linear(before, after, bias=False)
        self.place = nn.Linear(3, after, bias=False)
        self.first = nn.Sequential(_Norm(norm, after), nn.ReLU())
        self.rest = _mlp([after] * depth, norm)

    def forward(
        self, points: Tensor, features: Tensor, idx: Tensor, centers: Tensor, own: Tensor | None = None
    ) -> Tensor:
        """Returns features (B,M,C') at the centers."""
        shift = -self.place(centers) if own is None else own - self.place(centers)
        gathered = gather_points(self.feature(features) + self.place(points), idx)
        return self.rest(self.first(gathered + shift[:, :, None])).amax(2)


class _Level(NamedTuple):
    """Holds the points of one level and their features."""

    points: Tensor  # [B, n, 3]
    features: Tensor  # [B, n, C]


class _GatedUnit(nn.Module):
    """Is a GRU whose gates are set convolutions over the cloud: hidden (B,n,H), input (B,n,I) -> hidden (B,n,H)."""

    def __init__(self, hidden: int, given: int, norm: str) -> None:
        super().__init__()
        self.update, self.reset, self.propose = (SetConv(hidden + given, hidden, norm, 1) for _ in range(3))
        self.to_update, self.to_reset, self.to_propose = (nn.Linear(hidden, hidden) for _ in range(3))

    def forward(self, hidden: Tensor, given: Tensor, points: Tensor, idx: Tensor) -> Tensor:
        both = torch.cat([hidden, given], -1)
        update = torch.sigmoid(self.to_update(self.update(points, both, idx, points)))
        reset = torch.sigmoid(self.to_reset(self.reset(points, both, idx, points)))
        both = torch.cat([reset * hidden, given], -1)
        proposal = torch.tanh(self.to_propose(self.propose(points, both, idx, points)))
        return (1 - update) * hidden + update * proposal


class FlowStep3D(nn.Module):
    """Estimates the flow of a first cloud (B,N,3) toward a second (B,M,3), in several iterations.

    N and M should be 16 or more.
    """

    def __init__(self, config: FlowConfig) -> None:
        super().__init__()
        self.config, norm = config, config.norm
        widths = [3, *config.local, *config.deep]
        self.encoder = nn.ModuleList(SetConv(a, b, norm) for a, b in zip(widths, widths[1:]))
        self.sharpness = nn.Parameter(torch.zeros(1))
        local = config.local[1]
        self.correlate = SetConv(local, config.hidden, norm, 2)
        self.own = nn.Linear(local, config.hidden, bias=False)
        self.move = _mlp([config.hidden + 3, config.hidden], norm)
        self.start = nn.Linear(local, config.hidden)
        self.unit = _GatedUnit(config.hidden, config.hidden + local, norm)
        self.head = nn.ModuleList([SetConv(config.hidden, config.head, norm), SetConv(config.head, config.head, norm)])
        self.last = nn.Linear(config.head, 3)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, points1: Tensor, points2: Tensor) -> list[Tensor]:
        """Returns flows f32 (B,N,3): the global match's, then those of the further iterations, each a corrected one."""
        first, second = self._encode(points1), self._encode(points2)
        coarse = self._global_match(first[-1], second[-1])
        near, other = first[1], second[1]
        flow = three_nn_interpolate(near.points, first[-1].points, coarse)
        flows = [three_nn_interpolate(points1, near.points, flow)]
        _, idx = knn(near.points, near.points, self.config.neighbors)
        hidden = torch.tanh(self.start(near.features))
        for _ in range(self.config.iterations - 1):
            flow = flow.detach()  # each iteration learns to correct what it is given
            compared = self._compare(near, flow, other)
            given = torch.cat([self.move(torch.cat([compared, flow], -1)), near.features], -1)
            hidden = self.unit(hidden, given, near.points, idx)
            flow = flow + self._correction(hidden, near.points, idx)
            flows.append(three_nn_interpolate(points1, near.points, flow))
        return flows

    def _encode(self, points: Tensor) -> list[_Level]:
        """Returns levels of N/2, N/4, N/8, N/16 points; the first layer sees positions relative to the cloud's mean."""
        levels, features = [], points - points.mean(1, keepdim=True)
        for layer in self.encoder:
            chosen = fps(points, max(points.shape[1] // 2, 1))
            centers = gather_points(points, chosen)
            _, idx = knn(centers, points, self.config.neighbors)
            features = layer(points, features, idx, centers)
            points = centers
            levels.append(_Level(points, features))
        return levels

    def _global_match(self, first: _Level, second: _Level) -> Tensor:
        """Returns the flow (B,n,3) of the coarsest points by soft correspondences, as FLOT (Puy et al. 2020).

        The weights are exp(-(1 - cosine) / (exp(s) + 0.03)), normalized.
        """
        cosine = nn.functional.normalize(first.features, dim=-1) @ nn.functional.normalize(second.features, dim=-1).mT
        logits = (cosine - 1) / (self.sharpness.exp() + 0.03)
        distance = torch.cdist(first.points, second.points)
        logits = logits.masked_fill(distance > self.config.support, -1e4)
        return logits.softmax(-1) @ second.points - first.points

    def _compare(self, near: _Level, flow: Tensor, other: _Level) -> Tensor:
        """Returns features (B,n,hidden) of each warped point with its nearest points in the other frame."""
        warped = near.points + flow
        squared, idx = knn(warped, other.points, self.config.correlated)
        idx = torch.where(squared > self.config.radius**2, idx[..., :1], idx)
        return self.correlate(other.points, other.features, idx, warped, self.own(near.features))

    def _correction(self, hidden: Tensor, points: Tensor, idx: Tensor) -> Tensor:
        """Returns the correction (B,n,3) of the flow that the hidden state (B,n,H) says."""
        for layer in self.head:
            hidden = layer(points, hidden, idx, points)
        return self.last(hidden)
