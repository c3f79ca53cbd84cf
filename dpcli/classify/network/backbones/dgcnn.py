"""DGCNN (Wang et al. 2019) over the points of a clip: the graph-based backbone of thesis A.1.2.2.

The published classification network (its TensorFlow form: input transform, four edge convolutions, aggregation, two hidden
layers) with the published widths: 1,830,941 parameters for 20 classes. Ours: every point of the clip is a vertex, its
edges reach the frames within the temporal radius only (`frame_graph`), and the pooled edges use one product a point.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from dpcli.classify.network.backbones.frame_graph import frame_graph, pool_edges
from dpcli.classify.network.backbones.interface import Backbone, Grouping, Stage, require_frozen
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.layers import ClipLinear, RowNorm, SharedLayers, remember
from dpcli.classify.network.sync_norm import SyncNorm
from dpcli.errors import UsageError
from dpcli.ops import gather_points
from dpcli.runtime.mixed_precision import full_precision

PUBLISHED = ((64, 64, 64, 128), (1024,), (64, 128, 1024, 512, 256), (512, 256))
_EPS = 1e-3


class Dense(nn.Module):
    """Computes a linear layer, batch norm over all rows and ReLU.

    linear: the layer's class, ClipLinear where rows are clips.
    """

    def __init__(self, inputs: int, width: int, linear: type[nn.Linear] = nn.Linear) -> None:
        super().__init__()
        self.linear, self.norm = linear(inputs, width), RowNorm(width, eps=_EPS)

    def forward(self, values: Tensor) -> Tensor:
        """Returns (...,width) for values (...,C)."""
        rows = self.norm(self.linear(values.reshape(-1, values.shape[-1])))
        return torch.relu(rows).view(*values.shape[:-1], -1)

    def pool(self, values: Tensor) -> Tensor:
        """Returns `forward(values).amax(1)`, (B,N,C) -> (B,width), keeping no array of size (B,N,width) for the gradient.

        The norm's statistics are those of a linear image, W m and W S W^T of the mean and covariance of `values`, and norm
        and ReLU keep the order of rows (turn it where the norm's scale is negative). So the gradient passes through the
        rows that win and through S, and through no (B,N,width). Of equal rows the first one gets it.
        """
        if values.shape[0] * values.shape[1] == 1 or (self.training and isinstance(self.norm, SyncNorm)):
            return self.forward(values).amax(1)
        weight, norm = self.linear.weight, self.norm
        with torch.no_grad():
            sign = torch.where(norm.weight < 0, -1.0, 1.0).to(weight)
            place = linear(values, weight * sign[:, None]).argmax(1)
        return self._normed(values, place)

    @full_precision
    def _normed(self, values: Tensor, place: Tensor) -> Tensor:
        """Returns the rows `place` (B,width) of values (B,N,C), each times its channel's weights, norm and ReLU."""
        linear, norm = self.linear, self.norm
        largest = (gather_points(values, place) * linear.weight).sum(-1) + linear.bias
        if self.training:
            mean, var = image_statistics(values.flatten(0, 1), linear.weight)
            mean = mean + linear.bias
            remember(norm, mean, var, values.shape[0] * values.shape[1])
        else:
            mean, var = norm.running_mean, norm.running_var
        return torch.relu((largest - mean) * (norm.weight * torch.rsqrt(var + norm.eps)) + norm.bias)


def image_statistics(rows: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Returns mean and biased variance (width) of rows (R,C) @ weight.T (C,width), without making it; differentiable."""
    mean = rows.mean(0)
    centered = rows - mean.detach()  # they sum to zero: no gradient of the covariance passes through the mean
    covariance = centered.T @ centered / len(rows)
    return weight @ mean, ((weight @ covariance) * weight).sum(1).clamp(min=0)


class DenseHead(nn.Module):
    """Computes class logits by hidden layers with dropout behind each, as both published networks end."""

    def __init__(self, inputs: int, widths: tuple[int, ...], classes: int, dropout: float) -> None:
        super().__init__()
        self.hidden = nn.ModuleList(Dense(a, b, ClipLinear) for a, b in zip((inputs, *widths), widths))
        self.dropout = nn.Dropout(dropout)
        self.classify = ClipLinear(widths[-1], classes)

    def forward(self, values: Tensor) -> Tensor:
        """Returns the logits (B,classes) of features (B,inputs)."""
        for layer in self.hidden:
            values = self.dropout(layer(values))
        return self.classify(values)

    def macs(self) -> int:
        """Returns multiply-adds of one clip."""
        return sum(layer.linear.weight.numel() for layer in self.hidden) + self.classify.weight.numel()


class EdgeConv(nn.Module):
    """Computes h([x_i, x_j - x_i]) with one linear layer, batch norm over all edges and ReLU; the maximum over j.

    W [x_i, x_j - x_i] = W_b x_j + (W_a - W_b) x_i, so both products act on points, before neighbors are gathered.
    """

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.linear, self.norm = nn.Linear(2 * inputs, width), nn.BatchNorm1d(width, eps=_EPS)

    def forward(self, features: Tensor, idx: Tensor) -> Tensor:
        """Returns (B,N,width) from features (B,N,C) and neighbors idx (B,N,K)."""
        if not self.training:
            neighbor, own = _products(features, *self._folded())
            return torch.relu(pool_edges(neighbor, idx)[0] + own)
        if isinstance(self.norm, SyncNorm):
            return self._together(features, idx)
        # Norm and ReLU keep the order of values where the norm's scale is positive and turn it where it is negative,
        # so products with the scale's sign can be pooled first, and the rest acts on points instead of edges.
        sign = torch.where(self.norm.weight < 0, -1.0, 1.0).to(features)
        neighbor, own = _products(features, self.linear.weight * sign[:, None], self.linear.bias * sign)
        largest, total = pool_edges(neighbor, idx)
        mean, var = edge_statistics(neighbor, own, idx, total)
        remember(self.norm, mean * sign, var, idx.numel())
        scale = self.norm.weight * sign * torch.rsqrt(var + self.norm.eps)
        return torch.relu((largest + own - mean) * scale + self.norm.bias)

    def _together(self, features: Tensor, idx: Tensor) -> Tensor:
        """Computes `forward` edge by edge: the norm exchanges its statistics with the other processes of a shared run."""
        neighbor, own = _products(features, self.linear.weight, self.linear.bias)
        edges = gather_points(neighbor, idx) + own[:, :, None]
        return torch.relu(self.norm(edges.flatten(0, 2))).view_as(edges).amax(2)

    def activations(self, features: Tensor, idx: Tensor) -> Tensor:
        """Returns the activations after norm (by its running statistics) and ReLU, before pooling: (B,N,K,width)."""
        neighbor, own = _products(features, *self._folded())
        edges = gather_points(neighbor, idx)
        if edges.requires_grad or own.requires_grad:
            return torch.relu(edges + own[:, :, None])
        return edges.add_(own[:, :, None]).relu_()  # the largest array of the network: made once

    def _folded(self) -> tuple[Tensor, Tensor]:
        norm = self.norm
        scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
        return self.linear.weight * scale[:, None], (self.linear.bias - norm.running_mean) * scale + norm.bias


@full_precision
def _products(features: Tensor, weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
    """Returns W_b x_j and (W_a - W_b) x_i + bias, (B,N,width) each, in float32: their sum is a difference of places, which
    bfloat16 would round away."""
    first, second = weight.chunk(2, 1)
    return linear(features, second), linear(features, first - second, bias)


def edge_statistics(neighbor: Tensor, own: Tensor, idx: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
    """Returns mean and biased variance (C) of neighbor_j + own_i over all edges, without making them; differentiable.

    neighbor and own (B,N,C), idx (B,N,K), total (B,N,C) the sum of neighbor over each point's neighbors. Both parts are
    measured from their means first, so that the difference of squares keeps its digits.
    """
    slots, edges = idx.shape[-1], idx.numel()
    middle, shift = neighbor.detach().mean((0, 1)), own.detach().mean((0, 1))
    neighbor, own, total = neighbor - middle, own - shift, total - slots * middle
    ones = torch.ones((), dtype=neighbor.dtype, device=idx.device).expand(len(idx), idx[0].numel())
    degree = neighbor.new_zeros(neighbor.shape[:2]).scatter_add_(1, idx.flatten(1), ones)
    squares = (degree[..., None] * neighbor.square() + 2 * own * total + slots * own.square()).sum((0, 1)) / edges
    mean = (total + slots * own).sum((0, 1)) / edges
    return mean + middle + shift, (squares - mean.square()).clamp(min=0)


class InputTransform(nn.Module):
    """Computes a 3 x 3 matrix for each clip, from its edges; the identity before training.

    The published layers read an edge as [x_i, x_j - x_i], `SharedLayers` as [x_j - x_i, x_j], which is a linear function
    of it: the same layers can be learned, and they have as many weights.
    """

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        first, second, third, *hidden = widths
        self.edges, self.point = SharedLayers(3, (first, second)), Dense(second, third)
        self.hidden = nn.Sequential(*(Dense(a, b, ClipLinear) for a, b in zip((third, *hidden), hidden)))
        self.matrix = ClipLinear((third, *hidden)[-1], 9)

    def forward(self, points: Tensor, idx: Tensor) -> Tensor:
        """Returns points (B,N,3) times the learned matrix, from points (B,N,3) and their neighbors (B,N,K)."""
        pooled = self.point.pool(self.edges.pool(points, points, idx, points))
        matrix = self.matrix(self.hidden(pooled)).view(-1, 3, 3)
        return full_precision(torch.matmul)(points, matrix + torch.eye(3).to(matrix))


class DGCNN(Backbone):
    """Classifies by an input transform, edge convolutions on a graph that follows the features, aggregation of all layers, and
    hidden layers (Wang et al., 2019).

    Of the config: neighbors (20 as published), temporal_radius, grouping (balanced: equal shares of the frames; any other:
    the nearest of all of them), dropout (0.5 as published), and widths: edge convolutions, aggregation, input transform
    (two on edges, one on points, hidden), hidden layers. Radii and centroids have no part: all points are centroids.
    """

    def __init__(self, config: KinetConfig) -> None:
        super().__init__()
        edges, total, transform, hidden = expect_widths(config, PUBLISHED)
        self.config, self.tap_widths = config, tuple((width,) for width in edges)
        self.transform = InputTransform(transform)
        self.convs = nn.ModuleList(EdgeConv(a, b) for a, b in zip((3, *edges), edges))
        self.aggregate = Dense(sum(edges), total[0])
        self.head = DenseHead(total[0], hidden, config.num_classes, config.dropout)
        xavier_init(self)
        nn.init.zeros_(self.transform.matrix.weight)

    def group(self, points: Tensor, times: Tensor) -> list[Grouping]:
        """Returns the first graph, by coordinates; later ones follow from features."""
        return [Grouping(points, times, points, times, self._graph(points, times))]

    def forward(self, groups: list[Grouping]) -> Tensor:
        group = groups[0]
        features, levels = self.transform(group.points, group.idx), []
        for conv in self.convs:
            features = conv(features, self._graph(features, group.times))
            levels.append(features)
        return self._classified(levels)

    @torch.no_grad()
    def taps(self, groups: list[Grouping]) -> tuple[list[Stage], Tensor]:
        """Returns four stages of one layer, each on its own graph over all points (in input coordinates), and the logits."""
        require_frozen(self)
        group = groups[0]
        features, levels, stages = self.transform(group.points, group.idx), [], []
        for conv in self.convs:
            idx = self._graph(features, group.times)
            activation = conv.activations(features, idx)
            features = activation.amax(2)
            levels.append(features)
            stages.append(Stage(Grouping(group.points, group.times, group.points, group.times, idx), [activation]))
        return stages, self._classified(levels)

    def _graph(self, features: Tensor, times: Tensor) -> Tensor:
        config = self.config
        return frame_graph(features, times, config.neighbors, config.temporal_radius, config.grouping == "balanced")

    def _classified(self, levels: list[Tensor]) -> Tensor:
        return self.head(self.aggregate.pool(torch.cat(levels, -1)))

    def macs_as_written(self) -> int:
        """Returns multiply-adds of one clip as papers count them: each layer on every gathered edge, without the search."""
        vertices, t = self.config.num_frames * self.config.points_per_frame, self.transform
        on_edges = sum(
            layer.weight.numel() for layer in (t.edges.linear1, t.edges.linear2, *(c.linear for c in self.convs))
        )
        on_points = t.point.linear.weight.numel() + self.aggregate.linear.weight.numel()
        once = sum(layer.linear.weight.numel() for layer in t.hidden) + t.matrix.weight.numel() + self.head.macs()
        return vertices * (self.config.neighbors * on_edges + on_points) + once


def expect_widths(config: KinetConfig, published: tuple[tuple[int, ...], ...]) -> tuple[tuple[int, ...], ...]:
    """Returns `config.widths` if its parts are as many as the published ones and as long, but for the first and last. UsageError."""
    widths = config.widths
    fits = len(widths) == len(published) and all(part and min(part) >= 1 for part in widths)
    if not fits or any(len(a) != len(b) for a, b in zip(widths[1:-1], published[1:-1])):
        raise UsageError(f"backbone = {config.backbone}: widths = {widths}, expected numbers like {published}")
    return widths


def xavier_init(module: nn.Module) -> None:
    """Initializes every linear layer by Xavier's uniform rule with zero biases, as both published networks do."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
