"""Joints found between parts: hinges and slides of made objects with their true motions, and poor input."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.segment.kinematics.joint_fit import JointFit, _at_best_value, fit_joint, nearest_joints
from dpcli.segment.kinematics.kinematic_tree import _cheapest_joints, kinematic_tree
from dpcli.segment.kinematics.part_trajectories import part_trajectories, points_at_start
from dpcli.segment.kinematics.registration import (
    Registration,
    motion_twist,
    register,
    relative_registration,
    twist_motion,
)
from dpcli.segment.kinematics.surface_directions import directions_and_edges, distinct_directions
from dpcli.segment.rigid_motions import move
from dpcli.store import CloudSequence, PartsSample
from dpcli.store.joints import AXIS, FIXED, FREE, PARENT, POINT, PRISMATIC, REVOLUTE, TYPE, VALUE


def about(axis, angle, point=(0, 0, 0)) -> np.ndarray:
    """The turn (4,4) about a line, by SciPy."""
    from scipy.spatial.transform import Rotation

    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(angle * np.asarray(axis, float)).as_matrix()
    motion[:3, 3] = np.asarray(point) - motion[:3, :3] @ point
    return motion


def along(axis, length) -> np.ndarray:
    motion = np.eye(4)
    motion[:3, 3] = length * np.asarray(axis, float)
    return motion


def _surface(rng, count, size):
    """Points on the surface of a box about 0, by area."""
    area = np.prod(size) / size
    points, axis = rng.uniform(-0.5, 0.5, (count, 3)), rng.choice(3, count, p=area / area.sum())
    points[np.arange(count), axis] = rng.integers(0, 2, count) - 0.5
    return points * size


def made(poses, boxes, points=120, seed=0, pairs=None):
    """A sequence of boxes (center, size) with poses (T,K,4,4), and what a perfect segmenter says of it."""
    rng, clouds, ids = np.random.default_rng(seed), [], []
    for pose in poses:
        own = [_surface(rng, points, np.asarray(size, float)) + center for center, size in boxes]
        clouds.append(np.concatenate([p @ m[:3, :3].T + m[:3, 3] for p, m in zip(own, pose)]).astype(np.float32))
        ids.append(np.repeat(np.arange(len(boxes)), points).astype(np.int16))
    sequence = CloudSequence.from_frames("made", clouds, part=ids)
    pairs = pairs or [(t, t + 1) for t in range(len(poses) - 1)]
    motion = np.array([poses[j] @ np.linalg.inv(poses[i]) for i, j in pairs], np.float32)
    return sequence, PartsSample(np.zeros((len(sequence.points), len(boxes))), np.array(pairs), motion, [])


def cabinet(frames=5, seed=1):
    """A body, a door on it, a knob on the door, a drawer in the body; the whole is carried about."""
    angles, slide, turn = np.linspace(0, 0.9, frames), np.linspace(0, 0.2, frames), np.linspace(0, 1.2, frames)
    poses = []
    for t in range(frames):
        whole = about((0.6, 0, 0.8), 0.2 * t) @ along((1, 0, 0), 0.05 * t)
        door = whole @ about((0, 0, 1), angles[t], (0.3, 0.3, 0))
        poses.append(
            [whole, door, door @ about((0, 1, 0), turn[t], (-0.2, 0.35, 0)), whole @ along((0, 1, 0), slide[t])]
        )
    boxes = [
        ((0, 0, 0), (0.6, 0.6, 0.8)),
        ((0, 0.32, 0.1), (0.6, 0.04, 0.5)),
        ((-0.2, 0.38, 0), (0.12, 0.05, 0.04)),
        ((0, 0.2, -0.3), (0.4, 0.3, 0.1)),
    ]
    return *made(np.array(poses), boxes, seed=seed), angles, slide, turn


def known(motion, points, noise):
    """Motions whose errors are `noise` at the points, in every direction."""
    size = float(np.sqrt(points.var(0).sum()))
    covariance = np.diag(np.repeat([(noise / size) ** 2, noise**2], 3))
    return Registration(motion, points.mean(0), size, np.tile(covariance, (len(motion), 1, 1)))


def test_hinges_slides_and_the_tree_of_a_cabinet():
    sequence, said, angles, slide, turn = cabinet()
    field = kinematic_tree(sequence, said).as_field(5, 6)
    edges = {frozenset((k, int(row[PARENT]))): k for k, row in enumerate(field[0]) if row[PARENT] >= 0}
    assert set(edges) == {frozenset((0, 1)), frozenset((1, 2)), frozenset((0, 3))}
    assert (field[:, 4:, PARENT] == -1).all()  # ids that the sequence lacks
    for edge, kind, axis, point, value in (
        ((0, 1), REVOLUTE, (0, 0, 1), (0.3, 0.3, 0), angles),
        ((1, 2), REVOLUTE, (0, 1, 0), (-0.2, 0.35, 0), turn),
        ((0, 3), PRISMATIC, (0, 1, 0), None, slide),
    ):
        rows = field[:, edges[frozenset(edge)]]
        assert (rows[:, TYPE] == kind).all()
        assert abs(rows[0, AXIS] @ axis) == pytest.approx(1, abs=1.4e-3)
        np.testing.assert_allclose(np.abs(rows[:, VALUE]), value, atol=0.02)
        if point is not None:
            off = np.cross(rows[0, POINT] - point, axis)
            assert np.linalg.norm(off) < 0.02
    whole = about((0.6, 0, 0.8), 0.8) @ along((1, 0, 0), 0.2)
    assert abs(field[4, edges[frozenset((0, 3))], AXIS] @ whole[:3, :3] @ [0, 1, 0]) == pytest.approx(1, abs=1.4e-3)


def test_what_no_single_axis_explains_is_free_and_what_stands_still_is_fixed():
    rng, points = np.random.default_rng(2), np.random.default_rng(0).uniform(-0.3, 0.3, (64, 3))
    free = np.array(
        [np.eye(4)] + [about(rng.normal(size=3) * 0.4, 1.0) @ along(rng.normal(size=3), 0.2) for _ in range(6)]
    )
    assert fit_joint(known(free, points, 0.003)).kind == FREE
    assert fit_joint(known(np.tile(np.eye(4), (7, 1, 1)), points, 0.003)).kind == FIXED
    noisy = np.array([along(rng.normal(size=3), 0.001) for _ in range(7)])
    assert fit_joint(known(noisy, points, 0.003)).kind == FIXED


@pytest.mark.parametrize("kind", [REVOLUTE, PRISMATIC])
@pytest.mark.parametrize("seed", range(3))
def test_noise_of_the_motions_moves_an_axis_little(kind, seed):
    rng, points = np.random.default_rng(seed), np.random.default_rng(9).uniform(-0.3, 0.3, (64, 3))
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    value = np.linspace(0, 1.0, 8) * (1 if kind == REVOLUTE else 0.3)
    moves = [about(axis, v, (0.2, 0.1, 0)) if kind == REVOLUTE else along(axis, v) for v in value]
    noisy = np.array([along(rng.normal(size=3), 0.002) @ about(rng.normal(size=3), 0.005) @ m for m in moves])
    noisy[0] = np.eye(4)
    fit = fit_joint(known(noisy, points, 0.005))
    assert fit.kind == kind and np.degrees(np.arccos(min(1, abs(fit.axis @ axis)))) < 3
    np.testing.assert_allclose(fit.value * np.sign(fit.axis @ axis), value, atol=0.02)


def test_a_joint_s_values_are_those_of_least_squares_in_each_frame_but_the_first():
    rng = np.random.default_rng(0)
    slope, rest = rng.normal(size=(2, 4, 6))
    for kind in (REVOLUTE, PRISMATIC):
        start = JointFit(kind, np.eye(3)[0], np.zeros(3), np.array([0, *rng.normal(size=3)]), 0.0)
        error, value = _at_best_value(lambda _, value: slope * value[:, None] + rest, np.zeros(6), start, 2.0)
        expected = [0, *(np.linalg.lstsq(slope[t, :, None], -rest[t])[0][0] for t in (1, 2, 3))]
        assert value == pytest.approx(np.array(expected)) and error == pytest.approx(slope * value[:, None] + rest)


def test_the_nearest_hinge_and_slide_are_exact_where_the_motion_is_one():
    points, axis, place = np.random.default_rng(0).random((64, 3)), np.array([0.48, -0.6, 0.64]), [2, -1, 0.5]
    value = np.linspace(0, 7, 9)  # more than one turn
    hinge = nearest_joints(np.array([about(axis, v, place) for v in value]), points)[1]
    slide = nearest_joints(np.array([along(axis, v) for v in value]), points)[0]
    for fit in (hinge, slide):
        side = np.sign(fit.axis @ axis)
        assert side * fit.axis == pytest.approx(axis, abs=1e-6) and fit.residual < 1e-6
        assert side * fit.value == pytest.approx(value, abs=1e-6)
    assert np.cross(hinge.point - place, axis) == pytest.approx(np.zeros(3), abs=1e-6)


def test_one_part_has_no_joint_and_frames_apart_are_a_sentence():
    alone = made(np.tile(np.eye(4), (3, 1, 1, 1)), [((0, 0, 0), (1, 1, 1))])
    assert kinematic_tree(*alone).joints == []
    apart = made(
        np.tile(np.eye(4), (4, 2, 1, 1)), [((0, 0, 0), (1, 1, 1)), ((2, 0, 0), (1, 1, 1))], pairs=[(0, 1), (2, 3)]
    )
    with pytest.raises(DataError, match="no pair of frames leads to frame 2"):
        kinematic_tree(*apart)


def test_many_parts_two_frames_and_a_huge_place_make_a_tree():
    rng = np.random.default_rng(4)
    boxes = [(rng.uniform(-1, 1, 3), (0.2, 0.2, 0.2)) for _ in range(6)]
    poses = np.array([[np.eye(4)] * 6, [about(rng.normal(size=3) * 0.1, 1) for _ in range(6)]])
    poses[:, :, :3, 3] += 1e4
    tree = kinematic_tree(*made(poses, boxes, points=20))
    assert len(tree.joints) == 5 and {j.child for j in tree.joints} | {tree.root} == set(range(6))


def test_a_part_that_vanishes_keeps_the_others_right():
    sequence, said, angles, *_ = cabinet()
    gone = (sequence.part == 2) & (np.repeat(np.arange(5), np.diff(sequence.frame_offsets)) >= 3)
    sequence.take_points(*_without(sequence, gone))
    field = kinematic_tree(sequence, said).as_field(5, 4)
    door = 1 if field[0, 1, PARENT] == 0 else 0
    np.testing.assert_allclose(np.abs(field[:, door, VALUE]), angles, atol=0.02)


def _without(sequence, gone):
    rows = np.flatnonzero(~gone)
    frame = np.repeat(np.arange(sequence.num_frames), np.diff(sequence.frame_offsets))[rows]
    return rows, np.searchsorted(frame, np.arange(sequence.num_frames + 1))


def _spans(sequence) -> list[slice]:
    return [slice(a, b) for a, b in zip(sequence.frame_offsets, sequence.frame_offsets[1:])]


def test_motions_of_many_pairs_are_averaged():
    sequence, said, *_ = cabinet()
    pairs = [(i, j) for i in range(5) for j in range(5) if i != j]
    rng, truth = np.random.default_rng(0), part_trajectories(sequence, said).motion
    motion = np.array([truth[j] @ np.linalg.inv(truth[i]) for i, j in pairs])
    for row in motion:
        row[:] = [along(rng.normal(size=3), 0.01) @ one for one in row]
    few = PartsSample(said.probability, np.array(pairs)[:4], motion[:4], [])  # 0 -> 1, 2, 3, 4
    many = PartsSample(said.probability, np.array(pairs), motion, [])
    apart = [np.abs(part_trajectories(sequence, one).motion - truth).mean() for one in (few, many)]
    assert apart[1] < 0.75 * apart[0]
    found, ids = part_trajectories(sequence, many), [sequence.part[span] for span in _spans(sequence)]
    for k, said_apart in enumerate(found.disagreement):
        clouds = [sequence.points[span][own == k] for span, own in zip(_spans(sequence), ids)]
        homogeneous = [np.append(cloud, np.ones((len(cloud), 1)), 1).T for cloud in clouds]
        start = np.concatenate([np.linalg.inv(m) @ h for m, h in zip(found.motion[:, k], homogeneous)], 1)
        gaps = []
        for (i, j), step in zip(pairs, motion[:, k]):
            gaps.append((step @ found.motion[i, k] - found.motion[j, k]) @ start)
            gaps.append((np.linalg.inv(step) @ found.motion[j, k] - found.motion[i, k]) @ start)
        # of 64 points
        assert said_apart == pytest.approx(np.sqrt(np.mean([(gap**2).sum(0) for gap in gaps])), rel=0.03)
        assert 0.003 < said_apart
        assert move(found.motion[2, k], start[:3].T) == pytest.approx((found.motion[2, k] @ start)[:3].T)
        assert points_at_start(sequence, k, found.motion[:, k]) == pytest.approx(start[:3].T, abs=1e-9)


def test_a_plate_has_its_normal_and_both_edges_as_directions():
    turn = about((0.6, 0.8, 0), 0.7)[:3, :3]
    plate = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3)) * (0.6, 0.4, 0.002) @ turn.T + [5, -3, 2]
    found = directions_and_edges(plate)
    assert (np.abs(found @ turn).max(0) > np.cos(np.radians(4))).all()
    assert len(distinct_directions(found)) == 3


def test_the_errors_of_two_motions_make_those_of_the_motion_between_them():
    from scipy.spatial.transform import Rotation

    rng, draws = np.random.default_rng(2), 4000
    known, erring = [], []
    for _ in range(2):
        motion = np.tile(np.eye(4), (3, 1, 1))
        motion[:, :3, :3] = Rotation.random(3, random_state=rng.integers(99)).as_matrix()
        motion[:, :3, 3] = rng.normal(size=(3, 3))
        root = 1e-3 * rng.normal(size=(3, 6, 6))
        known.append(Registration(motion, rng.normal(size=3), 1.0, root @ root.transpose(0, 2, 1)))
        twist = np.einsum("tij,ntj->nti", root, rng.normal(size=(draws, 3, 6)))
        turn, center = Rotation.from_rotvec(twist[..., :3].reshape(-1, 3)).as_matrix(), known[-1].center
        moved = np.tile(np.eye(4), (draws, 3, 1, 1))
        moved[..., :3, :3] = turn.reshape(draws, 3, 3, 3)
        moved[..., :3, 3] = center + twist[..., 3:] - moved[..., :3, :3] @ center
        np.testing.assert_allclose(twist_motion(twist, center), moved, atol=1e-12)
        np.testing.assert_allclose(motion_twist(moved, center), twist, atol=1e-12)
        erring.append(motion @ moved)
    found = relative_registration(*known)
    np.testing.assert_allclose(known[0].motion @ found.motion, known[1].motion, atol=1e-12)
    error = motion_twist(np.linalg.inv(found.motion) @ np.linalg.inv(erring[0]) @ erring[1], known[1].center)
    drawn = np.einsum("nti,ntj->tij", error, error) / draws
    scale = np.sqrt(np.einsum("tii->ti", found.covariance))
    np.testing.assert_allclose((drawn - found.covariance) / scale[:, None] / scale[..., None], 0, atol=0.1)


def test_how_surely_motions_are_known_is_the_same_in_any_place_pose_and_unit():
    rng, turns = np.random.default_rng(3), [about((0, 0.6, 0.8), 0.5 * t, (1, 2, 3)) for t in range(3)]
    clouds = [_surface(rng, 200, np.ones(3)) + rng.normal([9, -7, 5], 0.01, (200, 3)) for _ in turns]
    still = register(clouds, np.tile(np.eye(4), (3, 1, 1)), np.random.default_rng(0))
    for unit in (1.0, 50.0):
        motion = np.array(turns)
        motion[:, :3, 3] *= unit
        carried = [unit * cloud @ m[:3, :3].T + m[:3, 3] for cloud, m in zip(clouds, motion)]
        found = register(carried, motion, np.random.default_rng(0))
        lengths = np.repeat([1, unit], 3)
        np.testing.assert_allclose(
            found.covariance, still.covariance * lengths[:, None] * lengths, rtol=1e-2, atol=1e-9
        )
        assert found.size == pytest.approx(unit * np.linalg.norm(np.std(np.concatenate(clouds), 0)))
        np.testing.assert_allclose(found.center, unit * np.concatenate(clouds).mean(0), atol=1e-6 * unit)
    clouds[1] = clouds[1][:3]  # which say nothing
    found = register(clouds, np.tile(np.eye(4), (3, 1, 1)), rng).covariance
    unsure = np.diag(np.repeat([1, 4 * np.concatenate(clouds).var(0).sum()], 3))
    np.testing.assert_allclose(found[1], unsure)
    assert np.diagonal(found[[0, 2]], axis1=1, axis2=2).max() < 0.01


def test_directions_of_a_dense_part_are_those_of_a_thin_one_and_need_no_memory_by_its_square():
    """A part of a scan has 100,000 points and more over all frames; their normals beside one another would take 100 GB."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (120_000, 3))
    side = rng.integers(0, 3, len(points))
    points[np.arange(len(points)), side] = np.sign(points[np.arange(len(points)), side]) / 2
    dense = directions_and_edges(points * [1, 0.6, 0.3])
    thin = directions_and_edges(points[:2000] * [1, 0.6, 0.3])
    for axis in np.eye(3):
        assert np.abs(dense @ axis).max() > np.cos(np.radians(0.5)) and np.abs(thin @ axis).max() > np.cos(
            np.radians(2)
        )


def _markers(poses, places, noise, rng):
    """A sequence of markers with identities, places (n,3) for each part; motions of pairs by SciPy's fit to the noisy markers."""
    from scipy.spatial.transform import Rotation

    ids = np.repeat(np.arange(len(places)), [len(own) for own in places]).astype(np.int16)
    frames = [np.concatenate([move(m, own) for own, m in zip(places, pose, strict=True)]) for pose in poses]
    frames = [frame + rng.normal(size=frame.shape) * noise for frame in frames]
    motion = np.tile(np.eye(4), (len(frames) - 1, len(places), 1, 1))
    for t, k in np.ndindex(motion.shape[:2]):
        before, after = frames[t][ids == k], frames[t + 1][ids == k]
        turn = Rotation.align_vectors(after - after.mean(0), before - before.mean(0))[0].as_matrix()
        motion[t, k, :3, :3], motion[t, k, :3, 3] = turn, after.mean(0) - turn @ before.mean(0)
    tracks = [np.arange(len(ids))] * len(frames)
    sequence = CloudSequence.from_frames(
        "markers", [np.float32(f) for f in frames], part=[ids] * len(frames), track=tracks
    )
    pairs = np.column_stack([np.arange(len(frames) - 1), np.arange(1, len(frames))])
    return sequence, PartsSample(np.zeros((len(sequence.points), len(places))), pairs, np.float32(motion), [])


@pytest.mark.parametrize("kind", [REVOLUTE, PRISMATIC])
def test_few_markers_tell_a_joint_by_their_identities(kind):
    """Five markers are no surface: without their identities the blades of scissors were one fixed thing."""
    rng = np.random.default_rng(0)
    places = [rng.uniform(-1, 1, (5, 3)) * [150, 30, 20] for _ in range(2)]
    axis = np.array([0.6, 0, 0.8])
    one = (lambda t: about(axis, t)) if kind == REVOLUTE else (lambda t: along(axis, 60 * t))
    poses = [(about([0, 0, 1], 0.1 * t), about([0, 0, 1], 0.1 * t) @ one(0.08 * t)) for t in range(12)]
    tree = kinematic_tree(*_markers(poses, places, 0.3, rng))
    fit, turned = tree.joints[0].fit, 1 if tree.joints[0].child == 1 else -1
    assert fit.kind == kind and abs(fit.axis @ axis) > np.cos(np.radians(3))
    true = 0.08 * np.arange(12) * (1 if kind == REVOLUTE else 60) * turned * np.sign(fit.axis @ axis)
    assert np.allclose(fit.value, true, atol=0.02 if kind == REVOLUTE else 1.0)


def test_what_is_hardly_seen_is_no_parent():
    """Nothing contradicts a joint on a part that only frame 0 shows, so it cost nothing."""
    poses = [(np.eye(4), about([0, 0, 1], 0.2 * t, (0.5, 0, 0)), np.eye(4)) for t in range(6)]
    sequence, said = made(poses, [((0, 0, 0), (1, 1, 1)), ((1, 0, 0), (1, 1, 0.1)), ((0.5, 0, 0.1), (0.1, 0.1, 0.1))])
    sequence.part[sequence.frame_offsets[1] :][sequence.part[sequence.frame_offsets[1] :] == 2] = 0
    tree = kinematic_tree(sequence, said)
    assert {(joint.child, joint.parent) for joint in tree.joints if joint.fit.kind == REVOLUTE} in ({(1, 0)}, {(0, 1)})


class _Fits:
    """Joints of known types and lengths, of parts 0 (the largest) to 3."""

    sizes = np.array([1600, 130, 120, 26])

    def __init__(self, **told):
        self.told = told  # a pair of parts, such as p01: type and length

    def joint(self, parent, child):
        kind, length = self.told[f"p{min(parent, child)}{max(parent, child)}"]
        return JointFit(kind, np.eye(3)[0], np.zeros(3), np.zeros(4), 0.0, length)


def _joined(**told):
    fits, cost = _Fits(**told), np.full((4, 4), np.inf)
    for a, b in (map(int, pair[1:]) for pair in told):
        cost[a, b] = cost[b, a] = fits.joint(a, b).length
    cost[1, 2] = cost[2, 1] = np.inf  # these don't touch
    return {(joint.child, joint.parent, joint.fit.kind) for joint in _cheapest_joints(fits, cost, 0)}


def test_what_is_fixed_to_a_part_is_fixed_to_all_that_is_fixed_to_it():
    """Nothing tells how part 3 moves, so that it could be fixed to both flaps, which move against each other."""
    flaps = {"p01": (REVOLUTE, 19.5), "p02": (REVOLUTE, 20.2), "p13": (FIXED, 8.0), "p23": (FIXED, 11.5)}
    assert _joined(**flaps, p12=(FREE, 58.0)) == {(1, 0, REVOLUTE), (3, 1, FIXED), (2, 0, REVOLUTE)}
    assert _joined(**flaps, p12=(FIXED, 7.0)) == {(1, 0, REVOLUTE), (3, 1, FIXED), (2, 3, FIXED)}
    alone = {pair: flaps[pair] for pair in ("p01", "p13", "p23")}  # the only way to part 2
    assert _joined(**alone, p12=(FREE, 58.0)) == {(1, 0, REVOLUTE), (3, 1, FIXED), (2, 3, FREE)}
