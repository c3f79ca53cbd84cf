"""Livox's own messages: every point as the driver sent it, in recordings of ROS 1 and ROS 2."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError
from dpcli.prepare.recordings.livox import read_livox
from dpcli.prepare.scans.recorded_clouds import RecordedClouds
from tests.support.recording_helpers import KINDS, START, Messages, new_store, write_recording

pytest.importorskip("rosbags")
RNG = np.random.default_rng(0)
POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
SCAN = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\nCustomPoint[] points\n"
)


def messages(kind: str, package: str = "livox_ros_driver") -> Messages:
    from rosbags.typesys import get_types_from_msg

    make = Messages(kind)
    make.store = new_store(make.ros1)
    make.store.register(get_types_from_msg(POINT, f"{package}/msg/CustomPoint"))
    make.store.register(get_types_from_msg(SCAN, f"{package}/msg/CustomMsg"))
    return make


messages_once = cache(messages)  # registering the types takes longest


def scan(make: Messages, points: np.ndarray, stamp: int, place: str = "livox", package: str = "livox_ros_driver"):
    rows = [
        make.make(
            f"{package}/msg/CustomPoint", offset_time=k * 10, x=x, y=y, z=z, reflectivity=k % 256, tag=16, line=k % 4
        )
        for k, (x, y, z) in enumerate(points.tolist())
    ]
    return make.make(
        f"{package}/msg/CustomMsg",
        header=make.header(stamp, place),
        timebase=stamp,
        point_num=len(rows),
        lidar_id=1,
        rsvd=np.zeros(3, np.uint8),
        points=rows,
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("package", ["livox_ros_driver", "livox_ros_driver2"])
def test_scans_of_livox_are_clouds_with_their_times(tmp_path, kind, package):
    make = messages(kind, package)
    frames = [RNG.uniform(1, 9, (count, 3)).astype(np.float32) for count in (5, 1, 7)]
    stamps = [START, START + 100_000_000, START + 350_000_000]
    content = [("/livox/lidar", t, scan(make, f, t, package=package)) for f, t in zip(frames, stamps)]
    reader = RecordedClouds(write_recording(tmp_path / "run", kind, make, content), keep=("reflectivity",))
    sequence = reader.read(reader.items()[0], RNG).sequence
    np.testing.assert_array_equal(sequence.points, np.concatenate(frames))
    assert np.diff(sequence.frame_offsets).tolist() == [5, 1, 7]
    np.testing.assert_allclose(sequence.time, [0, 0.1, 0.35], atol=1e-9)
    assert sequence.extra["field_reflectivity"].tolist() == [*range(5), 0, *range(7)]


@given(count=st.integers(0, 9), place=st.text("abc_/", max_size=12), kind=st.sampled_from(["bag", "mcap"]))
@settings(max_examples=60, deadline=None)
def test_the_name_of_the_sensor_moves_no_byte(count, place, kind):
    make = messages_once(kind)
    points = np.random.default_rng(count).uniform(-9, 9, (count, 3)).astype(np.float32)
    serialize = make.store.serialize_ros1 if make.ros1 else make.store.serialize_cdr
    raw = bytes(serialize(scan(make, points, START + 7, place), "livox_ros_driver/msg/CustomMsg"))
    found = read_livox(raw, ros1=make.ros1)
    assert (found.header.frame_id, found.header.stamp.sec, found.header.stamp.nanosec) == (place, START // 10**9, 7)
    np.testing.assert_array_equal(np.stack([found.columns[axis] for axis in "xyz"], 1), points)
    assert found.columns["line"].tolist() == [k % 4 for k in range(count)]
    for end in {len(raw) * 3 // 4, len(raw) - 1, 9} if count else ():
        with pytest.raises(ValueError, match="CustomMsg"):
            read_livox(raw[:end], ros1=make.ros1)


def test_a_scan_that_was_cut_is_named(tmp_path):
    make = messages("bag")
    whole = scan(make, RNG.uniform(1, 9, (5, 3)).astype(np.float32), START)
    serialize = make.store.serialize_ros1
    make.store.serialize_ros1 = lambda message, name: bytes(serialize(message, name))[:-4]
    path = write_recording(tmp_path / "run", "bag", make, [("/livox/lidar", START, whole)])
    reader = RecordedClouds(path)
    with pytest.raises(DataError, match="a CustomMsg of 5 points has 91 bytes"):
        reader.read(reader.items()[0], RNG)
