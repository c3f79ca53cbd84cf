"""Layers along rays against closed forms: balls, one behind the other, inside each other, open and inside out."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.prepare.meshes.animated_mesh import AnimatedMesh, Material
from dpcli.prepare.meshes.layered_views import draw_views, split_hits
from dpcli.prepare.synthetic.surface_nets import surface_nets


def _balls(*balls: tuple[tuple[float, float, float], float]) -> AnimatedMesh:
    """Balls (center, radius), each a closed surface of its own."""
    side = np.stack(np.meshgrid(*[np.linspace(-1.2, 1.2, 25)] * 3, indexing="ij"), axis=-1)
    unit, triangles = surface_nets(np.linalg.norm(side, axis=-1) - 1)
    unit = unit * (2.4 / 24) - 1.2
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    points = np.concatenate([center + radius * unit for center, radius in balls]).astype(np.float32)
    number = len(points)
    return AnimatedMesh(
        name="balls",
        time=np.zeros(1),
        positions=points[None],
        normals=np.tile(unit, (len(balls), 1)).astype(np.float32)[None],
        triangles=np.concatenate([triangles + k * len(unit) for k in range(len(balls))]),
        material=np.zeros(len(balls) * len(triangles), np.int64),
        materials=(Material(),),
        color=np.ones((number, 4), np.float32),
        uv=np.zeros((number, 2), np.float32),
        bones=np.zeros((number, 1), np.int64),
        weights=np.ones((number, 1), np.float32),
        bone_pose=np.eye(4)[None, None],
        bone_parent=np.array([-1]),
    )


def test_a_ball_is_as_deep_as_it_is_wide_and_lies_about_zero():
    views = draw_views(_balls(((3.0, -2.0, 5.0), 0.4)), 6, 48, np.random.default_rng(0))
    assert views.rgba.shape == (6, 4, 48, 48) and views.depth.dtype == np.float16
    for rgba, depth in zip(views.rgba, views.depth.astype(float)):
        seen = rgba[3] > 0
        width = np.ptp(np.flatnonzero(seen.any(0))) / 48
        assert 0.84 < width < 0.94
        assert (
            0.84 * width < np.nanmax(depth[1] - depth[0]) < 1.02 * width
        )  # a near camera sees the outline before the middle
        assert np.nanmin(depth[0]) == pytest.approx(-np.nanmax(depth[1]), abs=0.04)
        assert np.array_equal(seen, ~np.isnan(depth[0])) and np.isnan(depth[2:]).all()


def test_balls_apart_are_two_intervals_and_one_inside_another_is_none():
    apart = draw_views(_balls(((-1, 0, 0), 0.5), ((1, 0, 0), 0.5)), 40, 32, np.random.default_rng(1)).depth.astype(
        float
    )
    behind = ~np.isnan(apart[:, 2])
    assert behind.any() and (apart[:, 2] > apart[:, 1])[behind].all() and (apart[:, 3] >= apart[:, 2])[behind].all()
    inside = draw_views(_balls(((0, 0, 0), 1.0), ((0.2, 0, 0), 0.4)), 6, 32, np.random.default_rng(1)).depth
    assert np.isnan(inside[:, 2]).all()


@pytest.mark.parametrize(
    ("depth", "entering", "expected"),
    [
        ([1, 2], "+-", [1, 2, np.nan, np.nan]),
        ([1, 2, 3, 4], "+-+-", [1, 2, 3, 4]),
        ([1, 2, 3, 4], "++--", [1, 4, np.nan, np.nan]),  # a body inside another
        ([1, 2, 3, 4, 5, 6], "++-+--", [1, 6, np.nan, np.nan]),  # two bodies inside another
        ([1, 2, 3, 4, 8, 9], "+-+-+-", [1, 4, 8, 9]),  # three: parted at the widest gap
        ([1, 2, 3, 4], "-+-+", [1, 2, 3, 4]),  # inside out
        ([1, 2, 3], "+-+", [1, 2, 3, 3]),  # a body and an open sheet
        ([1], "+", [1, 1, np.nan, np.nan]),
        ([1, 2, 2.001, 3], "+-+-", [1, 3, np.nan, np.nan]),  # bodies that touch
    ],
)
def test_hits_become_intervals(depth, entering, expected):
    ray = np.full(len(depth), 7)
    found = split_hits(ray, np.array(depth, float), np.array([sign == "+" for sign in entering]))
    assert found[0] == pytest.approx(np.array(expected, float), nan_ok=True)


def test_rays_do_not_mix():
    ray, depth = np.array([0, 0, 5, 5, 5, 5]), np.array([1.0, 2, 1, 2, 3, 4])
    found = split_hits(ray, depth, np.array([True, False] * 3))
    assert found == pytest.approx(np.array([[1, 2, np.nan, np.nan], [1, 2, 3, 4]]), nan_ok=True)


def test_equal_seeds_make_equal_pictures():
    mesh = _balls(((-1, 0, 0), 0.5), ((1, 0.3, 0), 0.7))
    first, second = (draw_views(mesh, 5, 32, np.random.default_rng(4)) for _ in range(2))
    assert np.array_equal(first.rgba, second.rgba) and np.array_equal(first.depth, second.depth, equal_nan=True)
