"""Axes by the points of both parts: a tilted hinge comes right, an exact one and other types stay as they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpcli.segment.kinematics.joint_fit import JointFit, joint_motion
from dpcli.segment.kinematics.part_trajectories import Trajectories
from dpcli.segment.multibody.axis_choice import SeenParts
from dpcli.store import CloudSequence
from dpcli.store.joints import FREE, REVOLUTE

ANGLES = np.linspace(0, 0.9, 4)
TRUTH = JointFit(REVOLUTE, np.array([0.0, 0, 1]), np.array([0.3, 0.3, 0]), ANGLES, 0.0)
DIRECTIONS = np.eye(3)


@pytest.fixture(scope="module")
def seen() -> SeenParts:
    """A box and a door that turns about its edge, drawn anew in every frame, 200 points each; the box's motion is known."""
    rng, clouds, motion = np.random.default_rng(0), [], joint_motion(REVOLUTE, TRUTH.axis, TRUTH.point, ANGLES)
    for door in motion:
        box = rng.uniform(-0.3, 0.3, (200, 3))
        side = rng.integers(0, 3, 200)
        box[np.arange(200), side] = rng.choice([-0.3, 0.3], 200)
        plate = rng.uniform(-0.3, 0.3, (200, 3)) * (1, 0, 0.8) + (0, 0.32, 0)
        clouds.append(np.concatenate([box, plate @ door[:3, :3].T + door[:3, 3]]).astype(np.float32))
    sequence = CloudSequence.from_frames("door", clouds, part=[np.repeat([0, 1], 200).astype(np.int16)] * 4)
    both = np.stack([np.tile(np.eye(4), (4, 1, 1)), motion], 1)
    return SeenParts(sequence, Trajectories(np.arange(2), both, np.ones((4, 2), bool), np.zeros(2)))


def test_a_tilted_hinge_comes_right_and_an_exact_one_stays(seen):
    tilted = Rotation.from_rotvec([np.radians(12), 0, 0]).apply(TRUTH.axis)
    found = seen.with_axis(0, 1, replace(TRUTH, axis=tilted), DIRECTIONS)
    assert abs(found.axis @ TRUTH.axis) == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(found.value, ANGLES, atol=0.05)
    assert np.linalg.norm(np.cross(found.point - TRUTH.point, TRUTH.axis)) < 0.03
    turned = seen.with_axis(0, 1, replace(TRUTH, axis=-tilted, value=-ANGLES), DIRECTIONS)
    np.testing.assert_allclose(turned.value * (turned.axis @ TRUTH.axis), ANGLES, atol=0.05)
    assert seen.with_axis(0, 1, TRUTH, DIRECTIONS) is TRUTH


def test_other_types_and_clouds_of_few_points_stay_as_they_are(seen):
    free = replace(TRUTH, kind=FREE)
    assert seen.with_axis(0, 1, free, DIRECTIONS) is free
    few = CloudSequence.from_frames("few", [np.eye(3, dtype=np.float32)] * 2, part=[np.array([0, 0, 1], np.int16)] * 2)
    still = Trajectories(np.arange(2), np.tile(np.eye(4), (2, 2, 1, 1)), np.ones((2, 2), bool), np.zeros(2))
    hinge = replace(TRUTH, value=ANGLES[:2])
    assert SeenParts(few, still).with_axis(0, 1, hinge, DIRECTIONS) is hinge
