"""MCAP files of ROS 1, ROS 2 and Foxglove: every message arrives as it was written, however the file is laid out."""

from __future__ import annotations

import base64
import json
import re
from functools import cache
from itertools import combinations

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.cloud import AT_ORIGIN
from dpcli.prepare.recordings.depth import read_recorded_depth
from dpcli.prepare.recordings.topic_frames import LACKING
from dpcli.prepare.scans.recorded_clouds import RecordedClouds
from tests.support.mcap_helpers import Layout, cloud, mcap, protobuf
from tests.support.recording_helpers import START, Messages, write_recording

pytest.importorskip("rosbags")
RNG = np.random.default_rng(0)
XYZ = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
LOOSE = np.dtype({"names": ["ring", "z", "x", "y"], "formats": ["u1", "<f4", "<f4", "<f4"], "offsets": [0, 2, 7, 11]})
FOXGLOVE = "foxglove.PointCloud"
PARTS = ("schemas", "channels", "statistics", "index")
SUMMARIES = [
    tuple(one if one != "statistics" or counted else "uncounted" for one in some)
    for counted in (True, False)
    for count in range(len(PARTS) + 1)
    for some in combinations(PARTS, count)
]
LAYOUTS = st.builds(
    Layout,
    chunk=st.integers(0, 3),
    packing=st.sampled_from(["", "lz4", "zstd"]),
    summary=st.sampled_from(SUMMARIES),
    profile=st.sampled_from(["", "ros1", "ros2"]),
)


def frames_of(count: int, kind: np.dtype = XYZ, seed: int = 0) -> list[np.ndarray]:
    frames = [np.zeros(3 + t, kind) for t in range(count)]
    for t, frame in enumerate(frames):
        for k, name in enumerate(kind.names):
            frame[name] = np.random.default_rng([seed, t, k]).uniform(1, 100, len(frame))
    return frames


def xyz(frame: np.ndarray) -> np.ndarray:
    return np.stack([frame[name] for name in "xyz"], axis=1)


@cache
def messages_of(ros1: bool) -> Messages:
    return Messages("bag" if ros1 else "mcap")


def ros_cloud(frame: np.ndarray, stamp: int, ros1: bool) -> bytes:
    make = messages_of(ros1)
    pack = make.store.serialize_ros1 if ros1 else make.store.serialize_cdr
    return bytes(pack(make.cloud(frame, stamp), "sensor_msgs/msg/PointCloud2"))


def ros_channel(ros1: bool) -> tuple[str, str, str, str, str]:
    make = messages_of(ros1)
    described, _ = make.store.generate_msgdef("sensor_msgs/msg/PointCloud2", ros_version=1 if ros1 else 2)
    name = "sensor_msgs/PointCloud2" if ros1 else "sensor_msgs/msg/PointCloud2"
    return ("/points", "ros1" if ros1 else "cdr", name, "ros1msg" if ros1 else "ros2msg", described)


def idl_of_a_cloud() -> str:
    """A PointCloud2 and what it uses as IDL, as ROS 2 describes types that were defined so."""
    parts = {
        "sensor_msgs/msg/PointCloud2": "std_msgs::msg::Header header; unsigned long height; unsigned long width;"
        " sequence<sensor_msgs::msg::PointField> fields; boolean is_bigendian; unsigned long point_step;"
        " unsigned long row_step; sequence<uint8> data; boolean is_dense;",
        "sensor_msgs/msg/PointField": "string name; unsigned long offset; uint8 datatype; unsigned long count;",
        "std_msgs/msg/Header": "builtin_interfaces::msg::Time stamp; string frame_id;",
        "builtin_interfaces/msg/Time": "int32 sec; uint32 nanosec;",
    }
    described = ""
    for name, fields in parts.items():
        package, _, last = name.split("/")
        described += (
            f"{'=' * 80}\nIDL: {name}\nmodule {package} {{ module msg {{ struct {last} {{ {fields} }}; }}; }};\n"
        )
    return described


def read(path, **options):
    reader = RecordedClouds(path, **options)
    return reader.read(reader.items()[0], RNG)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    encoding=st.sampled_from(["ros1", "cdr", "idl", "protobuf", "json"]),
    layout=LAYOUTS,
    order=st.permutations(range(5)),
    other=st.booleans(),
)
def test_every_layout_and_encoding_holds_what_was_written(tmp_path, encoding, layout, order, other):
    kind = LOOSE if encoding in ("protobuf", "json") else XYZ
    frames, stamps = frames_of(5, kind), [START + 10**8 * t + t**2 for t in range(5)]
    if kind is XYZ:
        channels = [ros_channel(encoding == "ros1")]
        channels = [(*channels[0][:3], "ros2idl", idl_of_a_cloud())] if encoding == "idl" else channels
        raw = [ros_cloud(frame, stamp, encoding == "ros1") for frame, stamp in zip(frames, stamps)]
    else:
        channels = [("/points", encoding, FOXGLOVE, "", "")]
        raw = [cloud(frame, stamp, encoding) for frame, stamp in zip(frames, stamps)]
    messages = [(0, stamps[t] + 5, raw[t]) for t in order]
    if other:
        channels.append(("/notes", "json", "Note", "jsonschema", "{}"))
        messages = [one for message in messages for one in (message, (1, message[1], b"{}"))]
    path = tmp_path / "run.mcap"
    path.write_bytes(mcap(channels, messages, layout))
    sample = read(path, keep=() if kind is XYZ else ("ring",))
    np.testing.assert_array_equal(sample.sequence.points, np.concatenate([xyz(frame) for frame in frames]))
    assert np.diff(sample.sequence.frame_offsets).tolist() == [3, 4, 5, 6, 7]
    np.testing.assert_array_equal(sample.sequence.time, (np.array(stamps) - START) * 1e-9)
    assert not sample.notes
    if kind is LOOSE:
        np.testing.assert_array_equal(
            sample.sequence.extra["field_ring"], np.concatenate([f["ring"] for f in frames]).astype(np.float32)
        )


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_types_that_a_description_lacks_are_taken_from_another_one(tmp_path, ends):
    topic, *kind, described = ros_channel(False)
    header = described[: described.index("=" * 80)]
    (frame,) = frames_of(1)
    path = tmp_path / "run.mcap"
    described = described.replace("\n", ends)
    channels = [(topic, *kind, header), ("/other", *kind, described), ("/bad", "cdr", "a/msg/B", "ros2msg", "? !")]
    path.write_bytes(mcap(channels, [(0, START, ros_cloud(frame, START, False))]))
    np.testing.assert_array_equal(read(path).sequence.points, xyz(frame))


FIELDS = ["header", "height", "width", "fields", "is_bigendian", "point_step", "row_step", "data", "is_dense"]


@pytest.mark.parametrize("lacking", [*FIELDS, "stamp", "frame_id", "datatype", "count"])
def test_messages_whose_type_lacks_a_field_are_read_or_named_with_their_topic(tmp_path, lacking):
    topic, encoding, name, form, described = ros_channel(False)
    described = re.sub(rf"^\S+ {lacking}$", "", described, flags=re.MULTILINE)
    (frame,) = frames_of(1)
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    store.register(typesys.get_types_from_msg(described, name))
    whole = messages_of(False).cloud(frame, START)

    def without(one):
        """The message, and those in it, of the types that lack a field."""
        if isinstance(one, list):
            return [without(part) for part in one]
        if not hasattr(one, "__msgtype__"):
            return one
        kind = store.types[one.__msgtype__]
        return kind(**{k: without(v) for k, v in vars(one).items() if k in kind.__dataclass_fields__})

    path = tmp_path / "run.mcap"
    raw = bytes(store.serialize_cdr(without(whole), name))
    path.write_bytes(mcap([(topic, encoding, name, form, described)], [(0, START, raw)]))
    if lacking in ("header", "stamp", "frame_id", "is_dense"):
        np.testing.assert_array_equal(read(path).sequence.points, xyz(frame))
        return
    reader = RecordedClouds(path)
    with pytest.raises(DataError, match=f"{path}: a message of /points can't be decoded .*{lacking}"):
        reader.read(reader.items()[0], RNG)


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_poses_of_clouds_move_their_points_and_returns_that_met_nothing_are_dropped(tmp_path, encoding):
    frames = frames_of(2)
    frames[1][1:] = 0
    turn = [0.0, 0.0, float(np.sqrt(0.5)), float(np.sqrt(0.5))]  # a quarter about z
    raw = [
        cloud(frame, START + t * 10**8, encoding, ([1.0 + t, 2.0, 3.0], [2 * q for q in turn]))
        for t, frame in enumerate(frames)
    ]
    path = tmp_path / "run.mcap"
    path.write_bytes(mcap([("/points", encoding, FOXGLOVE, "", "")], [(0, START, one) for one in raw]))
    sample = read(path)
    points = [np.stack([1.0 + t - frame["y"], 2 + frame["x"], 3 + frame["z"]], 1) for t, frame in enumerate(frames)]
    np.testing.assert_allclose(sample.sequence.points, np.concatenate([points[0], points[1][:1]]), rtol=1e-6)
    assert sample.notes == {AT_ORIGIN: 3}


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    turn=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(v * v for v in q) > 0.1),
    stem=st.sampled_from(["normal_", "n", "N", "v", "velocity_"]),
    kept=st.sets(st.sampled_from("xyz"), min_size=1),
)
def test_poses_of_clouds_turn_normals_and_velocities_as_they_turn_what_lies_between_points(tmp_path, turn, stem, kept):
    axes = "XYZ" if stem == "N" else "xyz"
    frame = np.zeros(6, np.dtype([(name, "<f4") for name in (*"xyz", *(stem + axis for axis in axes))]))
    for k, name in enumerate(frame.dtype.names):
        frame[name][:3] = frame[name][3:] = np.random.default_rng([7, k]).uniform(1, 100, 3)
    for axis, name in zip("xyz", axes):
        frame[axis][3:] += frame[stem + name][:3]  # three points, and each where its vector ends
    path = tmp_path / "run.mcap"
    raw = cloud(frame, START, "protobuf", ([1.0, 2.0, 3.0], list(turn)))
    path.write_bytes(mcap([("/points", "protobuf", FOXGLOVE, "", "")], [(0, START, raw)]))
    sequence = read(path, keep=tuple(stem + axes["xyz".index(axis)] for axis in sorted(kept))).sequence
    for axis in kept:
        name, place = axes["xyz".index(axis)], "xyz".index(axis)
        ends = sequence.points[:3, place] + sequence.extra[f"field_{stem}{name}"][:3]
        np.testing.assert_allclose(ends, sequence.points[3:, place], atol=1e-3)


def test_a_normal_without_its_other_parts_is_refused_where_a_pose_turns_it(tmp_path):
    frame = np.ones(3, np.dtype([(name, "<f4") for name in (*"xyz", "normal_x", "normal_y")]))
    path = tmp_path / "run.mcap"
    for turn in ([0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0]):
        raw = cloud(frame, START, "protobuf", ([1.0, 2.0, 3.0], turn))
        path.write_bytes(mcap([("/points", "protobuf", FOXGLOVE, "", "")], [(0, START, raw)]))
        if turn[3]:
            assert (read(path, keep=("normal_x",)).sequence.extra["field_normal_x"] == 1).all()
            continue
        with pytest.raises(DataError, match="can't turn normal_x, normal_y, normal_z .* no normal_z"):
            reader = RecordedClouds(path, keep=("normal_x",))
            reader.read(reader.items()[0], RNG)


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
@pytest.mark.parametrize("form", ["16UC1", "32FC1", "png"])
def test_depth_of_foxglove_with_its_camera(tmp_path, encoding, form):
    depth = RNG.integers(500, 3000, (12, 16)).astype("<u2")
    depth = depth.astype("<f4") / 1000 if form == "32FC1" else depth
    data = cv2.imencode(".png", depth)[1].tobytes() if form == "png" else depth.tobytes()
    numbers = [500.0, 0.0, 8.0, 0.0, 510.0, 6.0, 0.0, 0.0, 1.0]
    if encoding == "json":
        said = {"data": base64.b64encode(data).decode(), "frame_id": "eye"}
        more = {"width": 16, "height": 12, "encoding": form, "step": 16 * depth.itemsize}
        image = json.dumps(said | ({"format": form} if form == "png" else more)).encode()
        infos = [json.dumps({"width": 16, "height": 12, "K": k}).encode() for k in ([], numbers)]
    else:
        more = [(2, np.uint32(16)), (3, np.uint32(12)), (4, form), (5, np.uint32(16 * depth.itemsize)), (6, data)]
        image = protobuf((2, data), (3, form)) if form == "png" else protobuf(*more)
        infos = [protobuf((2, np.uint32(16)), (3, np.uint32(12)), *k) for k in ([], [(6, numbers)])]
    name = "foxglove.CompressedImage" if form == "png" else "foxglove.RawImage"
    channels = [
        ("/eye/depth/image", encoding, name, "", ""),
        ("/eye/depth/calibration", encoding, "foxglove.CameraCalibration", "", ""),
    ]
    messages = [(1, START, infos[0]), (1, START, infos[1]), (0, START, image), (0, START + 10**8, image)]
    path = tmp_path / "run.mcap"
    path.write_bytes(mcap(channels, messages))
    frames, described, _ = read_recorded_depth(path)
    for frame in frames.frames:
        np.testing.assert_array_equal(frame, depth)
    np.testing.assert_allclose(frames.time, [0, 0.1])
    camera = described.of_pictures(16, 12)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500, 510, 8, 6)


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_foxglove_messages_that_were_cut_are_named(tmp_path, encoding):
    whole = cloud(frames_of(1)[0], START, encoding)
    said = "a message of /points can't be decoded .*it is damaged|has fewer|bytes.*/points"
    for kept in range(1, len(whole), 7):
        path = tmp_path / f"{kept}.mcap"
        path.write_bytes(mcap([("/points", encoding, FOXGLOVE, "", "")], [(0, START, whole[:kept])]))
        with pytest.raises(DataError, match=said):
            read(path)


@pytest.mark.parametrize("place", ["point_stride", "timestamp"])
def test_a_fraction_where_foxglove_has_whole_numbers_is_refused(tmp_path, place):
    said = json.loads(cloud(frames_of(1)[0], START, "json"))
    said[place] = {"sec": 1.5, "nsec": 0} if place == "timestamp" else 12.7
    path = tmp_path / "run.mcap"
    path.write_bytes(mcap([("/points", "json", FOXGLOVE, "", "")], [(0, START, json.dumps(said).encode())]))
    with pytest.raises(DataError, match=r"(1.5|12.7) stands where Foxglove's messages have whole numbers"):
        read(path)


def test_a_pose_in_two_parts_is_merged_as_protobuf_does(tmp_path):
    (frame,) = frames_of(1)
    parts = [protobuf((1, protobuf((1, 7.0), (2, 8.0)))), protobuf((1, protobuf((3, 9.0))))]
    path = tmp_path / "run.mcap"
    raw = cloud(frame, START, "protobuf") + b"".join(protobuf((3, part)) for part in parts)
    path.write_bytes(mcap([("/points", "protobuf", FOXGLOVE, "", "")], [(0, START, raw)]))
    np.testing.assert_allclose(read(path).sequence.points, xyz(frame) + [7, 8, 9], rtol=1e-6)


def test_memory_that_ends_is_not_called_a_damaged_message(tmp_path, monkeypatch):
    path = tmp_path / "run.mcap"
    raw = cloud(frames_of(1)[0], START, "protobuf")
    path.write_bytes(mcap([("/points", "protobuf", FOXGLOVE, "", "")], [(0, START, raw)]))
    reader = RecordedClouds(path)
    (item,) = reader.items()

    def ends(*_):
        raise MemoryError

    monkeypatch.setattr("dpcli.prepare.scans.recorded_clouds.cloud_of_message", ends)
    with pytest.raises(DataError, match="too large for the memory there is, or damaged; free memory"):
        reader.read(item, RNG)


def test_a_point_of_foxglove_that_was_cut_is_named(tmp_path):
    frame = frames_of(1)[0]
    raw = cloud(frame, START, "protobuf").removesuffix(frame.tobytes())
    raw = raw[:-1] + bytes([raw[-1] - 2]) + frame.tobytes()[:-2]
    path = tmp_path / "run.mcap"
    path.write_bytes(mcap([("/points", "protobuf", FOXGLOVE, "", "")], [(0, START, raw)]))
    with pytest.raises(DataError, match="a cloud of 3 x 1 points of 12 bytes, rows of 36, has 34 bytes"):
        read(path)


def test_encodings_that_are_not_read_are_named(tmp_path):
    path = tmp_path / "run.mcap"
    channels = [("/points", "flatbuffer", FOXGLOVE, "flatbuffer", ""), ("/scan", "json", "foxglove.LaserScan", "", "")]
    channels.append(("/empty", "json", FOXGLOVE, "", ""))
    path.write_bytes(mcap(channels, [(0, START, b"abc"), (1, START, b"{}")]))
    said = (
        r"it has /points \(foxglove.PointCloud in flatbuffer\), /scan .*, /empty \(foxglove.PointCloud, no messages\)"
    )
    with pytest.raises(DataError, match=said):
        read(path)


@pytest.mark.parametrize(
    ("damage", "said"), [("cut", "cut off at byte"), ("flipped", "a chunk is damaged"), ("other", "packed by zip")]
)
def test_damaged_files_are_named(tmp_path, damage, said):
    raw = cloud(frames_of(1)[0], START, "protobuf")
    packing = "zip" if damage == "other" else ""
    data = mcap([("/points", "protobuf", FOXGLOVE, "", "")], [(0, START, raw)], Layout(packing=packing))
    if damage == "cut":
        data = data[: len(data) * 2 // 3]
    elif damage == "flipped":
        at = data.index(raw) + len(raw) - 5
        data = data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]
    path = tmp_path / "run.mcap"
    path.write_bytes(data)
    with pytest.raises(DataError, match=f"not a readable recording .*{said}.*mcap recover"):
        read(path)


@pytest.mark.parametrize("chunk", [0, 2])
@pytest.mark.parametrize(
    "summary",
    [
        (),
        ("channels", "statistics", "index"),
        ("schemas", "channels", "statistics"),
        ("schemas", "channels", "uncounted"),
    ],
)
def test_bags_of_ros_2_may_lack_parts_of_their_index_and_have_several_files(tmp_path, chunk, summary):
    frames, stamps = frames_of(6), [START + 10**8 * t for t in range(6)]
    make = messages_of(False)
    content = [("/points", stamp, make.cloud(frame, stamp)) for frame, stamp in zip(frames, stamps)]
    bag = write_recording(tmp_path / "run", "mcap", make, content)
    for part, places in enumerate(([2, 0, 1], [5, 4, 3])):
        messages = [(0, stamps[t], ros_cloud(frames[t], stamps[t], False)) for t in places]
        data = mcap([ros_channel(False)], messages, Layout(chunk, summary=summary, profile="ros2"))
        (bag / f"run_{part}.mcap").write_bytes(data)
    (bag / "run.mcap").unlink()
    told = (bag / "metadata.yaml").read_text()
    files = "  relative_file_paths:\n  - run_0.mcap\n  - run_1.mcap\n"
    (bag / "metadata.yaml").write_text(told.replace("  relative_file_paths:\n  - run.mcap\n", files))
    sample = read(bag)
    np.testing.assert_array_equal(sample.sequence.points, np.concatenate([xyz(frame) for frame in frames]))
    np.testing.assert_allclose(sample.sequence.time, np.arange(6) / 10)
    assert not sample.notes


@pytest.mark.parametrize(
    ("told", "instead", "said"),
    [
        ("storage_identifier: mcap", "storage_identifier: ''", ""),  # as reindexing leaves it
        ("version: 9", "version: 10", ""),
        ("message_count: 2", "message_count: 0", ""),
        ("message_count: 2", "message_count: 3", "lack"),
        ("  - run.mcap", "  - run.mcap\n  - gone.mcap", "lists files that are not there: gone.mcap"),
        ("relative_file_paths", "paths", "metadata.yaml is damaged: KeyError 'relative_file_paths'"),
    ],
)
def test_files_of_a_bag_of_ros_2_count_where_its_metadata_says_otherwise(tmp_path, told, instead, said):
    make = messages_of(False)
    frames = frames_of(2)
    content = [("/points", START + t, make.cloud(frame, START + t)) for t, frame in enumerate(frames)]
    bag = write_recording(tmp_path / "run", "mcap", make, content)
    raw = [ros_cloud(frame, START + t, False) for t, frame in enumerate(frames)]
    channels = [ros_channel(False), ("/bad", "cdr", "a/msg/B", "ros2msg", "? !")]
    (bag / "run.mcap").write_bytes(mcap(channels, [(0, START + t, one) for t, one in enumerate(raw)]))
    metadata = (bag / "metadata.yaml").read_text()
    assert told in metadata
    (bag / "metadata.yaml").write_text(metadata.replace(told, instead))
    if said not in ("", "lack"):
        with pytest.raises(DataError, match=said):
            read(bag)
        return
    sample = read(bag)
    np.testing.assert_array_equal(sample.sequence.points, np.concatenate([xyz(frame) for frame in frames]))
    assert sample.notes == ({LACKING: 1} if said else {})


@pytest.mark.parametrize("damage", ["cut", "flipped"])
def test_the_damaged_one_of_several_files_of_a_bag_is_named(tmp_path, damage):
    make = messages_of(False)
    frames = frames_of(4)
    content = [("/points", START + t, make.cloud(frame, START + t)) for t, frame in enumerate(frames)]
    bag = write_recording(tmp_path / "run", "mcap", make, content)
    (bag / "run.mcap").unlink()
    for part in (0, 1):
        raw = [(0, START + t, ros_cloud(frames[t], START + t, False)) for t in (2 * part, 2 * part + 1)]
        data = mcap([ros_channel(False)], raw)
        if part and damage == "cut":
            data = data[: len(data) // 2]
        elif part:
            at = data.index(frames[3].tobytes())
            data = data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]
        (bag / f"run_{part}.mcap").write_bytes(data)
    told = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(told.replace("  - run.mcap\n", "  - run_0.mcap\n  - run_1.mcap\n"))
    said = "it is cut off" if damage == "cut" else "a chunk is damaged"
    reader = RecordedClouds(bag)
    with pytest.raises(DataError, match=rf"{bag}: not a readable recording \(run_1.mcap: {said}.*mcap recover"):
        reader.read(reader.items()[0], RNG)


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_files_whose_messages_are_packed_name_the_folder_that_says_so(tmp_path, kind):
    make = messages_of(False)
    bag = write_recording(tmp_path / "run", kind, make, [("/points", START, make.cloud(frames_of(1)[0]))], "MESSAGE")
    (file,) = (one for one in bag.iterdir() if one.suffix != ".yaml")
    with pytest.raises(DataError, match=f"its messages are packed: name the folder {bag}$"):
        read(file)
