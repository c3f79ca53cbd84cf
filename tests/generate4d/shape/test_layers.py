"""Layers of one picture: a ball from a disc, points and normals in the world, and what an empty frame gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage

from dpcli.errors import DataError
from dpcli.generate4d.shape import silhouette
from dpcli.generate4d.shape.guidance import sample_surface
from dpcli.generate4d.shape.layers import Camera, points_of
from dpcli.generate4d.shape.silhouette import Flat, Inflated, ball_thickness
from dpcli.generate4d.shape.splats import splats_of
from dpcli.ops.cameras import orbit_pose, pinhole


def _disc(size: int, radius: float) -> np.ndarray:
    axis = np.arange(size) + 0.5 - size / 2
    picture = np.zeros((1, 4, size, size), np.float32)
    picture[0, 3] = (axis[:, None] ** 2 + axis**2) < radius**2
    picture[0, 0] = np.linspace(0, 1, size)
    return picture


@pytest.mark.parametrize("azimuth", [0.0, 2.0])
def test_a_disc_becomes_a_ball_about_the_origin_with_outward_normals(azimuth):
    camera = Camera(pinhole(0.5, 96, 96), orbit_pose(azimuth, 0.3, 4.0))
    points = points_of(Inflated().layers(_disc(96, 30), camera)[0], camera)
    radius = 30 / camera.intrinsics[0, 0] * 4.0
    distance = np.linalg.norm(points.position, axis=1)
    assert np.median(distance) == pytest.approx(radius, rel=0.06) and np.abs(points.position.mean(0)).max() < 0.02
    outward = (points.normal * points.position).sum(1) / distance
    assert np.median(outward) > 0.97 and np.linalg.norm(points.normal, axis=1) == pytest.approx(1, abs=1e-5)
    assert set(points.layer) == {0, 1}  # front and back of the one interval
    assert points.color[:, 0] == pytest.approx(points.pixel[:, 1] / 95, abs=1e-6)


def test_a_ball_of_splats_is_a_disc_from_every_side():
    camera = Camera(pinhole(0.5, 96, 96), orbit_pose(0.0, 0.0, 4.0))
    splats = splats_of(Inflated().layers(_disc(96, 30), camera)[0], camera)
    truth = _disc(96, 30)[0, 3] > 0.5
    for azimuth, elevation in ((0.0, 0.0), (1.57, 0.0), (3.14, 0.4), (0.8, -0.5)):
        pose = torch.from_numpy(orbit_pose(azimuth, elevation, 4.0)).float()
        seen = splats.draw(pose, torch.from_numpy(camera.intrinsics).float(), 96, 96)[..., 3].numpy() > 0.5
        assert (seen & truth).sum() / (seen | truth).sum() > 0.82  # a cut-out has 0.1 from the side


def test_front_and_back_are_joined_and_the_outline_stays():
    """A slab, upright, whose front and back lie apart: closed from the side, no wider from the front."""
    camera = Camera(pinhole(0.5, 96, 96), orbit_pose(0.0, 0.0, 4.0))
    picture = np.zeros((1, 4, 96, 96), np.float32)
    picture[:, :, 20:76, 36:60] = 1
    flat = Flat().layers(picture, camera)[0]
    slab = replace(flat, depth=np.float32([3.8, 4.2, 4.0, 4.0])[:, None, None] + np.zeros_like(flat.depth))
    splats = splats_of(slab, camera)

    def seen(azimuth: float) -> np.ndarray:
        pose, intrinsics = orbit_pose(azimuth, 0.0, 4.0), camera.intrinsics
        return splats.draw(*(torch.from_numpy(a).float() for a in (pose, intrinsics)), 96, 96)[..., 3].numpy()

    assert seen(np.pi / 2)[24:72, 44:52].min() > 0.5  # the middle of its narrow side, nothing there without the join
    assert (seen(0.0) > 0.5).sum() == pytest.approx(56 * 24 * (4.0 / 3.8) ** 2, rel=0.12)


def test_points_drawn_from_a_ball_lie_on_it_evenly():
    camera = Camera(pinhole(0.5, 96, 96), orbit_pose(1.0, 0.0, 4.0))
    layers = Inflated().layers(_disc(96, 30), camera)[0]
    points, colors = sample_surface(layers, camera, 4000, np.random.default_rng(0))
    radius = 30 / camera.intrinsics[0, 0] * 4.0
    assert np.median(np.linalg.norm(points, axis=1)) == pytest.approx(radius, rel=0.06)
    depth = points @ camera.world_to_camera[2, :3] / radius
    assert np.mean(np.abs(depth) < 0.5) == pytest.approx(0.5, abs=0.12)  # as much area in the middle as at both ends
    for alpha, said in ((0.0, "shows nothing"), (0.3, r"at 16 pixels no alpha .* is above 0\.30.*--set start=sphere")):
        empty = Inflated().layers(np.full((1, 4, 16, 16), alpha, np.float32), camera)[0]
        with pytest.raises(DataError, match=said):
            sample_surface(empty, camera, 10, np.random.default_rng(0))


def test_a_cut_out_is_flat_and_stands_at_the_origin():
    camera = Camera(pinhole(0.5, 64, 64), orbit_pose(0.7, 0.0, 3.0))
    points = points_of(Flat().layers(_disc(64, 20), camera)[0], camera)
    depth = points.position @ camera.world_to_camera[2, :3]
    assert np.abs(depth).max() == pytest.approx(0.015, rel=1e-3)


def test_an_empty_frame_has_no_points():
    camera = Camera(pinhole(0.5, 16, 16), orbit_pose(0, 0))
    for prior in (Flat(), Inflated()):
        layers = prior.layers(np.zeros((1, 4, 16, 16), np.float32), camera)[0]
        assert len(points_of(layers, camera).position) == 0
        assert not splats_of(layers, camera).draw(torch.eye(4), torch.eye(3), 8, 8).any()


@pytest.mark.parametrize("absent", [0.0, np.nan, 50.0])
def test_normals_look_at_no_absent_neighbor(absent):
    """True layers: whatever stands where no interval is, points and their discs stay those of the object."""
    camera = Camera(pinhole(0.5, 96, 96), orbit_pose(0.7, 0.2, 4.0))
    whole = Inflated().layers(_disc(96, 30), camera)[0]
    layers = replace(whole, depth=np.where(np.repeat(whole.presence > 0.5, 2, axis=0), whole.depth, absent))
    points = points_of(layers, camera)
    outward = (points.normal * points.position).sum(1) / np.linalg.norm(points.position, axis=1)
    assert np.linalg.norm(points.normal, axis=1) == pytest.approx(1, abs=1e-5)
    assert np.quantile(outward, 0.01) > 0.7  # the outermost points too
    assert torch.isfinite(splats_of(layers, camera).quaternion).all()
    alone = replace(layers, presence=np.zeros_like(layers.presence))
    alone.presence[0, 48, 48] = 1
    facing = points_of(alone, camera).normal @ camera.world_to_camera[2, :3]
    assert facing == pytest.approx([-1, 1], abs=0.01)


def test_many_silhouettes_are_inflated_like_one():
    """The batched form, which runs on GPUs, against the one that goes from ball to ball; bodies at the border, too."""
    rng = np.random.default_rng(0)
    masks = ndimage.gaussian_filter(rng.normal(size=(7, 40, 52)), (0, 3, 3)) > 0.02
    masks[3], masks[4, :, :] = False, True
    expected = np.stack([ball_thickness(mask) for mask in masks])
    assert silhouette._ball_thicknesses(torch.from_numpy(masks)).numpy() == pytest.approx(expected, abs=1e-4)
    assert silhouette.ball_thicknesses(torch.from_numpy(masks)).numpy() == pytest.approx(expected, abs=1e-5)
