"""Errors of joints against numbers worked out by hand, whichever of two parts is called the child."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.evaluate.joints.metrics import JointStatistics, joint_statistics
from dpcli.evaluate.joints.protocol import joint_metrics
from dpcli.evaluate.joints.visibility import VISIBLE, joint_visibility
from dpcli.store import CloudSequence
from dpcli.store.joints import AXIS, FIXED, PARENT, POINT, PRISMATIC, REVOLUTE, TYPE, VALUE, no_joints

PART = np.repeat([0, 1, 2], 20)


def joints(*rows, frames=2):
    """The field of joints (child, parent, type, axis, point, values)."""
    field = no_joints(frames, 3)
    for child, parent, kind, axis, point, values in rows:
        field[:, child, PARENT], field[:, child, TYPE] = parent, kind
        field[:, child, AXIS], field[:, child, POINT], field[:, child, VALUE] = axis, point, values
    return field


TRUTH = joints((1, 0, REVOLUTE, (0, 0, 1), (1, 0, 0), (0.1, 0.6)), (2, 0, PRISMATIC, (1, 0, 0), (0, 0, 0), (0, 0.3)))


def test_an_exact_answer_has_no_error_also_turned_round_and_renamed():
    renamed = np.array([2, 0, 1])[PART]  # true 0 is predicted 2, and hangs on what was its child
    turned = no_joints(2, 3)
    turned[:, 2, PARENT], turned[:, 2, TYPE] = 0, REVOLUTE
    turned[:, 2, AXIS], turned[:, 2, POINT], turned[:, 2, VALUE] = (0, 0, -1), (1, 0, 5), (0, 0.5)
    turned[:, 1, PARENT], turned[:, 1, TYPE], turned[:, 1, AXIS], turned[:, 1, VALUE] = (
        2,
        PRISMATIC,
        (-1, 0, 0),
        (0, -0.3),
    )
    for part, field in ((PART, TRUTH), (renamed, turned)):
        found = joint_metrics([joint_statistics(PART, TRUTH, part, field)])
        assert (found["type"], found["edge_f1"], found["axis_within_5"]) == (1, 1, 1)
        assert [found[key] for key in ("axis_angle", "axis_position", "state_angle", "state_length")] == pytest.approx(
            [0, 0, 0, 0], abs=1e-6
        )


def test_errors_are_those_of_the_definition():
    tilt = np.radians(8)
    field = joints(
        (1, 0, REVOLUTE, (0, np.sin(tilt), np.cos(tilt)), (1.2, 0, 0), (0, 0.4)),
        (2, 1, PRISMATIC, (1, 0, 0), (0, 0, 0), (0, 0.3)),
    )
    found = joint_statistics(PART, TRUTH, PART, field)
    assert (found.joints, found.predicted, found.edges, found.types, found.axes, found.near) == (2, 2, 1, 1, 2, 0)
    assert found.angles == pytest.approx([8]) and found.distances == pytest.approx([0.2])
    assert found.turns == pytest.approx([np.degrees(0.1)]) and found.slides == []


@pytest.mark.parametrize("frames", [1, 2, 3, 8])
def test_frame_0_whose_value_is_0_by_definition_does_not_dilute_the_error(frames):
    turns, shifts = np.linspace(0, 1, frames), np.linspace(0, 0.3, frames)
    truth = joints(
        (1, 0, REVOLUTE, (0, 0, 1), (1, 0, 0), turns), (2, 0, PRISMATIC, (1, 0, 0), (0, 0, 0), shifts), frames=frames
    )
    off = truth.copy()
    off[1:, 1, VALUE] += np.radians(3)  # a constant error in every frame that has one
    off[1:, 2, VALUE] -= 0.05
    found = joint_statistics(PART, truth, PART, off)
    assert found.turns == pytest.approx([3] if frames > 1 else [])
    assert found.slides == pytest.approx([0.05] if frames > 1 else [])


def test_wrong_types_and_unmatched_parts_count_as_missed():
    wrong = joints((1, 0, FIXED, (0, 0, 0), (0, 0, 0), 0), (2, 0, PRISMATIC, (1, 0, 0), (0, 0, 0), (0, 0.1)))
    assert joint_statistics(PART, TRUTH, PART, wrong).types == 1
    merged = np.zeros(60, int)
    found = joint_statistics(PART, TRUTH, merged, no_joints(2, 3))
    assert (found.joints, found.edges, found.predicted) == (2, 0, 0)
    total = found + JointStatistics(joints=2, types=2)
    assert joint_metrics([total])["type"] == 0.5 and np.isnan(joint_metrics([found])["axis_angle"])


def test_joints_that_move_visibly_have_their_own_denominator():
    near = joints((1, 0, REVOLUTE, (0, 0, 1), (1, 0, 0), (0.1, 0.6)), (2, 0, FIXED, (0, 0, 0), (0, 0, 0), 0))
    found = joint_statistics(PART, TRUTH, PART, near, lambda child, parent: (child, parent) == (1, 0))
    assert (found.joints, found.types, found.near, found.axes) == (2, 1, 1, 2)
    assert (found.visible, found.visible_types, found.visible_near, found.visible_axes) == (1, 1, 1, 1)
    both = joint_metrics([found])
    assert (both["type"], both["visible_type"], both["visible_axis_within_5"]) == (0.5, 1, 1)
    assert np.isnan(joint_metrics([joint_statistics(PART, TRUTH, PART, near)])["visible_type"])


def test_a_motion_below_the_distance_between_points_is_not_visible():
    rng, pose = np.random.default_rng(0), np.tile(np.eye(4), (3, 3, 1, 1))
    pose[:, 1, 2, 3], pose[:, 2, 2, 3] = (0, 0.3, 0.6), (0, 0.004, 0.008)
    clouds = [rng.uniform(0, 1, (300, 3)) * (1, 1, 0) + pose[t, PART[::5].repeat(25), :3, 3] for t in range(3)]
    part = [PART[::5].repeat(25).astype(np.int16)] * 3
    truth = CloudSequence.from_frames("sheets", [cloud.astype(np.float32) for cloud in clouds], part=part)
    assert joint_visibility(truth, pose, 1, 0) > 2 * VISIBLE
    assert 0.9 < joint_visibility(truth, pose, 2, 0) < 1.15
    with pytest.raises(DataError, match="poses of 2 parts"):
        joint_visibility(truth, pose[:, :2], 2, 0)
