"""Rigid parts found on the motion of a whole clip: how many, whose they are, and whose word counts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpcli.generate4d.scene.seen_gaussians import trust
from dpcli.ops.cameras import DEFAULT_FOVY, orbit_pose, pinhole
from dpcli.ops.rigid_parts import _sums, find_parts

FRAMES, POINTS = 12, 300


def animal(swing: float = 0.5, noise: float = 0.001) -> tuple[np.ndarray, np.ndarray]:
    """A trunk that bobs with two legs that swing against each other from its ends: places (T,N,3), parts (N)."""
    rng = np.random.default_rng(0)
    trunk = rng.uniform(-1, 1, (POINTS, 3)) * [0.5, 0.12, 0.12]
    leg = rng.uniform(-1, 1, (2, POINTS, 3)) * [0.06, 0.2, 0.06] - [0, 0.3, 0]
    frames = []
    for phase in np.linspace(0, 2 * np.pi, FRAMES):
        turned = []
        for points, side in zip(leg, (-1, 1)):
            c, s = np.cos(side * swing * np.sin(phase)), np.sin(side * swing * np.sin(phase))
            turned.append(points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + [side * 0.4, 0, 0])
        frames.append(np.concatenate([trunk, *turned]) + [0, 0.03 * np.cos(phase), 0])
    places = np.stack(frames)
    return places + noise * rng.standard_normal(places.shape), np.repeat([0, 1, 2], POINTS)


def agree(found: np.ndarray, truth: np.ndarray) -> float:
    """The share of points whose part is the one that most of their true part's points have."""
    return np.mean([(found[truth == k] == np.bincount(found[truth == k]).argmax()).mean() for k in np.unique(truth)])


@pytest.mark.parametrize("noise", [0.0, 0.004])
def test_as_many_parts_as_move(noise):
    places, truth = animal(noise=noise)
    found = find_parts(places, np.ones(len(truth), bool), 16)
    assert len(np.unique(found)) == 3 and agree(found, truth) > 0.9


@pytest.mark.parametrize("noise", [0.0, 0.001])
@pytest.mark.parametrize("each", [5, 12, 60])
def test_few_points_such_as_markers(each, noise):
    places, truth = animal(noise=noise)
    pick = np.concatenate([np.flatnonzero(truth == k)[:each] for k in range(3)])
    found = find_parts(places[:, pick], np.ones(len(pick), bool), 16, patches=300, softness=1.0)
    assert 3 <= len(np.unique(found)) <= 4 and agree(found, truth[pick]) > 0.9
    still = np.repeat(places[:1, pick], FRAMES, 0)
    assert not find_parts(still, np.ones(len(pick), bool), 16, patches=300).any()


def test_no_more_than_asked_for_and_one_where_nothing_moves():
    places, truth = animal()
    every = np.ones(len(truth), bool)
    assert [len(np.unique(find_parts(places, every, most))) for most in (1, 2, 3)] == [1, 2, 3]
    assert not find_parts(np.repeat(places[:1], FRAMES, 0), every, 16).any()
    turned = places[:1] @ np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], float) + 3  # rigid as a whole
    assert not find_parts(np.concatenate([places[:1], turned]), every, 16).any()
    assert not find_parts(places[:1], every, 16).any() and not find_parts(places[:, :5], every[:5], 16).any()


def test_two_bodies_that_never_touch_join_only_when_they_must():
    places, truth = animal()
    pair = truth > 0
    assert agree(find_parts(places[:, pair], np.ones(2 * POINTS, bool), 2), truth[pair]) == 1
    assert not find_parts(places[:, pair], np.ones(2 * POINTS, bool), 1).any()


def test_what_no_camera_sees_has_no_say():
    """A shut door and one that opens, and behind both a wall that bulges as it likes, which makes no parts of its own."""
    x, y = (value.ravel() for value in np.meshgrid(np.linspace(-0.6, 0.6, 48), np.linspace(-0.3, 0.3, 24)))
    truth, frames = (x > 0).astype(int), []
    for time in range(FRAMES):
        angle = -0.06 * time * truth
        wall = [0.8 * x, 0.8 * y, -0.5 + 0.2 * np.sin(time) * np.sin(9 * x) * np.cos(7 * y)]
        frames.append(np.concatenate([np.stack([x * np.cos(angle), y, -x * np.sin(angle)], 1), np.stack(wall, 1)]))
    places, solid = np.stack(frames), np.ones(2 * len(truth), bool)
    trusted = trust(places, solid, orbit_pose(0.0, 0.0)[None], pinhole(DEFAULT_FOVY, 64, 64)[None], (64, 64))
    assert trusted[: len(truth)].all() and not trusted[len(truth) :].any()
    found = find_parts(places, trusted, 16)
    assert len(np.unique(found)) == 2 and agree(found[: len(truth)], truth) > 0.95
    assert len(np.unique(find_parts(places, solid, 16))) > 2


def test_points_that_are_not_trusted_go_with_the_one_that_stays_nearest():
    places, truth = animal()
    trusted = np.random.default_rng(1).random(len(truth)) < 0.5
    found = find_parts(places, trusted, 16)
    apart = np.linalg.norm(places[:, ~trusted, None] - places[:, None, trusted], axis=3)
    nearest = found[trusted][np.square(apart).sum(0).argmin(1)]
    assert (found[~trusted] == nearest).mean() > 0.98 and agree(found[~trusted], truth[~trusted]) > 0.9


def test_joining_costs_what_the_best_rigid_motions_leave_of_the_union():
    rng = np.random.default_rng(0)
    own, weights, patch = rng.normal(size=(5, 40, 3)), rng.uniform(0.1, 1, (5, 40)), rng.integers(0, 3, 40)
    own[1] = own[0] * [1, 1, -1]  # a mirror image, which is no motion
    sums = _sums(own, weights, patch)
    sets = [patch == 0, patch == 1, patch == 2, patch < 2, patch < 3]
    unions = [*(sums.pick([k]) for k in range(3)), sums.pick([0]).plus(sums.pick([1])), sums.whole()]
    for inside, union in zip(sets, unions):
        left = []
        for places, share in zip(own[:, inside], weights[:, inside]):
            x, y = (side - np.average(side, 0, share) for side in (own[0, inside], places))
            left.append(Rotation.align_vectors(y, x, share)[1] ** 2)
        extent = weights[0, inside] @ np.square(own[0, inside] - np.average(own[0, inside], 0, weights[0, inside])).sum(
            1
        )
        for compact in (0.0, 0.7):
            assert union.cost(compact) == pytest.approx([np.mean(left) + compact * extent])


def test_faint_points_have_no_say_and_all_have_where_few_are_seen():
    places, truth = animal()
    solid = truth != 1
    pose, lens = orbit_pose(0.0, 0.0)[None], pinhole(DEFAULT_FOVY, 64, 64)[None]
    assert not trust(places, solid, pose, lens, (64, 64))[~solid].any()
    deep = np.concatenate([places + [0, 0, -2.0 * k] for k in range(12)], 1)  # one stands before all others
    assert trust(deep, np.ones(deep.shape[1], bool), pose, lens, (64, 64)).all()
    assert trust(places, np.zeros(len(truth), bool), pose, lens, (64, 64)).any()
