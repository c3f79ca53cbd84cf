"""KITTI scene flow and detection: official files made byte by byte, read back, checked by projecting them again."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.errors import DataError, UsageError
from dpcli.prepare.decode.png import png_size
from dpcli.prepare.pipeline import convert
from dpcli.prepare.scans.kitti_det import Box, KittiDetection, parts_of_boxes, read_boxes, read_lists
from dpcli.prepare.scans.kitti_files import (
    View,
    calibration_matrix,
    read_calibration,
    read_png,
    read_velodyne,
    renumber_objects,
    training_folder,
)
from dpcli.prepare.scans.kitti_sf import CLASSES, KittiSceneFlow, flow_pair, unproject
from dpcli.prepare.thinning import Thinning
from dpcli.runtime.seeds import generator
from dpcli.store import CloudSequence, CloudsReader
from tests.support.commands import told as dpc
from tests.support.depth_png_helpers import png_bytes
from tests.support.kitti_helpers import P2, velodyne_to_camera, write_calibration, write_png, write_scan

H, W = 12, 16


def make_scene(seed, cityscapes=(26, 28, 27, 7)):
    """The images of a scene: instances in four columns of the image, some pixels without disparity or flow."""
    rng = np.random.default_rng(seed)
    near = P2[0, 0] * 0.54 / 12  # 12 m
    disparity = [(256 * rng.uniform(near / 4, near, (H, W))).astype(np.uint16) for _ in range(2)]  # 12 to 48 m
    for one in disparity:
        one[rng.random((H, W)) < 0.2] = 0
    flow = np.stack(
        [2**15 + rng.integers(-640, 640, (H, W)), 2**15 + rng.integers(-320, 320, (H, W)), rng.integers(0, 2, (H, W))],
        axis=-1,
    ).astype(np.uint16)
    instance = np.repeat([256 * number + 5 for number in cityscapes], W // 4).astype(np.uint16)
    return {
        "disp_occ_0": disparity[0],
        "disp_occ_1": disparity[1],
        "flow_occ": flow,
        "instance": np.tile(instance, (H, 1)),
    }


def write_scenes(raw, scenes):
    for name, images in scenes.items():
        for key, image in images.items():
            write_png(raw / "training" / key / f"{name}_10.png", image)
        calibration = {"S_02": np.ones(2), "P_rect_02": P2, "R_rect_02": np.eye(3)}
        write_calibration(raw / "training" / "calib_cam_to_cam" / f"{name}.txt", **calibration)
    return raw


def expected_points(images, far=35.0):
    """By the definition, pixel by pixel: points of both frames in camera axes that project to where the images say."""
    first, second, pixels = [], [], []
    for v in range(H):
        for u in range(W):
            d0, d1 = images["disp_occ_0"][v, u] / 256, images["disp_occ_1"][v, u] / 256
            du, dv, valid = images["flow_occ"][v, u].astype(float)
            if not (d0 and d1 and valid):
                continue
            pair = []
            for x, y, d in ((u, v, d0), (u + (du - 32768) / 64, v + (dv - 32768) / 64, d1)):
                z = P2[0, 0] * 0.54 / (d + 1e-5)
                # P [X Y z 1] = w [x y 1]: two equations for X and Y
                rows = np.array([P2[0] - x * P2[2], P2[1] - y * P2[2]])
                pair.append([*np.linalg.solve(rows[:, :2], -rows[:, 2] * z - rows[:, 3]), z])
            if max(pair[0][2], pair[1][2]) < far:
                first.append(pair[0])
                second.append(pair[1])
                pixels.append((v, u))
    return np.array(first), np.array(second), np.array(pixels)


def test_scene_flow_projects_to_the_images(tmp_path):
    images = make_scene(0)
    reader = KittiSceneFlow(write_scenes(tmp_path, {"000007": images}))
    (item,) = reader.items()
    assert (item.name, item.split, item.problem) == ("000007", "train", "")
    sequence = reader.read(item, None).sequence
    sequence.validate()
    first, second, pixels = expected_points(images)
    assert 10 < len(first) < H * W / 2
    turned = np.array([-1, -1, 1])  # x left, y up
    np.testing.assert_allclose(sequence.frame(0), first * turned, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(sequence.frame(1), second * turned, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(sequence.scene_flow[: len(first)], sequence.frame(1) - sequence.frame(0))
    np.testing.assert_array_equal(sequence.scene_flow[len(first) :], sequence.frame(0) - sequence.frame(1))
    part = np.select([pixels[:, 1] < 4, pixels[:, 1] < 8], [1, 2], 0)  # car, bus; truck and road are background
    np.testing.assert_array_equal(sequence.part, np.tile(part, 2))
    plain = KittiSceneFlow(tmp_path, coordinates="camera").read(item, None).sequence
    np.testing.assert_allclose(plain.points, sequence.points * turned)


def test_unproject_by_hand():
    """u = 610 + 720, z = 10 with a plain camera: x = z. And the part of the shift that P[2,3] makes."""
    plain = np.array([[720.0, 0, 610, 0], [0, 720, 170, 0], [0, 0, 1, 0]])
    np.testing.assert_allclose(unproject(np.array([1330.0]), np.array([170.0]), np.array([10.0]), plain), [[10, 0, 10]])
    plain[2, 3], plain[0, 3] = 0.5, 72
    expected = (1330 * 10.5 - 610 * 10 - 72) / 720
    np.testing.assert_allclose(
        unproject(np.array([1330.0]), np.array([170.0]), np.array([10.0]), plain)[0, 0], expected
    )


def test_channels_and_units():
    """One pixel: du = (2^15 + 64 - 2^15) / 64 = 1 pixel right, dv = -2; swapped channels would show."""
    flow = np.array([[[2**15 + 64, 2**15 - 128, 1]]], np.uint16)
    both = np.full((1, 1), 40.0)
    pair = flow_pair((both, both), flow, np.array([[720.0, 0, 0, 0], [0, 720, 0, 0], [0, 0, 1, 0]]), 35.0)
    depth = 720 * 0.54 / 40.00001
    np.testing.assert_allclose(pair.second - pair.first, [[depth / 720, -2 * depth / 720, 0]], atol=1e-12)
    assert not len(flow_pair((both, both), flow, P2, 9.0).pixel)


def test_truck_or_bus(tmp_path):
    raw = write_scenes(tmp_path, {"000000": make_scene(0)})
    parts = {}
    for objects in (("car", "bus"), ("car", "truck"), ("car", "truck", "bus")):
        reader = KittiSceneFlow(raw, objects)
        parts[objects] = reader.read(reader.items()[0], None).sequence.part
    assert (parts["car", "bus"] != parts["car", "truck"]).any()
    np.testing.assert_array_equal(parts["car", "truck", "bus"] > 0, (parts["car", "bus"] + parts["car", "truck"]) > 0)
    assert CLASSES["truck"] == 27 and CLASSES["bus"] == 28
    write_png(raw / "training" / "obj_map" / "000000_10.png", np.tile(np.repeat([3, 0], 8), (H, 1)).astype(np.uint8))
    reader = KittiSceneFlow(raw, labels="obj_map")
    moving = reader.read(reader.items()[0], None).sequence.part
    assert set(moving.tolist()) == {0, 1}


def test_scene_flow_command_thins_each_frame_and_keeps_flow(tmp_path):
    scenes = {f"{n:06d}": make_scene(n) for n in (3, 100)}
    raw = write_scenes(tmp_path / "KITTI Szenenfluß", scenes)
    (raw / "training" / "instance" / "000100_10.png").unlink()
    done = dpc("prepare", "kitti-sf", raw, "-o", tmp_path / "x.h5", "--points", 9, "--jobs", 1, "--item-seconds", 0)
    assert done.returncode == 0, done.stderr
    assert "2 scenes where the published training set has 200" in done.stderr
    full = KittiSceneFlow(raw)
    whole = full.read(full.items()[0], None).sequence
    with CloudsReader(tmp_path / "x.h5") as reader:
        assert reader.names == ["000003"] and reader.fields == ("part", "scene_flow")
        (skipped,) = reader.skipped
        assert skipped[0] == "000100" and "instance" in skipped[1] and "missing" in skipped[1]
        thin = reader.read(0)
    for t in range(2):
        span = slice(*whole.frame_offsets[t : t + 2])
        where = {tuple(p): k for k, p in enumerate(whole.points[span])}
        rows = [where[tuple(p)] for p in thin.frame(t)]
        assert len(set(rows)) == 9
        np.testing.assert_array_equal(thin.scene_flow[9 * t : 9 * t + 9], whole.scene_flow[span][rows])
        np.testing.assert_array_equal(thin.part[9 * t : 9 * t + 9], whole.part[span][rows])


def test_scene_flow_must_be_finite_and_is_thinned():
    points = np.arange(30, dtype=np.float32).reshape(10, 3)
    sequence = CloudSequence.from_frames("a", [points], scene_flow=[2 * points])
    sequence.validate()
    thinned = Thinning(4).apply(sequence, generator(0))
    np.testing.assert_array_equal(thinned.scene_flow, 2 * thinned.points)
    thinned.scene_flow[1, 2] = np.nan
    with pytest.raises(DataError, match="scene_flow holds NaN"):
        thinned.validate()


def damage(path, change):
    if change is None:
        path.unlink()
    else:
        path.write_bytes(change if isinstance(change, bytes) else png_bytes(change))


@pytest.mark.parametrize(
    "key, change, words",
    [
        ("flow_occ", b"", "not a readable PNG"),
        ("flow_occ", png_bytes(make_scene(0)["flow_occ"])[:60], "a truncated PNG"),
        ("flow_occ", np.zeros((H, W), np.uint16), "expected 16 bits, 3 channels"),
        ("disp_occ_0", np.zeros((H, W), np.uint8), "expected 16 bits, 1 channel"),
        ("disp_occ_1", np.zeros((H, W - 1), np.uint16), "15x12 pixels; the scene's other images have 16x12"),
        ("disp_occ_1", np.zeros((H, W), np.uint16), "no pixel has flow and both disparities"),
        ("instance", np.zeros((H, W, 3), np.uint8), "expected 8 or 16 bits, 1 channel"),
    ],
)
def test_damaged_scenes(key, change, words, tmp_path):
    raw = write_scenes(tmp_path, {"000000": make_scene(0)})
    damage(raw / "training" / key / "000000_10.png", change)
    reader = KittiSceneFlow(raw)
    with pytest.raises(DataError, match=words):
        reader.read(reader.items()[0], None)


@pytest.mark.parametrize(
    "text, words",
    [
        ("P_rect_00: 1 2 3\n", "no line 'P_rect_02:'; found P_rect_00"),
        ("", "no calibration at all"),
        ("P_rect_02: 1 2 3\n", "P_rect_02 has 3 numbers"),
        ("P_rect_02: " + "0 " * 12, "focal length 0"),
        ("P_rect_02: nan " + "1 " * 11, "all finite"),
    ],
)
def test_damaged_calibration(text, words, tmp_path):
    raw = write_scenes(tmp_path, {"000000": make_scene(0)})
    (raw / "training" / "calib_cam_to_cam" / "000000.txt").write_text(text)
    reader = KittiSceneFlow(raw)
    with pytest.raises(DataError, match=words):
        reader.read(reader.items()[0], None)


def test_folders_and_names(tmp_path):
    for reader in (KittiSceneFlow, KittiDetection):
        with pytest.raises(DataError, match="does not exist; expected a folder"):
            reader(tmp_path / "nowhere").items()
        with pytest.raises(DataError, match=r"no training/\w+/ in it"):
            reader(tmp_path).items()
    (tmp_path / "training" / "flow_occ").mkdir(parents=True)
    with pytest.raises(DataError, match="no 000000_10.png"):
        KittiSceneFlow(tmp_path).items()
    (tmp_path / "training" / "flow_occ" / "first_10.png").touch()
    with pytest.raises(DataError, match="expected a name of six digits"):
        KittiSceneFlow(tmp_path).items()
    assert training_folder(tmp_path / "training", "flow_occ") == tmp_path / "training"


def test_wrong_options(tmp_path):
    for options, words in (
        ({"objects": ("lorry",)}, "--objects lorry: lorry is not a class"),
        ({"objects": ()}, "nothing is not a class"),
        ({"labels": "x"}, "expected instance or obj_map"),
        ({"far": 0.0}, "above 0"),
        ({"coordinates": "x"}, "expected published or camera"),
    ):
        with pytest.raises(UsageError, match=words):
            KittiSceneFlow(tmp_path, **options)
    with pytest.raises(UsageError, match="expected some of Car, Van"):
        KittiDetection(tmp_path, objects=("car",))
    with pytest.raises(UsageError, match="expected 0 < near < far"):
        View(5.0, 4.0)


# --- detection ---

RECTIFY = np.linalg.qr(np.eye(3) + 0.01 * np.arange(9).reshape(3, 3))[0]
RECTIFY = RECTIFY * np.sign(np.diag(RECTIFY))


def to_scanner(points):
    """Rectified camera points (N,3) -> the scanner's axes."""
    camera = points @ RECTIFY  # R0^-1 = R0^T
    inverse = np.linalg.inv(velodyne_to_camera())
    return camera @ inverse[:3, :3].T + inverse[:3, 3]


def box_points(foot, size, angle, rng, count=40):
    """Points inside a box of height, width, length and the same number just outside of it, in camera axes."""
    height, width, length = size
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])  # about y
    local = rng.uniform(-1, 1, (count, 3)) * [length / 2, height / 2, width / 2] - [0, height / 2, 0]
    side = np.eye(3)[rng.integers(3, size=count)] * rng.choice([-1, 1], (count, 1))
    outside = np.where(side != 0, side * (np.array([length, height, width]) / 2 + 0.02), local + [0, height / 2, 0])
    outside -= [0, height / 2, 0]
    return local @ turn.T + foot, outside @ turn.T + foot


def label_line(kind, foot, size, angle):
    numbers = [0.0, 0, -1.5, 600, 150, 700, 250, *size, *foot, angle]
    return kind + " " + " ".join(f"{value:.2f}" for value in numbers)


CARS = [((2.0, 1.6, 15.0), (1.5, 1.7, 4.2), 0.6), ((-3.0, 1.5, 22.0), (1.4, 1.6, 3.9), -2.2)]


def write_detection(raw, name="000003"):
    rng = np.random.default_rng(0)
    inside, outside = zip(*(box_points(*car, rng) for car in CARS))
    van, _ = box_points((6.0, 1.6, 20.0), (2.0, 1.8, 4.0), 0.0, rng)
    cloud = np.concatenate([*inside, *outside, van])
    write_scan(raw / "training" / "velodyne" / f"{name}.bin", to_scanner(cloud))
    matrices = {"P0": P2, "P2": P2, "R0_rect": RECTIFY, "Tr_velo_to_cam": velodyne_to_camera()[:3]}
    write_calibration(raw / "training" / "calib" / f"{name}.txt", **matrices)
    lines = [
        label_line("Car", *CARS[0]),
        label_line("DontCare", (-1000, -1000, -1000), (-1, -1, -1), -10),
        label_line("Van", (6.0, 1.6, 20.0), (2.0, 1.8, 4.0), 0.0),
        label_line("Car", *CARS[1]),
    ]
    (raw / "training" / "label_2").mkdir(parents=True, exist_ok=True)
    (raw / "training" / "label_2" / f"{name}.txt").write_text("\n".join(lines) + "\n")
    write_png(raw / "training" / "image_2" / f"{name}.png", np.zeros((375, 1242), np.uint8))
    return cloud


def test_detection_labels_what_the_boxes_hold(tmp_path):
    cloud = write_detection(tmp_path)
    reader = KittiDetection(tmp_path)
    (item,) = reader.items()
    sample = reader.read(item, None)
    sample.sequence.validate()
    assert sample.notes == {}
    np.testing.assert_allclose(sample.sequence.points, cloud * [-1, -1, 1], atol=1e-4)  # all of it is in view
    expected = np.repeat([1, 2, 0, 0, 0], 40)
    np.testing.assert_array_equal(sample.sequence.part, expected)
    boxes = read_boxes(tmp_path / "training" / "label_2" / "000003.txt")
    assert [box.kind for box in boxes] == ["Car", "Van", "Car"]
    wrong = [Box(b.kind, b.foot, b.height, b.width, b.length, -b.rotation_y) for b in boxes if b.kind == "Car"]
    assert (parts_of_boxes(cloud, wrong) != expected).any()  # turned the other way: the test would see it
    vans = KittiDetection(tmp_path, objects=("Car", "Van")).read(item, None).sequence.part
    np.testing.assert_array_equal(vans, np.repeat([1, 3, 0, 0, 2], 40))


@pytest.mark.parametrize("kind", ["car", "Vehicle", "Bus"])
def test_boxes_of_types_that_kitti_lacks_are_told(tmp_path, kind):
    write_detection(tmp_path)
    path = tmp_path / "training" / "label_2" / "000003.txt"
    path.write_text(path.read_text().replace("Car", kind, 1))
    reader = KittiDetection(tmp_path)
    notes = reader.read(reader.items()[0], None).notes
    assert notes == {f"boxes left out whose type is none of KITTI's, such as '{kind}'": 1}


def brute_force_crop(scan, to_camera, projection, size, near=2.0, far=35.0):
    kept = []
    for k, (x, y, z) in enumerate(scan.astype(float)):
        camera = to_camera @ [x, y, z, 1]
        u, v, w = (projection @ camera)[:3]
        if x > near and camera[2] < far and w > 0 and 0 <= u / w < size[0] and 0 <= v / w < size[1]:
            kept.append(k)
    return kept


def test_crop_is_the_definition(shared_data):
    scan = read_velodyne(shared_data / "lidar" / "kitti_consecutive" / "000000.bin")[::40]
    projection, to_camera = np.vstack([P2, [0, 0, 0, 1]]), velodyne_to_camera()
    points, index = View().crop(scan, to_camera, projection, (1242, 375))
    expected = brute_force_crop(scan, to_camera, projection, (1242, 375))
    assert index.tolist() == expected and 100 < len(expected) < len(scan) / 2
    camera = np.concatenate([scan[expected], np.ones((len(expected), 1))], axis=1) @ to_camera.T
    np.testing.assert_allclose(points, camera[:, :3], atol=1e-9)
    assert len(View(far=20.0).crop(scan, to_camera, projection, (1242, 375))[1]) < len(expected)
    assert len(View().crop(scan, to_camera, projection, (600, 375))[1]) < len(expected)


@pytest.mark.parametrize(
    "change", ["label_2/000001.txt", "calib/000001.txt", "velodyne/000000.bin", "image_2/000000.png"]
)
def test_other_files_of_the_same_names_are_other_data(tmp_path, change):
    for name in ("000000", "000001"):
        write_detection(tmp_path, name)
    path, out = tmp_path / "training" / change, tmp_path / "x.h5"
    kept = path.read_bytes()
    path.write_bytes(b"") if "velodyne" in change else path.unlink()
    convert(KittiDetection(tmp_path), out)
    assert convert(KittiDetection(tmp_path), out).was_complete
    path.write_bytes(kept)
    with pytest.raises(UsageError, match="exists, made with"):
        convert(KittiDetection(tmp_path), out)


@pytest.mark.parametrize("folder", ["flow_occ", "disp_occ_1", "instance"])
def test_other_pictures_of_the_same_names_are_other_data(tmp_path, folder):
    write_scenes(tmp_path, {"000000": make_scene(0), "000001": make_scene(1)})
    path = tmp_path / "training" / folder / "000000_10.png"
    kept, out = path.read_bytes(), tmp_path / "x.h5"
    path.write_bytes(kept[:60])
    convert(KittiSceneFlow(tmp_path), out)
    path.write_bytes(kept)
    with pytest.raises(UsageError, match="exists, made with"):
        convert(KittiSceneFlow(tmp_path), out)


def test_detection_command_lists_and_notes(tmp_path):
    raw = tmp_path / "kitti objekte"
    for name in ("000000", "000003", "000005"):
        write_detection(raw, name)
    (raw / "training" / "image_2" / "000003.png").unlink()
    (raw / "training" / "label_2" / "000005.txt").unlink()
    (raw / "ImageSets").mkdir()
    (raw / "ImageSets" / "train.txt").write_text("000000\n000009\n")
    (raw / "ImageSets" / "val.txt").write_text("000003\n000005\n")
    done = dpc("prepare", "kitti-det", raw, "-o", tmp_path / "x.h5", "--jobs", 1, "--item-seconds", 0)
    assert done.returncode == 0, done.stderr
    assert "cropped to 1242x375, their image_2 is missing: 1" in done.stderr
    assert "000009.bin: listed (train), but not there" in done.stderr
    with CloudsReader(tmp_path / "x.h5") as reader:
        assert dict(zip(reader.names, reader.splits)) == {"000000": "train", "000003": "validation"}
        assert [name for name, _ in reader.skipped] == ["000005", "000009"]
        assert reader.length_unit == "m"


@pytest.mark.parametrize(
    "text, words",
    [
        ("Car 0 0\n", r"000003.txt:1: 'Car 0 0'; expected a type and 14 numbers"),
        ("\n" + label_line("Car", (0, 0, 9), (0, 1, 1), 0), r"000003.txt:2: a box of size 0.0"),
        (label_line("Car", (0, 0, float("nan")), (1, 1, 1), 0), "expected finite numbers"),
    ],
)
def test_damaged_labels(text, words, tmp_path):
    write_detection(tmp_path)
    (tmp_path / "training" / "label_2" / "000003.txt").write_text(text)
    reader = KittiDetection(tmp_path)
    with pytest.raises(DataError, match=words):
        reader.read(reader.items()[0], None)


def test_damaged_scans_and_lists(tmp_path):
    write_detection(tmp_path)
    scan = tmp_path / "training" / "velodyne" / "000003.bin"
    reader = KittiDetection(tmp_path)
    good = scan.read_bytes()
    for data, words in (
        (good[:-3], "expected some points of 16"),
        (b"", "0 bytes"),
        (np.full(4, np.nan, "<f4").tobytes(), "1 point NaN"),
        (np.full(4, -9, "<f4").tobytes(), "no point in the camera's view"),
    ):
        scan.write_bytes(data)
        with pytest.raises(DataError, match=words):
            reader.read(reader.items()[0], None)
    image = tmp_path / "training" / "image_2" / "000003.png"
    assert png_size(image) == (1242, 375)
    image.write_bytes(image.read_bytes()[:20])
    with pytest.raises(DataError, match="not a PNG"):
        png_size(image)
    (tmp_path / "train.txt").write_text("000001\n000001\n")
    with pytest.raises(DataError, match="000001 is listed twice"):
        read_lists(tmp_path)
    (tmp_path / "train.txt").write_text("../x\n")
    with pytest.raises(DataError, match="expected six digits a line"):
        read_lists(tmp_path)
    with pytest.raises(DataError, match="neither train.txt nor val.txt"):
        KittiDetection(tmp_path, lists=tmp_path / "training").items()


def test_small_pieces(tmp_path):
    assert renumber_objects(np.array([0, 900, 7, 7, 0])).tolist() == [0, 2, 1, 1, 0]
    write_calibration(tmp_path / "c.txt", R0_rect=np.arange(9))
    found = read_calibration(tmp_path / "c.txt")
    assert list(found) == ["R0_rect"]
    matrix = calibration_matrix(found, tmp_path / "c.txt", "R0_rect")
    np.testing.assert_array_equal(matrix[:3, :3], np.arange(9).reshape(3, 3))
    np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])
    image = np.arange(18, dtype=np.uint16).reshape(2, 3, 3)
    write_png(tmp_path / "a.png", image)
    np.testing.assert_array_equal(read_png(tmp_path / "a.png", 3), image)  # the channels in the file's order
