"""Errors of joints against numbers worked out by hand, whichever of two parts is called the child."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from dpcli.errors import DataError
from dpcli.evaluate.joints.metrics import JointStatistics, joint_statistics
from dpcli.evaluate.joints.protocol import joint_metrics
from dpcli.evaluate.joints.visibility import VISIBLE, joint_visibility
from dpcli.store import CloudSequence
from dpcli.store.joints import AXIS, FIXED, FREE, PARENT, POINT, PRISMATIC, REVOLUTE, TYPE, VALUE, no_joints

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
        found = joint_metrics(joint_statistics(PART, TRUTH, part, field))
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
    for own, edges in ((9, 1), (10, 2)):  # of the 20 points of part 1; at IoU 0.5 it is found
        assert joint_statistics(PART, TRUTH, np.repeat([0, 1, 2], [20, own, 40 - own]), TRUTH).edges == edges
    merged = np.zeros(60, int)
    found = joint_statistics(PART, TRUTH, merged, no_joints(2, 3))
    assert (found.joints, found.edges, found.predicted) == (2, 0, 0)
    total = found + JointStatistics(joints=2, types=2)
    assert joint_metrics(total)["type"] == 0.5 and np.isnan(joint_metrics(found)["axis_angle"])


def test_joints_that_move_visibly_have_their_own_denominator():
    near = joints((1, 0, REVOLUTE, (0, 0, 1), (1, 0, 0), (0.1, 0.6)), (2, 0, FIXED, (0, 0, 0), (0, 0, 0), 0))
    found = joint_statistics(PART, TRUTH, PART, near, lambda child, parent: (child, parent) == (1, 0))
    assert (found.joints, found.types, found.near, found.axes) == (2, 1, 1, 2)
    assert (found.visible, found.visible_types, found.visible_near, found.visible_axes) == (1, 1, 1, 1)
    both = joint_metrics(found)
    assert (both["type"], both["visible_type"], both["visible_axis_within_5"]) == (0.5, 1, 1)
    assert np.isnan(joint_metrics(joint_statistics(PART, TRUTH, PART, near))["visible_type"])


def test_a_motion_below_the_distance_between_points_is_not_visible():
    rng, pose = np.random.default_rng(0), np.tile(np.eye(4), (3, 3, 1, 1))
    pose[:, 1, 2, 3], pose[:, 2, 2, 3] = (0, 0.3, 0.6), (0, 0.004, 0.008)
    clouds = [rng.uniform(0, 1, (300, 3)) * (1, 1, 0) + pose[t, PART[::5].repeat(25), :3, 3] for t in range(3)]
    part = [PART[::5].repeat(25).astype(np.int16)] * 3
    truth = CloudSequence.from_frames("sheets", [cloud.astype(np.float32) for cloud in clouds], part=part)
    assert joint_visibility(truth, pose, 1, 0) > 2 * VISIBLE
    assert 0.9 < joint_visibility(truth, pose, 2, 0) < 1.15
    for count, seen in ((4, False), (5, True)):  # a child of fewer points shows no motion
        few = [np.concatenate([own[:200], own[200 : 200 + count]]) for own in part]
        held = [np.concatenate([cloud[:200], cloud[200 : 200 + count]]) for cloud in clouds]
        short = CloudSequence.from_frames("few", [own.astype(np.float32) for own in held], part=few)
        assert (joint_visibility(short, pose, 2, 0) > 0) == seen
    with pytest.raises(DataError, match="poses of 2 parts"):
        joint_visibility(truth, pose[:, :2], 2, 0)


def unit(rng: np.random.Generator) -> np.ndarray:
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)


def gap_of_lines(point, axis, other, along) -> float:
    """The least distance of two lines, from the places on them that solve for it."""
    sides = np.stack([axis, -along], 1)
    return float(np.linalg.norm(sides @ np.linalg.lstsq(sides, other - point)[0] - (other - point)))


def rerooted(field: np.ndarray, root: int) -> np.ndarray:
    """The same joints, hung up at another part: on the way from it to the old root, child and parent change places."""
    made, child = field.copy(), root
    made[:, root] = no_joints(len(field), 1)[:, 0]
    while (parent := int(field[0, child, PARENT])) >= 0:
        made[:, parent] = field[:, child]
        made[:, parent, PARENT], made[:, parent, VALUE] = child, -field[:, child, VALUE]
        child = parent
    return made


@settings(max_examples=60)
@given(st.integers(0, 10**6))
def test_any_tree_is_measured_by_its_motions(seed):
    rng, parts, frames = np.random.default_rng(seed), 5, 4
    truth, guess, expected = no_joints(frames, parts), no_joints(frames, parts), JointStatistics(joints=parts - 1)
    moving = set(rng.permutation(parts)[:3].tolist())
    for child in range(1, parts):
        kinds = rng.choice([REVOLUTE, PRISMATIC, FIXED, FREE], 2)
        kinds[1] = kinds[0] if rng.random() < 0.6 else kinds[1]
        axis, point, value = unit(rng), rng.normal(size=3), rng.uniform(-9, 9, frames)
        angle, side = rng.choice([0.0, 4.9, 5.1, 60]), rng.choice([1, -1])
        across = np.linalg.svd(axis[None])[2][1]
        other = side * Rotation.from_rotvec(np.radians(angle) * across).apply(axis)
        place, found = rng.normal(size=3), rng.uniform(-9, 9, frames)
        parent = rng.integers(child)
        for field, kind, numbers in ((truth, kinds[0], (axis, point, value)), (guess, kinds[1], (other, place, found))):
            moves = kind in (REVOLUTE, PRISMATIC)
            field[:, child, PARENT], field[:, child, TYPE] = parent, kind
            for key, number in zip((AXIS, POINT, VALUE), numbers):
                field[:, child, key] = number if moves else 0
        right, moves = kinds[0] == kinds[1], kinds[0] in (REVOLUTE, PRISMATIC)
        near = bool(right and moves and angle <= 5)
        expected += JointStatistics(0, 1, 1, right, moves, near)
        if child in moving:
            expected += JointStatistics(visible=1, visible_types=right, visible_axes=moves, visible_near=near)
        if right and moves:
            expected.angles.append(angle)
            turned, shifted = ((x[:, None] * a - x[0] * a)[1:] for x, a in ((value, axis), (found, side * axis)))
        if right and kinds[0] == REVOLUTE:
            expected.distances.append(gap_of_lines(point, axis, place, other))
            apart = Rotation.from_rotvec(turned) * Rotation.from_rotvec(shifted).inv()
            expected.turns.append(np.degrees(apart.magnitude()).mean())
        elif right and moves:
            expected.slides.append(np.linalg.norm(turned - shifted, axis=1).mean())
    # true part k is predicted name[k]
    part, name = (rng.permutation(np.repeat(np.arange(parts), 9)), rng.permutation(parts))
    guess = rerooted(guess, int(rng.integers(parts)))[:, np.argsort(name)]
    guess[..., PARENT] = np.where(guess[..., PARENT] < 0, -1, name[guess[..., PARENT].astype(int)])
    found = joint_statistics(part, truth, name[part], guess, lambda child, parent: child in moving)
    for key, own in vars(expected).items():
        assert np.sort(np.atleast_1d(getattr(found, key))) == pytest.approx(np.sort(np.atleast_1d(own)), abs=1e-5), key


def test_how_far_a_joint_takes_its_child_is_measured_by_all_distances():
    rng = np.random.default_rng(1)
    pose = np.tile(np.eye(4), (4, 2, 1, 1))
    pose[..., :3, :3] = Rotation.random(8, random_state=1).as_matrix().reshape(4, 2, 3, 3)
    pose[..., :3, 3] = rng.normal(size=(4, 2, 3))
    own = [(rng.normal(size=(30, 3)), rng.normal(size=(7, 3)) + 4) for _ in range(4)]
    parts = np.repeat([0, 1], [30, 7]).astype(np.int16)
    clouds = [
        np.concatenate([x @ m[:3, :3].T + m[:3, 3] for x, m in zip(two, at)]).astype(np.float32)
        for two, at in zip(own, pose)
    ]
    truth = CloudSequence.from_frames("two", clouds, part=[parts] * 4)
    expected = []
    for child in (0, 1):
        ratios = []
        for source in range(4):
            for target in set(range(4)) - {source}:
                here = np.append(clouds[source][parts == child], np.ones(((parts == child).sum(), 1)), 1)
                carried = [
                    (here @ (pose[target, k] @ np.linalg.inv(pose[source, k])).T)[:, :3] for k in (child, 1 - child)
                ]
                near, far = (cdist(x, clouds[target]).min(1).sum() for x in carried)
                ratios.append(far / near)
        expected.append(max(ratios))
    assert [joint_visibility(truth, pose, child, 1 - child) for child in (0, 1)] == pytest.approx(expected, rel=1e-4)
