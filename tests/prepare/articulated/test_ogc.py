"""OGC-DR and OGC-DRSV: the released arrays byte for byte, and new rooms whose parts and poses are exact."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.cli.prepare.articulated.ogc import NewRoomOptions, RoomConversion, ogc_dr
from dpcli.errors import DataError, UsageError
from dpcli.prepare.articulated.articulated_object import triangle_areas
from dpcli.prepare.articulated.articulated_sequence import random_rotation
from dpcli.prepare.articulated.ogc import OgcRooms, read_room
from dpcli.prepare.articulated.ogc_layout import GROUND, RoomMotion, box, draw_layout, overlaps, scale_range
from dpcli.prepare.articulated.ogc_meshes import find_meshes, load_shape
from dpcli.prepare.articulated.ogc_rooms import GeneratedRooms, RoomOptions, seen_by_camera
from dpcli.prepare.meshes.surface_points import choose_on_surface, points_on
from dpcli.runtime.seeds import generator
from dpcli.store import CloudsReader
from tests.support.commands import told as dpc

CUBE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
SIDES = [[1, 2, 3, 4], [5, 6, 7, 8], [1, 2, 6, 5], [2, 3, 7, 6], [3, 4, 8, 7], [4, 1, 5, 8]]


def make_room(seed, objects=3, points=50, frames=4, background=False):
    """Arrays of a room as released, and the body points that its clouds are the images of."""
    rng = np.random.default_rng(seed)
    arrays, bodies = {}, []
    for t in range(frames):
        pose = np.tile(np.eye(4), (objects, 1, 1))
        for matrix in pose:
            matrix[:3, :3], matrix[:3, 3] = random_rotation(rng), rng.normal(size=3)
        segm = (rng.permutation(points) % (objects + background) + (not background)).astype(np.int16)
        body = rng.normal(size=(points, 3))
        cloud = np.stack([(pose[s - 1] @ [*b, 1])[:3] if s else b for b, s in zip(body, segm)])
        arrays |= {f"pc_{t:02d}": cloud.astype(np.float32), f"segm_{t:02d}": segm, f"pose_{t:02d}": pose}
        bodies.append(body)
    return arrays, bodies


def write_room(data, name, arrays):
    (data / name).mkdir(parents=True)
    for key, value in arrays.items():
        np.save(data / name / f"{key}.npy", value)


def write_raw(raw, rooms, **lists):
    for name, arrays in rooms.items():
        write_room(raw / "data", name, arrays)
    for key, names in lists.items():
        (raw / "data" / f"{key}.lst").write_text("".join(f"{name}\n" for name in names))
    return raw


def test_released_rooms(tmp_path):
    one, bodies = make_room(0, 3)
    other, _ = make_room(1, 5)
    rooms = {"3_000001": one, "5_000000": other}
    raw = write_raw(tmp_path / "räume 1", rooms, train=["3_000001"], val=["5_000000"], test=["8_000009"])
    done = dpc("prepare", "ogc-dr", raw, "-o", tmp_path / "x.h5", "--item-seconds", 0, "--jobs", 1)
    assert done.returncode == 0, done.stderr
    assert "8_000009: in the list of the test split, but no such folder" in done.stderr
    with CloudsReader(tmp_path / "x.h5") as reader:
        assert reader.names == ["3_000001", "5_000000"] and reader.splits == ["train", "validation"]
        assert [name for name, _ in reader.skipped] == ["8_000009"]
        room = reader.read(0)
    assert room.pose.shape == (4, 5, 4, 4)  # padded to the largest room
    np.testing.assert_array_equal(room.pose[:, 3:], np.tile(np.eye(4), (4, 2, 1, 1)))
    for t in range(4):
        np.testing.assert_array_equal(room.frame(t), one[f"pc_{t:02d}"])
        part = room.part[50 * t : 50 * t + 50]
        np.testing.assert_array_equal(part, one[f"segm_{t:02d}"] - 1)
        pose = room.pose[t, part]
        placed = (pose[:, :3, :3] @ bodies[t][..., None])[..., 0] + pose[:, :3, 3]
        np.testing.assert_allclose(placed, room.frame(t), atol=1e-5)
        flow = one["pose_03"] @ np.linalg.inv(one[f"pose_{t:02d}"])  # as published: P2 P1^-1
        np.testing.assert_allclose((room.pose[3] @ np.linalg.inv(room.pose[t]))[:3], flow, atol=1e-12)


def test_background_is_a_part_that_stands_still(tmp_path):
    arrays, _ = make_room(2, 3, background=True)
    raw = write_raw(tmp_path, {"3_000000": arrays, "2_000000": make_room(3, 2)[0]}, test=["3_000000", "2_000000"])
    reader = OgcRooms(raw)
    items = reader.items()
    room = reader.read(items[0], None).sequence
    np.testing.assert_array_equal(room.part == 3, np.concatenate([arrays[f"segm_{t:02d}"] for t in range(4)]) == 0)
    np.testing.assert_array_equal(room.pose[:, 3], np.tile(np.eye(4), (4, 1, 1)))
    assert reader.read(items[1], None).sequence.pose.shape == (4, 4, 4, 4)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"pc_01": None}, r"frames \[0, 2, 3\]; expected pc_00.npy, pc_01.npy, ... without gaps"),
        ({"segm_02": None}, "segm_02.npy: missing"),
        ({"pc_01": np.zeros((50, 2))}, r"pc_01.npy: is float64 \(50, 2\); expected floats \(n, 3\)"),
        ({"pc_00": np.full((50, 3), np.nan)}, "holds NaN"),
        ({"segm_00": np.full(50, 4)}, "holds ids from 4 to 4; expected 1 to 3"),
        ({"segm_00": np.ones(49, int)}, r"is int64 \(49,\); expected whole numbers \(50\)"),
        ({"segm_00": np.array([{}], object)}, "not a readable .npy array"),
        ({"pose_03": np.tile(2 * np.eye(4), (3, 1, 1))}, "matrix of object 1 is not a rigid motion"),
        ({"pose_03": np.tile(np.diag([1.0, 1, -1, 1]), (3, 1, 1))}, "matrix of object 1 is not a rigid motion"),
        ({"pose_03": np.full((3, 4, 4), np.nan)}, "is not a rigid motion"),
        ({"pose_03": np.tile(np.eye(4), (2, 1, 1))}, "2 objects, 3 in pose_00"),
    ],
)
def test_damaged_rooms(change, words, tmp_path):
    arrays = {key: value for key, value in {**make_room(0)[0], **change}.items() if value is not None}
    write_raw(tmp_path, {"3_000000": arrays}, test=["3_000000"])
    with pytest.raises(DataError, match=words):
        read_room(tmp_path / "data" / "3_000000")


def test_truncated_array(tmp_path):
    write_raw(tmp_path, {"3_000000": make_room(0)[0]})
    path = tmp_path / "data" / "3_000000" / "pc_02.npy"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(DataError, match="pc_02.npy: not a readable .npy array"):
        read_room(path.parent)


@pytest.mark.parametrize(
    "lists, words",
    [
        ({}, "no rooms listed"),
        ({"train": []}, "no rooms listed"),
        ({"train": ["a", "a"]}, "room a is listed 2 times"),
        ({"train": ["a"], "val": ["a"]}, "room a is listed 2 times"),
    ],
)
def test_lists(lists, words, tmp_path):
    (tmp_path / "data").mkdir()
    with pytest.raises(DataError, match=words):
        OgcRooms(write_raw(tmp_path, {}, **lists)).items()


def test_rooms_in_no_list_are_named(tmp_path):
    rooms = {f"3_00000{k}": make_room(k)[0] for k in range(3)}
    reader = OgcRooms(write_raw(tmp_path, rooms, train=["3_000001"]))
    assert reader.summary(reader.items())[-1] == "not read, in no list: 3_000000, 3_000002"
    write_raw(tmp_path, {}, val=["3_000000"])  # what comes later in the same process is found, too
    assert [item.name for item in OgcRooms(tmp_path).items()] == ["3_000001", "3_000000"]


def test_a_list_cannot_lead_out_of_the_folder(tmp_path):
    write_room(tmp_path, "3_000000", make_room(0)[0])
    raw = write_raw(tmp_path / "raw", {"3_000001": make_room(0)[0]}, test=["../../3_000000", "3_000001"])
    assert ["expected the name of a folder" in item.problem for item in OgcRooms(raw).items()] == [True, False]


@pytest.mark.parametrize("name", ["../../far", "link"])
def test_nothing_outside_is_opened_to_count_parts(name, tmp_path):
    write_room(tmp_path, "far", make_room(0, 7)[0])
    raw = write_raw(tmp_path / "raw", {"near": make_room(0, 3)[0]}, train=["near", name])
    (raw / "data" / "link").symlink_to(tmp_path / "far")
    near, far = OgcRooms(raw).items()
    assert far.problem and not near.problem and near.extra["parts"] < 7


def write_box(path, sides):
    """A box of these sides as the text of an .obj file, four corners a face."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ["v {} {} {}".format(*(np.array(corner) * sides)) for corner in CUBE]
    path.write_text("\n".join([*lines, *("f " + " ".join(map(str, side)) for side in SIDES)]))


@pytest.fixture
def meshes(tmp_path):
    folder = tmp_path / "some meshes"
    for k, sides in enumerate([(1, 2, 0.6), (3, 1, 1), (0.5, 0.5, 2), (1, 1.2, 1.1)]):
        write_box(folder / f"class {k % 2}" / f"box{k}.obj", sides)
    return folder


def test_shapes_are_centered_and_of_size_one(meshes):
    assert find_meshes(meshes) == ("class 0/box0.obj", "class 0/box2.obj", "class 1/box1.obj", "class 1/box3.obj")
    shape = load_shape(meshes / "class 0" / "box0.obj", "y")
    corners = shape.triangles.reshape(-1, 3)
    np.testing.assert_allclose(corners.max(0), [0.25, 0.5, 0.15])
    np.testing.assert_allclose(corners.min(0), [-0.25, -0.5, -0.15])
    assert len(shape.hull) == 8
    up = load_shape(meshes / "class 0" / "box0.obj", "z").triangles
    np.testing.assert_allclose(up.reshape(-1, 3).max(0), [0.25, 0.15, 0.5])
    normal = np.cross(up[:, 1] - up[:, 0], up[:, 2] - up[:, 0])
    before = np.cross(shape.triangles[:, 1] - shape.triangles[:, 0], shape.triangles[:, 2] - shape.triangles[:, 0])
    np.testing.assert_allclose(normal, before[:, [0, 2, 1]] * [1, 1, -1], atol=1e-12)  # turned, not mirrored


def test_layout_keeps_the_recipe(meshes):
    hulls = [load_shape(meshes / name, "y").hull for name in find_meshes(meshes)]
    steps, turned = [], []
    for seed in range(12):
        layout = draw_layout(hulls, 4, RoomMotion(), generator(seed))
        assert layout.shrunk == 1 and ((layout.scale >= 0.25) & (layout.scale <= 0.45)).all()
        for t in range(4):
            boxes = [box(h * s, p) for h, s, p in zip(hulls, layout.scale, layout.pose[t])]
            assert not any(overlaps(b, boxes[:k]) for k, b in enumerate(boxes))
            if t == 0:
                np.testing.assert_allclose([b[0, 1] for b in boxes], GROUND, atol=1e-12)
                assert np.abs(boxes)[..., ::2].max() <= 0.5
        step = np.diff(layout.pose[..., :3, 3], axis=0)
        assert (step[..., 1] == 0).all() and np.abs(step[..., ::2]).min() >= 0.02 and np.abs(step).max() <= 0.04
        turn = layout.pose[1:, :, :3, :3] @ np.linalg.inv(layout.pose[:-1, :, :3, :3])
        angle = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=2, axis2=3) - 1) / 2, -1, 1)))
        assert angle.max() <= 10 + 1e-6
        diagonal = np.diagonal(turn, axis1=2, axis2=3)
        np.testing.assert_allclose(diagonal.max(-1), 1, atol=1e-12)  # about the room's axes, not the object's
        turned.append(np.isclose(turn[..., 1, 1], 1, atol=1e-12))
        steps.append(np.sign(step[..., ::2]))
    assert 0.5 < np.mean(turned) < 0.7 and abs(np.mean(steps)) < 0.2
    assert scale_range(8) == pytest.approx((0.2, 0.3)) and scale_range(4) == pytest.approx((0.25, 0.45))


def test_overlaps_says_yes_where_boxes_touch():
    one, touching, apart = (np.array([[x, 0, 0], [x + 1, 1, 1.0]]) for x in (0, 1, 1.001))
    assert overlaps(one, [touching]) and not overlaps(one, [apart]) and overlaps(one, [apart, touching])


def test_too_bulky_objects_shrink_and_then_fail():
    cube = np.array(CUBE) - 0.5
    crowd = draw_layout([cube] * 8, 4, RoomMotion(), generator(0))
    assert 0.5 < crowd.shrunk < 1
    with pytest.raises(DataError, match="8 objects of these meshes don't fit"):
        draw_layout([cube] * 8, 2, RoomMotion(shift=(5.0, 6.0), rotation=0.0), _Still())


class _Still:
    """A generator that always proposes the same, so objects collide forever."""

    def uniform(self, low, high, size=None):
        return np.broadcast_to(np.asarray(low, float), size if size is not None else np.shape(low)).copy()

    def random(self):
        return 0.0

    def choice(self, values, size=None):
        return np.full(size or (), values[0])


def surface_error(points, half):
    """How far points f64 (N,3) are from the surface of a box of these half sides."""
    outside = np.abs(points) - half
    return np.abs(outside.max(1))


@pytest.mark.parametrize("view", ["full", "single"])
def test_parts_and_poses_of_new_rooms_are_exact(view, tmp_path):
    write_box(tmp_path / "meshes" / "box.obj", (1, 2, 0.6))
    reader = GeneratedRooms(tmp_path / "meshes", RoomOptions((3, 2), 1, 4, view, 256), seed=4)
    items = reader.items()
    assert [item.name for item in items] == ["3_000000", "2_000000"]
    room = reader.read(items[0], generator(4, 0)).sequence
    room.validate()
    assert (np.diff(room.frame_offsets) == 256).all() and set(room.part.tolist()) == {0, 1, 2}
    frame = np.repeat(np.arange(4), 256)
    inverse = np.linalg.inv(room.pose)[frame, room.part]
    local = (inverse[:, :3, :3] @ room.points[..., None].astype(np.float64))[..., 0] + inverse[:, :3, 3]
    for part in range(3):
        own = local[room.part == part]
        reach = np.abs(own).max(0)
        scale = reach[1] * 2 if view == "full" else _scale_of(own)
        assert surface_error(own, scale * np.array([0.25, 0.5, 0.15])).max() < 1e-3 * (1 if view == "single" else 20)
        other = np.linalg.inv(room.pose)[(frame + 1) % 4, room.part]  # the pose of another frame: a wrong one
        wrong = (other[:, :3, :3] @ room.points[..., None].astype(np.float64))[..., 0] + other[:, :3, 3]
        assert surface_error(wrong[room.part == part], scale * np.array([0.25, 0.5, 0.15])).max() > 5e-3


def _scale_of(own):
    """The scale of a 0.5 x 1 x 0.3 box that all points lie on: every point gives a candidate."""
    return np.median((np.abs(own) / [0.25, 0.5, 0.15]).max(1))


def test_single_view_shows_no_hidden_surface(meshes):
    shapes = [load_shape(meshes / name, "y") for name in find_meshes(meshes)]
    layout = draw_layout([s.hull for s in shapes], 1, RoomMotion(), generator(1))
    placed = np.concatenate(
        [(s.triangles * size) @ p[:3, :3].T + p[:3, 3] for s, size, p in zip(shapes, layout.scale, layout.pose[0])]
    )
    low, high = placed.reshape(-1, 3).min(0), placed.reshape(-1, 3).max(0)
    eye = (low + high) / 2 + [0, 0, 0.7 * (high - low).max() / np.tan(np.pi / 6)]
    seen = points_on(placed, seen_by_camera(placed))
    x, y, z = ((seen - eye) * [1, -1, -1]).T
    focal = 180 / np.tan(np.pi / 6)  # a picture of 640x360, 60 degrees high, whose pixels' centers see
    pixels = np.stack([focal * x / z + 320, focal * y / z + 180])
    np.testing.assert_allclose(pixels % 1, 0.5, atol=1e-3)
    assert len(np.unique(np.floor(pixels), axis=1).T) == len(seen)
    few = seen[generator(0).permutation(len(seen))[:200]]
    assert not hidden(eye, few, placed).any()
    whole = points_on(placed, choose_on_surface(triangle_areas(placed), 200, generator(0)))
    assert hidden(eye, whole, placed).mean() > 0.3


def hidden(eye, points, triangles):
    """bool (N): some triangle crosses the way from the eye to the point, by Moeller and Trumbore, all pairs."""
    ray = (points - eye)[:, None]
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(ray, e2)
    det = (p * e1).sum(-1)
    det = np.where(np.abs(det) < 1e-12, np.inf, det)
    u = (p * (eye - a)).sum(-1) / det
    q = np.cross(eye - a, e1)
    v, t = (ray * q).sum(-1) / det, (q * e2).sum(-1) / det
    return ((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1 - 1e-4)).any(1)


def test_generate_command(meshes, tmp_path):
    (meshes / "class 0" / "broken.obj").write_text("no mesh at all\n")
    words = ["--generate", meshes, "--rooms", 2, "--objects", "3,2", "--frames", 2, "--points", 64, "--seed", 3]
    done = dpc("prepare", "ogc-dr", *words, "-o", tmp_path / "x.h5", "--item-seconds", 0, "--jobs", 1)
    assert done.returncode == 0, done.stderr
    assert "another mesh drawn, for class 0/broken.obj cannot be used" in done.stderr
    again = GeneratedRooms(meshes, RoomOptions((3, 2), 2, 2, points=64), seed=3)
    with CloudsReader(tmp_path / "x.h5") as reader:
        assert reader.names == ["3_000000", "3_000001", "2_000000", "2_000001"] and reader.length_unit == "room width"
        for k, item in enumerate(again.items()):
            room, same = reader.read(k), again.read(item, generator(3, k)).sequence
            assert room.split == same.split and room.pose.shape == (2, 3, 4, 4)
            np.testing.assert_array_equal(room.points, same.points)
            np.testing.assert_array_equal(room.pose, same.pose)
        assert not np.array_equal(reader.read(0).points, reader.read(1).points)


@pytest.mark.parametrize(
    "raw, generate, changed, complaint",
    [
        (False, False, {}, "neither was given"),
        (True, True, {}, "both were given"),
        (False, True, {"objects": "9"}, "expected different numbers of 2 to 8"),
        (False, True, {"objects": "a"}, "expected whole numbers"),
        (False, True, {"up": "x"}, "expected y or z"),
        (False, True, {"fractions": "1,0"}, "expected three numbers"),
        (False, True, {"fractions": "1,1,1"}, "that sum to 1"),
    ],
)
def test_wrong_use(raw, generate, changed, complaint, tmp_path):
    rooms = NewRoomOptions(**{"objects": "3", "rooms": 1, "frames": 1, "fractions": "1,0,0", **changed})
    conversion = RoomConversion(output=str(tmp_path / "out.h5"))
    with pytest.raises(UsageError, match=complaint):
        ogc_dr(tmp_path if raw else None, tmp_path if generate else None, rooms=rooms, conversion=conversion)


def test_folders_without_meshes(tmp_path):
    with pytest.raises(DataError, match="no meshes in it or below"):
        GeneratedRooms(tmp_path).items()
    (tmp_path / "a.stl").write_bytes(b"")
    reader = GeneratedRooms(tmp_path, RoomOptions((2,), 1))
    with pytest.raises(DataError, match=r"a.stl: (not a readable mesh|no surface)"):
        reader.read(reader.items()[0], generator(0))
