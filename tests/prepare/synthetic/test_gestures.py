"""Synthetic gestures: the virtual camera against brute force, the figure's bones, pairs that only time tells apart."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import ks_2samp

from dpcli.errors import UsageError
from dpcli.prepare.decode.pinhole_camera import Intrinsics
from dpcli.prepare.synthetic.gestures import (
    CLASS_NAMES,
    SyntheticGestures,
    draw_subject,
    time_warp,
    to_camera,
    wrist_path,
)
from dpcli.prepare.synthetic.human_figure import PARTS, Figure, bend_elbow, capsules
from dpcli.prepare.synthetic.virtual_depth_camera import add_noise, bounding_box, intersect, render
from dpcli.runtime.seeds import generator

CAMERA = Intrinsics(40.0, 40.0, 31.5, 23.5)


def distance_to_segment(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    axis = b - a
    s = np.clip((points - a) @ axis / max(axis @ axis, 1e-12), 0, 1)
    return np.linalg.norm(points - a - s[..., None] * axis, axis=-1)


def march(ray: np.ndarray, a: np.ndarray, b: np.ndarray, radius: float) -> float:
    """Sphere tracing: steps as long as the distance to the surface allows; inf when it passes by."""
    t, length = 0.0, np.linalg.norm(ray)
    for _ in range(4000):
        gap = distance_to_segment(t * ray, a, b) - radius
        if gap < 1e-9:
            return t
        t += gap / length
        if t > 20:
            break
    return np.inf


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_intersection_against_sphere_tracing(seed):
    rng = np.random.default_rng(seed)
    a = np.array([*rng.uniform(-1, 1, 2), rng.uniform(2, 4)])
    b = a + rng.normal(size=3) * rng.choice([0.8, 1e-3])
    radius = rng.uniform(0.1, 0.5)
    b[2] = max(b[2], 1.0)
    target = a + rng.uniform(0, 1) * (b - a) + rng.normal(size=3) * radius
    ray = np.array([target[0] / target[2], target[1] / target[2], 1.0]) if target[2] > 0.5 else np.array([0, 0, 1.0])
    found = float(intersect(ray[None], a, b, radius)[0])
    expected = march(ray, a, b, radius)
    closest = np.min(distance_to_segment(np.linspace(0, 8, 4001)[:, None] * ray, a, b)) - radius
    if abs(closest) > 1e-3:  # a ray that only grazes the surface may be told either way
        assert np.isfinite(found) == np.isfinite(expected)
    if np.isfinite(found) and np.isfinite(expected):
        assert found == pytest.approx(expected, abs=2e-3 if closest > -1e-3 else 2e-5)


def test_every_rendered_point_lies_on_the_capsule_of_its_part():
    figure = Figure()
    still = np.zeros((1, 3))
    right, left = (s + [[sign * 0.2, -0.3, 0.3]] for s, sign in zip(figure.shoulders(), (1, -1), strict=True))
    starts, ends = (to_camera(p[0], 0.3, np.array([0.1, 1.0, 2.5])) for p in capsules(figure, right + still, left))
    depth, part = render(starts, ends, figure.radii, Intrinsics(80.0, 80.0, 63.5, 47.5), 96, 128)
    rows, columns = np.nonzero(np.isfinite(depth))
    z = depth[rows, columns].astype(float)
    points = np.stack([(columns - 63.5) / 80 * z, (rows - 47.5) / 80 * z, z], axis=1)
    assert len(points) > 400 and len(set(part[rows, columns])) == len(PARTS)
    gaps = np.array([distance_to_segment(points, a, b) for a, b in zip(starts, ends, strict=True)])
    gaps -= figure.radii[:, None]
    np.testing.assert_allclose(gaps[part[rows, columns], np.arange(len(points))], 0, atol=1e-5)
    assert gaps.min() > -1e-5  # nothing in front was overlooked: no point is inside another part
    assert (part[~np.isfinite(depth)] == -1).all()


@given(st.integers(0, 2**32 - 1))
def test_bounding_boxes_hold_all_hits(seed):
    rng = np.random.default_rng(seed)
    a, b = np.array([0, 0, 3.0]) + rng.normal(size=(2, 3)) * [2, 2, 0.8]
    radius = rng.uniform(0.05, 0.6)
    if min(a[2], b[2]) < radius + 0.05:
        return
    rows, columns = bounding_box(a, b, radius, CAMERA, 48, 64)
    inside = np.zeros((48, 64), bool)
    inside[rows, columns] = True
    y, x = np.mgrid[:48, :64]
    rays = np.stack([(x - 31.5) / 40, (y - 23.5) / 40, np.ones((48, 64))], axis=-1)
    assert not (np.isfinite(intersect(rays, a, b, radius)) & ~inside).any()


@given(st.integers(0, 2**32 - 1))
def test_elbows_keep_the_bones_lengths(seed):
    rng = np.random.default_rng(seed)
    shoulder, wanted = rng.normal(size=3), rng.normal(size=(5, 3))
    elbow, wrist = bend_elbow(shoulder, wanted, 0.3, 0.25, np.array([0.5, -1, 0]))
    np.testing.assert_allclose(np.linalg.norm(elbow - shoulder, axis=1), 0.3, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(wrist - elbow, axis=1), 0.25, rtol=1e-4)
    reach = np.linalg.norm(wanted - shoulder, axis=1)
    possible = (reach > 0.0501) & (reach < 0.549)
    np.testing.assert_allclose(wrist[possible], wanted[possible], atol=1e-9)


def test_to_camera_is_rigid_and_faces_the_camera():
    figure_right, up, ahead = np.eye(3)
    place = np.array([0.0, 1.0, 2.5])
    origin = to_camera(np.zeros(3), 0.0, place)
    np.testing.assert_allclose(origin, [0, 1, 2.5])
    axes = np.stack([to_camera(v, 0.0, place) - origin for v in (figure_right, up, ahead)])
    np.testing.assert_allclose(axes, [[-1, 0, 0], [0, -1, 0], [0, 0, -1]])  # its right hand is on the image's left
    points = np.random.default_rng(0).normal(size=(6, 3))
    turned = to_camera(points, 0.7, place)
    gaps = np.linalg.norm(points[:, None] - points, axis=-1)
    np.testing.assert_allclose(np.linalg.norm(turned[:, None] - turned, axis=-1), gaps, atol=1e-12)


@pytest.mark.parametrize("movement", range(5))
def test_pairs_are_the_same_poses_in_opposite_order(movement):
    phase = np.linspace(0, 1, 9)
    forward, left = wrist_path(movement, phase, generator(3))
    backward, _ = wrist_path(movement, 1 - phase, generator(3))
    np.testing.assert_allclose(forward, backward[::-1])
    assert np.abs(forward - backward).max() > 0.3  # but the order matters
    assert (left is not None) == (movement == 4)
    assert np.linalg.norm(forward, axis=1).max() < 1.3


def test_what_the_classes_names_say():
    s = np.linspace(0, 1, 50)
    up = wrist_path(0, s, generator(0))[0]
    swipe = wrist_path(1, s, generator(0))[0]
    push = wrist_path(2, s, generator(0))[0]
    x, y, _ = wrist_path(3, s, generator(0))[0].T
    opening = wrist_path(4, s, generator(0))[0]
    assert up[-1, 1] > up[0, 1] + 1 and swipe[-1, 0] < swipe[0, 0] - 1 and push[-1, 2] > push[0, 2] + 0.3
    turn = np.sum((x[:-1] - x.mean()) * np.diff(y) - (y[:-1] - y.mean()) * np.diff(x))
    assert turn < 0  # clockwise seen from behind the figure: x right, y up
    assert opening[-1, 0] > opening[0, 0] + 0.5


def test_the_law_of_time_is_the_same_backwards():
    """Otherwise the rests at both ends would give the direction away."""
    warps = np.stack([time_warp(24, 0.3, generator(0, k)) for k in range(2000)])
    for frame in (3, 8, 12):
        assert ks_2samp(warps[:, frame], 1 - warps[:, 23 - frame]).pvalue > 1e-3
    skewed = warps**1.3
    assert ks_2samp(skewed[:, 12], 1 - skewed[:, 11]).pvalue < 1e-6  # the test sees a law that differs


def test_items_are_balanced_over_classes_subjects_and_splits():
    reader = SyntheticGestures(videos_per_class=20, subjects=10)
    items = reader.items()
    assert len({item.name for item in items}) == len(items) == 200
    for split, count in (("train", 12), ("test", 8)):
        labels = [item.label for item in items if item.split == split]
        assert np.bincount(labels).tolist() == [count] * len(CLASS_NAMES)
    subjects = {split: {i.subject for i in items if i.split == split} for split in ("train", "test")}
    assert subjects == {"train": set(range(1, 7)), "test": {7, 8, 9, 10}}


@pytest.mark.parametrize(
    "videos, train, words", [(2, 1, "1-1 of 2"), (5, 3, "1-3 of 5"), (10, 6, "1-6 of 10"), (1, 1, "all are")]
)
def test_fewer_videos_than_subjects_leave_some_to_test(videos, train, words):
    reader = SyntheticGestures(videos_per_class=videos, subjects=10)
    items = reader.items()
    seen = {split: {i.subject for i in items if i.split == split} for split in ("train", "test")}
    assert seen == {"train": set(range(1, train + 1)), "test": set(range(train + 1, videos + 1))}
    assert words in reader.summary(items)[0]


def test_a_video_depends_on_its_generator_and_the_seed_alone():
    reader = SyntheticGestures(frames=3, size=64)
    item = reader.items()[7]
    first, again = (reader.read(item, generator(0, 7)).sequence for _ in range(2))
    np.testing.assert_array_equal(first.points, again.points)
    other = reader.read(item, generator(0, 8)).sequence
    assert first.points.shape != other.points.shape or (first.points != other.points).any()
    assert draw_subject(0, 3) == draw_subject(0, 3) != draw_subject(1, 3)
    assert first.part.dtype == np.int16 and first.part.min() >= 0 and first.part.max() < len(PARTS)
    assert 1.2 < np.median(first.points[:, 2]) < 3.2  # meters in front of the camera


def test_noise_has_the_stated_law():
    depth = np.full(200_000, 2.4, np.float32)
    noisy = add_noise(depth, generator(0), 1.0, 0.25)
    assert np.mean(noisy == 0) == pytest.approx(0.25, abs=0.01)
    assert np.std(noisy[noisy > 0]) == pytest.approx(0.0012 + 0.0019 * 4, rel=0.02)
    np.testing.assert_array_equal(add_noise(depth, generator(0), 0.0, 0.0), depth)


def test_impossible_options():
    with pytest.raises(UsageError, match="--videos-per-class 0: expected 1 or more"):
        SyntheticGestures(videos_per_class=0)
    with pytest.raises(UsageError, match="--subjects 1"):
        SyntheticGestures(subjects=1)
