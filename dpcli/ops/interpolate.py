"""Features carried from one set of points to another (PointNet++'s feature propagation)."""

from __future__ import annotations

from torch import Tensor

from dpcli.ops.gather import gather_points
from dpcli.ops.nearest_neighbors import knn

_LEAST = 1e-10  # squared distances are clamped to this, so that a coincident point takes all the weight


def three_nn_interpolate(query: Tensor, points: Tensor, features: Tensor) -> Tensor:
    """Computes the inverse-squared-distance mean of the three nearest points' features: (B,M,3), (B,N,3), (B,N,C) -> (B,M,C).

    Weights are 1 / max(d^2, 1e-10), normalized; with fewer than three points, all of them count. Which points are
    nearest is decided in float32, ties to the lowest index; weights and result have the inputs' precision.
    Differentiable in features, and in both positions through the distances. Raises ValueError as `knn` does.

    >>> import torch
    >>> points = torch.tensor([[[0.0, 0, 0], [2, 0, 0]]])
    >>> three_nn_interpolate(torch.tensor([[[1.0, 0, 0]]]), points, torch.tensor([[[10.0], [20.0]]])).tolist()
    [[[15.0]]]
    """
    if features.shape[:-1] != points.shape[:-1]:
        raise ValueError(f"features {tuple(features.shape)} need one row for each of points {tuple(points.shape)}")
    _, idx = knn(query, points, min(3, points.shape[1]))
    distance = (query[..., None, :] - gather_points(points, idx)).square().sum(-1)
    weight = distance.clamp(min=_LEAST).reciprocal()
    weight = weight / weight.sum(-1, keepdim=True)
    return (weight[..., None] * gather_points(features, idx)).sum(-2)  # a batched product took three times as long
