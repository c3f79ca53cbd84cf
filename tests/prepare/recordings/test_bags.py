"""Bags of ROS 1 and ROS 2: a topic is read whatever the types of the others are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dpcli.prepare.scans.recorded_clouds import RecordedClouds
from tests.support.recording_helpers import KINDS, START, Messages

pytest.importorskip("rosbags")
CLOUD = "sensor_msgs/msg/PointCloud2"
RULE = "=" * 80
OTHERS = {
    "that is none": "? !",
    "with another hash": "uint8 a",
    "that lacks one it uses": "c_msgs/D d",
    "with its own Header": f"std_msgs/Header header\n{RULE}\nMSG: std_msgs/Header\nuint8 a\n",
    "with its own Time": f"builtin_interfaces/Time t\n{RULE}\nMSG: builtin_interfaces/Time\nuint8 a\n",
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("first", [True, False])
def test_a_topic_is_read_beside_one_of_a_type(tmp_path, kind, other, first):
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    make = Messages(kind)
    points = np.zeros(5, [(name, "<f4") for name in "xyz"])
    for k, name in enumerate("xyz"):
        points[name] = np.random.default_rng(k).uniform(1, 100, 5)
    path: Path = tmp_path / ("run.bag" if kind == "bag" else "run")
    if kind == "bag":
        writer, serialize, told = Writer1(path), make.store.serialize_ros1, {"md5sum": "0" * 32}
    else:
        writer = Writer2(path, version=9, storage_plugin=StoragePlugin[kind.upper()])
        serialize, told = make.store.serialize_cdr, {"rihs01": f"RIHS01_{'0' * 64}"}
    with writer:
        for topic in ("/bad", "/points") if first else ("/points", "/bad"):
            if topic == "/bad":
                connection = writer.add_connection(topic, "a_msgs/msg/B", msgdef=OTHERS[other], **told)
                writer.write(connection, START, b"\0" * 8)
            else:
                connection = writer.add_connection(topic, CLOUD, typestore=make.store)
                writer.write(connection, START, bytes(serialize(make.cloud(points), CLOUD)))
    reader = RecordedClouds(path)
    sample = reader.read(reader.items()[0], np.random.default_rng(0))
    np.testing.assert_array_equal(sample.sequence.points, np.stack([points[name] for name in "xyz"], axis=1))
    assert not sample.notes
