"""PartNet-Mobility folders and any URDF: layouts, merged links, odd and broken files, the real objects."""

from __future__ import annotations

import json
import os
import re
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dpcli.errors import DataError, UsageError
from dpcli.prepare.articulated.articulated_object import nothing_moves
from dpcli.prepare.articulated.articulated_sequence import Articulation, draw_sequence, study
from dpcli.prepare.articulated.sapien import Sapien, find_objects
from dpcli.prepare.articulated.urdf import load_object, mesh_files, read_skeleton
from dpcli.prepare.pipeline import Conversion, convert
from dpcli.runtime.seeds import generator
from dpcli.store import CloudsReader
from tests.support.articulated_helpers import CUBE_OBJ, box, cabinet, joint, link, write_urdf
from tests.support.commands import told as dpc


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
    degrees = "hinges with limits more than two turns apart (one turn taken; are they degrees? a URDF has radians)"
    assert limits(limits="0 100") == (0, 2 * np.pi, {degrees: 1})
    assert limits(limits="-90 90") == limits(limits="-1e16 1e16") == (-np.pi, np.pi, {degrees: 1})
    assert limits(limits="-6.2832 6.2832") == (-np.pi, np.pi, {})
    studied = study(load(two(tmp_path, kind="prismatic", limits="")), Articulation())
    assert 0.2 < studied.obj.joints[0].upper < 1 and "slides without limits" in str(studied.notes)
    endless = study(load(two(tmp_path, kind="prismatic", limits="-1e16 1e16")), Articulation())
    assert endless.obj.joints[0].upper == studied.obj.joints[0].upper and endless.notes == studied.notes
    millimeters = study(load(two(tmp_path, kind="prismatic", limits="0 400")), Articulation())
    assert millimeters.obj.joints[0].upper == 400 and "slides ten times as long as" in str(millimeters.notes)


def test_equal_limits_and_floating_joints_are_fixed(tmp_path):
    for options in ({"limits": "0.5 0.5"}, {"kind": "floating"}, {"kind": "planar"}, {"kind": "fixed"}):
        obj = load(two(tmp_path, **options))
        assert obj.num_bodies == 1 and len(obj.notes) == (options != {"kind": "fixed"})
        said = "give them limits or" if "limits" in options else "taken as fixed" if obj.notes else "can move$"
        with pytest.raises(DataError, match=f"r.urdf: no movable joint .*{said}"):
            study(obj, Articulation())
        problem = Sapien(tmp_path / "r.urdf").items()[0].problem
        assert problem.endswith(nothing_moves("r.urdf", obj.notes))
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
    with pytest.raises(DataError, match="joint 'k' mimics 'nobody'; there is no joint of that name"):
        load(two(tmp_path, link("c", box(1, 1, 1)), joint("k", "b", "c", more=mimic.format("nobody"))))
    fixed = load(two(tmp_path, link("c", box(1, 1, 1)), joint("k", "b", "c", more=mimic.format("j")), limits="0.5 0.5"))
    assert [(own.lower, own.upper) for own in fixed.joints] == [
        pytest.approx((-0.9, -0.9))
    ]  # -2 x the leader's value + 0.1


@pytest.mark.parametrize(("kind", "limits"), [("revolute", "0 1"), ("prismatic", "")])
def test_a_slide_without_limits_that_follows_a_joint_has_its_range(tmp_path, kind, limits):
    follower = joint("k", "a", "c", kind="prismatic", limits="", more='<mimic joint="j" multiplier="-2" offset="0.1"/>')
    studied = study(load(two(tmp_path, link("c", box(1, 1, 1)), follower, kind=kind, limits=limits)), Articulation())
    leader, own = studied.obj.joints
    assert np.isfinite(leader.upper) and (own.lower, own.upper) == pytest.approx((0.1 - 2 * leader.upper, 0.1))
    pose = draw_sequence("s", studied, Articulation(), 3, generator(0)).sequence.pose
    assert np.isfinite(pose).all()


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
        (
            [link("a", '<box size="1 x 1"/>')],
            "link 'a': size='1 x 1' of <box>; expected 3 numbers, with spaces between",
        ),
        ([joint("j", "a", "b", axis="0, 0, 1")], "joint 'j': xyz='0, 0, 1' of <axis>; expected 3 numbers"),
        ([joint("j", "a", "b", more='<mimic joint="k" offset="1e"/>')], "offset='1e' of <mimic>; expected 1 number,"),
        ([link("a", '<mesh filename="m.stl" scale="1 1"/>')], "scale='1 1' of <mesh>; expected 1 or 3 numbers"),
        ([link("a", '<box size="1 nan 1"/>')], "link 'a': size='1 nan 1' of <box>; expected 3 numbers"),
        ([link("a", box(1, 1, 1), "inf 0 0")], "link 'a': xyz='inf 0 0' of <origin>; no robot is that large"),
        ([joint("j", "a", "b", limits="nan 1")], "joint 'j': lower='nan' of <limit>; expected 1 number"),
        (
            [joint("j", "a", "b", more='<mimic joint="k" multiplier="1e12"/>')],
            "multiplier='1e12' of <mimic>; no robot is that large",
        ),
        (['<link name="a"><visual/></link>'], "link 'a' has a <visual> without geometry; expected box"),
        (['<link name="a"><visual><geometry/></visual></link>'], "link 'a' has a <visual> without geometry"),
        ([link("a", '<box size="1 1 1"/><sphere radius="1"/>')], "link 'a' has 2 shapes in one <visual>"),
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
    for text, words in (
        ("<sdf/>", "its root element is <sdf>; expected <robot>"),
        ("<robot><xacro:include filename='a'/></robot>", "it is written in xacro"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=words):
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
    with pytest.raises(DataError, match="its mesh .*bad.glb: not a glTF file"):
        load(with_mesh("bad.glb", "nonsense"))
    with pytest.raises(DataError, match="its mesh .*bad.stl: truncated: its header alone has 84 bytes, it holds 8"):
        load(with_mesh("bad.stl", "nonsense"))
    assert load(with_mesh("empty.stl", "solid a\nendsolid a\n")).notes["mesh files without faces"] == 1
    flat = "v 0 0 0\nv 1 0 0\nv 2 0 0\nv 0 1 0\nf 1 2 3\n"
    obj = load(with_mesh("flat.obj", flat))
    assert obj.notes["triangles without area dropped"] == 1 and obj.body_areas[0] == 0
    with pytest.raises(DataError, match=r"its mesh nan.obj .*corners of its faces lie at NaN"):
        load(with_mesh("nan.obj", flat + "v nan 0 0\nf 1 2 5\nf 1 2 4\n"))
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
    cabinet(flat / "9" / "mobility.urdf")  # what comes later in the same process is found, too
    assert [i.name for i in Sapien(flat, pairs_per_object=1).items()] == ["8_000", "9_000", "Safe_7_000"]
    linked = tmp_path / "linked"
    cabinet(linked / "1" / "mobility.urdf")
    (linked / "2").symlink_to(flat / "7")
    (linked / "3").symlink_to(linked / "1")
    assert [i.name for i in Sapien(linked, 1, allow_outside=True).items()] == ["1_000", "3_000", "Safe_2_000"]
    (problem,) = [i.problem for i in Sapien(linked, 1).items() if i.problem]
    assert "linked/2/mobility.urdf: 'mobility.urdf' is outside the folder" in problem
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
        "--item-seconds",
        0,
        "--test-categories",
        "Good",
    )
    assert done.returncode == 0, done.stderr
    assert "3 sequences, 6 frames, 594 points, 2 skipped" in done.stdout
    assert "Bad_2: " in done.stderr and "no movable joint" in done.stderr
    assert "its mesh meshes/cube.obj is missing" in done.stderr
    with CloudsReader(output) as reader:
        assert reader.class_names == ["Bad", "Good"] and reader.splits == ["test"] * 3
        assert reader.names == ["Good_1_000", "Good_1_001", "Good_1_002"] and reader.fields == ("part", "pose", "joint")
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
        "--item-seconds",
        0,
        "--test-categories",
        "Good",
    )
    assert again.returncode == 2 and "points 99, now 98" in again.stderr


@pytest.mark.parametrize(
    "limits, expected",
    [('upper="1.5"', (0, 1.5)), ('lower="-0.5"', (-0.5, 0)), ('lower="0.25"', (0, 0.25)), ('upper="-1"', (-1, 0))],
)
@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_limit_that_is_left_out_is_zero(limits, expected, kind, tmp_path):
    moving = joint("j", "a", "b", kind=kind, limits="", more=f'<limit {limits} effort="1" velocity="1"/>')
    path = write_urdf(tmp_path / "r.urdf", link("a", box(1, 1, 1)), link("b", box(1, 1, 1)), moving)
    assert (load(path).joints[0].lower, load(path).joints[0].upper) == expected


def test_angles_that_look_like_degrees_are_noted_and_fixed_joints_need_no_axis(tmp_path):
    assert not load(two(tmp_path, rpy="0 0 6.2832")).notes
    assert "more than one turn (are they degrees?" in str(load(two(tmp_path, rpy="0 0 90")).notes)
    fixed = joint("k", "b", "c", kind="fixed", axis="nan nan nan", limits="nan nan")
    assert load(two(tmp_path, link("c", box(1, 1, 1)), fixed)).num_bodies == 2


@settings(max_examples=15, derandomize=True, deadline=None)
@given(st.floats(1e-4, 1e3), st.sampled_from(["inch", "a b", "meter"]))
def test_collada_is_read_in_meters_whatever_unit_it_declares(meter, name):
    """pycollada writes; an own scale in the URDF counts besides, as robot viewers have it."""
    import collada
    import trimesh

    with tempfile.TemporaryDirectory() as folder:
        trimesh.creation.box(extents=np.array([1, 2, 3]) / meter).export(Path(folder, "b.dae"))
        file = collada.Collada(str(Path(folder, "b.dae")))
        file.assetInfo.unitmeter, file.assetInfo.unitname = meter, name
        file.write(str(Path(folder, "b.dae")))
        for scale, area in (("1 1 1", 22), ("2 2 2", 88)):
            shape = f'<mesh filename="b.dae" scale="{scale}"/>'
            path = write_urdf(Path(folder, "r.urdf"), link("a", shape), link("b", box(1, 1, 1)), joint("j", "a", "b"))
            assert load(path).body_areas == pytest.approx([area, 6], rel=1e-4)


def test_what_is_odd_in_an_object_counts_once_not_once_a_sequence(tmp_path):
    two(tmp_path, link("c", box(1, 1, 1)), joint("k", "a", "c", kind="planar"))
    few = ("--sequences-per-object", 3, "--frames", 2, "--points", 32, "--item-seconds", 0, "--jobs", 1)
    done = dpc("prepare", "sapien", tmp_path / "r.urdf", "-o", tmp_path / "o.h5", *few)
    assert "3 sequences" in done.stdout and "planar joints taken as fixed: 1\n" in done.stderr


def test_meshes_in_millimeters_are_told(tmp_path):
    for scale, told in ((1, True), (0.001, False)):
        cube = f'<mesh filename="cube.obj" scale="{" ".join([str(30 * scale)] * 3)}"/>'
        (tmp_path / "cube.obj").write_text(CUBE_OBJ)
        path = write_urdf(tmp_path / "r.urdf", link("a", cube), link("b", box(1, 1, 1)), joint("j", "a", "b"))
        assert any("are they in millimeters?" in note for note in load(path).notes) is told


@pytest.mark.parametrize(
    "text, words",
    [
        (b'<robot name="r"><!-- 90\xb0 --><link name="a"/></robot>', "save it as UTF-8, or name its encoding"),
        (b'<?xml version="1.0" encoding="klingon"?><robot name="r"/>', "not well-formed XML"),
        (b"", "not well-formed XML"),
        (b"\0" * 99, "not well-formed XML"),
        (b'<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/hostname">]><robot name="r">&x;</robot>', "it has a DOCTYPE"),
        (b'<robot name="r"><link/></robot>', ""),
        (b'<robot xmlns:xacro="http://ros.org/x"><xacro:include filename="arm.xacro"/></robot>', "written in xacro"),
        (b'<robot name="r"><link name="${prefix}base"/></robot>', "xacro FILE > robot.urdf"),
        (b'<sdf version="1.7"><model name="m"/></sdf>', "its root element is <sdf>"),
        (b'<robot name="r"><link name="a"/><link name="a"/></robot>', "two links have the name 'a'"),
    ],
)
def test_one_bad_urdf_never_ends_the_others(text, words, tmp_path):
    cabinet(tmp_path / "good" / "mobility.urdf")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "mobility.urdf").write_bytes(text)
    bad, good = sorted(Sapien(tmp_path, pairs_per_object=1).items(), key=lambda item: not item.problem)
    assert words in bad.problem and "bad/mobility.urdf: " in bad.problem and not good.problem


@settings(max_examples=150, derandomize=True, deadline=None)
@given(data=st.data())
def test_damage_to_a_urdf_ends_in_a_sentence_or_not_at_all(data):
    """Any cut, any changed byte: read, or refused with the file's name."""
    with tempfile.TemporaryDirectory() as folder:
        path = cabinet(Path(folder, "r.urdf"))
        whole = path.read_bytes()
        place = data.draw(st.integers(0, len(whole) - 1))
        if data.draw(st.booleans()):
            path.write_bytes(whole[:place])
        else:
            value = data.draw(st.sampled_from(b'0 -.e"<>/nax\xb0\0'))
            path.write_bytes(whole[:place] + bytes([value]) + whole[place + 1 :])
        try:
            assert load(path).num_bodies >= 1
        except DataError as error:
            assert "r.urdf" in str(error)


@pytest.mark.parametrize(
    "shape", ['<box size="1 2"/>', '<cylinder radius="1"/>', "<sphere/>", "<box/>", "<mesh/>", "<cone/>"]
)
def test_solids_without_a_size_are_refused(shape, tmp_path):
    elements = [link("a", box(1, 1, 1)), link("b", shape), joint("j", "a", "b")]
    path = write_urdf(tmp_path / "r.urdf", *elements)
    with pytest.raises(DataError, match="r.urdf: "):
        load(path)


@pytest.mark.parametrize(
    "before, robot",
    [
        ('\n\n<?xml version="1.0"?>', "robot"),
        ('<?xml version="0.0" ?>\n', "robot"),  # as in the data of PyBullet
        ('\ufeff<?xml version = "1.1" encoding="utf-8"?>', "robot"),
        ('<?xml version="1.0"?><!DOCTYPE robot><!-- made by hand --><?pi x?>', "robot"),
        ("\ufeff", "robot"),
        ("", 'robot xmlns="http://www.ros.org"'),
        ("", 'robot xmlns:xacro="http://ros.org/wiki/xacro" xmlns:sensor="http://x/s"'),
    ],
)
def test_urdfs_as_other_programs_write_them(before, robot, tmp_path):
    path = two(tmp_path)
    text = path.read_text().split("?>", 1)[1].replace("<robot ", f"<{robot} ")
    extra = '<gazebo reference="a"><material>x</material></gazebo><transmission name="t"/>'
    path.with_name("robot.xml").write_text(before + text.replace("</robot>", extra + "</robot>"), encoding="utf-8")
    (item,) = Sapien(tmp_path / "robot.xml", pairs_per_object=1).items()
    assert not item.problem and len(load(item.path).joints) == 1


ODD = {
    "link": '<inertial><mass value="1.0 kg"/><inertia ixx="a"/></inertial><contact><lateral_friction value=""/></contact>'
    '<collision><geometry><box size="x"/></geometry></collision>',
    "visual": '<material name="$(arg color)"><color rgba="red"/></material>',
    "geometry": '<material name="grey"/><drake:declare_convex/>',
    "joint": '<dynamics damping="" friction="a"/><safety_controller soft_lower_limit="x"/><calibration rising="x"/>',
    "limit": 'effort="unlimited" drake:acceleration="40" ',
    "robot": '<drake:collision_filter_group name="g"/>'
    '<transmission><joint/></transmission><gazebo><plugin filename="$(find x)"/></gazebo><sensor type="q"/>'
    '<material name="q"><color rgba="1,0,0,1"/></material>',
}


@pytest.mark.parametrize("place", ODD)
def test_what_is_not_read_of_a_urdf_may_be_as_odd_as_it_likes(place, tmp_path):
    path = two(tmp_path)
    plain = load(path)
    text = path.read_text()
    text = text.replace("<limit ", "<limit " + ODD[place]) if place == "limit" else text
    path.write_text(text.replace(f"</{place}>", ODD[place] + f"</{place}>"))
    assert ODD[place] in path.read_text()
    np.testing.assert_array_equal(load(path).triangles, plain.triangles)
    assert load(path).joints[0].upper == plain.joints[0].upper and load(path).notes == plain.notes


def test_empty_texts_are_none(tmp_path):
    path = two(tmp_path)
    plain = load(path)
    path.write_text(path.read_text().replace("<geometry>", '<origin xyz="" rpy=" "/><geometry>', 1))
    np.testing.assert_array_equal(load(path).triangles, plain.triangles)


def test_capsules_are_drawn_and_odd_collisions_passed_over(tmp_path):
    odd = link("b", "<cone radius='1'/>", kind="collision").replace("</link>", "").replace('<link name="b">', "")
    capsule = link("b", '<capsule radius="0.5" length="2"/>', xyz="0 0 1").replace("</link>", odd + "</link>")
    path = write_urdf(tmp_path / "r.urdf", link("a", box(1, 1, 1)), capsule, joint("j", "a", "b"))
    obj = load(path)
    assert obj.body_areas == pytest.approx([6, 3 * np.pi], rel=0.01)
    low, high = (f(obj.triangles[obj.body_of_triangle == 1].reshape(-1, 3), axis=0) for f in (np.min, np.max))
    np.testing.assert_allclose((low, high), [[-0.5, -0.5, -0.5], [0.5, 0.5, 2.5]], atol=1e-6)


def test_a_folder_of_other_robot_formats_names_one(tmp_path):
    (tmp_path / "urdf").mkdir()
    (tmp_path / "urdf" / "arm.urdf.xacro").write_text("<robot/>")
    with pytest.raises(DataError, match="no URDF found .urdf/arm.urdf.xacro is none; xacro FILE > robot.urdf"):
        find_objects(tmp_path)


def test_a_mesh_named_by_a_file_address_is_opened_where_that_is_allowed(tmp_path):
    (tmp_path / "cube.obj").write_text(CUBE_OBJ)
    shape = f'<mesh filename="file://{tmp_path}/cube.obj"/>'
    path = write_urdf(tmp_path / "r.urdf", link("a", box(1, 1, 1)), link("b", shape), joint("j", "a", "b"))
    assert len(load(path).triangles) == 24
    assert "only files in it are opened" in Sapien(path).items()[0].problem
    assert not Sapien(path, allow_outside=True).items()[0].problem


def test_names_of_ros_packages_and_of_browsers(tmp_path):
    pack = tmp_path / "my_robot"
    (pack / "meshes").mkdir(parents=True)
    (pack / "meshes" / "a cube.obj").write_text(CUBE_OBJ)
    shape = '<mesh filename="package://my_robot/meshes/a%20cube.obj"/>'
    elements = [link("a", shape), link("b", box(1, 1, 1)), joint("j", "a", "b")]
    path = write_urdf(pack / "urdf" / "r.urdf", *elements)
    for raw, problem in ((pack, ""), (path, "is outside the folder .*/urdf: name a folder above it")):
        assert re.search(problem, Sapien(raw).items()[0].problem) and bool(Sapien(raw).items()[0].problem) == bool(
            problem
        )
    assert not Sapien(path, allow_outside=True).items()[0].problem


def test_another_mesh_of_the_same_name_is_told(tmp_path, capsys):
    cabinet(tmp_path / "cabinet" / "mobility.urdf")
    mesh, out = tmp_path / "cabinet" / "meshes" / "cube.obj", tmp_path / "x.h5"
    reader, chosen = Sapien(tmp_path, pairs_per_object=1), Conversion(points=20)
    convert(reader, out, chosen)
    assert convert(reader, out, chosen).was_complete and "newer than" not in capsys.readouterr().err
    mesh.write_text(CUBE_OBJ.replace("1", "2", 1))
    assert convert(reader, out, chosen).was_complete
    assert "newer than what an earlier run left (x.h5), and not read again" in capsys.readouterr().err
    mesh.write_text(CUBE_OBJ + "# another")
    with pytest.raises(UsageError, match="exists, made with other samples, labels or sizes of files"):
        convert(reader, out, chosen)


@pytest.mark.parametrize("name", ["meshes\\c.obj", "Meshes/C.OBJ", "package://robot/MESHES/c.Obj"])
def test_names_written_on_windows(name, tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "c.obj").write_text(CUBE_OBJ)
    elements = [link("a", f'<mesh filename="{name}"/>'), link("b", box(1, 1, 1)), joint("j", "a", "b")]
    path = write_urdf(tmp_path / "r.urdf", *elements)
    assert len(load_object(read_skeleton(path, tmp_path)).triangles) == 24
    (tmp_path / "meshes" / "C.obj").write_text("")  # now capitals tell two files apart
    assert ("\\" in name) == all(file.is_file() for file in mesh_files(read_skeleton(path, tmp_path)).values())


def test_meshes_as_windows_and_old_programs_write_them(tmp_path):
    """The mark of UTF-8 is no part of the first vertex; an STL in capitals is text."""
    rows = ("0 0 0", "1 0 0", "0 2 0")
    (tmp_path / "m.obj").write_text("".join(f"v {row}\n" for row in rows) + "v 9 9 9\nf 1 2 3\n", encoding="utf-8-sig")
    facet = "facet normal 0 0 1\nouter loop\n" + "".join(f"vertex {row}\n" for row in rows) + "endloop\nendfacet\n"
    (tmp_path / "m.stl").write_text(f"solid part\n{facet}endsolid part\n".upper())
    for name in ("m.obj", "m.stl"):
        mesh = link("a", f'<mesh filename="{name}"/>')
        path = write_urdf(tmp_path / "r.urdf", mesh, link("b", box(1, 1, 1)), joint("j", "a", "b"))
        np.testing.assert_allclose(load(path).triangles[0], [[0, 0, 0], [1, 0, 0], [0, 2, 0]])


def test_an_origin_by_a_quaternion_turns_as_one_by_angles(tmp_path):
    def placed(origin: str) -> np.ndarray:
        shape = f'<link name="b"><visual><origin {origin}/><geometry><box size="1 2 3"/></geometry></visual></link>'
        return load(write_urdf(tmp_path / "r.urdf", link("a", box(1, 1, 1)), shape, joint("j", "a", "b"))).triangles

    x, y, z, w = Rotation.from_euler("xyz", [0.3, -0.7, 1.1]).as_quat()
    found = placed(f'xyz="1 2 3" quat_xyzw="{x} {y} {z} {w}"')
    np.testing.assert_allclose(found, placed('xyz="1 2 3" rpy="0.3 -0.7 1.1"'), atol=1e-9)
    with pytest.raises(DataError, match="quat_xyzw '0 0 0 0' is not a rotation"):
        placed('quat_xyzw="0 0 0 0"')


def test_a_robot_without_a_name_and_a_collision_without_geometry_are_read(tmp_path):
    path = write_urdf(tmp_path / "r.urdf", link("a", box(1, 2, 3)), link("b", box(1, 1, 1)), joint("j", "a", "b"))
    named = load(path)
    text = re.sub('<robot name="[^"]*"', "<robot", path.read_text()).replace("</link>", "<collision/></link>")
    path.write_text(text)
    np.testing.assert_array_equal(load(path).triangles, named.triangles)


def test_a_declared_encoding_is_read(tmp_path):
    path = two(tmp_path)
    path.write_bytes(b'<?xml version="1.0" encoding="iso-8859-1"?><!-- 90\xb0 -->' + path.read_bytes().split(b"?>")[-1])
    assert len(load(path).joints) == 1


def test_objects_within_objects_and_the_category_of_their_meta_file(tmp_path, capfd):
    for where in ("x/bucket", "x/bucket/100454", "y/bucket", "y/.cache"):
        cabinet(tmp_path / where / "mobility.urdf")
        (tmp_path / where / "meta.json").write_text(json.dumps({"model_cat": "Bucket"}))
    found = find_objects(tmp_path)
    assert [(f.name, f.category) for f in found] == [
        ("Bucket_100454", "Bucket"),
        ("Bucket_x_bucket", "Bucket"),
        ("Bucket_y_bucket", "Bucket"),
    ]
    (tmp_path / "x/bucket/meta.json").write_text('{"model_cat": 3}')
    assert {f.category for f in find_objects(tmp_path / "x")} == {"Bucket", ""}
    for damaged in ('{"model_cat": "a\\ud800"}', "{", "[" * 500, "3"):
        (tmp_path / "x/bucket/meta.json").write_text(damaged)
        assert {f.category for f in find_objects(tmp_path / "x")} == {"Bucket", ""}
        assert damaged == "3" or "its category is not known: " in capfd.readouterr().err


@pytest.mark.parametrize(
    "name",
    [
        "../../secret.obj",
        "{outside}",
        "file://{outside}",
        "package://../../secret.obj",
        "..\\..\\secret.obj",
        "link.obj",
        "a/\1.obj",
    ],
)
def test_nothing_outside_the_folder_is_opened(name, tmp_path):
    outside, raw = tmp_path / "secret.obj", tmp_path / "raw" / "1"
    outside.write_text(CUBE_OBJ)
    raw.mkdir(parents=True)
    (raw / "link.obj").symlink_to(outside)
    shape = f'<mesh filename="{name.format(outside=outside)}"/>'.replace("\1", "x" * 300)
    write_urdf(raw / "mobility.urdf", link("a", shape), link("b", box(1, 1, 1)), joint("j", "a", "b"))
    problem = Sapien(tmp_path / "raw").items()[0].problem
    assert "1/mobility.urdf: its mesh" in problem and ("is outside" in problem or "cannot be a file's" in problem)
    if "x" * 9 not in shape:
        assert not Sapien(tmp_path / "raw", allow_outside=True).items()[0].problem


def test_names_that_stay_in_the_folder_and_links_the_user_named(tmp_path):
    (tmp_path / "robot" / "meshes").mkdir(parents=True)
    (tmp_path / "robot" / "meshes" / "c.obj").write_text(CUBE_OBJ)
    names = ("../meshes/c.obj", "package://robot/meshes/c.obj", "package:///meshes/c.obj")
    shapes = [link(f"b{k}", f'<mesh filename="{name}"/>') for k, name in enumerate(names)]
    elements = [link("a"), *shapes, *(joint(f"j{k}", "a", f"b{k}") for k in range(3))]
    (tmp_path / "robot" / "urdf").mkdir()
    write_urdf(tmp_path / "robot" / "urdf" / "r.urdf", *elements)
    assert not Sapien(tmp_path).items()[0].problem
    assert not Sapien(tmp_path / "robot").items()[0].problem
    assert "'../meshes/c.obj' is outside" in Sapien(tmp_path / "robot" / "urdf").items()[0].problem
    (tmp_path / "named.urdf").symlink_to(two(tmp_path))
    assert not Sapien(tmp_path / "named.urdf").items()[0].problem


def test_meshes_open_no_files_outside_either(tmp_path):
    (tmp_path / "raw").mkdir()
    (tmp_path / "secret.bin").write_bytes(np.zeros(9, "f4").tobytes())
    tree = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": "../secret.bin", "byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    (tmp_path / "raw" / "m.gltf").write_text(json.dumps(tree))
    elements = [link("a", '<mesh filename="m.gltf"/>'), link("b", box(1, 1, 1)), joint("j", "a", "b")]
    path = write_urdf(tmp_path / "raw" / "r.urdf", *elements)
    with pytest.raises(DataError, match="m.gltf: refers to '../secret.bin' outside its folder"):
        load_object(read_skeleton(path, tmp_path / "raw"))
    assert load_object(read_skeleton(path, None)).notes["triangles without area dropped"] == 1


def test_vertices_of_two_numbers_are_refused(tmp_path):
    (tmp_path / "m.obj").write_text("v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n")
    elements = [link("a", '<mesh filename="m.obj"/>'), link("b", box(1, 1, 1)), joint("j", "a", "b")]
    with pytest.raises(DataError, match="m.obj cannot be read .* 2 coordinates, expected 3"):
        load(write_urdf(tmp_path / "r.urdf", *elements))


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
