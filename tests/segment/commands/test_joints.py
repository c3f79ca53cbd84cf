"""`dpc segment joints` and `dpc evaluate joints`, in a pipeline; the URDF in another program."""

from __future__ import annotations

import json
import shutil
from xml.etree import ElementTree

import h5py
import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.segment.commands import joints as command
from dpcli.segment.commands.joints import find_joints
from dpcli.segment.kinematics.part_surfaces import part_surface
from dpcli.segment.rigid_motions import move
from dpcli.store import CloudSequence, CloudsReader, PartsReader, PartsWriter
from dpcli.store.joints import PARENT, VALUE
from tests.support.commands import exit_code, piped
from tests.support.drawers import drawer, predicted


@pytest.fixture(scope="module", autouse=True)
def found_once():
    """The joints of the same points and motions are found once: most tests are about what is written of them."""
    trees, with_axes, find, choose = {}, {}, command.kinematic_tree, command.with_point_axes

    def tree(sequence, said):
        key = (sequence.points.tobytes(), said.motion.tobytes())
        return trees[key] if key in trees else trees.setdefault(key, find(sequence, said))

    def axes(sequence, found):
        return (
            with_axes[id(found)] if id(found) in with_axes else with_axes.setdefault(id(found), choose(sequence, found))
        )

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "kinematic_tree", tree)
        patch.setattr(command, "with_point_axes", axes)
        yield


def objects(folder, count):
    path = folder / "objects.h5"
    words = "--sequences-per-object 1 --kinds cabinet,laptop --points 384 --frames 5 --joint-step 0.4".split()
    assert exit_code("prepare", "synthetic", "articulated", "-o", path, "--objects", count, *words) == 0
    return path


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return objects(tmp_path_factory.mktemp("joints"), 4)


@pytest.fixture(scope="module")
def parts(truth):
    return told(truth)


@pytest.fixture(scope="module")
def few_truth(tmp_path_factory):
    """Two objects, for what isn't about how well joints are found."""
    return objects(tmp_path_factory.mktemp("few"), 2)


@pytest.fixture(scope="module")
def few(few_truth):
    return told(few_truth)


def told(truth):
    """What a segmenter would say that knows everything."""
    path = truth.with_name("parts.h5")
    with CloudsReader(truth) as reader:
        count = reader.read(0).pose.shape[1]
        with PartsWriter(
            path, num_parts=count, class_names=reader.class_names, length_unit=reader.length_unit
        ) as writer:
            for index in range(len(reader)):
                sequence = reader.read(index)
                pose, pairs = sequence.pose, [(t, t + 1) for t in range(4)]
                motion = [pose[j] @ np.linalg.inv(pose[i]) for i, j in pairs]
                share = np.eye(count, dtype=np.float32)[sequence.part]
                flow = [np.zeros((len(sequence.frame(i)), 3), np.float32) for i, _ in pairs]
                writer.write(sequence, share, np.array(pairs), np.array(motion), flow)
    return path


def test_true_parts_give_true_joints(truth, parts, tmp_path, dpc_here):
    found = dpc_here("segment", "joints", parts, "-o", tmp_path / "joints.h5", "--picture", tmp_path / "j.png")
    assert found.returncode == 0, found.stderr
    assert b"revolute" in found.stdout and (tmp_path / "j.png").stat().st_size > 5000
    scored = dpc_here("evaluate", "joints", tmp_path / "joints.h5", "--truth", truth, "--split", "all", "--json")
    assert scored.returncode == 0, scored.stderr
    report = json.loads(scored.stdout)
    metrics = report["metrics"]
    assert 0 < report["denominators"]["visible_joints"] <= report["denominators"]["true_joints"]
    assert metrics["visible_type"] > 0.8
    assert metrics["type"] > 0.8 and metrics["axis_angle"] < 1 and metrics["state_angle"] < 0.5
    shown = dpc_here("evaluate", "joints", tmp_path / "joints.h5", "--truth", truth, "--split", "all")
    assert b"axis within 5 deg" in shown.stdout
    with PartsReader(tmp_path / "joints.h5") as reader:
        assert "joint" in reader.fields and reader.read(0).joint.shape[2] == 9


def test_the_urdf_is_posed_as_the_points_are(parts, tmp_path, dpc_here):
    """Link by link in yourdfpy: at a frame's joint values the meshes lie on that frame's points, up to the root's motion."""
    from scipy.spatial import cKDTree
    from yourdfpy import URDF

    with PartsReader(parts) as reader:
        name, sequence = reader.names[0], reader.read(0)
    for output in ("object.urdf", "object.json"):
        done = dpc_here("segment", "joints", parts, "-o", tmp_path / output, "--sequence", name)
        assert done.returncode == 0, done.stderr
    robot = URDF.load(str(tmp_path / "object.urdf"))
    tree = json.loads((tmp_path / "object.json").read_text())[0]
    values = {f"joint_{joint['child']}": joint["value"] for joint in tree["joints"] if "value" in joint}
    assert values and set(robot.actuated_joint_names) == set(values)
    for t in range(5):
        robot.update_cfg({joint: value[t] for joint, value in values.items()})
        root = np.array(tree["root_motion"][t])
        corners = [
            np.asarray(mesh.vertices) @ (root @ robot.scene.graph.get(node)[0])[:3, :3].T
            + (root @ robot.scene.graph.get(node)[0])[:3, 3]
            for node in robot.scene.graph.nodes_geometry
            for mesh in [robot.scene.geometry[robot.scene.graph[node][1]]]
        ]
        far = cKDTree(np.concatenate(corners)).query(sequence.frame(t))[0]
        assert np.median(far) < 0.02 and np.quantile(far, 0.95) < 0.06


def test_joints_flow_through_a_pipe(few_truth, few):
    found = piped("segment", "joints", few, "-o", "-")
    assert found.returncode == 0, found.stderr
    scored = piped("evaluate", "joints", "-", "--truth", few_truth, "--split", "all", "--json", stdin=found.stdout)
    assert scored.returncode == 0 and json.loads(scored.stdout)["metrics"]["type"] > 0.8, scored.stderr


def test_a_folder_holds_one_object_for_each_sequence(few, tmp_path, dpc_here):
    """A name with letters that XML has no place for makes a robot that can be read, too."""
    odd = tmp_path / "odd.h5"
    shutil.copyfile(few, odd)
    with h5py.File(odd, "r+") as file:
        names = [name.decode() for name in file["name"][:]]
        file["name"][0] = names[0] + "\x1b[31m\n"
    done = dpc_here("segment", "joints", odd, "-o", tmp_path / "robots")
    assert done.returncode == 0, done.stderr
    found = {path.stem: ElementTree.parse(path).getroot().get("name") for path in (tmp_path / "robots").glob("*.urdf")}
    assert set(names[1:]) < set(found) and names[0] + "\\x1b[31m\\n" in found.values() and len(found) == len(names)


def test_sequences_whose_names_are_one_file_name_have_a_file_each(few, tmp_path):
    with h5py.File(shutil.copyfile(few, tmp_path / "odd.h5"), "r+") as file:
        file["name"][:2] = ["a/b", "a:b"]
    find_joints(str(tmp_path / "odd.h5"), tmp_path / "robots", sequence=None, picture=None, force=False)
    names = {ElementTree.parse(path).getroot().get("name") for path in (tmp_path / "robots").glob("*.urdf")}
    assert names == {"a/b", "a:b"}


def test_a_urdf_is_in_meters_whatever_the_clouds_are_in(few, tmp_path, dpc_here):
    """The JSON keeps the file's own unit."""
    with h5py.File(shutil.copyfile(few, tmp_path / "mm.h5"), "r+") as file:
        name, file.attrs["length_unit"] = file["name"][1].decode(), "mm"  # the one of fewer parts
        file["points"][:] = 1000 * file["points"][:]
        file["part_motion"][..., :3, 3] = 1000 * file["part_motion"][..., :3, 3]
    for parts, output in ((few, "m.urdf"), (tmp_path / "mm.h5", "mm.urdf"), (tmp_path / "mm.h5", "mm.json")):
        done = dpc_here("segment", "joints", parts, "-o", tmp_path / output, "--sequence", name)
        assert done.returncode == 0, done.stderr
    one, other = (ElementTree.parse(tmp_path / f"{unit}.urdf").getroot() for unit in ("m", "mm"))
    for path, key in (("joint/origin", "xyz"), ("joint/limit", "upper")):
        found = [[list(map(float, item.get(key).split())) for item in robot.iterfind(path)] for robot in (one, other)]
        assert found[0] and np.allclose(*found, atol=1e-3)
    meshes = [(tmp_path / f"{unit}_meshes" / "part_0.obj").read_text().splitlines() for unit in ("m", "mm")]
    widths = [max(float(line.split()[1]) for line in lines if line.startswith("v ")) for lines in meshes]
    assert np.isclose(*widths, atol=1e-3)
    assert json.loads((tmp_path / "mm.json").read_text())[0]["length_unit"] == "mm"


@pytest.mark.parametrize("place", [1e3, -2e4])
def test_meshes_far_from_the_origin_lie_on_the_points(place, few, tmp_path):
    from scipy.spatial import cKDTree

    with h5py.File(shutil.copyfile(few, tmp_path / "far.h5"), "r+") as file:
        file["points"][:] = file["points"][:] + place
        turn, middle = file["part_motion"][..., :3, :3].astype(np.float64), np.full(3, place)
        file["part_motion"][..., :3, 3] = file["part_motion"][..., :3, 3] + middle - turn @ middle
        name = file["name"][1].decode()  # the one of fewer parts
    far = {"sequence": name, "picture": None, "force": False}
    find_joints(str(tmp_path / "far.h5"), tmp_path / "far.urdf", **far)
    with PartsReader(tmp_path / "far.h5") as reader:
        sequence = reader.read(1)
    root = int(np.bincount(sequence.part).argmax())
    lines = (tmp_path / "far_meshes" / f"part_{root}.obj").read_text().splitlines()
    mesh = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
    own = sequence.frame(0)[sequence.part[: len(sequence.frame(0))] == root]
    assert np.median(cKDTree(mesh).query(own)[0]) < 0.02 and np.median(cKDTree(own).query(mesh)[0]) < 0.1


@pytest.mark.parametrize("place", [0, 1e3, 1e6])
@pytest.mark.parametrize("unit", [1e-3, 1, 1e3])
@pytest.mark.parametrize("flat", [False, True])
def test_surfaces_have_one_shape_in_any_unit_and_place(place, unit, flat):
    points = np.random.default_rng(0).uniform(-1, 1, (400, 3)).round(2) * ([1, 1, 0] if flat else [1, 1, 1])
    shape, triangles = part_surface(points)
    found, same = part_surface(unit * points + unit * place)
    assert abs(len(same) - len(triangles)) <= 0.1 * len(triangles)
    assert np.allclose(np.ptp(found, 0), unit * np.ptp(shape, 0), rtol=0.01)


def _box(kind, rng):
    """Returns points on a box of 0.8 x 0.8 x 0.4: random ones, random ones with noise, or a grid, as after thinning to voxels."""
    if kind == "grid":
        points = np.stack(np.meshgrid(*[np.arange(n) for n in (21, 21, 11)], indexing="ij"), -1).reshape(-1, 3)
        return 0.04 * points[((points == 0) | (points == [20, 20, 10])).any(1)]
    points, axis = rng.random((3000, 3)), rng.choice(3, 3000, p=[0.25, 0.25, 0.5])
    points[np.arange(3000), axis] = points[np.arange(3000), axis].round()
    return points * [0.8, 0.8, 0.4] + rng.normal(size=(3000, 3)) * (0.008 if kind == "noise" else 0)


@pytest.mark.parametrize("kind", ["grid", "random", "noise"])
def test_a_surface_has_no_holes_in_flat_sides(kind):
    """Without noise an alpha shape of tetrahedra alone covers half of the box or less."""
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(0)
    vertices, triangles = part_surface(_box(kind, rng))
    corners = vertices[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    share = rng.dirichlet(np.ones(3), 20_000)
    found = (share[..., None] * corners[rng.choice(len(area), 20_000, p=area / area.sum())]).sum(1)
    assert (cKDTree(found).query(_box("random", rng))[0] < 0.04).mean() > 0.97
    if kind == "grid":
        assert np.isclose(
            (corners.mean(1) * normal).sum() / 6, 0.8 * 0.8 * 0.4
        )  # closed, and all triangles face outward


def test_points_in_a_plane_have_a_thin_plate_as_their_surface():
    plane = np.random.default_rng(0).random((500, 3)) * [1, 1, 0] + 7
    vertices, triangles = part_surface(plane)
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 > 1.6  # both sides of a square
    assert 0 < np.ptp(vertices[:, 2]) < 0.01


def test_copies_of_points_change_no_joint(few, tmp_path):
    with PartsReader(few) as reader:
        options = {"num_parts": reader.num_parts, "class_names": reader.class_names, "length_unit": reader.length_unit}
        with PartsWriter(tmp_path / "copied.h5", **options) as writer:
            for index in range(len(reader)):
                sequence, said = reader.read(index), reader.read_parts(index)
                parts = np.split(sequence.part, sequence.frame_offsets[1:-1])
                frames = [np.concatenate([frame, frame]) for frame in map(sequence.frame, range(sequence.num_frames))]
                own = CloudSequence.from_frames(sequence.name, frames, part=[np.tile(part, 2) for part in parts])
                share, flow = (
                    np.eye(reader.num_parts, dtype=np.float32)[own.part],
                    [np.tile(f, (2, 1)) for f in said.flow],
                )
                writer.write(own, share, said.pairs, said.motion, flow)
    for path, output in ((few, "one.json"), (tmp_path / "copied.h5", "two.json")):
        find_joints(str(path), tmp_path / output, sequence=None, picture=None, force=False)
    assert (tmp_path / "one.json").read_bytes() == (tmp_path / "two.json").read_bytes()


def test_points_that_lie_on_one_another_have_joints_without_certainty(tmp_path):
    frames, still = [np.zeros((60, 3), np.float32)] * 3, np.tile(np.eye(4, dtype=np.float32), (2, 2, 1, 1))
    cloud = CloudSequence.from_frames("same", frames, part=[np.repeat([0, 1], 30)] * 3)
    with PartsWriter(tmp_path / "p.h5", num_parts=2, class_names=[], length_unit="m") as writer:
        share, flow = np.eye(2, dtype=np.float32)[cloud.part], [np.zeros((60, 3), np.float32)] * 2
        writer.write(cloud, share, np.array([(0, 1), (1, 2)]), still, flow)
    find_joints(str(tmp_path / "p.h5"), tmp_path / "j.json", sequence=None, picture=None, force=False)
    assert len(json.loads((tmp_path / "j.json").read_text())[0]["joints"]) == 1


@pytest.mark.parametrize(
    "output, unit, warned",
    [("o.urdf", "furlong", True), ("robots", "", True), ("o.json", "furlong", False), ("o.urdf", "mm", False)],
)
def test_a_unit_that_no_table_knows_is_told_once_where_meters_are_written(output, unit, warned, tmp_path, capsys):
    points = np.random.default_rng(0).random((60, 3), np.float32)
    cloud = CloudSequence.from_frames("one", [points] * 2, part=[np.repeat([0, 1], 30)] * 2)
    with PartsWriter(tmp_path / "p.h5", num_parts=2, class_names=[], length_unit=unit) as writer:
        share, flow = np.eye(2, dtype=np.float32)[cloud.part], [np.zeros((60, 3), np.float32)]
        writer.write(cloud, share, np.array([(0, 1)]), np.tile(np.eye(4, dtype=np.float32), (1, 2, 1, 1)), flow)
    find_joints(str(tmp_path / "p.h5"), tmp_path / output, sequence=None, picture=None, force=False)
    said = [line for line in capsys.readouterr().err.splitlines() if "unit of length" in line]
    assert len(said) == warned and all(repr(unit) in line or "not given" in line for line in said)


@pytest.mark.parametrize("hidden", [False, True])
def test_a_part_that_frame_0_does_not_show_is_told(hidden, tmp_path, capsys):
    seeds = (0, 1 + hidden)  # others, since `found_once` doesn't look at parts
    sequences = [drawer(name, seed) for name, seed in zip(("first", "second"), seeds)]
    if hidden:
        sequences[1].part[: sequences[1].frame_offsets[1]] = 0
    said = predicted(tmp_path / "parts.h5", sequences)
    find_joints(str(said), tmp_path / "joints.json", sequence=None, picture=None, force=False)
    assert ("is a guess: part 1 of second\n" in capsys.readouterr().err) == hidden


def test_what_was_taken_off_the_coordinates_stands_in_the_json(tmp_path):
    """Without it nobody finds an axis again in a map, where the frames of `predict --ply` lie."""
    sequences = [drawer("map", 0), drawer("room", 0)]
    sequences[0].shift = np.array([500_000.0, 5_400_000.0, 100.0])
    said = predicted(tmp_path / "parts.h5", sequences)
    find_joints(str(said), tmp_path / "joints.json", sequence=None, picture=None, force=False)
    found = json.loads((tmp_path / "joints.json").read_text())
    assert [one.get("shift") for one in found] == [[500_000.0, 5_400_000.0, 100.0], None]


@pytest.mark.parametrize(("turn", "said"), [(0.0, 0), (0.8, 1)])
def test_a_turn_that_points_do_not_show_is_told(turn, said, tmp_path, capsys):
    """A disk of few points spins on a box, and looks as before: its joint is fixed, but not in silence."""
    rng, frames, motions = np.random.default_rng(0), [], []
    for t in range(3):
        motion = np.eye(4)
        motion[:2, :2] = [[np.cos(turn * t), -np.sin(turn * t)], [np.sin(turn * t), np.cos(turn * t)]]
        body, angle = rng.uniform(-0.5, 0.5, (80, 3)), rng.uniform(0, 2 * np.pi, 10)
        body[np.arange(80), rng.integers(0, 3, 80)] = 0.5  # three faces
        radius = 0.2 * np.sqrt(rng.uniform(size=10))
        disk = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(10, 0.55)])
        frames.append(np.float32(np.concatenate([body, disk])))
        motions.append(motion)
    cloud = CloudSequence.from_frames("cap", frames, part=[np.repeat([0, 1], [80, 10])] * 3)
    steps = np.stack([np.stack([np.eye(4), motions[t + 1] @ np.linalg.inv(motions[t])]) for t in range(2)])
    with PartsWriter(tmp_path / "p.h5", num_parts=2, class_names=[], length_unit="m") as writer:
        share, flow = np.eye(2, dtype=np.float32)[cloud.part], [np.zeros((90, 3), np.float32)] * 2
        writer.write(cloud, share, np.array([(0, 1), (1, 2)]), steps, flow)
    find_joints(str(tmp_path / "p.h5"), tmp_path / "j.json", sequence=None, picture=None, force=False)
    assert json.loads((tmp_path / "j.json").read_text())[0]["joints"][0]["type"] == "fixed"
    assert capsys.readouterr().err.count("called fixed") == said


@pytest.mark.parametrize("straight", [False, True])
def test_a_motion_that_is_no_hinge_is_not_called_one_in_silence(straight, tmp_path, capsys):
    """A small block turns on a plate while its middle goes straight, or, as a hinge lets it, around a corner of the plate."""
    rng, frames, motions = np.random.default_rng(1), [], []
    for t in range(6):
        angle, motion = 0.3 * t, np.eye(4)
        motion[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        if straight:
            motion[:2, 3] = [0.16 * t, 0.1 * t]
        else:
            motion[:2, 3] = ((np.eye(4) - motion) @ [0.6, -0.5, 0, 0])[:2]
        plate = rng.uniform(-1, 1, (900, 3)) * [1, 0.7, 0.05]
        block = rng.uniform(-0.5, 0.5, (160, 3)) * [0.5, 0.25, 0.2]
        axis = rng.integers(0, 3, 160)
        block[np.arange(160), axis] = np.sign(block[np.arange(160), axis]) * np.array([0.25, 0.125, 0.1])[axis]
        frames.append(np.float32(np.concatenate([plate, move(motion, block + [0, 0, 0.15])])))
        motions.append(motion)
    cloud = CloudSequence.from_frames("puck", frames, part=[np.repeat([0, 1], [900, 160])] * 6)
    steps = np.stack([np.stack([np.eye(4), motions[t + 1] @ np.linalg.inv(motions[t])]) for t in range(5)])
    with PartsWriter(tmp_path / "p.h5", num_parts=2, class_names=[], length_unit="m") as writer:
        share, flow = np.eye(2, dtype=np.float32)[cloud.part], [np.zeros((1060, 3), np.float32)] * 5
        writer.write(cloud, share, np.array([(t, t + 1) for t in range(5)]), steps, flow)
    find_joints(str(tmp_path / "p.h5"), tmp_path / "j.json", sequence=None, picture=None, force=False)
    kind = json.loads((tmp_path / "j.json").read_text())[0]["joints"][0]["type"]
    told = "the joint may be free: part 1 on part 0 of puck" in capsys.readouterr().err
    assert (kind == "free" or told) if straight else (kind == "revolute" and not told)


def test_one_frame_has_no_joints(tmp_path):
    cloud = CloudSequence.from_frames("still", [np.eye(3, dtype=np.float32)], part=[np.arange(3)])
    with PartsWriter(tmp_path / "p.h5", num_parts=3, class_names=[], length_unit="m") as writer:
        writer.write(cloud, np.eye(3, dtype=np.float32), np.zeros((0, 2), np.int32), np.zeros((0, 3, 4, 4)), [])
    with pytest.raises(DataError, match="'still': one frame only, which shows no motion"):
        find_joints(str(tmp_path / "p.h5"), tmp_path / "p.json", sequence=None, picture=None, force=False)


def test_a_sequence_of_one_frame_and_one_part_has_no_joints_and_leaves_the_others_theirs(few, tmp_path):
    """`segment predict` makes one part of a single frame, with a warning."""
    with PartsReader(few) as reader:
        some, said, parts = reader.read(0), reader.read_parts(0), reader.num_parts
        still = CloudSequence.from_frames("still", [some.frame(0)], part=[np.zeros(len(some.frame(0)), np.int16)])
        share = np.eye(parts, dtype=np.float32)[still.part]
        with PartsWriter(tmp_path / "p.h5", num_parts=parts, class_names=[], length_unit="m") as writer:
            writer.write(still, share, np.zeros((0, 2), np.int32), np.zeros((0, parts, 4, 4)), [])
            writer.write(some, said.probability, said.pairs, said.motion, said.flow)
    find_joints(str(tmp_path / "p.h5"), tmp_path / "j.json", sequence=None, picture=None, force=False)
    one, other = json.loads((tmp_path / "j.json").read_text())
    assert one["name"] == "still" and len(one["parts"]) == 1 and one["joints"] == [] and other["joints"]
    find_joints(str(tmp_path / "p.h5"), tmp_path / "j.h5", sequence=None, picture=None, force=False)
    with PartsReader(tmp_path / "j.h5") as reader:
        assert (reader.read(0).joint[..., PARENT] == -1).all()


def test_a_folder_that_could_not_be_filled_is_not_left(few, tmp_path, monkeypatch):
    """Else the same command, which a full disk's sentence asks for, would be refused for what it had left."""

    def make():
        find_joints(str(few), tmp_path / "new" / "robots", sequence=None, picture=None, force=False)

    with monkeypatch.context() as patch:
        patch.setattr(
            "dpcli.segment.commands.joints.write_trees", lambda path, _: (path.parent / "no" / "x").write_bytes(b"")
        )
        with pytest.raises(OSError):
            make()
    assert list((tmp_path / "new").iterdir()) == []
    make()
    assert (tmp_path / "new" / "robots" / "joints.json").is_file()


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["-o", "a.urdf"], 2, "name one with --sequence"),
        (["-o", "a.URDF"], 2, "name one with --sequence"),
        (["-o", "a.urdf", "--sequence", "nobody"], 2, "--sequence nobody: not in"),
        (["-o", "a.xml"], 2, "expected a name that ends in .h5, .urdf, .json, or a folder"),
    ],
)
def test_mistakes_end_with_a_sentence(words, code, message, parts, tmp_path, dpc_here, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = dpc_here("segment", "joints", parts, *words)
    assert done.returncode == code and message in done.stderr.decode()


def test_files_without_joints_are_refused(parts, truth, dpc_here):
    done = dpc_here("evaluate", "joints", parts, "--truth", truth, "--split", "all")
    assert done.returncode == 3 and "dpc segment joints" in done.stderr.decode()


def test_the_true_values_stand_in_the_file(truth):
    with CloudsReader(truth) as reader:
        joint = reader.read(0).joint
    assert np.ptp(joint[..., VALUE], axis=0).max() > 0.05


def test_an_error_is_the_last_line(parts, tmp_path, monkeypatch, capsys):
    """The bar of what is being found ends first, though its generator would end later."""

    def refused(*given):
        raise DataError("no room")

    monkeypatch.setattr(command, "write_urdf", refused)
    assert exit_code("segment", "joints", parts, "-o", tmp_path / "folder") == 3
    assert capsys.readouterr().err.splitlines()[-1] == "dpc: error: no room"
