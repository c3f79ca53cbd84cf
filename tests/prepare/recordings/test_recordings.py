"""Recordings of robots: clouds and depth of every kind of file arrive as they were sent, with their times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError
from dpcli.prepare.actions.depth import DepthVideos
from dpcli.prepare.decode.calibration import Calibration
from dpcli.prepare.decode.pinhole_camera import Intrinsics
from dpcli.prepare.recordings.messages import cloud_of_message
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
    with pytest.raises(DataError, match="choose one that holds clouds .PointCloud2. with --topic: /front, /rear"):
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


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "form", ["16UC1", "mono16", "big", "padded", "16UC1; compressedDepth png", "16UC1; png compressed "]
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


@pytest.mark.parametrize(
    ("frame", "encoding", "message"),
    [
        (np.zeros((4, 12), np.uint8), "rgb8", "images of encoding 'rgb8'; expected depth"),
        (np.zeros((4, 4), np.uint16), "16UC1", "none of its 1 frames has a valid depth"),
    ],
)
def test_images_that_are_no_depth_are_named(tmp_path, frame, encoding, message):
    make = Messages("bag")
    path = write_recording(tmp_path / "run", "bag", make, [("/i", START, make.image(frame, encoding=encoding))])
    with pytest.raises(DataError, match=message):
        read(DepthVideos(inputs=(path,), fov=60))


@pytest.mark.parametrize("kind", ["bag", "mcap"])
@pytest.mark.parametrize("kept", [0, 10, 300, 0.7])
def test_damaged_recordings_are_refused_by_name(tmp_path, kind, kept):
    make = Messages(kind)
    content = [("/lidar", START + t * 10**8, make.cloud(points_of(500, seed=t))) for t in range(9)]
    path = write_recording(tmp_path / "run", kind, make, content)
    file = path if kind == "bag" else next(path.glob("*.mcap"))
    whole = file.read_bytes()
    file.write_bytes(whole[: kept if isinstance(kept, int) else int(kept * len(whole))])
    with pytest.raises(DataError, match="not a readable recording"):
        read(RecordedClouds(file))
