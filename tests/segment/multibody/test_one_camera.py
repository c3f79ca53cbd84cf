"""What one camera sees: points that turned out of its sight, and where it stood."""

from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpcli.segment.multibody.explanation import Explanation
from dpcli.segment.multibody.frames import Frames
from dpcli.segment.multibody.hypotheses import find_hypotheses
from dpcli.segment.multibody.search import Search, explain_sequence
from dpcli.segment.multibody.settings import MultibodySettings
from dpcli.segment.multibody.viewpoint import find_camera
from dpcli.segment.multibody.visibility import DepthMap

HALF = np.array([0.3, 0.2, 0.25])
EYE = np.array([0.0, 0.0, -3.0])


def turning_box(seed: int, *, all_sides: bool = False) -> list[np.ndarray]:
    """Returns four frames f32 (500,3), about the origin, of a box that turns by 25 degrees a frame, as a camera at EYE sees it."""
    rng = np.random.default_rng(seed)
    axis, first, clouds = rng.normal(size=3), Rotation.random(random_state=seed), []
    area = np.repeat(HALF.prod() / HALF, 2)
    for t in range(4):
        turn = Rotation.from_rotvec(np.radians(25) * t * axis / np.linalg.norm(axis)) * first
        side = rng.choice(6, 10000, p=area / area.sum())
        normals = np.eye(3)[side // 2] * np.where(side % 2, 1, -1)[:, None]
        points = np.where(normals == 0, rng.uniform(-1, 1, (len(side), 3)), normals) * HALF
        points, away = turn.apply(points), turn.apply(points) - EYE
        seen = -(turn.apply(normals) * away).sum(1) / np.linalg.norm(away, axis=1) ** 3  # pixels of a piece of surface
        points = points[all_sides | (rng.random(len(side)) < 2 * seen)]
        clouds.append(points[rng.permutation(len(points))[:500]].astype(np.float32))
    return clouds


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_sides_that_turn_out_of_sight_are_no_parts(seed):
    found = explain_sequence(turning_box(seed), MultibodySettings(), EYE)
    assert len(found.bodies) == 1  # two or three without the camera


@lru_cache(maxsize=2)
def explained(seed: int, all_sides: bool) -> tuple[Frames, Explanation]:
    """The frames of a turning box, and the first explanation of them, which knows no camera."""
    frames = Frames(turning_box(seed, all_sides=all_sides))
    return frames, Search(frames, MultibodySettings(), find_hypotheses(frames)).begin()


def camera_of(origin: np.ndarray, seed: int = 5, all_sides: bool = False) -> np.ndarray | None:
    return find_camera(*explained(seed, all_sides), origin)


def test_a_camera_is_found_within_20_degrees_if_the_clouds_show_one_side():
    camera = camera_of(np.zeros(3))
    eye = -camera[:, :3].T @ camera[:, 3]
    assert eye @ EYE / np.linalg.norm(eye) / np.linalg.norm(EYE) > np.cos(np.radians(20))
    np.testing.assert_allclose(camera[:, :3] @ camera[:, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera[:, :3]) == pytest.approx(1)


@pytest.mark.parametrize("origin", [np.zeros(3), EYE, np.full(3, 1e9)], ids=["amid", "outside", "far"])
def test_clouds_of_all_sides_have_no_camera(origin):
    assert camera_of(origin, all_sides=True) is None


def test_the_camera_at_the_origin_is_taken_as_it_is():
    camera = camera_of(EYE)
    np.testing.assert_allclose(-camera[:, :3].T @ camera[:, 3], EYE, atol=1e-9)


def test_depths_and_hidden_points_equal_a_search_by_exhaustion():
    rng = np.random.default_rng(0)
    points, asked = rng.normal(0, 0.2, (300, 3)), rng.normal(0, 0.3, (400, 3))
    camera = np.concatenate([Rotation.random(random_state=1).as_matrix(), [[0.1], [-0.2], [2.0]]], 1)
    seen = DepthMap.of(points, camera, 0.05)

    def cells(cloud):
        place = cloud @ camera[:, :3].T + camera[:, 3]
        return np.floor(place[:, 1::-1] / place[:, 2:] * seen.per_cell).astype(int), place[:, 2]

    (drawn, depths), (cell, depth) = cells(points), cells(asked)
    apart = np.abs(cell[:, None] - drawn[None]).max(2)
    far = np.where(apart <= 1, depths, -np.inf).max(1)
    near = np.where(apart == 0, depths, np.inf).min(1)
    for got, expected in zip(seen.look(asked), (depth, far, near), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-6)
    motion = np.concatenate([Rotation.random(random_state=2).as_matrix(), [[0.05], [0.0], [0.1]]], 1)
    before = ((asked - motion[:, 3]) @ motion[:, :3]).astype(np.float32)  # so that the motion takes them to `asked`
    cost, nearest = rng.random(400).astype(np.float32), np.zeros(400, np.int32)
    hidden = np.isfinite(far) & (depth > far + seen.margin) & (cost > 0.5)
    expected = np.where(hidden, 0.5, cost), np.where(hidden, 7 + np.arange(400), 0)
    seen.hide(np.ascontiguousarray(before.T), motion, 7, cost, nearest)
    assert 20 < hidden.sum() < 300
    sure = np.abs(depth - far - seen.margin) > 1e-5
    np.testing.assert_array_equal(cost[sure], expected[0][sure].astype(np.float32))
    np.testing.assert_array_equal(nearest[sure], expected[1][sure])


def test_a_frame_behind_the_camera_hides_nothing():
    camera = np.concatenate([np.eye(3), [[0.0], [0.0], [-5.0]]], 1)
    seen = DepthMap.of(np.random.default_rng(0).normal(0, 0.2, (50, 3)), camera, 0.05)
    depth, far, near = seen.look(np.zeros((3, 3)))
    assert (depth == -5).all() and np.isneginf(far).all() and np.isposinf(near).all()
