"""Layers that the networks of this room share: norms, linear layers over neighborhoods, the head of a clip, the initialization."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import batch_norm, linear

from dpcli.classify.network.sync_norm import SyncNorm
from dpcli.ops import gather_points
from dpcli.ops.grouped_mlp import Norm, grouped_mlp


class RowNorm(nn.BatchNorm1d):
    """Normalizes as a BatchNorm1d; a single row, which has no statistics, as outside of training."""

    def forward(self, rows: Tensor) -> Tensor:
        """Returns rows (R,C) normalized."""
        if len(rows) > 1:
            return super().forward(rows)
        return batch_norm(rows, self.running_mean, self.running_var, self.weight, self.bias, False, 0.0, self.eps)


@torch.no_grad()
def remember(norm: nn.BatchNorm1d, mean: Tensor, var: Tensor, rows: int) -> None:
    """Updates running statistics as BatchNorm1d does, from the mean and biased variance of so many rows."""
    norm.num_batches_tracked += 1
    norm.running_mean.lerp_(mean.to(norm.running_mean), norm.momentum)
    norm.running_var.lerp_(var.to(norm.running_var) * (rows / max(rows - 1, 1)), norm.momentum)


class SharedLayers(nn.Module):
    """Applies two linear layers shared by all neighbors, each with batch norm and ReLU, over [relative xyz, feature]."""

    def __init__(self, inputs: int, widths: tuple[int, int]) -> None:
        super().__init__()
        self.linear1, self.norm1 = nn.Linear(3 + inputs, widths[0]), nn.BatchNorm1d(widths[0], eps=1e-3)
        self.linear2, self.norm2 = nn.Linear(widths[0], widths[1]), nn.BatchNorm1d(widths[1], eps=1e-3)

    def _arguments(self) -> tuple:
        return tuple(
            (layer.weight, layer.bias) if isinstance(layer, nn.Linear) else self._norm(layer)
            for layer in (self.linear1, self.norm1, self.linear2, self.norm2)
        )

    def _norm(self, norm: nn.BatchNorm1d) -> Norm:
        mean, var = (None, None) if self.training else (norm.running_mean, norm.running_var)
        return Norm(norm.weight, norm.bias, mean, var, norm.eps)

    def pool(self, points: Tensor, centers: Tensor, idx: Tensor, features: Tensor | None) -> Tensor:
        """Returns the maximum over the neighbors, (B,M,C2); arguments as `grouped_mlp`. Training updates the running statistics."""
        if self.training and isinstance(self.norm1, SyncNorm):
            return self._pool_together(points, centers, idx, features)
        pooled, statistics = grouped_mlp(points, centers, idx, features, *self._arguments())
        if self.training:
            for norm, mean, var in zip((self.norm1, self.norm2), statistics[::2], statistics[1::2]):
                remember(norm, mean, var, idx.numel())
        return pooled

    def _pool_together(self, points: Tensor, centers: Tensor, idx: Tensor, features: Tensor | None) -> Tensor:
        """Computes `pool` layer by layer: between layers the processes of a shared run exchange their statistics."""
        values = gather_points(points, idx) - centers[:, :, None]
        if features is not None:
            values = torch.cat([values, gather_points(features, idx)], -1)
        hidden = torch.relu(self.norm1(self.linear1(values.flatten(0, 2))))
        return torch.relu(self.norm2(self.linear2(hidden))).view(*idx.shape, -1).amax(2)


class ClipLinear(nn.Linear):
    """Applies a linear layer to one row for each clip.

    Outside of training a clip's result doesn't depend, to the bit, on the clips beside it: a product of so few rows is
    rounded by their number, so each row has a product of its own.
    """

    def forward(self, rows: Tensor) -> Tensor:
        """Returns (B,C) for rows (B,F), or (C) for one."""
        if self.training or rows.ndim < 2:
            return super().forward(rows)
        return torch.cat([linear(row, self.weight, self.bias) for row in rows.split(1)])


class GlobalHead(SharedLayers):
    """Computes class logits: [xyz, feature] of every centroid -> two shared layers -> max over the clip -> linear."""

    def __init__(self, inputs: int, widths: tuple[int, int], classes: int, dropout: float) -> None:
        super().__init__(inputs, widths)
        self.dropout = nn.Dropout(dropout)
        self.classify = ClipLinear(widths[1], classes)

    def embed(self, centers: Tensor, features: Tensor) -> Tensor:
        """Returns the clip's feature vector, (B, widths[1])."""
        batch, count = centers.shape[:2]
        if self.training:  # as one group: its center is the origin, its neighbors are all centroids
            everyone = torch.arange(count, device=centers.device).expand(batch, 1, count)
            return self.pool(centers, centers.new_zeros(batch, 1, 3), everyone, features)[:, 0]
        values = torch.cat([centers, features], -1)
        hidden = torch.relu_(self.norm1(self.linear1(values.view(batch * count, -1))))
        return torch.relu_(self.norm2(self.linear2(hidden))).view(batch, count, -1).amax(1)

    def forward(self, centers: Tensor, features: Tensor) -> Tensor:
        """Returns the class logits (B,C) of centers (B,M,3) with features (B,M,F)."""
        return self.classify(self.dropout(self.embed(centers, features)))


def he_init(module: nn.Module) -> None:
    """Gives every linear layer a variance-scaling initialization (fan-in, factor 2, truncated normal; He et al., 2015) and zero
    biases."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            nn.init.trunc_normal_(layer.weight, std=(2 / layer.in_features) ** 0.5)
            nn.init.zeros_(layer.bias)
    for layer in module.modules():
        if isinstance(layer, GlobalHead):  # logits near zero, so that the first steps don't unlearn large random ones
            nn.init.trunc_normal_(layer.classify.weight, std=0.01)
