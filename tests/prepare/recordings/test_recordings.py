"""Recordings of robots: clouds and depth of every kind of file arrive as they were sent, with their times."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError
from dpcli.prepare.actions.depth import DepthVideos
from dpcli.prepare.cloud_formats.cloud import BEYOND
from dpcli.prepare.decode.pinhole_camera import Calibration, Intrinsics
from dpcli.prepare.recordings.depth import CHANGES
from dpcli.prepare.recordings.messages import calibration_of_message, cloud_of_message, depth_of_message
from dpcli.prepare.recordings.recording import find_recordings, holds_only_recordings
from dpcli.prepare.recordings.topic_frames import LACKING, LOGGED, PACES, SEVERAL_PLACES, SORTED, UNLISTED
from dpcli.prepare.scans.assembling import UNREAD_COLORS
from dpcli.prepare.scans.recorded_clouds import RecordedClouds
from tests.support.recording_helpers import KINDS, START, TYPES, Messages, write_recording

pytest.importorskip("rosbags")
RNG = np.random.default_rng(0)
XYZ = np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4")])
K = [500.0, 0, 8, 0, 510, 6, 0, 0, 1]


def points_of(count: int, kind: np.dtype = XYZ, seed: int = 0) -> np.ndarray:
    points = np.zeros(count, kind)
    for name in kind.names:
        values = np.random.default_rng([seed, len(name)]).uniform(1, 100, count)
        points[name] = values
    return points


def depth16(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(500, 3000, (12, 16)).astype(np.uint16)


def read(reader, place: int = 0):
    return reader.read(reader.items()[place], RNG)


@pytest.mark.parametrize("kind", KINDS)
def test_clouds_of_every_kind_of_recording_with_the_times_of_their_headers(tmp_path, kind):
    make = Messages(kind)
    frames = [points_of(5 + t, seed=t) for t in range(3)]
    stamps = [START, START + 100_000_000, START + 350_000_000]
    content = [("/lidar", stamp + 7_000_000 * t, make.cloud(frames[t], stamp)) for t, stamp in enumerate(stamps)]
    reader = RecordedClouds(write_recording(tmp_path / "run", kind, make, content))
    sequence = read(reader).sequence
    assert np.diff(sequence.frame_offsets).tolist() == [5, 6, 7]
    np.testing.assert_array_equal(sequence.points, np.concatenate([f.view("f4").reshape(-1, 3) for f in frames]))
    np.testing.assert_allclose(sequence.time, [0, 0.1, 0.35], atol=1e-9)
    assert reader.fields == ("time",)


PACKED = [
    ("bag", "BZ2"),
    ("bag", "LZ4"),
    ("mcap", "FILE"),
    ("mcap", "MESSAGE"),
    ("mcap", "STORAGE"),
    ("sqlite3", "FILE"),
]


@pytest.mark.parametrize(("kind", "packed"), [*PACKED, ("sqlite3", "MESSAGE"), ("bag", "")])
def test_packed_recordings_and_suffixes_in_capitals(tmp_path, kind, packed):
    make = Messages(kind)
    path = write_recording(tmp_path / "run", kind, make, scans(make, [0, 1, 2]), packed)
    if not packed:
        path = path.rename(path.with_suffix(".BAG"))
    assert holds_only_recordings(path, ()) and find_recordings(tmp_path) == [path]
    sequence = read(RecordedClouds(path)).sequence
    np.testing.assert_array_equal(sequence.points, np.concatenate([rows(t) for t in range(3)]))


def rows(number: int) -> np.ndarray:
    """The points of scan ``number``, f32 (N,3)."""
    return points_of(4 + number, seed=number).view("f4").reshape(-1, 3)


def scans(make: Messages, taken: list[int], places: str = "a", clock: int = START) -> list:
    """Scans 0, 1, ..., recorded every tenth of a second; ``taken``: in which tenth their headers say."""
    content = []
    for number, tenth in enumerate(taken):
        message = make.cloud(points_of(4 + number, seed=number))
        message.header = make.header(clock + tenth * 10**8, places[number % len(places)])
        content.append(("/lidar", START + number * 10**8, message))
    return content


@pytest.mark.parametrize(
    ("taken", "clock", "order", "note"),
    [
        ([0, 1, 3], 10**9, [0, 1, 2], None),  # since the sensor was switched on
        ([0, 2, 1, 3], START, [0, 2, 1, 3], SORTED),
        ([0, 1, 1, 3], START, [0, 1, 2, 3], LOGGED),
        ([0, 900, 1, 2], START, [0, 1, 2, 3], LOGGED),  # a clock that was set while it recorded
    ],
)
def test_frames_have_the_order_and_times_of_their_headers(tmp_path, taken, clock, order, note):
    make = Messages("bag")
    sample = read(RecordedClouds(write_recording(tmp_path / "run", "bag", make, scans(make, taken, clock=clock))))
    np.testing.assert_array_equal(sample.sequence.points, np.concatenate([rows(number) for number in order]))
    tenths = sorted(taken) if note != LOGGED else range(len(taken))
    np.testing.assert_allclose(sample.sequence.time, np.array(tenths) / 10, atol=1e-9)
    assert sample.notes == ({note: 1} if note else {})


@pytest.mark.parametrize(("scale", "told"), [(1, False), (10, False), (1000, True), (0.001, True)])
def test_headers_whose_time_passes_at_another_pace_are_doubted(tmp_path, scale, told):
    make = Messages("mcap")
    content = [("/l", START + t * 10**8, make.cloud(points_of(3), 1 + round(t * 10**8 / scale))) for t in range(3)]
    sample = read(RecordedClouds(write_recording(tmp_path / "run", "mcap", make, content)))
    assert sample.notes == ({PACES: 1} if told else {}) and np.isclose(sample.sequence.time[1], 0.1 / scale)


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
@pytest.mark.parametrize("name", ["run.bag", "run.mcap", "run.db3"])
def test_a_folder_of_ros_2_may_be_called_as_a_file_is(tmp_path, kind, name):
    make = Messages(kind)
    path = write_recording(tmp_path / "run", kind, make, scans(make, [0, 1])).rename(tmp_path / name)
    sequence = read(RecordedClouds(path)).sequence
    np.testing.assert_array_equal(sequence.points, np.concatenate([rows(0), rows(1)]))
    assert find_recordings(tmp_path) == [path]


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
@pytest.mark.parametrize("packed", ["", "FILE"])
def test_files_that_a_folder_of_ros_2_does_not_list_are_counted(tmp_path, kind, packed):
    make = Messages(kind)
    path = write_recording(tmp_path / "run", kind, make, scans(make, [0, 1]), packed)
    assert read(RecordedClouds(path)).notes == {}
    (file,) = (one for one in path.iterdir() if one.suffix != ".yaml")
    (path / f"more_{file.name}").write_bytes(file.read_bytes())
    assert read(RecordedClouds(path)).notes == {UNLISTED: 1}


def test_recordings_still_written_or_packed_are_named(tmp_path):
    make = Messages("mcap")
    for name in ("a", "b"):
        write_recording(tmp_path / name, "mcap", make, scans(make, [0, 1]), "FILE" if name == "b" else "")
    for name in ("c.bag.active", "d.MCAP.gz", "e.db3.zstd", "README.bag", ".f.bag.gz", "a.bag.txt.md"):
        (tmp_path / name).touch()
    reader = RecordedClouds(tmp_path)
    assert reader.summary(reader.items())[1].startswith(
        "left out, not .bag, .mcap or .db3: c.bag.active, d.MCAP.gz, e.db3.zstd;"
    )


def test_scans_of_several_sensors_in_one_topic_and_lost_messages_are_told(tmp_path):
    make = Messages("sqlite3")
    path = write_recording(tmp_path / "run", "sqlite3", make, scans(make, [0, 1, 2], places="ab"))
    (table,) = path.glob("*.db3")
    with closing(sqlite3.connect(table)) as base, base:
        base.execute("DELETE FROM messages WHERE id = 2")
    assert read(RecordedClouds(path)).notes == {LACKING: 1}
    with closing(sqlite3.connect(table)) as base, base:
        base.execute("DELETE FROM messages")
    with pytest.raises(DataError, match="/lidar declares 3 messages and holds none"):
        read(RecordedClouds(path))
    several = write_recording(tmp_path / "two", "sqlite3", make, scans(make, [0, 1, 2], places="ab"))
    assert read(RecordedClouds(several)).notes == {SEVERAL_PLACES: 1}


def test_fields_that_are_not_read_are_named_and_colors_are_on_all_frames(tmp_path):
    make = Messages("mcap")
    bright = np.dtype([*XYZ.descr, ("intensity", "u2"), ("ring", "u1"), ("rgb", "u4")])
    content = [("/c", START + t, make.cloud(points_of(4, kind))) for t, kind in enumerate((bright, XYZ))]
    reader = RecordedClouds(write_recording(tmp_path / "run", "mcap", make, content[:1]), keep=("ring",))
    assert reader.summary(reader.items()) == ["1 recording found; not read: intensity (--keep-fields)"]
    with pytest.raises(DataError, match="1 of 2 frames without colors"):
        read(RecordedClouds(write_recording(tmp_path / "two", "mcap", make, content)))


@pytest.mark.parametrize("together", [True, False])  # in one recording, or the second in another
def test_colors_and_fields_that_the_first_cloud_lacks_are_told(tmp_path, together):
    make = Messages("mcap")
    bright = np.dtype([*XYZ.descr, ("ring", "u1"), ("rgb", "u4")])
    content = [("/c", START + t, make.cloud(points_of(4, kind), START + t)) for t, kind in enumerate((XYZ, bright))]
    for number, part in enumerate([content] if together else [content[:1], content[1:]]):
        write_recording(tmp_path / "raw" / str(number), "mcap", make, part)
    reader = RecordedClouds(tmp_path / "raw")
    told = {UNREAD_COLORS: 1, "frames with further columns (ring), which are not read": 1}
    assert [read(reader, place).notes for place in range(1 if together else 2)] == ([told] if together else [{}, told])
    assert "color" not in reader.fields


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(
    types=st.lists(st.sampled_from(sorted(TYPES)), min_size=3, max_size=3),
    order=st.permutations(["x", "y", "z", "intensity"]),
    gap=st.integers(0, 5),
    height=st.sampled_from([1, 3]),
    padding=st.integers(0, 9),
    big=st.booleans(),
)
def test_clouds_of_every_layout_arrive_as_they_were_sent(types, order, gap, height, padding, big):
    make = Messages("mcap")
    named = dict(zip("xyz", types), intensity="f4")
    offsets, end = [], gap
    for name in order:
        offsets.append(end)
        end += np.dtype(named[name]).itemsize + gap
    kind = np.dtype({"names": order, "formats": [named[n] for n in order], "offsets": offsets, "itemsize": end})
    sent = points_of(6, kind)
    cloud = cloud_of_message(Path("run"), make.cloud(sent, height=height, padding=padding, big=big), ("intensity",))
    np.testing.assert_array_equal(cloud.points, np.stack([sent[axis].astype("f8") for axis in "xyz"], axis=1))
    np.testing.assert_array_equal(cloud.extra["intensity"], sent["intensity"])


@pytest.mark.parametrize("place", [0, 1])
def test_a_message_without_points_and_fields_is_a_frame_in_which_nothing_was_seen(tmp_path, place):
    make = Messages("bag")
    kind = np.dtype([*XYZ.descr, ("rgb", "u4"), ("ring", "u1")])
    sent = [make.cloud(points_of(4, kind, seed=t), START + t) for t in range(3)]
    sent[place] = replace(
        sent[place], fields=[], height=0, width=0, point_step=0, row_step=0, data=np.zeros(0, np.uint8)
    )
    content = [("/c", START + t, message) for t, message in enumerate(sent)]
    reader = RecordedClouds(write_recording(tmp_path / "run", "bag", make, content), keep=("ring",))
    sample = read(reader)
    assert sample.notes == {"frames without points dropped": 1} and "color" in reader.fields
    assert np.diff(sample.sequence.frame_offsets).tolist() == [4, 4] and len(sample.sequence.extra["field_ring"]) == 8


@pytest.mark.parametrize(("width", "height", "padding", "beyond"), [(4, 1, 0, 6), (2, 3, 3, 4), (0, 1, 0, 10)])
def test_points_beyond_the_size_of_a_message_are_counted(width, height, padding, beyond):
    make = Messages("mcap")
    message = make.cloud(points_of(10), height=5 if padding else 1, padding=padding)
    row_step = message.row_step if padding else 12 * width
    cloud = cloud_of_message(Path("a.mcap"), replace(message, width=width, height=height, row_step=row_step))
    assert len(cloud.points) == width * height and cloud.dropped == {BEYOND: beyond}


def test_packed_colors_and_points_that_saw_nothing(tmp_path):
    make = Messages("mcap")
    points = points_of(4, np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4"), ("rgb", "f4")]))
    points["rgb"] = np.array([0xFF0000, 0x00FF00, 0x0000FF, 0x102030], np.uint32).view("f4")
    points["x"][1] = np.nan
    reader = RecordedClouds(write_recording(tmp_path / "run", "mcap", make, [("/c", START, make.cloud(points))]))
    sample = read(reader)
    assert sample.sequence.color.tolist() == [[255, 0, 0], [0, 0, 255], [16, 32, 48]]
    assert sum(sample.notes.values()) == 1, sample.notes


def test_a_topic_is_chosen_or_the_topics_are_listed(tmp_path):
    make = Messages("bag")
    content = [(topic, START, make.cloud(points_of(3))) for topic in ("/front", "/rear")]
    path = write_recording(tmp_path / "run", "bag", make, [*content, ("/image", START, make.image(depth16()))])
    assert read(RecordedClouds(path, topic="rear")).sequence.num_frames == 1
    with pytest.raises(
        DataError,
        match="choose one that holds clouds .PointCloud2, CustomMsg of Livox, PointCloud of Foxglove. with --topic: /front, /rear",
    ):
        read(RecordedClouds(path))
    with pytest.raises(DataError, match="no topic /top; choose one"):
        read(RecordedClouds(path, topic="/top"))
    with pytest.raises(DataError, match="/image is of type sensor_msgs/msg/Image; choose one"):
        read(RecordedClouds(path, topic="/image"))


def test_times_of_the_recording_count_where_headers_have_none(tmp_path):
    make = Messages("sqlite3")
    content = [("/lidar", START + t * 50_000_000, make.cloud(points_of(3, seed=t), stamp=0)) for t in range(3)]
    path = write_recording(tmp_path / "run", "sqlite3", make, content)
    np.testing.assert_allclose(read(RecordedClouds(path)).sequence.time, [0, 0.05, 0.1], atol=1e-9)
    np.testing.assert_allclose(read(RecordedClouds(path, stride=2)).sequence.time, [0, 0.1], atol=1e-9)
    np.testing.assert_allclose(read(RecordedClouds(path, fps=10, stride=2)).sequence.time, [0, 0.2], atol=1e-9)


def test_labels_from_folders_and_from_a_table(tmp_path):
    make = Messages("bag")
    for name in ("walk/1", "walk/2", "fall/1"):
        write_recording(tmp_path / "raw" / name, "bag", make, [("/l", START, make.cloud(points_of(3)))])
    reader = RecordedClouds(tmp_path / "raw", label_from_folder=True)
    assert [(i.name, i.label) for i in reader.items()] == [("fall/1.bag", 0), ("walk/1.bag", 1), ("walk/2.bag", 1)]
    (tmp_path / "t.csv").write_text("name,label\nwalk/1.bag,w\nfall/1.bag,f\n")
    assert [i.label for i in RecordedClouds(tmp_path / "raw", labels=tmp_path / "t.csv").items()] == [0, 1, -1]


def test_fields_of_several_numbers_a_point_and_names_that_come_again_are_told():
    message = Messages("mcap").cloud(points_of(5))
    message.fields += [
        replace(message.fields[0], name="normal", count=3),
        replace(message.fields[0], name="odd", datatype=9),
        replace(message.fields[0], offset=8),
    ]
    cloud = cloud_of_message(Path("a.mcap"), message)
    assert len(cloud.points) == 5 and cloud.unread == ("normal", "odd", "x (again)")
    np.testing.assert_array_equal(cloud.points[:, 0], points_of(5)["x"])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "form",
    [
        "16UC1",
        "mono16",
        "big",
        "padded",
        "16UC1; compressedDepth png",
        "16UC1; compressedDepth rvl",
        "16UC1; png compressed ",
    ],
)
def test_depth_images_with_the_camera_that_the_recording_describes(tmp_path, kind, form):
    make = Messages(kind)
    content = [("/cam/depth/camera_info", START, make.camera(K, 16, 12))]
    for t in range(2):
        frame, stamp = depth16(t), START + t * 33_000_000
        if ";" in form:
            message = make.compressed(frame, stamp, form=form)
        else:
            encoding = "mono16" if form == "mono16" else "16UC1"
            message = make.image(frame, stamp, encoding=encoding, big=form == "big", padding=6 * (form == "padded"))
        content += [("/cam/depth/image_raw", stamp, message), ("/cam/color/image_raw", stamp, color_image(make, stamp))]
    reader = DepthVideos(inputs=(write_recording(tmp_path / "run", kind, make, content),))
    sequence = read(reader).sequence
    meters = np.concatenate([depth16(t).reshape(-1) for t in range(2)]) / 1000
    np.testing.assert_allclose(sequence.points[:, 2], meters, rtol=1e-6)
    np.testing.assert_allclose(
        sequence.points[0], [(0 - 8) / 500 * meters[0], (0 - 6) / 510 * meters[0], meters[0]], rtol=1e-5
    )
    np.testing.assert_allclose(sequence.time, [0, 0.033], atol=1e-9)


def color_image(make: Messages, stamp: int):
    return make.image(np.zeros((12, 48), np.uint8), stamp, encoding="rgb8")


def test_float_depth_plain_and_compressed(tmp_path):
    make = Messages("mcap")
    meters = depth16().astype(np.float32) / 1000
    meters[0, 0] = np.nan
    whole = np.nan_to_num(meters)
    for name, message, tolerance in (
        ("plain", make.image(meters, encoding="32FC1"), 1e-6),
        ("packed", make.compressed(whole, form="32FC1; compressedDepth png"), 0.02),
    ):
        path = write_recording(tmp_path / name, "mcap", make, [("/depth", START, message)])
        sample = read(DepthVideos(inputs=(path,), fov=60))
        np.testing.assert_allclose(sample.sequence.points[:, 2], whole[whole > 0], rtol=tolerance)


def test_rectified_images_have_the_projection_and_others_their_lens(tmp_path):
    make = Messages("mcap")
    info = make.camera(K, 16, 12, d=(0.3, 0.0, 0.0, 0.0, 0.0), p=[400, 0, 7, 0, 0, 410, 5, 0, 0, 0, 1, 0])
    corner = {}
    for name in ("image_raw", "image_rect"):
        content = [
            ("/d/camera_info", START, info),
            (f"/d/{name}", START, make.image(np.full((12, 16), 1000, np.uint16))),
        ]
        corner[name] = read(
            DepthVideos(inputs=(write_recording(tmp_path / name, "mcap", make, content),))
        ).sequence.points[0]
    np.testing.assert_allclose(corner["image_rect"], [-7 / 400, -5 / 410, 1], rtol=1e-6)
    x, y = corner["image_raw"][:2].astype(float)
    bent = 1 + 0.3 * (x * x + y * y)
    np.testing.assert_allclose([x * bent, y * bent], [-8 / 500, -6 / 510], rtol=1e-6)


def test_what_a_user_gives_comes_before_what_the_recording_says(tmp_path):
    make = Messages("mcap")
    content = [("/d/camera_info", START, make.camera(K, 16, 12)), ("/d/image", START, make.image(depth16()))]
    path = write_recording(tmp_path / "run", "mcap", make, content)
    own = Calibration(Intrinsics(100, 100, 8, 6))
    first = read(DepthVideos(inputs=(path,), calibration=own)).sequence.points[0]
    np.testing.assert_allclose(first[0] / first[2], -8 / 100, rtol=1e-6)
    bare = write_recording(tmp_path / "bare", "mcap", make, [("/color/camera_info", START, content[0][2]), content[1]])
    assert any("without camera_info" in note for note in read(DepthVideos(inputs=(bare,))).notes)


def test_recordings_of_a_realsense_have_its_camera_and_its_units(tmp_path):
    make, sensor = Messages("bag"), "/device_0/sensor_0"
    units = [make.make("std_msgs/msg/Float32", data=value) for value in (0.0001, 0.001)]
    content = [
        ("/device_0/sensor_1/Color_0/info/camera_info", START, make.camera([9.0, 0, 8, 0, 9, 6, 0, 0, 1], 16, 12)),
        (f"{sensor}/Depth_0/info/camera_info", START, make.camera(K, 16, 12)),
        (f"{sensor}/option/Depth_Units/value", START, units[0]),
        ("/device_0/sensor_1/option/Depth_Units/value", START, units[1]),
        (f"{sensor}/Depth_0/image/data", START, make.image(depth16(), encoding="mono16")),
    ]
    path = write_recording(tmp_path / "run", "bag", make, content)
    meters = depth16().reshape(-1) / 10_000
    points = read(DepthVideos(inputs=(path,))).sequence.points
    np.testing.assert_allclose(points[:, 2], meters, rtol=1e-6)
    np.testing.assert_allclose(points[0, :2], [-8 / 500 * meters[0], -6 / 510 * meters[0]], rtol=1e-5)
    np.testing.assert_allclose(
        read(DepthVideos(inputs=(path,), depth_scale=2000)).sequence.points[:, 2], meters * 5, rtol=1e-6
    )
    path = write_recording(tmp_path / "two", "bag", make, [*content, (content[2][0], START + 1, units[1])])
    with pytest.raises(DataError, match=r"Depth_Units/value changes on the way \(0.0001, 0.001\)"):
        read(DepthVideos(inputs=(path,)))


@pytest.mark.parametrize(
    ("focal", "counts", "changes"), [((0.0, 400.0, 400.0), 400.0, False), ((500.0, 400.0), 500.0, True)]
)
def test_the_first_camera_that_is_calibrated_counts_and_a_change_is_told(tmp_path, focal, counts, changes):
    make = Messages("mcap")
    content = [("/c/depth", START, make.image(np.full((12, 16), 1000, np.uint16)))]
    content += [
        ("/c/camera_info", START + t, make.camera([f, 0, 8, 0, f, 6, 0, 0, 1], 16, 12)) for t, f in enumerate(focal)
    ]
    sample = read(DepthVideos(inputs=(write_recording(tmp_path / "run", "mcap", make, content),)))
    np.testing.assert_allclose(sample.sequence.points[0, 0], -8 / counts, rtol=1e-6)
    assert sample.notes == ({CHANGES: 1} if changes else {})


def test_of_several_camera_infos_the_one_that_says_depth_counts(tmp_path):
    make = Messages("mcap")
    image = ("/robot/depth", START, make.image(np.full((12, 16), 1000, np.uint16)))
    infos = {name: make.camera([k, 0, 8, 0, k, 6, 0, 0, 1], 16, 12) for name, k in (("rgb", 100.0), ("depth", 500.0))}
    content = [(f"/robot/{name}_camera_info", START, info) for name, info in infos.items()]
    path = write_recording(tmp_path / "run", "mcap", make, [*content, image])
    np.testing.assert_allclose(read(DepthVideos(inputs=(path,))).sequence.points[0, 0], -8 / 500, rtol=1e-6)
    path = write_recording(
        tmp_path / "two", "mcap", make, [(f"/robot/{k}", START, infos["rgb"]) for k in "ab"] + [image]
    )
    assert any("without camera_info of their depth" in note for note in read(DepthVideos(inputs=(path,))).notes)


@pytest.mark.parametrize(
    ("frame", "encoding", "message"),
    [
        (np.zeros((4, 12), np.uint8), "rgb8", "images of encoding 'rgb8'; expected depth"),
        (np.zeros((4, 4), np.uint16), "16UC1", r"none of its frames \(1\) has a valid depth"),
    ],
)
def test_images_that_are_no_depth_are_named(tmp_path, frame, encoding, message):
    make = Messages("bag")
    path = write_recording(tmp_path / "run", "bag", make, [("/i", START, make.image(frame, encoding=encoding))])
    with pytest.raises(DataError, match=message):
        read(DepthVideos(inputs=(path,), fov=60))


@pytest.mark.parametrize("change", [{"step": 16}, {"width": 17}, {"height": 13}])
def test_an_image_whose_bytes_are_not_of_its_size_is_damaged(change):
    sent = Messages("mcap").image(depth16())
    with pytest.raises(DataError, match="an image of .* 16UC1 has 384 bytes; it is damaged"):
        depth_of_message(Path("a.mcap"), "sensor_msgs/msg/Image", replace(sent, **change))


IR, PLAIN, JPEG = "/kinect/ir/image_raw", "/usb_cam/image_raw", "mono8; jpeg compressed "


@pytest.mark.parametrize(
    ("topic", "encoding", "message"),
    [
        (PLAIN, "mono8", "/usb_cam/image_raw holds 8-bit images, hardly depth; if they are, name it with --topic"),
        (IR, "mono16", "no topic holds depth: /kinect/ir/image_raw; if one does, name it"),
        (PLAIN + "/compressed", JPEG, "are JPEG, which holds no depth"),
        ("/stereo/disparity", "32FC1", "/stereo/disparity holds disparities, not depth"),
        ("/d/depth", "16UC1; compressedDepth rvl", "can't hold such a picture"),
    ],
)
def test_pictures_of_cameras_are_no_depth(tmp_path, topic, encoding, message):
    make = Messages("bag")
    gray = (depth16() // 20).astype({"mono16": "u2", "32FC1": "f4"}.get(encoding, "u1"))
    if ";" in encoding:
        image = make.compressed(gray, form=encoding)
        image.data = np.frombuffer(cv2.imencode(".jpg", gray)[1].tobytes(), np.uint8)
    else:
        image = make.image(gray, encoding=encoding)
    path = write_recording(tmp_path / "run", "bag", make, [(topic, START, image)])
    with pytest.raises(DataError, match=message):
        read(DepthVideos(inputs=(path,), fov=60))
    if encoding.startswith("mono") and ";" not in encoding:
        assert read(DepthVideos(inputs=(path,), fov=60, topic=topic)).sequence.num_frames == 1
    depth = [("/cam/depth", START, make.image(depth16()))]
    packed = [("/cam/depth/compressedDepth", START, make.compressed(depth16()))]
    path = write_recording(
        tmp_path / "both", "bag", make, [(topic.replace("depth", "x"), START, image), *depth, *packed]
    )
    assert read(DepthVideos(inputs=(path,), fov=60)).sequence.points.shape == (16 * 12, 3)


@pytest.mark.parametrize(
    ("roi", "binned", "size", "center"),
    [
        ((0, 0, 0, 0), 1, (16, 12), (8, 6)),
        ((0, 0, 16, 12), 1, (32, 24), (8, 6)),  # a corner of the picture, not the picture at half size
        ((4, 2, 16, 12), 1, (32, 24), (4, 4)),
        ((0, 0, 0, 0), 2, (32, 24), ((8 + 0.5) / 2 - 0.5, (6 + 0.5) / 2 - 0.5)),
    ],
)
def test_cut_outs_and_binned_pixels_of_camera_info(roi, binned, size, center):
    make = Messages("mcap")
    info = make.camera(K, *size)
    info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height = roi
    info.binning_x = info.binning_y = binned
    camera = calibration_of_message(Path("run"), "/d/image", info).of_pictures(16, 12)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500 / binned, 510 / binned, *center)


@pytest.mark.parametrize("kind", ["bag", "mcap"])
@pytest.mark.parametrize("kept", [0, 10, 300, 0.7])
def test_damaged_recordings_are_refused_by_name(tmp_path, kind, kept):
    make = Messages(kind)
    content = [("/lidar", START + t * 10**8, make.cloud(points_of(500, seed=t))) for t in range(9)]
    path = write_recording(tmp_path / "run", kind, make, content)
    file = path if kind == "bag" else next(path.glob("*.mcap"))
    whole = file.read_bytes()
    file.write_bytes(whole[: kept if isinstance(kept, int) else int(kept * len(whole))])
    tool = {"bag": "rosbag reindex", "mcap": "mcap recover"}[kind]
    with pytest.raises(
        DataError, match=f"not a readable recording .*if it was cut off or lacks its index, {tool} repairs it"
    ):
        read(RecordedClouds(file))
