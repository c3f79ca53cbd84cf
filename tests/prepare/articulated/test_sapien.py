"""PartNet-Mobility folders and any URDF: layouts, merged links, odd and broken files, the real objects."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.prepare.articulated.articulated_sequence import Articulation, study
from dpcli.prepare.articulated.sapien import Sapien, find_objects
from dpcli.prepare.articulated.urdf import load_object, read_skeleton
from dpcli.runtime.seeds import generator
from dpcli.store import CloudsReader
from tests.support.articulated_helpers import CUBE_OBJ, box, cabinet, joint, link, write_urdf
from tests.support.prepare_helpers import dpc


def load(path):
    return load_object(read_skeleton(path))


def two(tmp_path, *more, **options):
    """Two boxes and a joint."""
    return write_urdf(
        tmp_path / "r.urdf",
        link("a", box(1, 1, 1)),
        link("b", box(1, 0.5, 0.2), "0.5 0 0.7"),
        joint("j", "a", "b", **options),
        *more,
    )


def test_links_joined_by_fixed_joints_are_one_body(tmp_path):
    obj = load(cabinet(tmp_path / "cabinet" / "mobility.urdf"))
    assert obj.num_bodies == 3 and [j.kind for j in obj.joints] == ["revolute", "prismatic"]
    assert np.bincount(obj.body_of_triangle).tolist() == [12, 24, 12]  # body; door and knob; drawer
    low, high = (f(obj.triangles[obj.body_of_triangle == 1].reshape(-1, 3), axis=0) for f in (np.min, np.max))
    np.testing.assert_allclose((low, high), [[0, -0.1, -0.35], [1, 0.025, 0.35]], atol=1e-12)
    size = np.ptp(obj.triangles[obj.body_of_triangle == 0].reshape(-1, 3), axis=0)
    c, s = np.cos(0.3), np.sin(0.3)
    np.testing.assert_allclose(size, [c + 0.6 * s, s + 0.6 * c, 1.5], atol=1e-12)  # scaled, then turned by 0.3
    np.testing.assert_allclose(obj.joints[1].axis, [0, -1, 0])  # the file's axis has length 2
    np.testing.assert_allclose(
        obj.areas.sum(),
        2 * (0.6 + 1.5 + 0.9) + 2 * (0.05 + 0.7 + 0.035) + 2 * (0.008 + 0.008 + 0.01) + 2 * (0.45 + 0.36 + 0.2),
    )


def test_every_kind_of_geometry(tmp_path):
    import trimesh

    cube = trimesh.creation.box(extents=(1, 2, 3))
    names = []
    for suffix in ("obj", "stl", "ply", "glb", "off"):
        cube.export(tmp_path / f"m.{suffix}")
        names.append(f"m.{suffix}")
    (tmp_path / "textured.obj").write_text(CUBE_OBJ)  # its .mtl isn't there
    for name in names:
        path = write_urdf(
            tmp_path / "r.urdf", link("a", f'<mesh filename="{name}"/>'), link("b", box(1, 1, 1)), joint("j", "a", "b")
        )
        assert load(path).body_areas == pytest.approx([22, 6])
    path = write_urdf(
        tmp_path / "r.urdf",
        link("a", '<mesh filename="package://robot/textured.obj" scale="2 2 2"/>'),
        link("b", '<cylinder radius="0.5" length="2"/>'),
        link("c", '<sphere radius="1"/>'),
        joint("j", "a", "b"),
        joint("k", "a", "c"),
    )
    assert load(path).body_areas == pytest.approx([24, 2.5 * np.pi, 4 * np.pi], rel=0.01)


def test_limits(tmp_path):
    def limits(**options):
        obj = load(two(tmp_path, **options))
        return obj.joints[0].lower, obj.joints[0].upper, dict(obj.notes)

    assert limits(limits="-0.5 0.7") == (-0.5, 0.7, {})
    assert limits(limits="0.7 -0.5") == (-0.5, 0.7, {"joints with inverted limits (swapped)": 1})
    assert limits(limits="") == (-np.pi, np.pi, {"hinges without limits (+-180 degrees taken)": 1})
    assert limits(kind="continuous", limits="0 1") == (-np.pi, np.pi, {})
    assert limits(limits="0 100")[:2] == (0, 2 * np.pi)
    studied = study(load(two(tmp_path, kind="prismatic", limits="")), Articulation())
    assert 0.2 < studied.obj.joints[0].upper < 1 and "slides without limits" in str(studied.notes)


def test_equal_limits_and_floating_joints_are_fixed(tmp_path):
    for options in ({"limits": "0.5 0.5"}, {"kind": "floating"}, {"kind": "planar"}, {"kind": "fixed"}):
        obj = load(two(tmp_path, **options))
        assert obj.num_bodies == 1
        with pytest.raises(DataError, match="r.urdf: no movable joint"):
            study(obj, Articulation())
    assert load(two(tmp_path, kind="planar")).notes == {"planar joints taken as fixed": 1}
    turned = load(two(tmp_path, limits="1.5707963267948966 1.5707963267948966")).triangles[12:].reshape(-1, 3)
    np.testing.assert_allclose(turned.max(0), [0.25, 1, 0.8], atol=1e-9)  # the one value of the joint is kept


def test_mimic_joints_follow(tmp_path):
    mimic = '<mimic joint="{}" multiplier="-2" offset="0.1"/>'
    more = [
        link("c", box(1, 1, 1)),
        link("d", box(1, 1, 1)),
        joint("k", "b", "c", more=mimic.format("j")),
        joint("l", "c", "d", more=mimic.format("k")),
    ]
    obj = load(two(tmp_path, *more))
    np.testing.assert_allclose(obj.follow(np.array([[0.5, 9, 9]])), [[0.5, -0.9, 1.9]])
    ring = [
        link("c", box(1, 1, 1)),
        joint("k", "b", "c", more=mimic.format("l")),
        link("d", box(1, 1, 1)),
        joint("l", "b", "d", more=mimic.format("k")),
    ]
    with pytest.raises(DataError, match="joint 'k' mimics itself, through k, l"):
        load(two(tmp_path, *ring))
    still = load(two(tmp_path, link("c", box(1, 1, 1)), joint("k", "b", "c", more=mimic.format("nobody"))))
    assert (still.joints[1].lower, still.joints[1].upper) == (0.1, 0.1)
    fixed = load(two(tmp_path, link("c", box(1, 1, 1)), joint("k", "b", "c", more=mimic.format("j")), limits="0.5 0.5"))
    assert [(own.lower, own.upper) for own in fixed.joints] == [
        pytest.approx((-0.9, -0.9))
    ]  # -2 x the leader's value + 0.1


@pytest.mark.parametrize(
    "elements, words",
    [
        ([link("a"), link("b"), joint("j", "a", "c")], "joint 'j' has the child 'c'; there is no link of that name"),
        (
            [link("a"), link("b"), link("c"), joint("j", "a", "b"), joint("k", "c", "b")],
            "child of two joints, 'j' and 'k'",
        ),
        (
            [link("a"), link("b"), joint("j", "a", "b"), joint("k", "b", "a")],
            "links b, a hang on each other in a cycle",
        ),
        ([link("a", box(1, 1, 1)), link("b"), link("c"), joint("j", "b", "c")], "2 links have no parent"),
        (
            [link("a"), link("b"), joint("j", "a", "b", kind="screw")],
            "joint 'j' has the type 'screw'; expected revolute",
        ),
        ([link("a"), link("b"), joint("j", "a", "b", axis="0 0 0")], "joint 'j' has the axis"),
        ([link("a"), '<joint name="j" type="revolute"><child link="a"/></joint>'], "not a valid URDF"),
        ([link("a", '<box size="1 x 1"/>')], "not a valid URDF"),
    ],
)
def test_broken_urdfs_end_with_a_sentence(elements, words, tmp_path):
    with pytest.raises(DataError, match="r.urdf") as error:
        read_skeleton(write_urdf(tmp_path / "r.urdf", *elements))
    assert words in str(error.value)


def test_not_xml_and_not_urdf(tmp_path):
    path = tmp_path / "r.urdf"
    path.write_text("<robot name='r'><link")
    with pytest.raises(DataError, match="not well-formed XML"):
        read_skeleton(path)
    path.write_text("<sdf/>")
    with pytest.raises(DataError, match="its root element is <sdf>; expected <robot>"):
        read_skeleton(path)


def test_meshes_that_cannot_be_used(tmp_path):
    def with_mesh(name, text=None):
        if text is not None:
            (tmp_path / name).write_text(text)
        return write_urdf(
            tmp_path / "r.urdf", link("a", f'<mesh filename="{name}"/>'), link("b", box(1, 1, 1)), joint("j", "a", "b")
        )

    with pytest.raises(DataError, match="its mesh gone.obj is missing"):
        load(with_mesh("gone.obj"))
    with pytest.raises(DataError, match="its mesh a.xyz is of an unknown format; expected one of .obj"):
        load(with_mesh("a.xyz", "1 2 3"))
    with pytest.raises(DataError, match="its mesh bad.glb cannot be read"):
        load(with_mesh("bad.glb", "nonsense"))
    assert load(with_mesh("bad.stl", "nonsense")).notes["mesh files without faces"] == 1
    flat = "v 0 0 0\nv 1 0 0\nv 2 0 0\nv 0 1 0\nf 1 2 3\n"
    obj = load(with_mesh("flat.obj", flat))
    assert obj.notes["triangles without area dropped"] == 1 and obj.body_areas[0] == 0
    assert load(with_mesh("nan.obj", flat + "v nan 0 0\nf 1 2 5\nf 1 2 4\n")).body_areas[0] == pytest.approx(0.5)
    both = write_urdf(tmp_path / "r.urdf", link("a", '<mesh filename="flat.obj"/>'), link("b"), joint("j", "a", "b"))
    with pytest.raises(DataError, match="none of its meshes has an area"):
        study(load(both), Articulation())


def test_collision_geometry_only_when_there_is_no_other(tmp_path):
    elements = [
        link("a", box(1, 1, 1), kind="collision"),
        link("b", box(1, 1, 1), kind="collision"),
        joint("j", "a", "b"),
    ]
    obj = load(write_urdf(tmp_path / "r.urdf", *elements))
    assert len(obj.triangles) == 24 and "collision geometry taken" in str(obj.notes)
    missing = link("c", '<mesh filename="gone.obj"/>', kind="collision")
    assert len(load(two(tmp_path, missing, joint("k", "a", "c"))).triangles) == 24  # nobody asks for it


def test_layouts(tmp_path):
    by_category = tmp_path / "cat"
    for where in ("Box/12", "Box/3", "Lamp/3"):
        cabinet(by_category / where / "mobility.urdf")
    write_urdf(by_category / "Box/3/other.urdf", link("a"))  # hidden by mobility.urdf
    assert [f.name for f in find_objects(by_category)] == ["Box_3", "Box_12", "Lamp_3"]
    flat = tmp_path / "flat"
    cabinet(flat / "7" / "mobility.urdf")
    (flat / "7" / "meta.json").write_text(json.dumps({"model_cat": "Safe"}))
    cabinet(flat / "8" / "mobility.urdf")
    assert [(f.name, f.category) for f in find_objects(flat)] == [("8", ""), ("Safe_7", "Safe")]
    assert [f.name for f in find_objects(flat / "8")] == ["8"]
    assert [f.name for f in find_objects(cabinet(tmp_path / "my robot.urdf"))] == ["my robot"]
    reader = Sapien(flat, pairs_per_object=2)
    assert [(i.name, i.label) for i in reader.items()] == [
        ("8_000", -1),
        ("8_001", -1),
        ("Safe_7_000", 0),
        ("Safe_7_001", 0),
    ]
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="no URDF found; expected a .urdf file, or a folder of objects"):
        find_objects(tmp_path / "empty")


def test_the_command_skips_and_names_bad_objects(tmp_path):
    raw = tmp_path / "raw"
    cabinet(raw / "Good" / "1" / "mobility.urdf")
    two(raw / "Bad" / "2", kind="fixed").rename(raw / "Bad" / "2" / "mobility.urdf")
    cabinet(raw / "Bad" / "3" / "mobility.urdf")
    (raw / "Bad" / "3" / "meshes" / "cube.obj").unlink()
    output = tmp_path / "x.h5"
    done = dpc(
        "prepare",
        "sapien",
        raw,
        "-o",
        output,
        "--pairs-per-object",
        3,
        "--frames",
        2,
        "--points",
        99,
        "--jobs",
        1,
        "--test-categories",
        "Good",
    )
    assert done.returncode == 0, done.stderr
    assert "3 sequences, 6 frames, 594 points, 2 skipped" in done.stdout
    assert "Bad_2: " in done.stderr and "no movable joint" in done.stderr
    assert "its mesh meshes/cube.obj is missing" in done.stderr
    with CloudsReader(output) as reader:
        assert reader.class_names == ["Bad", "Good"] and reader.splits == ["test"] * 3
        assert reader.names == ["Good_1_000", "Good_1_001", "Good_1_002"] and reader.fields == ("part", "pose")
        assert reader.read(0).pose.shape == (2, 3, 4, 4)
    again = dpc(
        "prepare",
        "sapien",
        raw,
        "-o",
        output,
        "--pairs-per-object",
        3,
        "--frames",
        2,
        "--points",
        98,
        "--jobs",
        1,
        "--test-categories",
        "Good",
    )
    assert again.returncode == 2 and "points 99 (now 98)" in again.stderr


def test_real_objects(shared_data):
    check_real_objects(shared_data / "partnet_mobility", slice(5, None, 22), 6)


@pytest.mark.skipif("DPC_TEST_ALL" not in os.environ, reason="takes half a minute; DPC_TEST_ALL=1 runs it")
def test_all_real_objects(shared_data):
    check_real_objects(shared_data / "partnet_mobility", slice(None), 121)


def check_real_objects(raw, which, count):
    reader = Sapien(raw, pairs_per_object=1)
    assert len(reader.class_names) == 11
    items = reader.items()[which]
    assert len(items) == count and not any(item.problem for item in items)
    for index, item in enumerate(items):
        sequence = reader.read(item, generator(0, index)).sequence
        sequence.validate(11)
        assert np.diff(sequence.frame_offsets).tolist() == [512] * 4 and 1 <= sequence.part.max() < 8
        parts = sequence.part.max() + 1
        for f in range(4):
            assert (np.bincount(part_of(sequence, f), minlength=parts) >= 7).all()
        # undone the motion of their part, the points of all frames cover the same surface
        for part in range(parts):
            clouds = [local(sequence, f, part) for f in (0, 3)]
            if min(map(len, clouds)) < 60:
                continue
            gaps = np.linalg.norm(clouds[0][:, None] - clouds[1], axis=2)
            spacing = np.linalg.norm(clouds[1][:, None] - clouds[1], axis=2) + 9 * np.eye(len(clouds[1]))
            assert np.median(gaps.min(1)) < 2 * np.median(spacing.min(1)), (item.name, part)


def part_of(sequence, frame):
    return sequence.part[sequence.frame_offsets[frame] : sequence.frame_offsets[frame + 1]]


def local(sequence, frame, part):
    points = sequence.frame(frame)[part_of(sequence, frame) == part].astype(np.float64)
    inverse = np.linalg.inv(sequence.pose[frame, part])
    return points @ inverse[:3, :3].T + inverse[:3, 3]
