"""Layers along rays against closed forms: balls, one behind the other, inside each other, open and inside out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dpcli.prepare.meshes import layered_views
from dpcli.prepare.meshes.animated_mesh import AnimatedMesh, Material
from dpcli.prepare.meshes.layered_views import LayeredViews, draw_views, posed, split_hits
from dpcli.prepare.meshes.raycast import FrameCaster
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


def _views(mesh: AnimatedMesh, count: int, size: int, seed: int, warp: float = 0.0) -> LayeredViews:
    rng = np.random.default_rng(seed)
    return draw_views([posed(mesh, rng)], count, size, rng, warp=warp)


def test_a_ball_is_as_deep_as_it_is_wide_and_lies_about_zero():
    views = _views(_balls(((3.0, -2.0, 5.0), 0.4)), 6, 48, 0)
    assert views.rgba.shape == (6, 4, 48, 48) and views.depth.dtype == torch.float16
    for rgba, depth in zip(views.rgba.numpy(), views.depth.double().numpy()):
        seen = rgba[3] > 0
        width = np.ptp(np.flatnonzero(seen.any(0))) / 48
        assert 0.82 < width < 0.94
        # a near camera sees the outline before the middle
        assert 0.84 * width < np.nanmax(depth[1] - depth[0]) < 1.02 * width
        assert np.nanmin(depth[0]) == pytest.approx(-np.nanmax(depth[1]), abs=0.04)
        assert np.array_equal(seen, ~np.isnan(depth[0])) and np.isnan(depth[2:]).all()


def test_balls_apart_are_two_intervals_and_one_inside_another_is_none():
    apart = _views(_balls(((-1, 0, 0), 0.5), ((1, 0, 0), 0.5)), 40, 32, 1).depth.double()
    behind = ~apart[:, 2].isnan()
    assert behind.any() and (apart[:, 2] > apart[:, 1])[behind].all() and (apart[:, 3] >= apart[:, 2])[behind].all()
    inside = _views(_balls(((0, 0, 0), 1.0), ((0.2, 0, 0), 0.4)), 6, 32, 1).depth
    assert inside[:, 2].isnan().all()


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
    ray = torch.full((len(depth),), 7)
    found = split_hits(ray, torch.tensor(depth, dtype=float), torch.tensor([sign == "+" for sign in entering]))
    assert found[0] == pytest.approx(np.array(expected, float), nan_ok=True)


def test_rays_do_not_mix():
    ray, depth = torch.tensor([0, 0, 5, 5, 5, 5]), torch.tensor([1.0, 2, 1, 2, 3, 4])
    found = split_hits(ray, depth, torch.tensor([True, False] * 3))
    assert found == pytest.approx(np.array([[1, 2, np.nan, np.nan], [1, 2, 3, 4]]), nan_ok=True)


def test_equal_seeds_make_equal_pictures():
    mesh = _balls(((-1, 0, 0), 0.5), ((1, 0.3, 0), 0.7))
    first, second = (_views(mesh, 5, 32, 4, warp=0.2) for _ in range(2))
    assert torch.equal(first.rgba, second.rgba) and torch.equal(first.depth.nan_to_num(9), second.depth.nan_to_num(9))


def test_layers_are_those_of_rays_that_open3d_casts(monkeypatch):
    """Rasterized hits against an independent ray caster, through the same pixels of the same camera."""
    rng = np.random.default_rng(3)
    mesh = posed(_balls(((-1, 0, 0.4), 0.5), ((1, 0.3, 0), 0.7), ((1, 0.2, 0.1), 0.4)), rng)
    seen = []
    hits = layered_views._hits
    monkeypatch.setattr(layered_views, "_hits", lambda *all: seen.append((all, hits(*all))) or seen[-1][1])
    depth = draw_views([mesh], 1, 40, rng).depth[0].double().numpy()
    (pixel, ahead, view, size), (ray, _, _, distance, entering) = seen[0]
    points = torch.cat([(pixel - 0.5 * size) * ahead[..., None], ahead[..., None]], -1).reshape(-1, 3).numpy()
    flat = replace(_balls(((0, 0, 0), 1.0)), positions=points[None], triangles=np.arange(len(points)).reshape(-1, 3))
    y, x = np.mgrid[:size, :size].reshape(2, -1) + 0.5 - 0.5 * size
    way = np.stack([x, y, np.ones_like(x)], 1)
    rays = np.concatenate([np.zeros_like(way), way], 1).astype(np.float32)
    cast, reach, triangle, _ = FrameCaster(flat, 0).all_hits(rays)
    assert np.array_equal(ray.numpy(), cast) and distance.numpy() == pytest.approx(reach, abs=1e-3)
    a, b, c = (points[flat.triangles[triangle, k]] for k in range(3))
    # triangles keep their sense of turning in these coordinates, which look along +z as the camera does
    assert np.array_equal(entering.numpy(), np.einsum("na,na->n", np.cross(b - a, c - a), rays[cast, 3:]) < 0)
    assert (~np.isnan(depth[0])).sum() == len(np.unique(cast))


def test_a_warp_changes_shapes_and_leaves_halves_alike():
    mesh = _balls(((-0.8, 0, 0), 0.5), ((0.8, 0, 0), 0.5))
    corners = torch.from_numpy(posed(mesh, np.random.default_rng(0)).vertices[0])[None]
    waves = layered_views._waves(1, 0.2, np.random.default_rng(1))
    mirror = torch.tensor([-1.0, 1, 1])
    moved, other = (
        layered_views._warped(x, torch.zeros(1, dtype=torch.long), waves) for x in (corners, corners * mirror)
    )
    assert other == pytest.approx(moved * mirror, abs=1e-5)
    assert (moved - corners).norm(dim=-1).max() > 0.02
