"""PLY: whatever plyfile writes is read back equal; what is damaged or impossible is named, never filled up."""

from __future__ import annotations

import numpy as np
import plyfile
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.ply import read_ply

POINTS = [(0.126, -0.132, 0.64), (0.105, -0.536, 0.362), (1.304, 0.947, -0.704)]
quick = settings(
    max_examples=60, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def text_ply(rows: list[str], properties: str = "float x|float y|float z", count: int | None = None) -> str:
    lines = "".join(f"property {one}\n" for one in properties.split("|"))
    return f"ply\nformat ascii 1.0\nelement vertex {len(rows) if count is None else count}\n{lines}end_header\n" + (
        "".join(f"{row}\n" for row in rows)
    )


def read_text(path, *arguments, **options):
    path.write_text(text_ply(*arguments, **options))
    return read_ply(path)


@pytest.mark.parametrize("more", ["", "|list uchar int rings"])
def test_units_in_names_are_read(tmp_path, more):
    lines = text_ply(["1 2 3"], "float x_mm|float y_mm|float z_mm" + more)
    if more:  # whose rows are read one by one, of bytes alone
        head = lines.replace("ascii", "binary_little_endian").partition("1 2 3")[0].encode()
        (tmp_path / "a.ply").write_bytes(head + np.float32([1, 2, 3]).tobytes() + b"\1" + np.int32([7]).tobytes())
    else:
        (tmp_path / "a.ply").write_text(lines)
    cloud = read_ply(tmp_path / "a.ply")
    assert cloud.points.tolist() == [[1, 2, 3]] and cloud.unit == "mm"


def test_a_range_grid_of_empty_lists_is_no_damage(tmp_path):
    grid = np.array([([0],), ([],), ([1],)], dtype=[("vertex_indices", object)])
    points = np.array(POINTS, dtype=[(name, "f4") for name in "xyz"])
    elements = [plyfile.PlyElement.describe(points, "vertex"), plyfile.PlyElement.describe(grid, "range_grid")]
    plyfile.PlyData(elements, byte_order=">").write(str(tmp_path / "a.ply"))
    np.testing.assert_allclose(read_ply(tmp_path / "a.ply").points, POINTS, rtol=1e-6)


@quick
@given(data=st.data())
def test_what_plyfile_writes_is_read_back(tmp_path, data):
    axis = data.draw(st.sampled_from(["f4", "f8", "i2", "i4", "u1"]))
    color = data.draw(st.sampled_from([None, "u1", "u2", "f4"]))
    order = data.draw(st.permutations(["x", "y", "z", "nx", *(["red", "green", "blue"] if color else [])]))
    text, endian = data.draw(st.booleans()), data.draw(st.sampled_from("<>"))
    count, seed = data.draw(st.integers(0, 20)), data.draw(st.integers(0, 9))
    rng = np.random.default_rng(seed)
    row = np.dtype([(n, (color if n in ("red", "green", "blue") else "f4" if n == "nx" else axis)) for n in order])
    vertices = np.zeros(count, row)
    for name in order:
        vertices[name] = rng.uniform(0, 1 if row[name].kind == "f" and name[0] in "rgb" else 200, count)
    faces = np.array([([0, 1, 2],)] * 3, dtype=[("vertex_indices", "i4", (3,))])
    elements = [plyfile.PlyElement.describe(vertices, "vertex")]
    where = data.draw(st.sampled_from(["none", "before", "behind"]))
    if where != "none":
        elements.insert(0 if where == "before" else 1, plyfile.PlyElement.describe(faces, "face"))
    path = tmp_path / "a.ply"
    plyfile.PlyData(elements, text=text, byte_order=endian, comments=["made by a test"]).write(str(path))
    cloud = read_ply(path, keep=["nx"])
    for k, name in enumerate("xyz"):
        np.testing.assert_array_equal(cloud.points[:, k], vertices[name])
    np.testing.assert_array_equal(cloud.extra["nx"], vertices["nx"])
    assert (cloud.color is None) == (color is None)
    if color:
        np.testing.assert_array_equal(cloud.color, np.stack([vertices[n] for n in ("red", "green", "blue")], axis=1))


def test_decimal_commas_are_numbers(tmp_path):
    cloud = read_text(tmp_path / "a.ply", ["0,126 -0,132 0,64", "0,105 -0,536 0,362", "1,304 0,947 -0,704"])
    np.testing.assert_allclose(cloud.points, POINTS, atol=1e-6)


@pytest.mark.parametrize(
    ("rows", "properties", "message"),
    [
        (["1 2 3 10", "1 2 3 256"], "float x|float y|float z|uchar red", "red of vertex 1 is 256; .* from 0 to 255"),
        (["1 2 3 10", "1 2 3 -1"], "float x|float y|float z|uchar red", "red of vertex 1 is -1"),
        (["1 2 3", "1 2.5 word"], "float x|float y|float z", ":9: column 'z' holds 'word'"),
        (["1 2 3", "1 2"], "float x|float y|float z", ":9: 2 values"),
        (["1.5 2 3"], "int x|int y|int z", "x of vertex 0 is 1.5"),
        (["1 2 3"], "float x|float y|float w", "fields x, y, w; expected x, y and z"),
    ],
)
def test_what_does_not_fit_its_type_is_named(tmp_path, rows, properties, message):
    with pytest.raises(DataError, match=message):
        read_text(tmp_path / "a.ply", rows, properties)


@pytest.mark.parametrize(
    "names", ["r g b", "red green blue", "diffuse_red diffuse_green diffuse_blue", "R G B", "Rf Gf Bf"]
)
def test_names_of_colors(tmp_path, names):
    properties = "float x|float y|float z|" + "|".join(f"float {name}" for name in names.split())
    assert read_text(tmp_path / "a.ply", ["1 2 3 0.1 0.5 1"], properties).color.tolist() == [
        [np.float32(0.1), 0.5, 1.0]
    ]


@pytest.mark.parametrize("ends", ["\n", "\r\n", "\r"])
def test_comments_that_sound_like_the_header(tmp_path, ends):
    text = text_ply(["1 2 3", "4 5 6"]).replace("element", "comment element vertex 9 end_header\nobj_info x 1\nelement")
    (tmp_path / "a.ply").write_bytes(text.replace("\n", ends).encode())
    assert read_ply(tmp_path / "a.ply").points.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_a_mark_before_the_header_and_windows_line_ends(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(b"\xef\xbb\xbf" + text_ply(["1 2 3", "4 5 6"]).replace("\n", "\r\n").encode())
    assert read_ply(path).points.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_lists_of_vertices_are_named(tmp_path):
    rows = np.zeros(3, [*((axis, "f4") for axis in "xyz"), ("tags", object)])
    for k, axis in enumerate("xyz"):
        rows[axis] = [point[k] for point in POINTS]
    rows["tags"] = [np.arange(k, dtype="i4") for k in range(3)]
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "a.ply"))
    cloud = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(cloud.points, np.float32(POINTS))
    assert cloud.unread == ("tags",)


def test_a_count_that_is_no_number_is_named(tmp_path):
    (tmp_path / "a.ply").write_text(text_ply(["1 2 3"]).replace("vertex 1", "vertex ²"), "latin-1")
    with pytest.raises(DataError, match="no element vertex in its header"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("ends", [" \n", "\t\n", "  \r\n"])
def test_blanks_behind_the_header_are_no_coordinates(tmp_path, ends):
    head = text_ply([], count=3).replace("ascii", "binary_little_endian").removesuffix("\n") + ends
    (tmp_path / "a.ply").write_bytes(head.encode() + np.float32(POINTS).tobytes())
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").points, np.float32(POINTS))


def test_a_text_that_ends_early_and_not_a_number(tmp_path):
    with pytest.raises(DataError, match="says 5 points, it has room for 2"):
        read_text(tmp_path / "a.ply", ["1 2 3", "4 5 6"], count=5)
    assert np.isnan(read_text(tmp_path / "a.ply", ["nan 2 3", "-1.#IND 5 6"]).points[:, 0]).all()


@quick
@given(degree=st.integers(0, 3), kind=st.sampled_from(["f4", "f8"]), data=st.data())
def test_gaussians_of_any_layout_bring_their_color(tmp_path, degree, kind, data):
    rest = [f"f_rest_{k}" for k in range(3 * ((degree + 1) ** 2 - 1))]
    dc = [f"f_dc_{k}" for k in range(3)]
    names = data.draw(st.permutations(["x", "y", "z", "opacity", "rot_0", "scale_0", *dc, *rest]))
    color = data.draw(st.lists(st.tuples(*[st.integers(0, 255)] * 3), min_size=3, max_size=3))
    rows = np.zeros(3, [(name, kind) for name in names])
    for k in range(3):
        rows["xyz"[k]] = [point[k] for point in POINTS]
        rows[dc[k]] = [(one[k] / 255 - 0.5) / (0.5 / np.sqrt(np.pi)) for one in color]
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "a.ply"))
    cloud = read_ply(tmp_path / "a.ply")
    assert cloud.color.tolist() == [list(one) for one in color]
    np.testing.assert_allclose(cloud.points, POINTS, rtol=1e-6)
    assert set(cloud.unread) == {"opacity", "rot_0", "scale_0", *rest}
