"""Gradients of the fit's own terms are the same bits in every run, whatever the order in which threads end."""

from __future__ import annotations

import torch

from dpcli.generate4d.scene.control_points import ControlPoints
from dpcli.generate4d.scene.identification import spatial_loss
from dpcli.generate4d.scene.losses import arap_loss
from dpcli.runtime.tuning import torch_threads


def test_threads_add_gradients_in_one_order():
    """Many Gaussians share a control point or a neighbor; torch's own indexing adds what they say as its threads come."""
    torch.manual_seed(0)
    points = torch.randn(20_000, 3)
    control = ControlPoints.among(points, 16)
    nearest = control.nearest(points)
    part = torch.rand(2, 20_000, 4, requires_grad=True)
    moved = torch.randn(2, 20_000, 3, requires_grad=True)
    neighbors = torch.randint(64, (20_000, 8))
    target = torch.rand(nearest.shape)
    terms = [
        (lambda: (control.weights(points, nearest) - target).square().sum(), [control.position, control.log_radius]),
        (lambda: spatial_loss(part, neighbors), [part]),
        (lambda: arap_loss(points, moved, neighbors), [moved]),
    ]
    with torch_threads(4):
        for term, parameters in terms:
            first, *others = [torch.autograd.grad(term(), parameters) for _ in range(5)]
            assert all(torch.equal(a, b) for other in others for a, b in zip(first, other))
