"""The surface of a scene: distances against a plain double loop, a ball whose errors are known, nothing to see."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import Resampling
from dpcli.evaluate.video.surface import SIDE, _cameras, _unproject, point_errors, surface_score, visible_points
from dpcli.store.gaussians import GaussianScene
from tests.support.scenes import toy_scene


def test_distances_and_f_scores_are_those_of_a_double_loop():
    rng = np.random.default_rng(0)
    points, truth = rng.random((40, 3)), rng.random((25, 3))
    distance = np.array([[np.sqrt(((a - b) ** 2).sum()) for b in truth] for a in points])
    chamfer, scores = point_errors(points, truth, 12.0)
    assert chamfer == pytest.approx((distance.min(1).mean() + distance.min(0).mean()) / 2)
    for score, reach in zip(scores, (0.12, 0.24)):
        precision, recall = np.mean(distance.min(1) <= reach), np.mean(distance.min(0) <= reach)
        assert score == pytest.approx(2 * precision * recall / (precision + recall))
    assert point_errors(points, truth + 100, 1.0)[1].tolist() == [0, 0]


def _directions(count: int) -> np.ndarray:
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    up = 1 - 2 * (np.arange(count) + 0.5) / count
    flat = np.sqrt(1 - up**2)
    return np.stack([flat * np.cos(turn), up, flat * np.sin(turn)], 1).astype(np.float32)


def _ball(radius: float, middle: float = 0.0) -> GaussianScene:
    """A ball of solid Gaussians, with others inside that no camera sees; it stands in two frames."""
    shell = np.concatenate([_directions(3000) * radius, _directions(500) * 0.3 * radius]) + [middle, 0, 0]
    count = len(shell)
    toy = toy_scene(size=16)
    mean, turn = shell.astype(np.float32), np.tile(np.float32([1, 0, 0, 0]), (count, 1))
    pick = np.zeros(count, int)
    return replace(
        toy,
        mean=mean,
        log_scale=np.full((count, 3), np.log(0.04 * radius), np.float32),
        quaternion=turn,
        opacity_logit=np.full(count, 4.0, np.float32),
        sh=toy.sh[pick],
        time=toy.time[:2],
        frame_mean=np.stack([mean, mean]),
        frame_quaternion=np.stack([turn, turn]),
        part=toy.part[pick],
        part_probability=toy.part_probability[pick],
        part_motion=toy.part_motion[:2],
        rigid_weight=toy.rigid_weight[:2][:, pick],
        control_position=toy.control_position[:2],
        control_quaternion=toy.control_quaternion[:2],
    )


def test_a_ball_larger_by_a_tenth_is_off_by_its_thickness_and_what_is_inside_does_not_count():
    track = np.stack([_directions(2000)] * 2)
    times = np.zeros(2)
    diameter = np.linalg.norm(np.ptp(track[0], axis=0))
    right, large = (surface_score(_ball(radius), track, times) for radius in (1.0, 1.1))
    assert (right.chamfer < 0.012 * diameter).all() and (right.f_score[:, 1] > 0.93).all() and right.unseen == 0
    assert large.chamfer == pytest.approx(0.1, abs=0.03)  # the true points lie 0.08 apart
    assert (large.f_score[:, 1] < 0.05).all()  # 0.1 is 2.9 % of the diameter
    ends = right.intervals(Resampling(200))
    assert set(ends) == {"chamfer", "chamfer_of_diameter", "f_score_1", "f_score_2"}


def test_a_scene_that_shows_nothing_has_no_distance_and_no_points_are_an_error():
    scene = _ball(1.0)
    faint = replace(scene, opacity_logit=np.full_like(scene.opacity_logit, -9))
    score = surface_score(faint, np.stack([_directions(50)]), np.zeros(1))
    assert score.unseen == 1 and np.isnan(score.chamfer).all() and (score.f_score == 0).all()
    with pytest.raises(DataError, match="no surface points"):
        surface_score(scene, np.zeros((1, 0, 3)), np.zeros(1))


def test_the_cameras_see_all_of_a_ball_from_a_cube_s_sides_and_corners():
    rng, middle, radius = np.random.default_rng(1), np.array([3.0, -2, 9]), 0.7
    poses, lens = _cameras(middle, radius)
    away = -np.einsum("cji,cj->ci", poses[:, :3, :3], poses[:, :3, 3]) - middle
    cube = np.array([x for x in itertools.product([-1, 0, 1], repeat=3) if np.abs(x).sum() in (1, 3)])
    cosines = (
        away / np.linalg.norm(away, axis=1, keepdims=True) @ (cube / np.linalg.norm(cube, axis=1, keepdims=True)).T
    )
    np.testing.assert_allclose(np.sort(cosines.max(1)), 1, atol=1e-12)
    assert sorted(cosines.argmax(1)) == list(range(14))
    ball = middle + 1.4 * radius * _directions(4000)
    for pose in poses:
        seen = (ball @ pose[:3, :3].T + pose[:3, 3]) @ lens.T
        pixels = seen[:, :2] / seen[:, 2:]
        assert (
            (seen[:, 2] > 0).all()
            and pixels.min(0) == pytest.approx(0, abs=0.5)
            and pixels.max(0) == pytest.approx(SIDE, abs=0.5)
        )
    depth, chosen = rng.uniform(1, 9, (14, SIDE, SIDE)), rng.random((14, SIDE, SIDE)) < 1e-3
    camera, row, column = np.nonzero(chosen)
    back = np.einsum("nij,nj->ni", poses[camera, :3, :3], _unproject(depth, chosen, poses, lens)) + poses[camera, :3, 3]
    np.testing.assert_allclose(back[:, 2], depth[chosen])
    np.testing.assert_allclose((back @ lens.T / back[:, 2:])[:, :2], np.stack([column + 0.5, row + 0.5], 1))


def test_a_scene_shows_the_same_surface_wherever_it_stands():
    here, there = (
        visible_points(_ball(1.0, place), 0.0, _directions(500) * [1, 1, 0.5] + [place, 0, 0]) - [place, 0, 0]
        for place in (0.0, 8.0)
    )
    for points in (here, there):
        assert np.abs(np.linalg.norm(points, axis=1) - 1).max() < 0.1
        # pixels of the ball in all pictures; its Gaussians' rim adds a tenth to its radius
        disk = 14 * np.pi * (SIDE / 2 / 1.4) ** 2
        assert disk < len(points) < 1.25 * disk
    assert len(here) == pytest.approx(len(there), rel=1e-3)


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_a_surface_has_the_same_errors_in_any_unit(unit):
    one, other = (
        surface_score(_ball(size), np.tile(_directions(500) * size, (2, 1, 1)), np.arange(2)) for size in (1, unit)
    )
    assert other.unseen == 0 and other.f_score == pytest.approx(one.f_score, abs=1e-3)
    assert other.chamfer / unit == pytest.approx(one.chamfer, rel=1e-3)
