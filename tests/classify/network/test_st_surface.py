"""The space-time surface against physics: a rigidly moving plane's normal is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dpcli.classify.network.st_surface import along_normal, deviations, fit_surface, surface_normal


def moving_plane(normal, velocity, count=60, seed=0, dtype=torch.float64):
    """Points of a plane through the origin with this unit normal, moved by velocity * t, t in {-1, 0, 1}."""
    rng = np.random.default_rng(seed)
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    basis = np.linalg.svd(normal[None])[2][1:]
    times = rng.integers(-1, 2, count).astype(float)
    points = rng.normal(size=(count, 2)) @ basis + times[:, None] * np.asarray(velocity)
    return (
        torch.tensor(points, dtype=dtype)[:, None],
        torch.tensor(times, dtype=dtype),
        torch.tensor(normal, dtype=dtype),
    )


def test_normal_is_orthogonal_to_the_flow_and_gives_the_normal_speed():
    """n.x = (n.v) t on the moving plane, so A = n / (n.v): eq. 3.1 solved by hand."""
    velocity = [0.3, -0.2, 0.5]
    points, times, normal = moving_plane([1, 2, 3], velocity)
    surface = fit_surface(points, times)
    speed = float(normal @ torch.tensor(velocity, dtype=torch.float64))
    torch.testing.assert_close(surface[0, :3], normal / speed, rtol=1e-8, atol=1e-8)
    flow = torch.tensor([*velocity, 1.0], dtype=torch.float64)
    assert abs(float(surface_normal(surface)[0] @ flow)) < 1e-8


def test_weights_leave_outliers_out():
    points, times, _ = moving_plane([0, 0, 1], [0, 0, 0.4])
    noisy = points.clone()
    noisy[:5] += 3
    weights = torch.ones(len(times), 1, dtype=torch.float64)
    weights[:5] = 0
    clean = fit_surface(points[5:], times[5:])
    torch.testing.assert_close(fit_surface(noisy, times, weights), clean)
    assert (fit_surface(noisy, times) - clean).abs().max() > 0.1


@pytest.mark.parametrize("size", [2, 3, 4, 8, 20])
def test_fit_equals_a_least_squares_solver(size):
    g = torch.Generator().manual_seed(size)
    features = torch.randn(5, 64, 3, size, generator=g, dtype=torch.float64)
    times, weights = (
        torch.randn(5, 64, generator=g, dtype=torch.float64),
        torch.rand(5, 64, 3, generator=g, dtype=torch.float64),
    )
    ours = fit_surface(features, times, weights, guard="none")
    for b in range(5):
        for k in range(3):
            root = weights[b, :, k].sqrt()
            design = torch.cat([features[b, :, k], torch.ones(64, 1, dtype=torch.float64)], 1)
            best = np.linalg.lstsq((root[:, None] * design).numpy(), (root * times[b]).numpy(), rcond=None)[0]
            np.testing.assert_allclose(ours[b, k], best, atol=1e-7)


def test_ridge_and_guard_are_finite_where_neighbors_repeat():
    features = torch.randn(1, 1, 2, 4).expand(7, 64, 2, 4).clone().requires_grad_()
    times = torch.zeros(7, 64)
    for options in ({"solver": "ridge"}, {"guard": "signed"}, {"guard": "release"}):
        normal = surface_normal(fit_surface(features, times, **options))
        assert torch.isfinite(normal).all() and torch.isfinite(torch.autograd.grad(normal.sum(), features)[0]).all(), (
            options
        )


def test_deviations_vanish_on_the_plane_and_project_onto_the_normal():
    points, times, _ = moving_plane([1, 0, 1], [0.1, 0, 0.3])
    surface = fit_surface(points, times)
    assert deviations(surface, points, times).abs().max() < 1e-9
    moved = points + torch.tensor([0.1, 0.0, -0.2], dtype=torch.float64)
    vector = along_normal(surface, deviations(surface, moved, times))
    normal = surface_normal(surface)[0]
    along = vector[:, 0] @ normal
    torch.testing.assert_close(vector[:, 0], along[:, None] * normal)
    signed = deviations(surface, moved, times)[:, 0] / (surface[0, :3].square().sum() + 1).sqrt()
    torch.testing.assert_close(along, signed)


def test_gradients_against_finite_differences():
    g = torch.Generator().manual_seed(0)
    features = torch.randn(2, 12, 2, 3, generator=g, dtype=torch.float64, requires_grad=True)
    weights = torch.rand(2, 12, 2, generator=g, dtype=torch.float64, requires_grad=True)
    times = torch.randn(2, 12, generator=g, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda f, w: surface_normal(fit_surface(f, times, w)), (features, weights))


def test_measuring_time_from_the_centroid_changes_no_normal():
    points, times, _ = moving_plane([1, 2, 0], [0.2, 0, 0])
    torch.testing.assert_close(
        surface_normal(fit_surface(points, times)), surface_normal(fit_surface(points, times + 7)), rtol=1e-7, atol=1e-7
    )
