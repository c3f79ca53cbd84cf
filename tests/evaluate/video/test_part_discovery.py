"""Part discovery and surface tracks: scikit-learn, rigid motions carried exactly, hand-made scenes, broken twins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.evaluate.video.part_discovery import (
    PART_NEIGHBORS,
    SOLID,
    TRACK_NEIGHBORS,
    _kmeans_parts,
    carry_points,
    nearest_gaussians,
    part_score,
    surface_parts,
    track_score,
)
from dpcli.store.gaussians import GaussianScene
from tests.support.scenes import toy_scene


def surface(scene: GaussianScene, count: int = 400, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Points near the scene's Gaussians at the first frame, f64 (M,3), and the part of each."""
    rng = np.random.default_rng(seed)
    chosen = rng.integers(0, scene.num_gaussians, count)
    return scene.frame_mean[0, chosen] + rng.normal(0, 0.002, (count, 3)), scene.part[chosen].astype(int)


def true_track(scene: GaussianScene, points: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Points moved by their part's own motion, f64 (T,M,3); the first frame's motion is the identity."""
    motion = scene.part_motion[:, part].astype(np.float64)
    return np.einsum("tmij,mj->tmi", motion[..., :3, :3], points) + motion[..., :3, 3]


def test_attach_takes_the_nearest_and_a_point_on_a_gaussian_has_it_alone() -> None:
    rng = np.random.default_rng(0)
    means, points, opacity = rng.normal(size=(60, 3)), rng.normal(size=(30, 3)), rng.uniform(0.2, 1, 60)
    points[0] = means[17]
    index, weight = nearest_gaussians(points, means, opacity, 4)
    distance = np.linalg.norm(points[:, None] - means, axis=-1)
    assert np.array_equal(index, np.argsort(distance, 1)[:, :4])  # brute force
    near = np.take_along_axis(distance, index, 1)[1:]
    expected = opacity[index[1:]] / near
    assert np.allclose(weight[1:], expected / expected.sum(1, keepdims=True)) and np.allclose(weight.sum(1), 1)
    assert index[0, 0] == 17 and weight[0, 0] > 1 - 1e-6


def test_attach_passes_by_faint_gaussians_unless_there_are_no_others() -> None:
    means, point = np.arange(12.0)[:, None] * [1, 0, 0], np.array([[0.2, 0, 0]])
    opacity = np.full(12, 0.9)
    opacity[:3] = 0.01
    assert sorted(nearest_gaussians(point, means, opacity, 4)[0][0]) == [3, 4, 5, 6]
    assert sorted(nearest_gaussians(point, means, np.full(12, 0.01), 4)[0][0]) == [0, 1, 2, 3]
    assert nearest_gaussians(point, means[:2], opacity[:2], 4)[0].shape == (1, 2)
    assert np.allclose(nearest_gaussians(point, means, np.zeros(12), 4)[1], 0.25)  # nothing is visible: no NaN


def test_the_scenes_own_parts_are_found() -> None:
    scene = toy_scene()
    points, part = surface(scene)
    score = part_score(scene, points, part, 0.0)
    assert score.ari > 0.97 and score.ari_one_part == 0  # points at the hinge lie between both
    assert (score.points, score.unknown, score.true_parts, score.discovered) == (400, 0, 2, 2)
    renamed = replace(scene, part=(1 - scene.part).astype(np.int16))
    assert part_score(renamed, points, part, 0.0).ari == score.ari


def test_wrong_parts_score_low_and_unknown_points_are_left_out() -> None:
    scene = toy_scene()
    points, part = surface(scene)
    rng = np.random.default_rng(0)
    shuffled = replace(scene, part=rng.permutation(scene.part))
    assert abs(part_score(shuffled, points, part, 0.0).ari) < 0.2
    single = replace(scene, part=np.zeros_like(scene.part))
    assert part_score(single, points, part, 0.0).ari == 0 and part_score(single, points, part, 0.0).discovered == 1
    part[:100] = -1
    score = part_score(scene, points, part, 0.0)
    assert (score.points, score.unknown) == (300, 100) and score.ari > 0.97
    with pytest.raises(DataError, match="no surface point"):
        part_score(scene, points, np.full(400, -1), 0.0)


def test_kmeans_splits_two_boxes_and_depends_on_the_seed_only() -> None:
    scene = toy_scene()
    points, part = surface(scene)
    scores = [part_score(scene, points, part, 0.0, seed=1).ari_kmeans for _ in range(2)]
    assert scores[0] == scores[1] > 0.9  # two boxes side by side: positions alone tell them apart


def test_a_point_among_gaussians_without_part_has_none() -> None:
    scene = toy_scene()
    scene.part[:] = -1
    scene.part[0] = 1
    found = surface_parts(scene, scene.frame_mean[0].astype(np.float64), 0.0)
    assert found[0] == 1 and set(found) == {-1, 1} and (found == 1).sum() <= 8 * PART_NEIGHBORS


@pytest.mark.parametrize("seed", range(5))
def test_a_point_has_the_heaviest_part_of_its_neighbors_however_many_have_none(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = toy_scene()
    count, parts = scene.num_gaussians, scene.num_parts
    scene = replace(
        scene,
        part=np.where(rng.random(count) < 0.8, -1, rng.integers(0, parts, count)).astype(np.int16),
        opacity_logit=rng.uniform(-6, 3, count).astype(np.float32),
    )
    points = surface(scene, 60, seed)[0] + rng.normal(0, 0.1, (60, 3))
    solid, means = np.flatnonzero(scene.opacity >= SOLID), scene.at(float(scene.time[0]))[0]
    expected = []
    for point in points:
        apart = np.linalg.norm(means[solid] - point, axis=1)
        near = np.argsort(apart)[:PART_NEIGHBORS]
        weight = scene.opacity[solid[near]] / apart[near]
        votes = [weight[scene.part[solid[near]] == part].sum() for part in range(parts)]
        expected.append(int(np.argmax(votes)) if max(votes) > 0 else -1)
    assert surface_parts(scene, points, float(scene.time[0])).tolist() == expected and -1 in expected


def rigid_scene(rng: np.random.Generator, frames: int = 4) -> tuple[GaussianScene, np.ndarray]:
    """A scene that moves as one body by random rotations, and those motions f64 (T,4,4)."""
    from scipy.spatial.transform import Rotation

    scene = toy_scene(frames=frames)
    turns = Rotation.random(frames, random_state=rng)
    motion = np.tile(np.eye(4), (frames, 1, 1))
    motion[:, :3, :3], motion[:, :3, 3] = turns.as_matrix(), rng.normal(size=(frames, 3))
    means = np.einsum("tij,nj->tni", motion[:, :3, :3], scene.mean) + motion[:, None, :3, 3]
    quaternion = np.roll(turns.as_quat(), 1, axis=-1)[:, None]  # w first
    scene.frame_mean[:] = means
    scene.frame_quaternion[:] = np.broadcast_to(quaternion, scene.frame_quaternion.shape)
    return scene, motion


def test_points_of_a_rigid_scene_are_carried_exactly() -> None:
    rng = np.random.default_rng(11)
    scene, motion = rigid_scene(rng)
    local = rng.normal(size=(50, 3))  # far from any Gaussian, too
    truth = np.einsum("tij,mj->tmi", motion[:, :3, :3], local) + motion[:, None, :3, 3]
    assert np.abs(carry_points(scene, truth[0], scene.time) - truth).max() < 2e-5  # float32 quaternions
    score = track_score(scene, truth, scene.time)
    assert score.epe < 2e-5 < score.static and (score.points, score.frames) == (50, 3)
    frozen = replace(scene, frame_quaternion=np.tile(scene.frame_quaternion[:1], (4, 1, 1)))
    assert track_score(frozen, truth, scene.time).epe > 0.1  # without its turn a neighbor carries a point elsewhere


def test_tracks_of_the_toy_and_the_baseline_by_hand() -> None:
    scene = toy_scene()
    points, part = surface(scene)
    truth = true_track(scene, points, part)
    score = track_score(scene, truth, scene.time)
    static = np.linalg.norm(truth[1:] - truth[0], axis=-1).mean()
    assert score.static == pytest.approx(static) and score.epe < 0.02 * static
    assert score.diameter == pytest.approx(np.linalg.norm(points.max(0) - points.min(0)))
    still = replace(
        scene,
        frame_mean=np.tile(scene.frame_mean[:1], (5, 1, 1)),
        frame_quaternion=np.tile(scene.frame_quaternion[:1], (5, 1, 1)),
    )
    assert track_score(still, truth, scene.time).epe == pytest.approx(static)


def test_one_frame_has_no_tracks_and_no_points_are_an_error() -> None:
    scene = toy_scene()
    score = track_score(scene, np.zeros((1, 5, 3)), scene.time[:1])
    assert np.isnan(score.epe) and np.isnan(score.static) and score.frames == 0
    with pytest.raises(DataError, match="no surface points"):
        track_score(scene, np.zeros((5, 0, 3)), scene.time)


def test_fewer_gaussians_than_neighbors() -> None:
    scene = toy_scene(per_part=1)
    assert scene.num_gaussians == 2 < TRACK_NEIGHBORS
    points = scene.frame_mean[0].astype(np.float64)
    assert carry_points(scene, points, scene.time).shape == (5, 2, 3)
    assert list(surface_parts(scene, points, 0.0)) == [0, 1]


def test_any_seed_serves_k_means():
    points = np.random.default_rng(0).normal(size=(40, 3))
    assert len(np.unique(_kmeans_parts(points, 3, 2**40 + 1))) == 3
