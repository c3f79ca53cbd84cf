"""Hinges by where two parts touch: flaps whose half-turns look alike, in motions that may be wrong."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.ops.rotations import axis_rotation
from dpcli.segment.kinematics.contact_hinge import contact_hinge
from dpcli.segment.multibody.explanation import body_of, label_points
from dpcli.segment.multibody.frames import Frames, relative_motion
from dpcli.segment.multibody.joint_motions import simplify_motions
from dpcli.segment.multibody.settings import MultibodySettings
from dpcli.segment.rigid_motions import compose

WIDTH, DEPTH, HEIGHT, FLAP = 0.5, 0.4, 0.3, 0.25
EDGE = np.array([0.0, 0.0, HEIGHT])  # the hinge runs along y through it
SPACING = 0.04


def body(rng, count=600):
    """Points on the five walls of an open box."""
    point, wall = rng.random((count, 3)), rng.integers(0, 5, count)
    for k, (axis, value) in enumerate([(0, 0), (0, 1), (1, 0), (1, 1), (2, 0)]):
        point[wall == k, axis] = value
    return point * [WIDTH, DEPTH, HEIGHT]


def flap(rng, angle, count=80):
    """Points on a flap that is hinged at the box's edge x = 0; angle 0 shuts it, further turns open it outwards."""
    flat = np.stack([rng.random(count) * FLAP, rng.random(count) * DEPTH, np.zeros(count)], 1)
    return flat @ axis_rotation(np.array([0.0, -1.0, 0.0]), np.array([angle]))[0].T + EDGE


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 99), st.lists(st.floats(0.4, 3.6), min_size=3, max_size=5).filter(lambda a: np.ptp(a) > 0.8))
def test_a_flap_s_hinge_is_where_it_keeps_touching(seed, angles):
    rng = np.random.default_rng(seed)
    found = contact_hinge([flap(rng, a) for a in angles], [body(rng) for _ in angles], SPACING)
    assert abs(found.axis @ [0, 1, 0]) > np.cos(np.radians(20))
    off = found.point - EDGE
    assert np.hypot(off[0], off[2]) < 2 * SPACING
    value = found.value * np.sign(-found.axis[1])
    np.testing.assert_allclose(value, np.array(angles) - angles[0], atol=np.radians(20))


def test_parts_that_don_t_keep_touching_have_none():
    rng = np.random.default_rng(0)
    bodies = [body(rng) for _ in range(3)]
    away = [flap(rng, 1.0) + [0, 0, 0.2 * t] for t in range(3)]
    assert contact_hinge(away, bodies, SPACING) is None
    assert contact_hinge([flap(rng, 1.0), np.zeros((0, 3)), flap(rng, 2.0)], bodies, SPACING) is None
    assert contact_hinge([flap(rng, 1.0)[:1]] * 3, bodies, SPACING) is None


@pytest.mark.parametrize("about", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)])  # the flap's normal, and along its hinge
def test_half_turns_that_the_points_can_t_tell_are_told_by_the_hinge(about):
    """The flap is explained by another half-turn in its last two frames; its points fit as well."""
    rng, angles = np.random.default_rng(3), np.array([0.5, 1.1, 2.0, 2.7])
    turns = axis_rotation(np.array([0.0, -1.0, 0.0]), angles)
    true = np.concatenate([turns, (EDGE - turns @ EDGE)[..., None]], 2)  # of a flap that is shut at rest
    middle = EDGE + [FLAP / 2, DEPTH / 2, 0]
    half = axis_rotation(np.array(about), np.array([np.pi]))[0]
    flip = np.concatenate([half, (middle - half @ middle)[:, None]], 1)
    said = np.stack([*true[:2], *(compose(motion, flip) for motion in true[2:])])
    clouds = [np.float32(np.concatenate([body(rng), flap(rng, angle)])) for angle in angles]
    label = np.tile(np.repeat([0, 1], [600, 80]), 4)
    frames = Frames(clouds)
    motions = [np.tile(np.eye(3, 4), (4, 1, 1)), said]
    found = label_points(frames, [body_of(frames, m) for m in motions], MultibodySettings(), label)
    found.label = label
    after = simplify_motions(frames, found).bodies[1].trajectory
    for t in range(1, 4):
        off = relative_motion(after, 0, t)[:, :3].T @ relative_motion(true, 0, t)[:, :3]
        assert np.degrees(np.arccos(np.clip((np.trace(off) - 1) / 2, -1, 1))) < 8
