"""The small ball around points."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.prepare.bounding_sphere import bounding_sphere


def test_the_bounding_ball():
    rng = np.random.default_rng(4)
    points = rng.normal(size=(30_000, 3))
    points *= (rng.uniform(0, 1, 30_000) ** (1 / 3) / np.linalg.norm(points, axis=1))[:, None]
    center, radius = bounding_sphere(3 * points + [1, 2, 3])
    assert np.linalg.norm(3 * points + [1, 2, 3] - center, axis=1).max() <= radius + 1e-9
    assert radius < 3.03
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    assert bounding_sphere(corners)[1] == pytest.approx(np.sqrt(3), rel=1e-6)


def test_the_bounding_ball_of_a_lopsided_cloud_is_nearly_the_smallest():
    rng = np.random.default_rng(0)
    inside = rng.normal(size=(500, 3))
    inside *= rng.random((500, 1)) ** (1 / 3) / np.linalg.norm(inside, axis=1, keepdims=True)
    pole = np.array([[0, 0.6, 0.8]])
    points = np.concatenate([inside[inside @ pole[0] > -0.2], pole, -pole])  # lopsided, yet the poles fix the sphere
    center, radius = bounding_sphere(3 * points + [1, 2, 3])
    assert 3 - 1e-9 <= radius < 3.03 and np.linalg.norm(center - [1, 2, 3]) < 0.05
    assert (np.linalg.norm(3 * points + [1, 2, 3] - center, axis=1) <= radius + 1e-12).all()
