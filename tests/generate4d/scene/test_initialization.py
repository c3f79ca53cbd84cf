"""The first Gaussians, how their number grows and shrinks, and the losses on pictures and shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dpcli.errors import DataError
from dpcli.generate4d.config import FIT_PRESETS
from dpcli.generate4d.scene.canonical_gaussians import NAMES, CanonicalGaussians
from dpcli.generate4d.scene.initialization import carve_hull, check_cameras, first_points, sample_sphere
from dpcli.generate4d.scene.losses import picture_loss, thickness_loss
from dpcli.generate4d.shape.silhouette import ball_thickness
from dpcli.generate4d.targets import Targets
from dpcli.ops.cameras import orbit_pose, pinhole

RNG = np.random.default_rng(0)
QUICK = FIT_PRESETS["quick"]


def _disc(size: int, radius: float) -> np.ndarray:
    axis = np.arange(size) + 0.5 - size / 2
    rgba = np.zeros((size, size, 4), np.float32)
    rgba[..., 0], rgba[..., 3] = 0.5, (axis[:, None] ** 2 + axis**2) < radius**2
    return rgba


def test_a_disc_becomes_a_ball_and_a_bar_a_rod():
    disc = ball_thickness(_disc(80, 30)[..., 3] > 0)
    assert disc.max() == pytest.approx(30, abs=2.5) and disc[40, 40 + 24] == pytest.approx(18, abs=3)
    bar = np.zeros((60, 200), bool)
    bar[25:35, 10:190] = True
    thickness = ball_thickness(bar)
    assert thickness.max() == pytest.approx(5, abs=1.5) and thickness[~bar].max() == 0
    joined = bar.copy()
    joined[:, 150:] = True  # a body at the end doesn't fatten the limb
    assert ball_thickness(joined)[30, 60] == pytest.approx(thickness[30, 60], abs=0.5)


def test_the_hull_is_inside_every_silhouette_and_takes_the_near_color():
    intrinsics = np.stack([pinhole(np.deg2rad(49.1), 64, 64)] * 2)
    poses = np.stack([orbit_pose(0, 0), orbit_pose(np.pi, 0)])
    front, back = _disc(64, 15), _disc(64, 15)
    back[..., :3] = [0, 0, 1]
    points, colors = carve_hull([front, back], intrinsics, poses, 800, RNG)
    near, far = points[:, 2] > 0.3, points[:, 2] < -0.3
    assert len(points) == 800 and (colors[near, 0] > colors[near, 2]).all() and (colors[far, 2] > colors[far, 0]).all()
    side = np.stack([orbit_pose(0, 0), orbit_pose(np.pi / 2, 0)])
    off = np.roll(_disc(64, 4), 28, axis=0)
    with pytest.raises(DataError, match="no point in common"):
        carve_hull([_disc(64, 4), off], intrinsics, side, 100, RNG)


@pytest.mark.parametrize("unit, away", [(1.0, 0.0), (2.5, 0.0), (1.0, 1.6), (1.0, -1.2)])
def test_a_hull_is_found_wherever_and_however_large_the_object_is(unit, away):
    """Four views of a ball; a world in another unit, or with the object beside its origin, moves the hull with it."""
    intrinsics = np.stack([pinhole(np.deg2rad(49.1), 64, 64)] * 4)
    poses = np.stack([orbit_pose(np.pi / 2 * turn, 0) for turn in range(4)])
    middle = np.array([away, 0, 0])
    poses[:, :3, 3] = unit * poses[:, :3, 3] - poses[:, :3, :3] @ middle
    points, _ = carve_hull([_disc(64, 15)] * 4, intrinsics, poses, 800, np.random.default_rng(0))
    assert len(points) == 800
    np.testing.assert_allclose(points.mean(0), middle, atol=0.04 * unit)
    half = 15 / intrinsics[0, 0, 0] * 2 * unit
    assert np.percentile(np.linalg.norm(points - middle, axis=1), 99) == pytest.approx(half, rel=0.2)


@pytest.mark.parametrize("alpha, views", [((1, 1, 1), 3), ((1, 0, 1), 2), ((1, 0.4, 0), 1), ((0.4, 0.2, 0), 0)])
def test_a_view_that_the_object_has_left_carves_nothing(alpha, views):
    """Three views of a ball in the frame to start from; in some it isn't seen, or but faintly."""
    pictures = torch.from_numpy(np.stack([_disc(64, 15)[None] * [1, 1, 1, clear] for clear in alpha])).half()
    poses = np.stack([orbit_pose(azimuth, 0) for azimuth in (0.0, 1.5, 3.0)])
    targets = Targets("ball", pictures, np.stack([pinhole(np.deg2rad(49.1), 64, 64)] * 3), poses, np.zeros(1), 0)
    config = replace(QUICK, gaussians=300)
    if not views:
        with pytest.raises(DataError, match=r"is above 0\.40, expected 0\.5; take --set start=sphere"):
            first_points("hull", config, targets, np.random.default_rng(0))
        return
    points, _ = first_points("hull", config, targets, np.random.default_rng(0))
    assert len(points) == 300
    for clear, pose in zip(alpha, poses):
        camera = points.numpy() @ pose[:3, :3].T + pose[:3, 3]
        seen = np.hypot(*(camera[:, :2] / camera[:, 2:] * targets.intrinsics[0, 0, 0]).T)
        assert (seen.max() < 16) == (clear == 1)


def _balls(seed: int, poses: np.ndarray, lenses: np.ndarray, size: int) -> torch.Tensor:
    """Silhouettes (V,1,size,size,4) of five balls of random places and sizes, by the distance of each pixel's ray."""
    rng = np.random.default_rng(seed)
    centers, radii = rng.uniform(-0.45, 0.45, (5, 3)), rng.uniform(0.1, 0.25, 5)
    row, column = np.indices((size, size)) + 0.5
    pictures = []
    for pose, lens in zip(poses, lenses):
        rays = np.stack([(column - lens[0, 2]) / lens[0, 0], (row - lens[1, 2]) / lens[1, 1], np.ones_like(row)], -1)
        places = centers @ pose[:3, :3].T + pose[:3, 3]
        along = rays @ places.T / np.linalg.norm(rays, axis=-1, keepdims=True)  # [H, W, 5]
        alpha = ((places**2).sum(1) - along**2 < radii**2).any(-1)
        pictures.append(np.repeat(alpha[..., None], 4, -1)[None])
    return torch.from_numpy(np.stack(pictures)).half()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("wrong", ["", "mirrored", "exchanged", "angle of view", "upside down"])
def test_views_of_wrong_cameras_contradict_one_another(wrong, seed, capsys):
    """Right are cameras of unequal lenses, too, with a picture that cuts the object, and one that shows nothing of it."""
    angles = np.deg2rad([(0, 0), (60, 20), (150, -10), (220, 30), (300, 10)])
    poses = np.stack([orbit_pose(azimuth, elevation) for azimuth, elevation in angles])
    lenses = np.stack([pinhole(np.deg2rad(angle), 64, 64) for angle in (49, 60, 45, 55, 49)])
    lenses[1, 0, 0] *= 1.3
    lenses[2, 0, 2], lenses[3, 1, 2] = 4, 40
    pictures = _balls(seed, poses, lenses, 64)
    pictures[4] *= 1e-4
    if wrong == "mirrored":
        poses = np.stack([orbit_pose(-azimuth, elevation) for azimuth, elevation in angles])
    elif wrong == "upside down":
        poses = np.stack([orbit_pose(azimuth, -elevation) for azimuth, elevation in angles])
    elif wrong == "exchanged":
        poses = poses[[0, 2, 1, 3, 4]]
    elif wrong:
        lenses[1:, [0, 1], [0, 1]] *= 1.6
    check_cameras(Targets("balls", pictures, lenses, poses, np.zeros(1), 0), "balls.h5")
    said = capsys.readouterr().err
    assert ("balls.h5: the views contradict one another" in said) == bool(wrong), said
    assert "nan" not in said


def test_two_views_at_a_right_angle_make_a_rod_round_not_square():
    intrinsics = np.stack([pinhole(np.deg2rad(49.1), 96, 96)] * 2)
    poses = np.stack([orbit_pose(0, 0), orbit_pose(np.pi / 2, 0)])
    bar = np.zeros((96, 96, 4), np.float32)
    bar[16:80, 36:60] = 1.0
    points, _ = carve_hull([bar, bar], intrinsics, poses, 2000, RNG)
    points = points[np.abs(points[:, 1]) < 0.2]
    half = 12 / intrinsics[0, 0, 0] * 2  # of the bar, in the world
    radius = np.linalg.norm(points[:, [0, 2]], axis=1)
    assert 0.9 * half < np.percentile(radius, 99) < 1.2 * half  # a square's corners are at 1.41


def test_sphere_points_fill_the_volume_evenly():
    radius = np.linalg.norm(sample_sphere(20_000, 0.5, RNG), axis=1)
    assert radius.max() <= 0.5 and np.mean(radius < 0.25) == pytest.approx(1 / 8, abs=0.01)


def _trained(count: int) -> tuple[CanonicalGaussians, torch.optim.Adam]:
    torch.manual_seed(0)
    gaussians = CanonicalGaussians(torch.randn(count, 3), torch.rand(count, 3))
    optimizer = torch.optim.Adam(gaussians.parameter_groups(QUICK))
    sum((getattr(gaussians, name) ** 2).sum() for name in NAMES).backward()
    optimizer.step()
    return gaussians, optimizer


def test_growing_copies_the_busy_and_drops_the_transparent():
    gaussians, optimizer = _trained(20)
    gaussians.opacity_logit.data[3] = -9.0
    gaussians.gradient[[5, 7]] = torch.tensor([3.0, 9.0])
    gaussians.seen += 1
    before = {name: getattr(gaussians, name).detach().clone() for name in NAMES}
    memory = optimizer.state[gaussians.color]["exp_avg"].clone()
    config = replace(QUICK, grow_share=0.1)
    gaussians.densify_and_prune(optimizer, config, torch.Generator().manual_seed(0), grow=True)
    kept = [i for i in range(20) if i != 3]
    assert len(gaussians) == 21
    torch.testing.assert_close(gaussians.color.data, before["color"][kept + [5, 7]])
    torch.testing.assert_close(gaussians.anchor[20], gaussians.anchor[kept.index(7)])
    torch.testing.assert_close(optimizer.state[gaussians.color]["exp_avg"][:19], memory[kept])
    assert (optimizer.state[gaussians.color]["exp_avg"][19:] == 0).all()
    assert not torch.equal(gaussians.mean[20], before["mean"][7])
    (gaussians.mean**2).sum().backward()
    optimizer.step()  # the optimizer's groups hold the new parameters


def test_growth_stops_at_the_cap_and_something_always_remains():
    gaussians, optimizer = _trained(20)
    gaussians.gradient += 1
    gaussians.seen += 1
    rng = torch.Generator().manual_seed(0)
    gaussians.densify_and_prune(
        optimizer, replace(QUICK, grow_share=0.9, gaussians=24, max_gaussians=24), rng, grow=True
    )
    assert len(gaussians) == 24
    gaussians.opacity_logit.data[:] = -20.0
    gaussians.densify_and_prune(optimizer, QUICK, rng, grow=False)
    assert len(gaussians) == 1


def test_picture_loss_by_hand_and_shape_losses_see_what_they_should():
    target = torch.tensor([0.5, 0.0, 0.0, 0.5]).reshape(1, 1, 1, 4)
    white = torch.ones(1, 3)
    perfect = torch.tensor([1.0, 0.5, 0.5]).reshape(1, 1, 1, 3)
    half = torch.full((1, 1, 1, 1), 0.5)
    assert picture_loss(perfect, half, target, white, 0.1) == 0
    assert picture_loss(perfect - 0.2, half - 0.5, target, white, 0.1) == pytest.approx(0.04 + 0.1 * 0.25)
    anchor = torch.randn(10, 3)
    axis, moved = torch.tensor([0.0, 0, 1]), anchor.expand(2, 10, 3).clone()
    moved[..., 1] += 1.0
    assert thickness_loss(moved, anchor, axis) == 0
    moved[1, :, 2] += 0.1  # one of the two times
    assert thickness_loss(moved, anchor, axis).item() == pytest.approx(0.005, rel=1e-4)
