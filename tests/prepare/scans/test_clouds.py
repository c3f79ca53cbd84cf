"""Point cloud files: all formats give equal points, invalid points are dropped and counted, bad files are named."""

from __future__ import annotations

import shutil
import sys

import h5py
import laspy
import numpy as np
import pytest

from dpcli.errors import DataError, UsageError
from dpcli.ops.open3d_import import load_open3d
from dpcli.prepare.decode.cloud_files import read_cloud
from dpcli.prepare.scans.assembling import UNREAD_COLORS
from dpcli.prepare.scans.cloud_series import find_sequences
from dpcli.prepare.scans.clouds import CloudFolders

RNG = np.random.default_rng(0)
POINTS = np.random.default_rng(1).normal(size=(40, 3)).astype(np.float32)
COLOR = np.random.default_rng(2).integers(0, 256, (40, 3)).astype(np.uint8)


def save(path, points=POINTS, color=None):
    """Write one cloud in the format of the path's suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    suffix = path.suffix
    if suffix in (".ply", ".pcd"):
        open3d = load_open3d()
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(float)))
        if color is not None:
            cloud.colors = open3d.utility.Vector3dVector(color / 255)
        open3d.io.write_point_cloud(str(path), cloud)
    elif suffix == ".npy":
        np.save(path, points)
    elif suffix == ".npz":
        np.savez(path, points=points, **({} if color is None else {"colors": color}))
    elif suffix == ".bin":
        np.hstack([points, np.ones((len(points), 1))]).astype("<f4").tofile(path)
    elif suffix == ".las":
        save_las(path, points, color)
    else:
        table = points if color is None else np.hstack([color, points])
        header = "" if color is None else "red,green,blue,x,y,z"
        delimiter = "," if suffix == ".csv" else " "
        np.savetxt(path, table, delimiter=delimiter, header=header, comments="")
    return path


def save_las(path, points, color=None, scale=1e-6):
    las = laspy.create(point_format=2 if color is not None else 0)
    las.header.scales, las.header.offsets = [scale] * 3, np.floor(points.min(0).astype(float))
    las.x, las.y, las.z = points.T.astype(float)
    if color is not None:
        las.red, las.green, las.blue = color.T.astype(np.uint16) * 257
    las.write(str(path))


def read(folder, **options):
    reader = CloudFolders(folder, **options)
    return reader.read(reader.items()[0], RNG)


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npy", ".npz", ".bin", ".csv", ".las", ".xyz", ".txt"])
def test_every_format_gives_the_same_points(tmp_path, suffix):
    for number in (10, 9):  # natural order: frame9 first
        save(tmp_path / "seq" / f"frame{number}{suffix}", POINTS + (number - 9))
    sample = read(tmp_path / "seq")
    assert sample.sequence.name == "seq" and sample.sequence.num_frames == 2 and sample.notes == {}
    np.testing.assert_allclose(sample.sequence.frame(0), POINTS, atol=2e-6)
    np.testing.assert_allclose(sample.sequence.frame(1), POINTS + 1, atol=2e-6)


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npz", ".csv", ".las"])
def test_colors_are_kept(tmp_path, suffix):
    save(tmp_path / "seq" / f"0{suffix}", color=COLOR)
    reader = CloudFolders(tmp_path / "seq", fps=5)
    sequence = reader.read(reader.items()[0], RNG).sequence
    assert reader.fields == ("time", "color")
    np.testing.assert_array_equal(sequence.color, COLOR)
    np.testing.assert_allclose(sequence.points, POINTS, atol=2e-6)


def test_a_frame_without_the_others_colors_is_refused(tmp_path):
    save(tmp_path / "0.ply", color=COLOR)
    save(tmp_path / "1.ply")
    with pytest.raises(DataError, match=r"1.ply: no colors"):
        read(tmp_path)


@pytest.mark.parametrize("suffix", [".ply", ".npz", ".las"])
def test_what_later_frames_alone_have_is_told(tmp_path, suffix):
    save(tmp_path / f"0{suffix}", color=0 * COLOR if suffix == ".las" else None)
    save(tmp_path / f"1{suffix}", color=COLOR)
    (tmp_path / "2.csv").write_text("x,y,z,snr\n1,2,3,4\n1,2,4,4\n")
    assert read(tmp_path, pattern=f"*{suffix}").notes == {UNREAD_COLORS: 1}
    (tmp_path / "1.csv").write_text("x,y,z\n1,2,3\n1,2,4\n")
    assert read(tmp_path, pattern="*.csv").notes == {"frames with further columns (snr), which are not read": 1}


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npy", ".npz", ".bin", ".csv", ".xyz"])
def test_points_with_nan_are_dropped_with_their_colors_and_counted(tmp_path, suffix):
    points = POINTS.copy()
    points[3, 1], points[7] = np.nan, np.inf
    color = None if suffix in (".npy", ".bin", ".xyz") else COLOR
    save(tmp_path / f"0{suffix}", points, color)
    sample = read(tmp_path)
    valid = np.delete(np.arange(40), [3, 7])
    assert sample.notes == {"points with NaN or infinity dropped": 2}
    np.testing.assert_allclose(sample.sequence.points, POINTS[valid], atol=2e-6)
    if color is not None:
        np.testing.assert_array_equal(sample.sequence.color, COLOR[valid])


def test_frames_of_nan_only(tmp_path):
    save(tmp_path / "a" / "0.npy", np.full((5, 3), np.nan, np.float32))
    with pytest.raises(DataError, match=r"none of its frames \(1\)"):
        read(tmp_path / "a")
    save(tmp_path / "a" / "1.npy")
    sample = read(tmp_path / "a", fps=10)
    assert sample.notes["frames without points dropped"] == 1
    np.testing.assert_allclose(sample.sequence.time, [0.1])


def test_folders_of_folders_with_labels_from_their_names(tmp_path):
    for folder in ("walk/s2", "walk/s10", "run/s1"):
        save(tmp_path / folder / "0.npy")
    reader = CloudFolders(tmp_path, label_from_folder=True)
    assert reader.class_names == ["run", "walk"]
    assert [(i.name, i.label) for i in reader.items()] == [("run/s1", 0), ("walk/s2", 1), ("walk/s10", 1)]


def test_folders_of_splits_above_those_of_classes(tmp_path):
    for folder in ("train/walk/s1", "train/run/s1", "test/walk/s2"):
        save(tmp_path / folder / "0.npy")
    reader = CloudFolders(tmp_path, label_from_folder=True)
    assert reader.class_names == ["run", "walk"]
    assert [(i.label, i.split) for i in reader.items()] == [(1, "test"), (0, "train"), (1, "train")]


def test_a_label_table_beside_the_data_is_no_cloud(tmp_path):
    save(tmp_path / "a" / "0.npy")
    (tmp_path / "labels.csv").write_text("a,2\n")
    reader = CloudFolders(tmp_path, labels=tmp_path / "labels.csv")
    assert [(i.name, i.label) for i in reader.items()] == [("a", 2)]


def test_map_coordinates_keep_their_millimeters(tmp_path):
    base = np.array([500_000.0, 5_800_000.0, 100.0])
    save_las(tmp_path / "0.las", POINTS.astype(float) + base, scale=1e-4)
    save_las(tmp_path / "1.las", POINTS.astype(float) + base + [1, 0, 0], scale=1e-4)
    sample = read(tmp_path)
    assert sample.notes == {"sequences shifted to their first frame's corner for precision": 1}
    a, b = sample.sequence.frame(0), sample.sequence.frame(1)
    np.testing.assert_allclose(a - a[0], POINTS - POINTS[0], atol=3e-4)
    np.testing.assert_allclose(b - a, np.broadcast_to([1, 0, 0], a.shape), atol=3e-4)


def test_scale_stride_and_columns(tmp_path):
    for t in range(5):
        np.hstack([POINTS + t, np.zeros((40, 2))]).astype("<f4").tofile(tmp_path / f"{t}.bin")
    sequence = read(tmp_path, bin_columns=5, scale=1000.0, stride=2, fps=10).sequence
    np.testing.assert_allclose(sequence.frame(2), (POINTS + 4) / 1000, rtol=1e-5)
    np.testing.assert_allclose(sequence.time, [0, 0.2, 0.4])


def test_a_recording_in_millimeters_keeps_its_sensor(tmp_path):
    """What counts as far away is meters: 12 m of a scan in millimeters are not."""
    np.save(tmp_path / "0.npy", np.float32([[0, 0, 2000], [1000, 1000, 3000], [0, 1000, 12_000]]))
    sample = read(tmp_path, scale=1000.0)
    assert sample.notes == {}
    np.testing.assert_allclose(sample.sequence.points, [[0, 0, 2], [1, 1, 3], [0, 1, 12]], rtol=1e-6)


def test_kitti_scans(shared_data):
    folder = shared_data / "lidar" / "kitti_consecutive"
    sample = read(folder)
    files = sorted(folder.glob("*.bin"))
    assert sample.sequence.num_frames == len(files) == 4
    np.testing.assert_array_equal(sample.sequence.frame(0), np.fromfile(files[0], "<f4").reshape(-1, 4)[:, :3])


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npy", ".npz", ".bin", ".las"])
def test_truncated_files_are_named(tmp_path, suffix):
    path = save(tmp_path / f"0{suffix}")
    whole = path.read_bytes()
    path.write_bytes(whole[:-7])
    with pytest.raises(DataError, match=f"0{suffix}: .*(truncated|not a readable|damaged)"):
        read_cloud(path)
    path.write_bytes(b"")
    with pytest.raises(DataError, match=f"0{suffix}: the file is empty"):
        read_cloud(path)


def test_truncated_ply_as_text_and_one_with_faces(tmp_path):
    open3d = load_open3d()
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(POINTS.astype(float)))
    open3d.io.write_point_cloud(str(tmp_path / "0.ply"), cloud, write_ascii=True)
    lines = (tmp_path / "0.ply").read_text().splitlines(keepends=True)
    (tmp_path / "0.ply").write_text("".join(lines[:-3]))
    with pytest.raises(DataError, match="says 40 points, it has room for 37"):
        read_cloud(tmp_path / "0.ply")
    mesh = open3d.geometry.TriangleMesh.create_sphere()
    open3d.io.write_triangle_mesh(str(tmp_path / "1.ply"), mesh)
    np.testing.assert_allclose(read_cloud(tmp_path / "1.ply").points, np.asarray(mesh.vertices))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("0.csv", "a,b,c\n1,2,3\n", "0.csv:1: columns a, b, c; expected x, y and z"),
        ("0.csv", "x,y,z\n1,2,word\n", "0.csv:2: column 'z' holds 'word'; expected numbers"),
        ("0.csv", "1,2\n3,4\n", "shape \\(2, 2\\)"),
        ("0.ply", "not a ply", "no number of points in its header"),
        ("0.xyz", "1 2 3\n4 5\n", "0.xyz:2: 2 values; expected numbers in columns, 3 as in"),
    ],
)
def test_bad_text_files(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(DataError, match=message):
        read_cloud(tmp_path / name)


def test_arrays_of_other_kinds(tmp_path):
    np.save(tmp_path / "0.npy", np.ones((3, 2)))
    with pytest.raises(DataError, match="expected numbers \\(points, 3 or more\\)"):
        read_cloud(tmp_path / "0.npy")
    np.save(tmp_path / "1.npy", np.array([{"pickled": 1}], object))
    with pytest.raises(DataError, match="not a readable .npy"):
        read_cloud(tmp_path / "1.npy")
    np.savez(tmp_path / "2.npz", other=np.ones((3, 3)), more=np.ones((3, 3)))
    with pytest.raises(DataError, match="arrays other, more; expected one called points"):
        read_cloud(tmp_path / "2.npz")


def test_folders_without_clouds(tmp_path):
    (tmp_path / "readme.md").touch()
    with pytest.raises(DataError, match="no point clouds"):
        CloudFolders(tmp_path).items()
    with pytest.raises(UsageError, match="use one"):
        CloudFolders(tmp_path, label_from_folder=True, labels=tmp_path / "x.csv")
    save(tmp_path / "0.npy")
    with pytest.raises(DataError, match="expects CLASS/SEQUENCE/frames"):
        CloudFolders(tmp_path, label_from_folder=True).items()


@pytest.mark.parametrize(
    ("content", "advice"),
    [
        ("import no_such_module_at_all", "pip install open3d libusb-package"),
        (
            "import ctypes; ctypes.CDLL('libnone.so.1')",
            r"libnone.so.1: cannot open .*apt install libegl1 libgl1 libx11-6",
        ),
    ],
)
def test_why_open3d_cannot_be_imported_is_told(monkeypatch, tmp_path, content, advice):
    """Open3D's wheel links to libraries of screens, which images of containers and small servers lack."""
    from dpcli.errors import DpcError

    load_open3d.cache_clear()
    (tmp_path / "open3d.py").write_text(content)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    with pytest.raises(DpcError, match=advice):
        load_open3d()
    load_open3d.cache_clear()


def test_what_else_lies_there_is_named(tmp_path):
    save(tmp_path / "a" / "0.ply")
    (tmp_path / "a" / "0.obj").write_text("v 1 2 3\n")
    (tmp_path / "a" / "0.bag").write_bytes(b"#ROSBAG V2.0")
    (tmp_path / "a" / "0.zarr").mkdir()
    (tmp_path / "a" / "0.zarr" / "0.0").write_bytes(b"x")
    reader = CloudFolders(tmp_path)
    assert (
        reader.summary(reader.items())[1] == "a: its frames are 0.ply; left out: 1 .bag file, 1 .obj file, 1 .zarr file"
    )
    shutil.rmtree(tmp_path / "a" / "0.zarr")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "0.bag.active").touch()
    with pytest.raises(DataError, match="found 1 .active file: end the recording, or repair it by `rosbag reindex`"):
        CloudFolders(tmp_path / "b").items()
    for rest in ("a/0.bag", "b/0.bag.active"):
        (tmp_path / rest).unlink()
    (tmp_path / "a" / "0.ply").rename(tmp_path / "a" / "0.ply.gz")
    reader = CloudFolders(tmp_path)
    assert reader.summary(reader.items())[1] == "a: its frames are 0.obj; left out: 1 .gz file"
    (tmp_path / "a" / "0.obj").rename(tmp_path / "a" / "0.stl")
    with pytest.raises(DataError, match="found 1 .gz file, 1 .stl file: save their points as .ply, or unpack them"):
        CloudFolders(tmp_path).items()
    (tmp_path / "a.xlsx").write_bytes(b"PK")
    with pytest.raises(DataError, match="a.xlsx: .xlsx files are not read: save their sheets as .csv"):
        CloudFolders(tmp_path / "a.xlsx").items()
    save(tmp_path / "b.ply")
    with pytest.raises(DataError, match="b.ply: one cloud; expected a folder"):
        CloudFolders(tmp_path / "b.ply").items()


@pytest.mark.parametrize("name", ["0.ply", "0.pcd", "0.las", "0.npy", "0.bin", "0.csv", "0.npz"])
def test_what_stands_in_for_a_file_is_told(tmp_path, name):
    (tmp_path / name).write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1234\n")
    with pytest.raises(DataError, match=f"{name}: a pointer of Git LFS; `git lfs pull` brings the file itself"):
        read_cloud(tmp_path / name)
    (tmp_path / name).write_bytes(b"<!DOCTYPE html>\n<html><body>Sign in</body></html>")
    with pytest.raises(DataError, match=f"{name}: a web page; download it again"):
        read_cloud(tmp_path / name)


def test_texts_of_a_vehicles_sensors_are_no_clouds(tmp_path):
    for folder in ("velodyne/data", "oxts/data", "label_2"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "0.txt").write_text("49.0 8.4 116.4 0.2\n" * 2)
    reader = CloudFolders(tmp_path)
    assert [item.name for item in reader.items()] == ["velodyne/data"]
    assert "left out: label_2/0.txt, oxts/data/0.txt" in reader.summary(reader.items())[1]
    assert len(CloudFolders(tmp_path / "oxts").items()) == 1  # who names it, gets it


def test_one_text_above_the_clouds_and_arrays_of_normals_are_no_clouds(tmp_path):
    for folder in ("00/velodyne", "00/normals", "00/b"):
        save(tmp_path / folder / "0.npy")
    (tmp_path / "00" / "instances.txt").write_text("1 2 3\n4 5 6\n")
    reader = CloudFolders(tmp_path)
    assert [item.name for item in reader.items()] == ["00/b", "00/velodyne"]
    assert "left out: 00/instances.txt, 00/normals/0.npy" in reader.summary(reader.items())[1]
    save(tmp_path / "00" / "normals" / "1.npy")  # other frames: a sequence of that name
    assert [item.name for item in CloudFolders(tmp_path).items()] == ["00/b", "00/normals", "00/velodyne"]


def test_folders_that_may_each_be_a_moment_are_told(tmp_path):
    for k in range(3):
        for camera in "ab":
            save(tmp_path / "raw" / f"t{k:04d}" / f"{camera}.npy")
    reader = CloudFolders(tmp_path / "raw")
    told = "3 folders such as t0000 hold a.npy, b.npy each: if a folder is one moment"
    assert told in reader.summary(reader.items())[-1]
    save(tmp_path / "raw" / "t0001" / "c.npy")
    assert told not in "".join((again := CloudFolders(tmp_path / "raw")).summary(again.items()))


@pytest.mark.parametrize(
    "row",
    [
        "1 0 0 {} 0 1 0 0 0 0 1 0",
        "130503{}.5 1 2 3 0 0 0.6 0.8\n1 1 2 3 0 0 1 0\n#",
        "1,0,0,0,0,1,0,{},0,0,1,0,0,0,0,1",
    ],
)
def test_the_way_of_a_camera_is_no_cloud(tmp_path, row):
    save(tmp_path / "velodyne" / "0.npy")
    (tmp_path / "00.txt").write_text("".join(row.format(k) + "\n" for k in range(300)))
    reader = CloudFolders(tmp_path)
    assert [item.name for item in reader.items()] == ["velodyne"]
    assert reader.summary(reader.items())[1] == "velodyne: its frames are 0.npy; left out: 00.txt"


@pytest.mark.parametrize("edges", [False, True])
def test_points_with_normals_and_curvature_or_intensity_are_no_poses(tmp_path, edges):
    """Such as PCL's; where a surface is flat, a normal and its curvature are as long as a quaternion."""
    normal = RNG.normal(size=(200, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    beside = np.zeros((200, 1)) if not edges else np.linspace(0, 0.2, 200)[:, None]
    rows = [RNG.normal(size=(200, 3)), *((normal, beside) if edges else (beside, normal))]
    np.savetxt(tmp_path / "0.txt", np.hstack(rows), fmt="%.6f")
    (series,) = find_sequences(tmp_path, (".txt",))
    assert series.names == ("0.txt",)


def test_a_sequence_beside_folders_of_classes_has_no_class(tmp_path):
    for folder in ("a", "wave/b"):
        save(tmp_path / folder / "0.npy")
    with pytest.raises(DataError, match="'a' is in no folder of its class"):
        CloudFolders(tmp_path, label_from_folder=True).items()


def test_a_first_frame_that_saw_nothing_decides_nothing(tmp_path):
    (tmp_path / "0.csv").write_text("x,y,z\n")
    (tmp_path / "1.csv").write_text("x,y,z,r,g,b\n1,2,3,4,5,6\n")
    sequence = read(tmp_path).sequence
    assert sequence.num_frames == 1 and sequence.color.tolist() == [[4, 5, 6]]


def test_columns_that_are_not_read_are_named(tmp_path):
    (tmp_path / "0.csv").write_text("x,y,z,ring,snr\n1,2,3,4,5\n1,2,4,4,5\n")
    reader = CloudFolders(tmp_path, keep=("snr",))
    assert reader.summary(reader.items()) == ["1 sequence of 1 frame found; not read: ring (--keep-fields)"]
    np.save(tmp_path / "0.npy", np.ones((4, 6)))
    reader = CloudFolders(tmp_path, pattern="*.npy")
    assert reader.summary(reader.items())[0] == "1 sequence of 1 frame found; not read: columns 4 to 6 (no names)"


def test_columns_that_would_be_one_data_set_are_refused(tmp_path):
    (tmp_path / "0.csv").write_text("x,y,z,v/s,v_s\n1,2,3,4,5\n1,2,4,4,5\n")
    with pytest.raises(UsageError, match="v/s and v_s would both be kept as field_v_s"):
        _ = CloudFolders(tmp_path, keep=("v/s", "v_s")).fields


def test_pictures_of_depth_are_sent_to_the_command_that_reads_them(tmp_path):
    (tmp_path / "v").mkdir()
    for k in range(3):
        (tmp_path / "v" / f"{k}.png").write_bytes(b"\x89PNG")
    with pytest.raises(DataError, match="found 3 .png files: if they hold depth, `dpc prepare depth` reads them"):
        find_sequences(tmp_path, (".ply",))


@pytest.mark.parametrize("rest", ["poses.txt", "b/part.zip", "meta/ego_pose.json", "b/times.txt", "b/raw.tar"])
def test_what_lies_in_folders_without_clouds_is_named(tmp_path, rest):
    save(tmp_path / "velodyne" / "0.npy")
    (tmp_path / rest).parent.mkdir(exist_ok=True)
    (tmp_path / rest).write_text("1 2 3\n")
    reader = CloudFolders(tmp_path)
    assert [item.name for item in reader.items()] == ["velodyne"]
    told = reader.summary(reader.items())[1].partition("left out: ")[2]
    assert rest.rpartition("/")[0] in told and (rest in told or f"1 {rest[rest.index('.') :]} file" in told)


@pytest.mark.parametrize("form", ["feather", "parquet"])
def test_tables_of_poses_beside_clouds_are_no_clouds(tmp_path, form):
    """As in Argoverse 2: they are named, with what lies beside them, and the clouds keep the times in their names."""
    pyarrow = pytest.importorskip("pyarrow")
    write = pytest.importorskip(f"pyarrow.{form}")
    write = write.write_feather if form == "feather" else write.write_table
    pose = {name: [1.0, 0.5] for name in ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")}
    for name in ("city_SE3_egovehicle", "calibration/egovehicle_SE3_sensor"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write(pyarrow.table(pose), str(tmp_path / f"{name}.{form}"))
    write(pyarrow.table({"category": ["BUS"], "tx_m": [1.0]}), str(tmp_path / f"annotations.{form}"))
    (tmp_path / "sensors/lidar").mkdir(parents=True)
    points = np.random.default_rng(2).normal(size=(20, 3))
    for stamp in (315966070559696000, 315966070659696000):
        columns = dict(zip("xyz", points.T)) | {"qw": points[:, 0]}  # a rotation of each point makes it no pose
        columns |= {name: points[:, 1] for name in ("qx", "qy", "qz")}
        write(pyarrow.table(columns), str(tmp_path / f"sensors/lidar/{stamp}.{form}"))
    reader = CloudFolders(tmp_path)
    (item,) = reader.items()
    sample = reader.read(item, np.random.default_rng(0)).sequence
    assert np.allclose(sample.points, np.tile(points, (2, 1))) and np.allclose(sample.time, [0, 0.1])
    told = reader.summary([item])[1].partition("left out: ")[2]
    assert all(word in told for word in ("annotations", "calibration/egovehicle_SE3_sensor", "city_SE3_egovehicle"))


@pytest.mark.parametrize(
    ("at", "size", "told"), [(2100.7, 300, True), (600.3, 80, True), (2.1, 0.4, False), (40.0, 30, False)]
)
def test_millimeters_with_fractions_are_asked_for(tmp_path, at, size, told):
    points = np.random.default_rng(1).uniform(-size, size, (200, 3)) + (0, 0, at)
    np.save(tmp_path / "0.npy", points)
    reader = CloudFolders(tmp_path)
    notes = reader.read(reader.items()[0], np.random.default_rng(0)).notes
    assert any("millimeters" in note for note in notes) == told


@pytest.mark.parametrize("nothing", [[], [[]]])
def test_an_empty_list_of_points_is_a_frame_without_points(nothing, tmp_path):
    for t, points in enumerate((np.ones((4, 3)), np.array(nothing), np.ones((5, 3)))):
        np.save(tmp_path / f"{t}.npy", points + np.arange(points.size).reshape(points.shape))
    reader = CloudFolders(tmp_path, fps=10)
    sample = reader.read(reader.items()[0], np.random.default_rng(0))
    assert sample.sequence.time.tolist() == [0.0, 0.2] and sample.notes == {"frames without points dropped": 1}


@pytest.mark.parametrize(
    ("header", "told"),
    [("lon,lat,alt", "project"), ("range,azimuth,elevation", "compute x, y and z"), ("a,b,c", "numbers only$")],
)
def test_angles_instead_of_lengths_are_told(tmp_path, header, told):
    (tmp_path / "0.csv").write_text(f"{header}\n1,2,3\n")
    with pytest.raises(DataError, match=told):
        read_cloud(tmp_path / "0.csv")


def test_classes_of_one_sequence_each_are_told(tmp_path):
    for label in ("wave", "bow"):
        for name in ("a", "b"):
            save(tmp_path / "flat" / label / f"{name}.csv")
            save(tmp_path / "deep" / label / name / "0.csv")
    for folder, told in (("flat", True), ("deep", False)):
        reader = CloudFolders(tmp_path / folder, label_from_folder=True)
        assert any("each class has one sequence only" in line for line in reader.summary(reader.items())) == told


def test_a_table_that_names_frames_is_told_what_a_sample_is(tmp_path):
    for name in ("a", "b"):
        save(tmp_path / "in" / f"{name}.csv")
    for text, told in (("a.csv,wave\nb,bow\n", True), ("c,wave\n", False)):
        (tmp_path / "labels.csv").write_text("name,label\n" + text)
        with pytest.raises(DataError, match="not among the samples") as raised:
            CloudFolders(tmp_path / "in", labels=tmp_path / "labels.csv").items()
        assert ("the frames of one sample" in str(raised.value) and "--frame-column" in str(raised.value)) == told


def test_hdf5_files_of_one_cloud_each_are_frames(tmp_path):
    """Where nothing else lies there: what dpc makes is HDF5, too, and may lie beside the clouds."""
    clouds = np.random.default_rng(0).normal(size=(4, 30, 3)).astype(np.float32)
    for place, cloud in enumerate(clouds):
        with h5py.File(tmp_path / f"{place}.h5", "w") as file:
            file["points"] = cloud
    reader = CloudFolders(tmp_path)
    sample = reader.read(reader.items()[0], np.random.default_rng(0)).sequence
    assert np.array_equal(sample.points.reshape(clouds.shape), clouds)
