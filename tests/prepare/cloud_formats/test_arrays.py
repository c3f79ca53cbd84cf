"""Arrays: every type and order of NumPy's files, colors of any range, and the number of columns of a `.bin`."""

from __future__ import annotations

import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.arrays import guess_bin_columns, read_bin, read_npy, read_npz
from dpcli.prepare.cloud_formats.colors import as_bytes
from dpcli.prepare.decode.cloud_files import read_cloud
from dpcli.prepare.scans.clouds import CloudFolders

quick = settings(
    max_examples=60, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@quick
@given(data=st.data())
def test_what_numpy_writes_is_read_back(tmp_path, data):
    kind = data.draw(st.sampled_from(["f2", "<f4", ">f4", "<f8", ">f8", "<i2", ">i4", "<u2", "u1"]))
    width, count = data.draw(st.integers(3, 7)), data.draw(st.integers(5, 30))
    rng = np.random.default_rng(data.draw(st.integers(0, 9)))
    array = rng.uniform(0, 200, (count, width)).astype(kind)
    form = data.draw(st.sampled_from(["C", "F", "structured", "npz"]))
    if form == "structured":
        order = data.draw(st.permutations(["x", "y", "z", "v"]))
        rows = np.zeros(count, [(name, kind) for name in order])
        for k, name in enumerate("xyz"):
            rows[name] = array[:, k]
        np.save(tmp_path / "a.npy", rows)
        found = read_npy(tmp_path / "a.npy", keep=["v"])
        assert found.extra["v"].tolist() == [0] * count
    elif form == "npz":
        shape = data.draw(st.sampled_from([(count,), (count, 1)]))  # the second as Open3D has it
        np.savez_compressed(tmp_path / "a.npz", xyz=array, v=np.arange(count).reshape(shape))
        found = read_npz(tmp_path / "a.npz", keep=["v"])
        assert found.extra["v"].tolist() == list(range(count))
    else:
        np.save(tmp_path / "a.npy", np.asarray(array, order=form))
        found = read_npy(tmp_path / "a.npy")
    np.testing.assert_array_equal(found.points, array[:, :3].astype(np.float64))


@pytest.mark.parametrize(
    "arrays",
    [
        {"data": "points"},
        {"x": 0, "y": 1, "z": 2, "snr": 0},
        {"pc": "points", "rgb": "colors", "normals": "points"},
        {"frame": "points", "label": 0},
    ],
)
def test_archives_whose_points_are_called_otherwise(tmp_path, arrays):
    points = np.random.default_rng(0).uniform(0, 2, (20, 3))
    made = {"points": points, "colors": np.zeros((20, 3), np.uint8)}
    np.savez(tmp_path / "a.npz", **{k: points[:, v] if isinstance(v, int) else made[v] for k, v in arrays.items()})
    cloud = read_npz(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.points, points)
    assert (cloud.color is not None) == ("rgb" in arrays)
    assert cloud.unread == tuple(name for name in arrays if name in ("snr", "normals", "label"))


@pytest.mark.parametrize("shape", [(20, 3), (1, 20, 3), (1, 3)])
def test_a_batch_of_one_and_a_single_point_of_hdf5_are_clouds(tmp_path, shape):
    points = np.random.default_rng(0).uniform(0, 2, shape).astype(np.float32)
    colors = np.arange(points.size, dtype=np.uint8).reshape(-1, 3)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["points"], file["colors"], file["v"] = points, colors, np.arange(len(colors))[None]
    cloud = read_cloud(tmp_path / "a.h5", keep=["v"])
    np.testing.assert_array_equal(cloud.points, points.reshape(-1, 3))
    np.testing.assert_array_equal(cloud.color, colors)
    assert cloud.extra["v"].tolist() == list(range(len(colors)))


def test_columns_of_other_shapes_are_read_or_named(tmp_path):
    """x, y and z may be a grid of rows and columns, or columns of one; several numbers a point are no column."""
    points = np.random.default_rng(0).uniform(0, 2, (20, 3))
    for shape in ((20,), (4, 5), (20, 1)):
        axes = {name: points[:, k].reshape(shape) for k, name in enumerate("xyz")}
        np.savez(tmp_path / "a.npz", **axes, v=axes["x"], colors=np.zeros((20, 3), np.uint8))
        cloud = read_npz(tmp_path / "a.npz")
        np.testing.assert_array_equal(cloud.points, points)
        assert cloud.unread == ("v", "colors")
    rows = np.zeros(20, [("x", "f8", (1,)), ("y", "f8"), ("z", "f8"), ("rgb", "u1", (3,)), ("v", "f4")])
    rows["x"], rows["y"], rows["z"] = points[:, :1], points[:, 1], points[:, 2]
    np.save(tmp_path / "a.npy", rows)
    cloud = read_npy(tmp_path / "a.npy")
    np.testing.assert_array_equal(cloud.points, points)
    assert cloud.color is None and cloud.unread == ("v", "rgb")


@pytest.mark.parametrize("parts", [1, 1e3, 1e6, 1e9])
@pytest.mark.parametrize("suffix", [".npy", ".txt", ".xyz"])
def test_a_first_column_of_times_is_no_axis(tmp_path, suffix, parts):
    points = np.random.default_rng(0).normal(0, 50, (20, 3))
    times = (1_709_649_057.25 + np.arange(20) * 1e-3) * parts
    path = tmp_path / f"a{suffix}"
    for columns, refused in (([times, *points.T], True), ([*points.T, times], False), ([times, *points.T[:2]], False)):
        rows = np.stack(columns, axis=1)
        np.save(path, rows) if suffix == ".npy" else np.savetxt(path, rows, "%.6f")
        if refused:
            with pytest.raises(DataError, match=r"first column seems to hold times \(1\.?709649"):
                read_cloud(path)
        else:
            np.testing.assert_allclose(read_cloud(path).points, rows[:, :3], atol=1e-6)
    rows = np.stack([1.5e9 + points[:, 0], 4e6 + points[:, 1], points[:, 2], times], axis=1)  # a map, in millimeters
    np.save(path.with_suffix(".npy"), rows)
    np.testing.assert_array_equal(read_cloud(path.with_suffix(".npy")).points, rows[:, :3])


def test_pictures_and_poses_are_no_points(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((48, 64)))
    with pytest.raises(DataError, match=r"\(48, 64\); .* is it a picture, such as of depth"):
        read_npy(tmp_path / "a.npy")
    np.savetxt(tmp_path / "a.txt", np.ones((48, 64)))
    with pytest.raises(DataError, match=r"\(48, 64\); .* is it a picture"):
        read_cloud(tmp_path / "a.txt")
    np.save(tmp_path / "a.npy", np.eye(4))
    with pytest.raises(DataError, match="the pose of a camera"):
        read_npy(tmp_path / "a.npy")


def test_an_array_that_lies_on_its_side_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((3, 1000)))
    with pytest.raises(DataError, match=r"\(3, 1000\); expected a row for each point"):
        read_npy(tmp_path / "a.npy")


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (np.float32([[0, 0.5, 1]]), [0, 128, 255]),
        (np.float32([[0, 100, 255]]), [0, 100, 255]),
        (np.float32([[1.0000001, 0.5, 0]]), [255, 128, 0]),
        (np.float32([[2, 0.5, 127.5]]), [2, 0, 128]),
        (np.float64([[121, 131, 193]]), [121, 131, 193]),
        (np.uint16([[39, 57, 249]]), [39, 57, 249]),
        (np.uint16([[0, 32768, 65535]]), [0, 128, 255]),
        (np.float64([[0, 32768, 65535]]), [0, 128, 255]),
        (np.int32([[1, 2, 3]]), [1, 2, 3]),
        (np.uint8([[1, 0, 1]]), [1, 0, 1]),
    ],
)
def test_ranges_of_color(values, expected):
    (found,) = as_bytes([values])
    assert found.dtype == np.uint8 and found.tolist() == [expected]


@pytest.mark.parametrize(
    "values", [[[-1.0, 0, 0]], [[np.nan, 0, 0]], [[256.0, 3, 4]], [[1e6, 0, 0]], [[1.4, 0.5, 0]], [[3.5, 0, 0]]]
)
def test_colors_of_no_range_are_refused(values):
    with pytest.raises(DataError, match="expected 0 to 255, fractions from 0 to 1, or 16 bits"):
        as_bytes([np.float64(values)])


def test_frames_of_different_ranges_of_color_are_refused():
    with pytest.raises(DataError, match="from 0 to 1 in some frames and to 255 in others"):
        as_bytes([np.float64([[1, 0.5, 0]]), np.float64([[255, 128, 0]])])
    assert as_bytes([np.float64([[1, 0, 0]]), np.float64([[255, 128, 0]])])[0].tolist() == [[1, 0, 0]]


def scan(columns: int, count: int, seed: int) -> np.ndarray:
    """A scan of a room as a lidar has it, x y z and then reflectance, ring, time or normals."""
    rng = np.random.default_rng(seed)
    points = np.stack([rng.normal(0, 12, count), rng.normal(0, 9, count), rng.normal(-1, 0.6, count)], axis=1)
    further = [rng.uniform(0, 1, count), rng.integers(0, 32, count), rng.uniform(0, 0.1, count)]
    return np.column_stack([points, *further[: columns - 3]]).astype("<f4")


@pytest.mark.parametrize("columns", [3, 4, 5, 6])
@pytest.mark.parametrize("count", [360, 4096, 30_000])
def test_columns_are_told_by_their_look(tmp_path, columns, count):
    paths = []
    for seed in range(3):
        paths.append(tmp_path / f"{seed}.bin")
        scan(columns, count, seed).tofile(paths[-1])
    assert guess_bin_columns(paths) == (columns, True)


def test_few_points_are_kitti_s_unless_a_reflectance_is_negative(tmp_path):
    values = np.random.default_rng(0).normal(size=(8, 3)).astype("<f4")
    values.tofile(tmp_path / "0.bin")
    assert guess_bin_columns([tmp_path / "0.bin"]) == (3, False)
    np.abs(values).tofile(tmp_path / "0.bin")
    assert guess_bin_columns([tmp_path / "0.bin"]) == (4, True)
    reader = CloudFolders(tmp_path)
    values.tofile(tmp_path / "0.bin")
    sample = reader.read(reader.items()[0], np.random.default_rng(0))
    np.testing.assert_array_equal(sample.sequence.points, values)
    (note,) = sample.notes
    assert "3 float32 a point" in note and "other numbers fit as well" in note and "--bin-columns" in note


@pytest.mark.parametrize("step", [0, 1 / 512])  # a radar's whole numbers of 1/512 m leave half of each float64 at zero
@pytest.mark.parametrize("columns", [3, 4, 5])
def test_a_bin_of_another_type_is_refused(step, columns, tmp_path):
    values = np.random.default_rng(0).normal(size=(60, columns))
    (np.round(values / step) * step if step else values).astype("<f8").tofile(tmp_path / "0.bin")
    for guess in (columns, 2 * columns):
        with pytest.raises(DataError, match="no coordinates in float32 .* float64, as NumPy writes"):
            read_bin(tmp_path / "0.bin", guess)


def test_a_bin_that_holds_axis_after_axis_is_refused_unless_its_columns_are_said(tmp_path):
    scan(4, 500, 0).astype("<f4").T.tofile(tmp_path / "0.bin")
    with pytest.raises(DataError, match=r"axis after axis, all x first; .*reshape\(4, -1\).T"):
        guess_bin_columns([tmp_path / "0.bin"])
    item = CloudFolders(tmp_path, bin_columns=4).items()[0]
    assert CloudFolders(tmp_path, bin_columns=4).read(item, np.random.default_rng(0)).sequence.num_frames == 1


def test_a_count_before_the_points_is_no_coordinate(tmp_path):
    (tmp_path / "0.bin").write_bytes(np.uint32(500).tobytes() + scan(4, 500, 0).tobytes())
    with pytest.raises(DataError, match="no coordinate, but the whole number 500; a header before the points"):
        CloudFolders(tmp_path).read(CloudFolders(tmp_path).items()[0], np.random.default_rng(0))


@pytest.mark.parametrize("size", [12_185, 12_192, 12_288])  # of which the second and the third are whole points
def test_a_bin_of_cloudcompare_is_called_so(tmp_path, size):
    head = b"CCB2" + np.uint32(50).tobytes() + b"\x01\x01" + bytes(6)
    (tmp_path / "0.bin").write_bytes((head + scan(3, 1100, 0).astype("<f4").tobytes())[:size])
    with pytest.raises(DataError, match="CloudCompare's own .bin, .* save its clouds as .ply"):
        CloudFolders(tmp_path).read(CloudFolders(tmp_path).items()[0], np.random.default_rng(0))


def test_damaged_arrays_are_named(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.ones((4, 3), np.float32))
    whole = path.read_bytes()
    for old, new in ((b"(4, 3)", b"(9**9,"), (b"(4, 3), }", b"(4, 3)   "), (b"(4, 3)", b"(9999999999, 3)")):
        path.write_bytes(whole.replace(old, new))
        with pytest.raises(DataError, match="a.npy: not a readable .npy"):
            read_npy(path)
    np.savez(tmp_path / "b.npz", other=np.ones(3))
    path.write_bytes((tmp_path / "b.npz").read_bytes())
    with pytest.raises(DataError, match="a.npy: not a readable .npy"):
        read_npy(path)
    with zipfile.ZipFile(tmp_path / "c.npz", "w") as archive:
        archive.writestr("points", b"no array")
    with pytest.raises(DataError, match="expected one called points"):
        read_npz(tmp_path / "c.npz")


def test_an_archive_whose_members_would_begin_before_the_file_is_damaged(tmp_path):
    np.savez(tmp_path / "a.npz", xyz=np.ones((20, 3)))
    data = bytearray((tmp_path / "a.npz").read_bytes())
    directory = int.from_bytes(data[-6:-2], "little")  # where the list of members is said to be
    data[-6:-2] = (directory + 40).to_bytes(4, "little")
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(DataError, match="a.npz: damaged.*Invalid argument"):
        read_npz(tmp_path / "a.npz")


@given(st.integers(3, 40), st.integers(4, 7), st.sampled_from([0, 1]), st.integers(0, 2**32 - 1))
def test_a_first_column_that_counts_the_rows_is_no_axis(rows, columns, start, seed):
    points = np.random.default_rng(seed).uniform(0.1, 0.9, (rows, columns))
    assert np.array_equal(saved(points).points, points[:, :3])
    numbered = points.copy()
    numbered[:, 0] = np.arange(rows) + start
    found = saved(numbered)
    assert np.array_equal(found.points, points[:, 1:4]) and "numbers of the rows" in found.unread[0]
    assert np.array_equal(saved(np.floor(numbered)).points, np.floor(numbered)[:, :3])  # a grid of whole numbers


def saved(array: np.ndarray):
    with TemporaryDirectory() as folder:
        np.save(Path(folder) / "p.npy", array)
        return read_npy(Path(folder) / "p.npy")


@pytest.mark.parametrize("corners", ["faces", "triangles", "edges", "indices"])
def test_the_corners_of_a_mesh_are_no_points(tmp_path, corners):
    points, faces = np.random.default_rng(0).normal(size=(9, 3)), np.arange(12).reshape(4, 3)
    np.savez(tmp_path / "m.npz", verts=points, **{corners: faces})
    assert np.array_equal(read_npz(tmp_path / "m.npz").points, points)
    np.savez(tmp_path / "n.npz", **{corners: faces})
    with pytest.raises(DataError, match="expected one called points"):
        read_npz(tmp_path / "n.npz")


def test_objects_beside_one_cloud_are_named_and_not_loaded(tmp_path):
    points, objects = np.random.default_rng(3).normal(size=(20, 3)), np.array([{"frame": 1}, print], object)
    np.savez(tmp_path / "a.npz", points=points, about=objects)
    cloud = read_npz(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.points, points)
    assert cloud.unread == ("about",)
    np.savez(tmp_path / "b.npz", points=objects)
    with pytest.raises(DataError, match="expected numbers"):
        read_npz(tmp_path / "b.npz")
    np.savez(tmp_path / "c.npz", about=objects)
    with pytest.raises(DataError, match=r"arrays about \(a pickle\)"):
        read_npz(tmp_path / "c.npz")


def test_the_only_structured_array_of_an_npz_is_the_cloud(tmp_path):
    points, level = np.random.default_rng(4).normal(size=(20, 3)), np.arange(20) / 3
    records = np.rec.fromarrays([level, *points.T], names="level,x,y,z")
    np.savez(tmp_path / "a.npz", records, labels=np.arange(20))
    cloud = read_npz(tmp_path / "a.npz", keep=["level"])
    np.testing.assert_array_equal(cloud.points, points)
    np.testing.assert_array_equal(cloud.extra["level"], level)
    assert cloud.unread == ("labels",)
    np.savez(tmp_path / "b.npz", about=records, points=points + 1)
    np.testing.assert_array_equal(read_npz(tmp_path / "b.npz").points, points + 1)


def test_several_tables_in_a_file_of_one_cloud_are_named(tmp_path):
    points = np.random.default_rng(4).normal(size=(20, 3))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["lidar"] = file["radar"] = np.rec.fromarrays(points.T, names="x,y,z")
    with pytest.raises(DataError, match=r"holds several tables \(lidar, radar\)"):
        read_cloud(tmp_path / "a.h5")
