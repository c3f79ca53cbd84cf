"""PCD: whatever pypcd4 and Open3D write is read back equal, in every type and encoding."""

from __future__ import annotations

import numpy as np
import pypcd4
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError
from dpcli.ops.open3d_import import load_open3d
from dpcli.prepare.cloud_formats.pcd import BLACK, POSED, read_pcd

quick = settings(
    max_examples=60, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@quick
@given(data=st.data())
def test_what_pypcd4_writes_is_read_back(tmp_path, data):
    kinds = st.sampled_from([np.float32, np.float64, np.int8, np.int16, np.int32, np.uint8, np.uint16, np.uint32])
    axis = data.draw(kinds)
    names = data.draw(st.permutations(["x", "y", "z", "intensity", "ring"]))
    types = [axis if name in "xyz" else data.draw(kinds) for name in names]
    encoding = data.draw(st.sampled_from(["ascii", "binary", "binary_compressed"]))
    count = data.draw(st.integers(1, 60))
    rng = np.random.default_rng(data.draw(st.integers(0, 9)))
    columns = [np.round(rng.uniform(0, 100, count), 4).astype(kind) for kind in types]
    path = tmp_path / "a.pcd"
    pypcd4.PointCloud.from_points(columns, tuple(names), tuple(types)).save(path, pypcd4.Encoding(encoding))
    cloud = read_pcd(path, keep=["intensity", "ring"])
    for name, column in zip(names, columns):
        own = cloud.points[:, "xyz".index(name)] if name in "xyz" else cloud.extra[name]
        np.testing.assert_allclose(own, column, rtol=1e-6)


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("kind", ["float32", "float64"])
def test_what_open3d_writes_is_read_back(tmp_path, text, compressed, kind):
    open3d = load_open3d()
    points = np.random.default_rng(0).uniform(0, 1, (30, 3)).astype(kind) + (448_000 if kind == "float64" else 0)
    cloud = open3d.t.geometry.PointCloud(open3d.core.Tensor(points))
    cloud.point.colors = open3d.core.Tensor(np.random.default_rng(1).integers(0, 256, (30, 3)).astype(np.uint8))
    path = tmp_path / "a.pcd"
    assert open3d.t.io.write_point_cloud(str(path), cloud, write_ascii=text, compressed=compressed)
    found = read_pcd(path)
    np.testing.assert_allclose(found.points, points, rtol=1e-6 if text else 0)
    if found.color is not None and not text:
        np.testing.assert_array_equal(found.color, cloud.point.colors.numpy())


def header(fields="x y z", size="4 4 4", kind="F F F", count="1 1 1", points=2, data="ascii", version="0.7"):
    return (
        f"# .PCD\nVERSION {version}\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\nCOUNT {count}\nWIDTH {points}\n"
        f"HEIGHT 1\nPOINTS {points}\nDATA {data}\n"
    )


def test_padding_counts_and_packed_colors(tmp_path):
    row = np.dtype(
        [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_", "u1", 4), ("rgb", "<u4"), ("normal", "<f4", 3), ("z2", "<f8")]
    )
    rows = np.zeros(2, row)
    rows["x"], rows["rgb"], rows["z2"] = [1, 2], [0xFF102030, 0x00405060], [7, 8]
    head = header("x y z _ rgb normal z2", "4 4 4 1 4 4 8", "F F F U F F F", "1 1 1 4 1 3 1", data="binary")
    (tmp_path / "a.pcd").write_bytes(head.encode() + rows.tobytes())
    cloud = read_pcd(tmp_path / "a.pcd", keep=["z2"])
    assert cloud.points[:, 0].tolist() == [1, 2] and cloud.extra["z2"].tolist() == [7, 8]
    assert cloud.color.tolist() == [[16, 32, 48], [64, 80, 96]]


@pytest.mark.parametrize("packed", ["4.2108e+06", "4210752", "U 4210752"])
def test_packed_colors_in_texts(tmp_path, packed):
    kind = "F F F U" if packed.startswith("U") else "F F F F"
    value = packed.removeprefix("U ")
    (tmp_path / "a.pcd").write_text(header("x y z rgb", "4 4 4 4", kind, "1 1 1 1", points=1) + f"1 2 3 {value}\n")
    color = read_pcd(tmp_path / "a.pcd").color
    assert np.abs(color.astype(int) - 64).max() <= (48 if "e" in packed else 0)  # the first has few digits left


def test_a_color_of_a_text_that_is_no_number_is_none(tmp_path):
    """As writers of float32 leave it of alpha 255 and much red; points that nothing measured need no color."""
    dark, text = np.uint32([0x10203040]).view(np.float32)[0], header("x y z rgb", "4 4 4 4", "F F F F", "1 1 1 1")
    for row, color in (("nan nan nan nan", [[32, 48, 64]]), ("4 5 6 nan", None)):
        (tmp_path / "a.pcd").write_text(f"{text}1 2 3 {dark:.9g}\n{row}\n")
        cloud = read_pcd(tmp_path / "a.pcd")
        assert (
            (cloud.color is None and cloud.unread == ("rgb",)) if color is None else cloud.color[:1].tolist() == color
        )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (header() + "1 2 3\n", "says 2 points, it has room for 1"),
        (header() + "1 2 3\n1 2\n", ":12: 2 values"),
        (header() + "1,5 2,5 3\n1 2 word\n", ":12: column 'z' holds 'word'"),
        (header(size="4 4") + "1 2 3\n", "have different lengths"),
        (header(size="4 4 3") + "1 2 3\n", "field z has TYPE F SIZE 3"),
        (header(size="4 4 ²") + "1 2 3\n", "field z has TYPE F SIZE "),
        (header(count="1 1 ²") + "1 2 3\n", "field z has COUNT "),
        (header(data="zip") + "1 2 3\n", "DATA zip; expected ascii"),
        (header(data="binary_compressed") + "12345678", "truncated or damaged"),
        ("# .PCD\n", "no number of points in its header"),
    ],
)
def test_what_is_damaged_is_named(tmp_path, content, message):
    (tmp_path / "a.pcd").write_text(content, "latin-1")
    with pytest.raises(DataError, match=message):
        read_pcd(tmp_path / "a.pcd")


def test_several_blanks_decimal_commas_and_an_old_version(tmp_path):
    (tmp_path / "a.pcd").write_text(header(version=".5") + "1,5  2   3\n4 5,25 nan \n")
    points = read_pcd(tmp_path / "a.pcd").points
    np.testing.assert_array_equal(points, [[1.5, 2, 3], [4, 5.25, np.nan]])


def test_units_in_names_count_before_those_in_comments(tmp_path):
    for names, said, unit in (
        ("x_mm y_mm z_mm", "", "mm"),
        ("x_mm y_mm z_mm", "# unit: m\n", "mm"),
        ("x y z", "# unit: m\n", "m"),
    ):
        (tmp_path / "a.pcd").write_text(said + header(names) + "1 2 3\n4 5 6\n")
        assert read_pcd(tmp_path / "a.pcd").unit == unit


def test_numbers_of_a_compressed_field_lie_point_after_point(tmp_path):
    """As PCL packs them: all numbers of a field's first point, then those of its second."""
    points, normals = np.arange(9, dtype="<f4").reshape(3, 3), np.arange(10, 19, dtype="<f4").reshape(3, 3)
    raw = points[:, :2].T.tobytes() + normals.tobytes() + points[:, 2].tobytes()
    packed = b"".join(bytes([len(raw[k : k + 32]) - 1]) + raw[k : k + 32] for k in range(0, len(raw), 32))
    head = header("x y normal z", "4 4 4 4", "F F F F", "1 1 3 1", points=3, data="binary_compressed")
    (tmp_path / "a.pcd").write_bytes(head.encode() + np.array([len(packed), len(raw)], "<u4").tobytes() + packed)
    cloud = read_pcd(tmp_path / "a.pcd", keep=[f"normal_2_{k}" for k in range(3)])
    np.testing.assert_array_equal(cloud.points, points)
    np.testing.assert_array_equal(np.stack(list(cloud.extra.values()), axis=1), normals)


def test_damaged_compression_is_named(tmp_path):
    values = np.random.default_rng(0).integers(0, 3, 300).astype(np.float32)
    path = tmp_path / "a.pcd"
    cloud = pypcd4.PointCloud.from_xyz_points(values.reshape(-1, 3))
    cloud.save(path, pypcd4.Encoding.BINARY_COMPRESSED)
    whole = path.read_bytes()
    start = whole.index(b"DATA binary_compressed\n") + 31
    path.write_bytes(whole[:start] + b"\xff" * (len(whole) - start))
    with pytest.raises(DataError, match="damaged"):
        read_pcd(path)


@pytest.mark.parametrize(
    ("viewpoint", "posed"),
    [("0 0 0 1 0 0 0", False), ("0 0 0 -1 0 0 0", False), ("1.5 0 0.2 1 0 0 0", True), ("0 0 0 0.7 0 0 0.7", True)],
)
def test_a_sensor_pose_is_told_and_not_applied(tmp_path, viewpoint, posed):
    text = header().replace("POINTS", f"VIEWPOINT {viewpoint}\nPOINTS") + "1 2 3\n4 5 6\n"
    (tmp_path / "a.pcd").write_text(text)
    cloud = read_pcd(tmp_path / "a.pcd")
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]] and cloud.dropped == ({POSED: 1} if posed else {})


@pytest.mark.parametrize("encoding", [pypcd4.Encoding.ASCII, pypcd4.Encoding.BINARY])
def test_colors_that_a_text_rounds_to_nothing_are_told(tmp_path, encoding):
    """As pypcd4 writes texts: the bytes of a color are a tiny float32, of which ten decimals are 0."""
    colors = np.random.default_rng(5).integers(0, 256, (20, 3)).astype(np.uint8)
    columns = [np.arange(20, dtype=np.float32)] * 3 + [pypcd4.PointCloud.encode_rgb(colors)]
    pypcd4.PointCloud.from_xyzrgb_points(columns).save(tmp_path / "a.pcd", encoding)
    cloud = read_pcd(tmp_path / "a.pcd")
    if encoding == pypcd4.Encoding.ASCII:
        assert not cloud.color.any() and cloud.dropped == {BLACK: 1}
    else:
        assert np.array_equal(cloud.color, colors) and not cloud.dropped
