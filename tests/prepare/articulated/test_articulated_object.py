"""Articulated objects: kinematics by hand and by another library, exact flow, parts, sampling, what a camera sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dpcli.errors import DataError, UsageError
from dpcli.prepare.articulated.articulated_object import joint_motion, lock_some, parts, sample_values, transform
from dpcli.prepare.articulated.articulated_sequence import (
    Articulation,
    draw_sequence,
    global_motions,
    random_rotation,
    study,
)
from dpcli.prepare.articulated.object_splits import SplitRule
from dpcli.prepare.articulated.procedural.kinds import KINDS
from dpcli.prepare.articulated.procedural.solids import (
    Builder,
    X,
    Y,
    Z,
    ball,
    box,
    cylinder,
    open_box,
    plate,
    ring,
    rod,
)
from dpcli.prepare.articulated.synthetic_articulated import SyntheticArticulated, build_object
from dpcli.prepare.articulated.urdf import load_object, read_skeleton
from dpcli.prepare.meshes.surface_points import Camera, choose_on_surface, choose_visible, points_on
from dpcli.prepare.pipeline import convert_item
from dpcli.prepare.thinning import Thinning
from dpcli.runtime.seeds import generator
from dpcli.store import CloudsReader
from dpcli.store.joints import AXIS, PARENT, POINT, PRISMATIC, REVOLUTE, TYPE, VALUE
from tests.support.articulated_helpers import cabinet, distance_to_triangles, link, write_urdf
from tests.support.articulated_helpers import joint as joint_xml
from tests.support.commands import told as dpc

KIND_NAMES = tuple(sorted(KINDS))


def chain() -> Builder:
    """A foot, an upper arm hinged about x at height 1, a forearm that slides out of it along y."""
    b = Builder()
    b.add(0, box((1, 1, 0.2)))
    upper = b.hinge((0, 0, 1), X, -90, 90, box((0.1, 1, 0.1), (0, 0.5, 0)))
    b.slide((0, 1, 0), Y, 0, 0.5, box((0.08, 0.6, 0.08)), on=upper)
    return b


def test_forward_kinematics_of_a_chain_by_hand():
    obj = chain().build("arm")
    poses = obj.poses(np.array([[np.pi / 2, 0.25], [0, 0.5]]))
    tip = np.array([0, 0.3, 0])  # of the forearm
    # upper arm turned up by 90 degrees: its y is the world's z; the forearm is 1 + 0.25 along it, its tip 0.3 more
    np.testing.assert_allclose(transform(poses[0, 2], tip), [0, 0, 1 + 1 + 0.25 + 0.3], atol=1e-12)
    np.testing.assert_allclose(transform(poses[1, 2], tip), [0, 1 + 0.5 + 0.3, 1], atol=1e-12)
    np.testing.assert_allclose(poses[:, 0], np.tile(np.eye(4), (2, 1, 1)))


def test_forward_kinematics_against_another_library(tmp_path):
    from yourdfpy import URDF

    path = write_urdf(
        tmp_path / "r.urdf",
        *[link(f"l{k}", '<box size="1 1 1"/>') for k in range(6)],
        joint_xml("a", "l0", "l1", xyz="1 2 3", rpy="0.1 0.2 0.3", axis="1 1 0"),
        joint_xml("b", "l1", "l2", "prismatic", xyz="0 1 0", rpy="1 0 -1", axis="0 0 1"),
        joint_xml("w", "l2", "l3", "fixed", xyz="0.3 0 0", rpy="0 1 0"),
        joint_xml("c", "l3", "l4", "continuous", limits="", rpy="0 0 2", axis="0 1 1"),
        joint_xml("m", "l0", "l5", axis="0 1 0", more='<mimic joint="a" multiplier="-2" offset="0.3"/>'),
    )
    obj = load_object(read_skeleton(path))
    robot = URDF.load(str(path), load_meshes=False)
    assert len(obj.joints) == 4 and obj.num_bodies == 5
    rng = np.random.default_rng(0)
    corners = np.stack([c.mean((0, 1)) for c in (obj.triangles[obj.body_of_triangle == b] for b in range(5))])
    for values in rng.uniform(-1, 1, (5, 3)):
        robot.update_cfg(dict(zip("abc", values)))
        order = {"a": 0, "b": 2, "c": 3}  # breadth first: a and m hang on the root
        mine = np.zeros((1, 4))
        for name, value in zip("abc", values):
            mine[0, order[name]] = value
        poses = obj.poses(obj.follow(mine))[0]
        for body, name in ((1, "l1"), (2, "l5"), (4, "l4")):
            np.testing.assert_allclose(poses[body], robot.get_transform(name), atol=1e-10)
        both = [robot.get_transform(name)[:3, 3] for name in ("l2", "l3")]  # one body of two welded boxes
        np.testing.assert_allclose(transform(poses[3], corners[3]), np.mean(both, axis=0), atol=1e-10)


def draw(obj, seed=0, pad=1, **options):
    options = Articulation(**options)
    studied = study(obj, options)
    return studied, draw_sequence("s", studied, options, pad, generator(seed)).sequence


def local_distances(obj, sequence, transpose=False):
    """How far every point, taken to its part's own frame, is from the surface of that part. Every body is a part."""
    frame = np.repeat(np.arange(sequence.num_frames), np.diff(sequence.frame_offsets))
    pose = sequence.pose[frame, sequence.part]
    if transpose:
        pose = pose.copy()
        pose[:, :3, :3] = pose[:, :3, :3].transpose(0, 2, 1)
    local = transform(np.linalg.inv(pose), sequence.points.astype(np.float64))
    distances = np.zeros(len(local))
    for part in range(obj.num_bodies):
        mine = sequence.part == part
        distances[mine] = distance_to_triangles(local[mine], obj.triangles[obj.body_of_triangle == part])
    return distances


@pytest.mark.parametrize("view", ["full", "single"])
def test_true_flow_lands_on_the_surface_of_the_other_frame(view, tmp_path):
    obj = load_object(read_skeleton(cabinet(tmp_path / "c.urdf")))
    _, sequence = draw(obj, points_per_frame=60, view=view)
    rigid = sequence.pose[:, :, :3, :3]
    np.testing.assert_allclose(rigid @ rigid.swapaxes(2, 3), np.broadcast_to(np.eye(3), rigid.shape), atol=1e-12)
    scale = scale_of(obj, sequence)
    scaled = replace(obj, triangles=obj.triangles * scale)
    for i in range(4):
        for j in range(4):
            here = slice(*sequence.frame_offsets[i : i + 2])
            part, points = sequence.part[here], sequence.points[here].astype(np.float64)
            motion = sequence.pose[j, part] @ np.linalg.inv(sequence.pose[i, part])
            there = transform(motion, points)
            mesh = transform(sequence.pose[j][obj.body_of_triangle][:, None], scaled.triangles)
            for s in range(3):
                own = mesh[obj.body_of_triangle == s]
                assert distance_to_triangles(there[part == s], own).max() < 1e-5
    assert local_distances(scaled, sequence).max() < 1e-5
    assert local_distances(scaled, sequence, transpose=True).max() > 0.05  # a pose the wrong way round is seen


def scale_of(obj, sequence) -> float:
    """Of the parts' own frames: how far the hinge, which doesn't move, is from the root's origin, over what it was."""
    hinge = (np.linalg.inv(sequence.pose[0, 0]) @ sequence.pose[0, 1])[:3, 3]
    return float(np.linalg.norm(hinge) / np.linalg.norm(obj.joints[0].origin[:3, 3]))


def test_relative_motions_are_those_of_the_joints(tmp_path):
    obj = load_object(read_skeleton(cabinet(tmp_path / "c.urdf")))
    _, sequence = draw(obj, rotation=180.0, translation=1.0)
    scale = scale_of(obj, sequence)
    relative = np.linalg.inv(sequence.pose[:, :1]) @ sequence.pose[:, 1:3]
    for k, joint in enumerate(obj.joints):
        origin = joint.origin.copy()
        origin[:3, 3] *= scale
        motion = np.linalg.inv(origin) @ relative[:, k]
        if joint.kind == "revolute":
            values = np.arctan2(*(motion[:, a, b] for a, b in ((1, 0), (0, 0)))) * joint.axis[2]
            np.testing.assert_allclose(motion, joint_motion(joint, values), atol=1e-9)
        else:
            values = motion[:, :3, 3] @ joint.axis / scale
            np.testing.assert_allclose(motion[:, :3, :3], np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-9)
        assert values.min() >= joint.lower - 1e-9 and values.max() <= joint.upper + 1e-9
        assert np.abs(np.diff(values)).max() <= 0.3 * (joint.upper - joint.lower) + 1e-9  # --joint-step
        assert np.ptp(values) >= 0.15 * (joint.upper - joint.lower) - 1e-9
        told, turns = sequence.joint[:, k + 1], joint.kind == "revolute"
        assert (told[:, PARENT] == 0).all() and (told[:, TYPE] == (REVOLUTE if turns else PRISMATIC)).all()
        np.testing.assert_allclose(told[:, VALUE], values * (1 if turns else scale), atol=1e-9)
        carried = sequence.pose[:, 0] @ np.linalg.inv(sequence.pose[0, 0]) @ sequence.pose[0, k + 1]
        for row, before, after in zip(told, carried, sequence.pose[:, k + 1], strict=True):
            step = (row[VALUE] - told[0, VALUE]) * row[AXIS]  # along or about the axis, since the first frame
            turn = Rotation.from_rotvec(step if turns else 0 * step).as_matrix()
            place = turn @ (before[:3, 3] - row[POINT]) + row[POINT] + (0 if turns else step)
            np.testing.assert_allclose(after[:3, 3], place, atol=1e-9)
            np.testing.assert_allclose(after[:3, :3], turn @ before[:3, :3], atol=1e-9)


def test_frame_0_fits_its_sphere_and_is_centered():
    obj = chain().build("arm")
    _, sequence = draw(obj, rotation=0.0, translation=0.0, points_per_frame=4000)
    first = sequence.frame(0)
    assert 0.47 < np.linalg.norm(first, axis=1).max() <= 0.5 + 1e-6


def test_orientation_upright_keeps_z_up():
    options = Articulation(orientation="upright", rotation=20.0)
    for motion in global_motions(options, generator(0)):
        np.testing.assert_allclose(motion[:3, 2], [0, 0, 1], atol=1e-12)
    options = replace(options, orientation="random")
    first, second = global_motions(options, generator(0))[:2, :3, :3]
    assert abs(first[2, 2]) < 0.99
    angle = np.degrees(np.arccos((np.trace(second @ first.T) - 1) / 2))
    assert angle <= 40 + 1e-9


def test_random_rotations_are_uniform():
    rotations = np.stack([random_rotation(generator(0, k)) for k in range(4000)])
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (4000, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1)
    assert np.abs(rotations.mean(0)).max() < 0.04
    # the rotation angle of Haar measure has density (1 - cos a) / pi, so the mean of the trace squared is 1
    assert np.mean(np.trace(rotations, axis1=1, axis2=2) ** 2) == pytest.approx(1, abs=0.1)


def test_sampling_is_uniform_over_area():
    triangles = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[5, 0, 0], [5, 2, 0], [5, 0, 3]]], float)
    areas = np.array([0.5, 3.0])
    chosen = choose_on_surface(areas, 7000, generator(0))
    assert np.abs(np.bincount(chosen.triangle) - [1000, 6000]).max() <= 1
    points = points_on(triangles, chosen)[chosen.triangle == 1]
    np.testing.assert_allclose(points.mean(0), triangles[1].mean(0), atol=0.03)
    inside = (points[:, 1] < 1).mean()  # y < half of the leg: 3/4 of the area
    assert inside == pytest.approx(0.75, abs=0.02)
    first = np.flatnonzero(chosen.triangle == 0)
    assert first.mean() == pytest.approx(3500, abs=250)  # not in the order of the triangles


def test_small_parts_get_enough_points_and_tiny_ones_are_glued():
    b = Builder()
    b.add(0, box((1, 1, 1)))
    b.hinge((0.5, 0, 0), Z, 0, 90, box((0.12, 0.1, 0.1), (0.2, 0, 0)))  # 1 % of the surface: 5 points of 512
    b.hinge((-0.5, 0, 0), Z, 0, 90, box((0.02, 0.02, 0.2), (-0.2, 0, 0)))  # 0.3 %
    obj = b.build("box")
    studied, sequence = draw(obj)
    assert studied.locked == {1}
    counts = [np.bincount(sequence.part[a:b]) for a, b in zip(sequence.frame_offsets[:-1], sequence.frame_offsets[1:])]
    assert all(len(c) == 2 and 7 <= c[1] <= 9 for c in counts)
    assert study(obj, Articulation(min_part=0)).locked == set()
    alone = Builder()
    alone.add(0, box((1, 1, 1)))
    alone.hinge((0.5, 0, 0), Z, 0, 90, box((0.02, 0.02, 0.2), (0.2, 0, 0)))
    assert study(alone.build("one"), Articulation()).locked == set()  # the largest moving part stays


def test_what_doesnt_move_isnt_a_part():
    b = Builder()
    b.add(0, box((1, 1, 0.2)))
    b.hinge((0, 0, 0.1), Z, -180, 180, cylinder(0.4, 0.3, (0, 0, 0.15)))  # spins in itself
    b.slide((0, 0, -0.3), Z, 0, 0.001, box((0.5, 0.5, 0.1)))
    b.slide((0, 0, -0.5), Z, -0.4, 0, box((0.5, 0.5, 0.1)))
    b.hinge((0.4, 0, 0.1), Z, -180, 180, cylinder(0.012, 0.8, (0, 0, 0.4)))  # a pin, whose surface goes nowhere
    obj = b.build("spinner")
    assert study(obj, Articulation()).locked == {1, 3}
    assert study(obj, Articulation(visible_only=True)).locked == {0, 1, 3}
    with pytest.raises(DataError, match="spinner: one rigid part only; none of its joints .4. moves its part visibly"):
        study(obj, Articulation(visible_only=True, min_motion=0.5))
    assert len(study(obj, Articulation(min_motion=0.9)).locked) == 3  # without it, what moves most stays


def test_glued_parts_hold_still_and_share_an_id():
    obj = chain().build("arm")
    studied = study(obj, Articulation())
    studied.locked.add(1)
    sequence = draw_sequence("s", studied, Articulation(), 5, generator(1)).sequence
    assert set(sequence.part) == {0, 1} and sequence.pose.shape == (4, 5, 4, 4)
    np.testing.assert_array_equal(sequence.pose[:, 2:], np.tile(np.eye(4), (4, 3, 1, 1)))
    local = [
        transform(np.linalg.inv(sequence.pose[f, 1]), sequence.frame(f)[part_of(sequence, f) == 1].astype(float))
        for f in range(4)
    ]
    reach = [points[:, 1].max() for points in local]
    assert np.ptp(reach) < 0.02  # the forearm's end stays where it is, seen from the upper arm


def part_of(sequence, frame):
    return sequence.part[sequence.frame_offsets[frame] : sequence.frame_offsets[frame + 1]]


def test_never_more_parts_than_asked_for():
    b = Builder()
    b.add(0, box((2, 2, 2)))
    for k in range(12):
        b.slide((0, 0.2 * k, 1), Z, 0, 0.5, box((1, 0.2, 0.2)))
    obj = b.build("many")
    seen = set()
    for seed in range(6):
        locked = lock_some(obj, set(), 4, generator(seed))
        assert parts(obj, locked).max() == 3 and len(locked) == 9
        seen.add(tuple(sorted(locked)))
    assert len(seen) > 3  # other joints each time


def test_bodies_without_surface_are_no_parts():
    b = Builder()
    on = b.slide((0, 0, 0), Z, 0, 1)
    b.hinge((0, 0, 0), X, 0, 90, box((1, 1, 1)), on=on)
    b.hinge((3, 0, 0), X, 0, 90, box((1, 1, 1)))
    obj = b.build("floating")
    assert parts(obj, set()).tolist() == [-1, -1, 0, 1]
    assert parts(obj, {0, 2}).tolist() == [0, 0, 1, 0]  # welded to the empty root, a body is its surface


def test_steps_of_joint_values():
    obj = chain().build("arm")
    values = sample_values(obj, 2000, 1.0, generator(0))
    assert np.corrcoef(values[:-1, 0], values[1:, 0])[0, 1] == pytest.approx(0, abs=0.08)  # 1: independent
    assert values[:, 1].min() < 0.01 and values[:, 1].max() > 0.49
    steps = np.abs(np.diff(sample_values(obj, 2000, 0.1, generator(0)), axis=0))
    assert steps[:, 1].max() <= 0.05 + 1e-12


def first_hit(origin, direction, triangles):
    """Moeller-Trumbore over all triangles -> distance to the nearest along the ray, inf for none."""
    e1, e2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(direction, e2)
    det = (e1 * p).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = origin - triangles[:, 0]
        u = (s * p).sum(1) / det
        q = np.cross(s, e1)
        v, t = q @ direction / det, (e2 * q).sum(1) / det
    hit = (np.abs(det) > 1e-12) & (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 1e-6)
    return t[hit].min() if hit.any() else np.inf


def test_a_part_that_no_frame_shows_is_told():
    b = Builder()
    b.add(0, box((1, 1, 1)))
    b.slide((0, 0, 0), Z, -0.2, 0.2, box((0.3, 0.3, 0.3)))
    options = Articulation(view="single", points_per_frame=64)
    sample = draw_sequence("s", study(b.build("hidden"), options), options, 2, generator(0))
    assert not sample.sequence.part.any() and sample.notes == {"frames in which not every part is seen": 4}


def test_single_view_takes_what_the_camera_sees():
    obj = build_object(0, KIND_NAMES.index("lamp"), KIND_NAMES)
    poses = obj.poses(np.zeros((1, len(obj.joints))))[0]
    placed = poses[obj.body_of_triangle]
    world = transform(placed[:, None], obj.triangles)
    camera = Camera.random(float(np.linalg.norm(world, axis=2).max()), False, generator(3))
    chosen = choose_visible(obj.triangles, placed, camera, 80, generator(1))
    assert len(chosen.triangle) == 80
    for point in points_on(world, chosen):
        nearest = first_hit(camera.eye, point - camera.eye, world)
        assert nearest == pytest.approx(1, abs=1e-4)  # nothing stands before it
    hidden = sum(
        first_hit(camera.eye, p - camera.eye, world) < 0.999
        for p in points_on(world, choose_on_surface(obj.areas, 80, generator(2)))
    )
    assert hidden > 20  # while much of the whole surface is hidden


def test_the_camera_sees_the_whole_sphere():
    camera = Camera.random(0.7, True, generator(0))
    rays = camera.rays(64, generator(0)).astype(float)
    assert camera.eye[2] >= np.sin(np.radians(-15)) * np.linalg.norm(camera.eye) - 1e-9
    directions = rays[:, 3:] / np.linalg.norm(rays[:, 3:], axis=1, keepdims=True)
    closest = np.linalg.norm(camera.eye - (directions @ camera.eye)[:, None] * directions, axis=1)
    assert (closest > 0.7).any() and (closest < 0.02).any()
    assert (closest < 0.7).mean() == pytest.approx(np.pi / 4, abs=0.03)  # the ball touches the image's sides


@pytest.mark.parametrize(
    "solid, area",
    [
        (box((1, 2, 3)), 22),
        (cylinder(0.5, 2), 2.5 * np.pi),
        (ball(1), 4 * np.pi),
        (ring(1, 0.2), 0.8 * np.pi**2),
        (plate([(0, 0), (2, 0), (2, 1), (0, 1)], 0.5), 2 * 2 + 6 * 0.5),
        (open_box((1, 1, 1), 0), 10),
        (rod(np.zeros(3), np.array([1.0, 2, 2]), 0.1), 2 * np.pi * (0.3 + 0.01)),
    ],
)
def test_areas_of_the_solids(solid, area):
    doubled = np.linalg.norm(np.cross(solid[:, 1] - solid[:, 0], solid[:, 2] - solid[:, 0]), axis=1)
    assert doubled.sum() / 2 == pytest.approx(area, rel=0.03)  # walls of an open box have two sides


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.integers(0, 200))
def test_every_procedural_object_is_sound(seed, number):
    obj = build_object(seed, number, KIND_NAMES)
    assert all(joint.parent < joint.child and joint.lower < joint.upper for joint in obj.joints)
    assert np.isfinite(obj.triangles).all() and (obj.areas > 0).all()
    _, sequence = draw(obj, seed=number, points_per_frame=128)
    sequence.validate()
    assert sequence.part.min() == 0 and 1 <= sequence.part.max() < 8
    assert np.isfinite(sequence.pose).all() and np.abs(sequence.points).max() < 4


def test_kinds_differ_and_so_do_their_objects():
    reader = SyntheticArticulated(objects=2 * len(KINDS), sequences_per_object=1)
    items = reader.items()
    assert {item.label for item in items} == set(range(len(KINDS))) and len({i.name for i in items}) == len(items)
    for number in range(len(KINDS)):
        a, b = (build_object(0, number + k * len(KINDS), KIND_NAMES) for k in (0, 1))
        assert a.triangles.shape != b.triangles.shape or (a.triangles != b.triangles).any()
    with pytest.raises(UsageError, match="--kinds door,lamp,door: a kind is named twice"):
        SyntheticArticulated(kinds=("door", "lamp", "door"))
    with pytest.raises(UsageError, match="--kinds boat: not known"):
        SyntheticArticulated(kinds=("boat",))


def test_splits():
    categories = ["a"] * 6 + ["b"] * 3 + ["c"]
    by_category = SplitRule(("c",), ("b",)).assign(categories, 0)
    assert by_category == ["train"] * 6 + ["validation"] * 3 + ["test"]
    by_object = SplitRule().assign(["a"] * 100, 0)
    assert [by_object.count(s) for s in ("train", "validation", "test")] == [80, 10, 10]
    assert by_object == SplitRule().assign(["a"] * 100, 0) != SplitRule().assign(["a"] * 100, 1)
    both = SplitRule(("c",), fractions=(0.5, 0.5, 0)).assign(categories, 0)
    assert both.count("test") == 1 and {both.count("train"), both.count("validation")} <= {4, 5}
    with pytest.raises(UsageError, match="--test-categories d: no such category; found: a, b, c"):
        SplitRule(("d",)).assign(categories, 0)
    with pytest.raises(UsageError, match="--fractions 0.5,0.2: expected train,validation,test"):
        SplitRule(fractions=(0.5, 0.2))
    with pytest.raises(UsageError, match="b: in --test-categories and in --validation-categories"):
        SplitRule(("b",), ("b",))


def test_bytes_dont_depend_on_jobs(tmp_path):
    written = []
    for jobs in (1, 2):
        path = tmp_path / f"{jobs}.h5"
        done = dpc(
            "prepare",
            "synthetic",
            "articulated",
            "--objects",
            5,
            "--sequences-per-object",
            2,
            "--points",
            64,
            "--jobs",
            jobs,
            "-o",
            path,
        )
        assert done.returncode == 0, done.stderr
        written.append(path)
    first, second = (CloudsReader(path) for path in written)
    assert first.names == second.names and len(first) == 10 and first.fields == ("part", "pose", "joint")
    for k in range(10):
        a, b = first.read(k), second.read(k)
        for name in ("points", "part", "pose", "frame_offsets"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("view", ["full", "single"])
def test_a_sequence_depends_on_its_generator_alone(view):
    reader = SyntheticArticulated(objects=3, articulation=Articulation(view=view, points_per_frame=64))
    items = reader.items()
    first = reader.read(items[5], generator(0, 5)).sequence
    reader.read(items[0], generator(0, 0))
    again, other = (reader.read(items[5], generator(0, k)).sequence for k in (5, 6))
    np.testing.assert_array_equal(first.points, again.points)
    assert first.points.shape != other.points.shape or (first.points != other.points).any()


def test_fps_spreads_the_points():
    nearest = {}
    for sampling in ("random", "fps"):
        reader = SyntheticArticulated(1, articulation=Articulation(points_per_frame=128, sampling=sampling))
        sample = convert_item(reader, Thinning(128, sampling), 0, (0, reader.items()[0]))
        cloud = sample.sequence.frame(0)
        assert len(cloud) == 128
        gaps = np.linalg.norm(cloud[:, None] - cloud, axis=2) + 9 * np.eye(128)
        nearest[sampling] = np.median(gaps.min(1))
    assert nearest["fps"] > 1.3 * nearest["random"]


@pytest.mark.parametrize(
    "options, words",
    [
        ({"view": "top"}, "--view top: expected full or single"),
        ({"joint_step": 0.0}, "--joint-step 0.0"),
        ({"orientation": "left"}, "--orientation left: expected random or upright"),
        ({"points_per_frame": 0}, "--points 0: expected 1 or more"),
        ({"max_parts": 1}, "--max-parts 1: expected 2"),
    ],
)
def test_wrong_options_end_with_a_sentence(options, words):
    with pytest.raises(UsageError, match=words):
        Articulation(**options)


def test_the_command_says_what_is_wrong(tmp_path):
    done = dpc("prepare", "synthetic", "articulated", "--fractions", "a", "-o", tmp_path / "x.h5")
    assert done.returncode == 2 and "--fractions a: expected three numbers" in done.stderr
