"""Texts: every delimiter, decimal sign, encoding and quoting that people's programs write is read back equal."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError
from dpcli.ops.open3d_import import load_open3d
from dpcli.prepare.cloud_formats.cloud import AT_ORIGIN
from dpcli.prepare.cloud_formats.colors import as_bytes
from dpcli.prepare.cloud_formats.column_names import find_axes, find_colors, find_frame_column
from dpcli.prepare.cloud_formats.text_cloud import BLOCKS, COUNTED, EMPTY, read_text, read_vertices
from dpcli.prepare.cloud_formats.text_numbers import CUT
from dpcli.prepare.decode.cloud_files import read_cloud
from dpcli.prepare.reader import Item
from dpcli.prepare.scans.assembling import Lengths, assemble

POINTS = [[0.126, -0.132, 0.64], [0.105, -0.536, 0.362], [-1.265, -0.623, 0.041]]
quick = settings(
    max_examples=150, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def read(path, text, encoding="utf-8", **options):
    path.write_bytes(text.encode(encoding))
    return read_text(path, **options)


@quick
@given(data=st.data())
def test_what_csv_writers_write_is_read_back(tmp_path, data):
    delimiter = data.draw(st.sampled_from([",", ";", "\t", "|", " "]))
    comma = delimiter != " " and data.draw(st.booleans())
    quoting = data.draw(st.sampled_from([csv.QUOTE_MINIMAL, csv.QUOTE_ALL]))
    encoding = data.draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "latin-1"]))
    order = data.draw(st.permutations(["x", "y", "z", "größe" if encoding != "latin-1" else "size"]))
    trailing, ends = data.draw(st.booleans()) and delimiter != " ", data.draw(st.sampled_from(["\n", "\r\n", "\r"]))
    rng = np.random.default_rng(data.draw(st.integers(0, 9)))
    values = np.round(rng.normal(0, 10.0 ** data.draw(st.integers(-2, 5)), (data.draw(st.integers(1, 12)), 4)), 3)
    file = io.StringIO()
    writer = csv.writer(file, delimiter=delimiter, quoting=quoting, lineterminator=ends)
    writer.writerow([*order, *([""] if trailing else [])])
    for row in values:
        cells = [f"{value:.3f}".replace(".", "," if comma else ".") for value in row]
        writer.writerow([*cells, *([""] if trailing else [])])
    (tmp_path / "a.csv").write_bytes(file.getvalue().encode(encoding))
    found = read_text(tmp_path / "a.csv").points
    np.testing.assert_allclose(found, values[:, [order.index(axis) for axis in "xyz"]], atol=1e-9)


@pytest.mark.parametrize(
    "text",
    [
        "x;y;z\n0,126;-0,132;0,64\n0,105;-0,536;0,362\n-1,265;-0,623;0,041\n",
        "0,126 -0,132 0,64\n0,105  -0,536 0,362\n-1,265 -0,623 0,041\n",
        "3\n0.126 -0.132 0.64\n0.105 -0.536 0.362\n-1.265 -0.623 0.041\n",
        "//X Y Z\n0.126 -0.132 0.64\n0.105 -0.536 0.362\n-1.265 -0.623 0.041\n",
        "# a lidar log\n# x y z\n0.126 -0.132 0.64\n0.105 -0.536 0.362\n-1.265 -0.623 0.041\n",
        "sep=;\nX;Y;Z\n0,126;-0,132;0,64\n0,105;-0,536;0,362\n-1,265;-0,623;0,041\n",
        "Radar 77 GHz\nrecorded,Monday\nz,y,x,\n0.64,-0.132,0.126,\n0.362,-0.536,0.105,\n0.041,-0.623,-1.265,\n",
        "x,y,z,class\n0.126,-0.132,0.64,car\n0.105,-0.536,0.362,a bus\n-1.265,-0.623,0.041,\n",
        '"x","y","z"\n"0.126","-0.132","0.64"\n"0.105","-0.536","0.362"\n"-1.265","-0.623","0.041"\n',
        "0.126, -0.132, 0.64\n0.105, -0.536, 0.362\n\n-1.265, -0.623, 0.041",
        "x,y,z\n1.26e-1,-1.32E-01,+.64\n0.105,-0.536,0.362\n-1.265,-0.623,0.041\n",
        "x,y,z,v\nm,m,m,m/s\n0.126,-0.132,0.64,1\n0.105,-0.536,0.362,2\n-1.265,-0.623,0.041,3\n",
        "x;y;z\n#[m];[m];[m]\n0,126;-0,132;0,64\n0,105;-0,536;0,362\n-1,265;-0,623;0,041\n",
        "x y z\n0.126 -0.132 0.64\nx y z\n0.105 -0.536 0.362\nx y z\n-1.265 -0.623 0.041\n",
        "0,1,2\n0.126,-0.132,0.64\n0.105,-0.536,0.362\n-1.265,-0.623,0.041\n",
        ",0,1,2,3\n0,0.126,-0.132,0.64,9\n1,0.105,-0.536,0.362,9\n2,-1.265,-0.623,0.041,8\n",
        "1 0.126 -0.132 0.64\n2 0.105 -0.536 0.362\n3 -1.265 -0.623 0.041\n",
        '"x" "y" "z"\n"1" 0.126 -0.132 0.64\n"2" 0.105 -0.536 0.362\n"3" -1.265 -0.623 0.041\n',
        " x y z\n0 0.126 -0.132 0.64\n1 0.105 -0.536 0.362\n2 -1.265 -0.623 0.041\n",
        "       x      y      z\n0  0.126 -0.132  0.640\n1  0.105 -0.536  0.362\n2 -1.265 -0.623  0.041\n",
        '"x" "y" "z" "c"\n"51" 0.126 -0.132 0.64 "a"\n"57" 0.105 -0.536 0.362 "b"\n"58" -1.265 -0.623 0.041 "a"\n',
        '"x";"y";"z"\n"p1";0,126;-0,132;0,64\n"p2";0,105;-0,536;0,362\n"p3";-1,265;-0,623;0,041\n',
        '"x" "y" "z" "c"\n"1" 0,126 -0,132 0,64 "a"\n"2" 0,105 -0,536 0,362 "b"\n"3" -1,265 -0,623 0,041 "a"\n',
        "x,y,z\n0.126,\u22120.132,0.64\n0.105,\u22120.536,0.362\n\u22121.265,\u22120.623,0.041\n",
        "Points:0,Points:1,Points:2,id\n0.126,-0.132,0.64,0\n0.105,-0.536,0.362,1\n-1.265,-0.623,0.041,2\n",
    ],
)
def test_texts_of_the_same_points(tmp_path, text):
    np.testing.assert_allclose(read(tmp_path / "a.csv", text).points, POINTS)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x;y;z\n1.234,5;-2,25;1.000.000,5\n", [1234.5, -2.25, 1000000.5]),
        ('x,y,z\n"1,234.5","2.25","448,000.249"\n', [1234.5, 2.25, 448000.249]),
        ("x;y;z\n448'000.5;1;2\n", [448000.5, 1, 2]),
        ("x;y;z\n1 234,5;1;2\n", [1234.5, 1, 2]),
        ("x,y,z\n,2,nan\n", [np.nan, 2, np.nan]),
        ("x,y,z\nNULL,2,1e30\n", [np.nan, 2, 1e30]),
        ("x,y,z\n#DIV/0!,2,3\n", [np.nan, 2, 3]),
        ("x,y,z\n1,#N/A,3\n", [1, np.nan, 3]),
        ('x,y,z\n"1,500","-2,250",500\n', [1500, -2250, 500]),
        ("x;y;z\n1,500;2,250;1,125\n", [1.5, 2.25, 1.125]),
        ("x;y;z\n1,500;0,250;7\n", [1.5, 0.25, 7]),
        ("x;y;z\n448.262.123;-5.411.932;1.000\n", [448262123, -5411932, 1000]),
        ("x;y;z\n1.500;-2.250;7\n", [1.5, -2.25, 7]),
        ("x,y,z\n1.500,2,3\n" + "\0" * 600, [1.5, 2, 3]),
    ],
)
def test_groups_of_thousands_and_missing_cells(tmp_path, text, expected):
    np.testing.assert_allclose(read(tmp_path / "a.csv", text).points, [expected])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,z\n0,126,-0,132,0,640\n", "a.csv:2: 6 values; .*decimal commas between commas"),
        ("0,126,-0,132,0,640\n0,105,-0,536,0,362\n", "a.csv:1: decimal commas between commas can't be told apart"),
        ("1,5, 2,25, 3,5\n4,5, 5,25, 6,5\n", "a.csv:1: decimal commas between commas can't be told apart"),
        ("x;y;z\n0,5;1.5;2\n", "numbers such as 0,5 beside others with a point"),
        (
            '"x","y","z"\n"1.5","2.5","3.5","4"\n"5.5","6.5","7.5","8"\n',
            "a.csv:2: 4 values; expected .*3 as in the header",
        ),
        ("x y z\n0 0 1 5\n1 0 1 5\n0 1 1 5\n", "a.csv:2: 4 values; expected .*3 as in the header"),
        ('"x" "y" "z"\n"car" 1.5 2.5 3.5\n"car" 5.5 6.5 7.5\n', "a.csv:2: 4 values; expected .*3 as in the header"),
        ("x;y;z\n1,500;2,250;500\n", "1,500 beside 500 may be 1500 or 1.500"),
        ("x;y;z\n448.262.123;2;0.512\n", "numbers such as 448.262.123 beside 0.512; expected one style"),
        ("x y z\n1 2 3\n1.2.3 2 3.5\n", "a.csv:3: column 'x' holds '1.2.3'"),
        ("x;y;z\n1.500;2;3\n500;2;3\n", "1.500 beside 500 may be 1500 or 1.500"),
        ("x,y,z\n1_000,2,3\n", "column 'x' holds '1_000'"),
        ("4\n1 2 3\n4 5 6\n", "says 4 points in line 1, holds 2"),
        ("\n\n", "no rows"),
        ("range,azimuth,elevation\n1,2,3\n", "columns range, azimuth, elevation; expected x, y and z"),
        (
            "header: \n  seq: 6\nx: 1.0\ny: 2.0\nz: 0.5\n---\n",
            "header:; .* make a table .*: a row for each point",
        ),  # RadHAR
        ("x,y,z,pos_x,X\n1,2,3,4,5\n", "columns x, X could each be x"),
        ("x_mm,y_mm,z_m\n1,2,3\n", "different units"),
        ("# frame 0\n1 2 3\n# frame 1\n4 5 6\n", "comments such as '# frame 1' divide its rows into frames"),
        ("x y z\n1 2 3\n// Scan no: 2\n4 5 6\n", "comments such as '// Scan no: 2' divide its rows into frames"),
        ("x [ms],y [ms],z [ms]\n1,2,3\n", "expected x, y and z among them"),
        ("frame,x,y,z\n0,1,2,3\n1,1,2,3\n", "'frame' numbers 2 frames; --frame-column frame"),
    ],
)
def test_what_cannot_be_told_is_refused(tmp_path, text, message):
    with pytest.raises(DataError, match=message):
        read(tmp_path / "a.csv", text)


@pytest.mark.parametrize("row", ["mm,mm,mm,m/s", "[mm],[mm],[mm]", "# mm,mm,mm,-"])
def test_a_row_of_units_below_the_header_counts(tmp_path, row):
    cloud = read(tmp_path / "a.csv", f"x,y,z,v\n{row}\n1,2,3,4\n5,6,7,8\n", keep=["v"])
    assert (
        cloud.unit == "mm" and cloud.points.tolist() == [[1, 2, 3], [5, 6, 7]] and cloud.extra["v"].tolist() == [4, 8]
    )


@pytest.mark.parametrize(
    ("suffix", "rows", "color", "unread"),
    [
        ("pts", "2\n1 2 3 -700 255 0 9\n4 5 6 -1 0 1 2\n", [[255, 0, 9], [0, 1, 2]], ("intensity",)),
        ("pts", "1 2 3 255 0 9\n4 5 6 0 1 2\n", [[255, 0, 9], [0, 1, 2]], ()),
        ("pts", "1 2 3 9\n4 5 6 8\n", None, ("intensity",)),
        ("xyzrgb", "1 2 3 1 0 0.5\n4 5 6 0 0.25 0\n", [[1, 0, 0.5], [0, 0.25, 0]], ()),
        ("xyzi", "1 2 3 7\n4 5 6 8\n", None, ("intensity",)),
        ("xyzn", "1 2 3 0 0 1\n4 5 6 0 1 0\n", None, ("nx", "ny", "nz")),
        ("xyz", "1 2 3 0 0 1\n4 5 6 0 1 0\n", None, ("columns 4 to 6 (no names)",)),
        ("csv", "x,y,z,snr\n1,2,3,4\n4,5,6,7\n", None, ("snr",)),
        ("xyz", "1 2 3 4\n4 5 6 4\n", None, ("column 4 (no name)",)),
    ],
)
def test_columns_that_a_format_implies_and_those_not_read(tmp_path, suffix, rows, color, unread):
    cloud = read(tmp_path / f"a.{suffix}", rows)
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]] and cloud.unread == unread
    assert (None if cloud.color is None else cloud.color.tolist()) == color


@pytest.mark.parametrize("suffix", ["xyz", "xyzn", "xyzrgb", "pts"])
def test_what_open3d_writes_as_text_is_read_back(tmp_path, suffix):
    open3d = load_open3d()
    rng = np.random.default_rng(0)
    points, colors = rng.uniform(-3, 3, (20, 3)), rng.uniform(0, 1, (20, 3))
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.colors = cloud.normals = open3d.utility.Vector3dVector(colors)
    assert open3d.io.write_point_cloud(str(tmp_path / f"a.{suffix}"), cloud)
    found = read_text(tmp_path / f"a.{suffix}")
    np.testing.assert_allclose(found.points, points, atol=1e-9)
    assert (found.color is not None) == (suffix in ("xyzrgb", "pts"))
    if found.color is not None:
        np.testing.assert_allclose(as_bytes([found.color])[0], colors * 255, atol=1)


@pytest.mark.parametrize("color", [None, [7, 8, 9]])
def test_scans_of_a_ptx_stand_where_their_matrices_say(tmp_path, color):
    rng, scans, expected = np.random.default_rng(0), [], []
    for angle in (0.0, 0.5):
        turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        matrix, own = np.eye(4), rng.uniform(-9, 9, (6, 3)).round(6)
        matrix[:3, :3], matrix[3, :3], own[2] = turn, [10 + angle, 20, 30], 0
        head = ["3", "2", *(" ".join(map(str, row)) for row in [[0, 0, 0], *np.eye(3).tolist(), *matrix.tolist()])]
        scans += [*head, *(" ".join(map(str, [*point.tolist(), 0.5, *(color or [])])) for point in own)]
        expected.append(np.delete(own, 2, 0) @ turn + matrix[3, :3])
    empty = ["0", "0", *scans[2:10]]
    (tmp_path / "a.ptx").write_text("\r\n".join([*empty, *scans, *empty]) + "\r\n")
    cloud = read_cloud(tmp_path / "a.ptx", keep=["intensity"])
    np.testing.assert_allclose(cloud.points, np.concatenate(expected), atol=1e-9)
    assert cloud.dropped == {AT_ORIGIN: 2} and cloud.extra["intensity"].tolist() == [0.5] * 10
    assert (None if cloud.color is None else cloud.color[-1].tolist()) == color
    (tmp_path / "a.ptx").write_text("\n".join(scans[:-1]))
    with pytest.raises(DataError, match="says 6 points, it has room for 5"):
        read_cloud(tmp_path / "a.ptx")
    for lines in (
        scans[1:],
        ["nan", *scans[1:]],
        ["inf", *scans[1:]],
        ["1e200", "1e200", *scans[2:]],
        ["2.5", *scans[1:]],
        ["-3", *scans[1:]],
    ):
        (tmp_path / "a.ptx").write_text("\n".join(lines))
        with pytest.raises(DataError, match="row 1 begins no scan"):
            read_cloud(tmp_path / "a.ptx")


def test_a_ptx_written_by_its_description_gives_the_places_in_the_world(tmp_path):
    """The description: a point lies at the scanner's place plus x, y and z along the scanner's axes, which the header lists
    before the matrix that repeats them.
    """
    rng = np.random.default_rng(1)
    place, world = np.array([448_262.5, 5_411_932.25, 103.125]), rng.uniform(-20, 20, (5, 3))
    axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))  # a row each
    own = [" ".join(f"{float(np.dot(point, axis)):.9f}" for axis in axes) for point in world]
    rows = [[f"{value:.12f}" for value in axis] for axis in axes]
    where = [f"{value:.6f}" for value in place]
    head = ["5", "1", " ".join(where), *map(" ".join, rows)]
    matrix = [" ".join([*row, "0.000000"]) for row in rows] + [" ".join([*where, "1.000000"])]
    lines = [*head, *matrix, *(f"{point} 0.250000 10 20 30" for point in own)]
    (tmp_path / "a.ptx").write_text("\n".join(lines) + "\n")
    np.testing.assert_allclose(read_cloud(tmp_path / "a.ptx").points, world + place, atol=1e-6)
    lines[len(head) : len(head) + 4] = [" ".join(row) for row in zip(*(line.split() for line in matrix))]
    (tmp_path / "a.ptx").write_text("\n".join(lines) + "\n")
    with pytest.raises(DataError, match="the matrix in rows 7 to 10 doesn't end with 0 0 0 1 in its last column"):
        read_cloud(tmp_path / "a.ptx")


def test_whole_numbers_before_three_columns_of_fractions_are_asked_about(tmp_path):
    scan = "".join(f"{k} 7 1.5 2.25 0.{k}5 128\n" for k in range(3, 6))
    with pytest.raises(DataError, match="its first 2 columns hold whole numbers, .*which are x, y and z"):
        read(tmp_path / "a.xyz", scan)
    assert read(tmp_path / "a.xyz", "row column x y z i\n" + scan).points[0].tolist() == [1.5, 2.25, 0.35]
    frames = "".join(f"{k // 4} 1.5 2.25 0.{k}5\n" for k in range(12))
    with pytest.raises(DataError, match="its first column holds whole numbers"):
        read(tmp_path / "a.xyz", frames)
    plain = [f"{k} 2.5 {k}.25 0.5\n" for k in (3, 4, 9)]
    for text in ("".join(plain), "".join(plain) * 3 + "3.5 2.5 4.25 0.5\n", "3 4 5 0.1\n" * 20, "3 4 5.5 0.1\n" * 20):
        assert read(tmp_path / "a.xyz", text).points[0, 0] == 3


@pytest.mark.parametrize(
    ("suffix", "text"), [("csv", "x,y,z,r,g,b,snr\n"), ("csv", "x;y;z;snr\nm;m;m;\n"), ("pts", "0\n")]
)
def test_a_moment_that_saw_nothing_has_no_points(tmp_path, suffix, text):
    cloud = read(tmp_path / f"a.{suffix}", text, keep=["snr"] if "snr" in text else [])
    assert cloud.points.shape == (0, 3) and (cloud.color is not None) == ("r,g,b" in text)


def test_a_column_to_keep_that_is_not_there_is_told_with_those_that_are(tmp_path):
    with pytest.raises(DataError, match="no column snr among those to read; found x, y, z, SNR, t"):
        read(tmp_path / "a.csv", "x,y,z,SNR,t\n1,2,3,4,5\n", keep=["snr"])


def test_kept_columns_that_float32_would_round_are_refused(tmp_path):
    clouds = [
        read(tmp_path / "a.csv", f"x,y,z,t\n1,2,3,{first}\n1,2,4,{second}\n", keep=["t"])
        for first, second in (("1700000000.0", "1700000000.1"), ("5", "1700000001"))
    ]
    item = Item("a", tmp_path / "a.csv")
    with pytest.raises(DataError, match="a.csv: column t: float32, .* would round its values by up to 0.1;"):
        assemble(item, clouds[:1], Lengths())
    assert assemble(item, clouds[1:], Lengths()).sequence.extra["field_t"][0] == 5


@quick
@given(st.lists(st.integers(1, 5), min_size=3, max_size=8), st.integers(0, 9), st.sampled_from(["Bild", "fr", "n"]))
def test_a_column_that_counts_frames_by_an_unknown_name_is_told(tmp_path, points, first, name):
    numbers = [first + frame for frame, count in enumerate(points) for _ in range(count)]
    rows = "".join(f"{number},{k},2.5,3\n" for k, number in enumerate(numbers))
    told = {COUNTED.format(name): 1} if max(points) > 1 else {}  # else it may number the points
    assert read(tmp_path / "a.csv", f"{name},x,y,z\n{rows}").dropped == told
    assert read(tmp_path / "a.csv", f"{name},x,y,z\n{rows.replace(',', ';')}".replace(",", ";")).dropped == told


@pytest.mark.parametrize("values", [(0, 0, 0, 0), (0, 2, 2, 4), (1, 2, 1, 2), (0, 1, 2, 3), (0.5, 1, 1, 2)])
def test_columns_of_points_count_no_frames(tmp_path, values):
    rows = "".join(f"{value},{k},2,3\n" for k, value in enumerate(values))
    assert read(tmp_path / "a.csv", f"ring,x,y,z\n{rows}").dropped == {}


def test_comments_and_empty_lines_between_rows(tmp_path):
    assert len(read(tmp_path / "a.xyz", "1 2 3\n# 5 outliers left out\n4 5 6\n# frame 7\n").points) == 2
    assert read(tmp_path / "a.xyz", "1 2 3\n\n4 5 6\n\n\n").dropped == {}
    assert read(tmp_path / "a.xyz", "1 2 3\n\n\n4 5 6\n").dropped == {BLOCKS: 1}


@pytest.mark.parametrize(
    ("number", "cut"),
    [
        ("5.41123e+06", 1),
        ("5,41123E+06", 1),
        ("4.4812e+05", 1),
        ("1.70965E+12", 1),
        ("-5.41e6", 0),
        ("5.411234512e+06", 0),
    ]
    + [("1.000000000000000000e+05", 0), ("1e+06", 0), ("5411234.5", 0), ("2.3418e-38", 0), ("1.2346e+04", 0)],
)
def test_numbers_without_their_last_digits_are_told(tmp_path, number, cut):
    """As C++ streams write six digits, MATLAB five, and spreadsheets long numbers; a program that writes them all is left alone."""
    rows, point = f"1 2 {number}\n4 5 {number}\n", number.replace(",", ".")
    (tmp_path / "a.ply").write_text(PLY.format("").replace("vertex 1", "vertex 2").replace("1 2 3\n", rows))
    (tmp_path / "a.pcd").write_text(
        PCD.format("").replace("1\nDATA", "2\nDATA").replace("TH 1", "TH 2").replace("1 2 3\n", rows)
    )
    (tmp_path / "a.csv").write_text("x;y;z\n" + rows.replace(" ", ";"))
    (tmp_path / "a.txt").write_text("x,y,z\n" + rows.replace(",", ".").replace(" ", ","))
    (tmp_path / "a.xyz").write_text(rows)
    for suffix in ("ply", "pcd", "csv", "txt", "xyz"):
        cloud = read_cloud(tmp_path / f"a.{suffix}")
        np.testing.assert_allclose(cloud.points[:, 2], float(point), rtol=1e-6)
        assert cloud.dropped == ({CUT: 1} if cut else {})


@pytest.mark.parametrize("sign", [",", ";", "\t", "|"])
@pytest.mark.parametrize(("columns", "word"), [("xyz", ""), ("xyzi", ""), ("xyzi", "car")])
def test_rows_of_nothing_are_dropped_and_counted(tmp_path, sign, columns, word):
    """As pandas writes points of NaN, and spreadsheets what was deleted."""
    row = sign.join(["1.5", "2.5", "3.5", word or "4.5"][: len(columns)])
    rows = [sign.join(columns), row, sign * (len(columns) - 1), row, sign * (len(columns) - 1)]
    for end, empty in (("\n", 2), ("\n" + row, 2), ("\n" + rows[-1] + "\n\n", 3)):
        cloud = read(tmp_path / "a.csv", "\n".join(rows) + end)
        assert (cloud.points == [1.5, 2.5, 3.5]).all() and cloud.dropped == {EMPTY: empty}
    if sign != "\t":  # tabs alone are blanks
        assert read(tmp_path / "a.csv", "\n".join([rows[0], rows[-1], rows[-1]])).dropped == {EMPTY: 2}


@pytest.mark.parametrize("first", ["0, 0, 0", "1, 2, 3", "-1, 20, 300", "1000, 2, 3"])
def test_a_first_row_of_whole_numbers_between_commas_and_blanks(tmp_path, first):
    points = [[float(number) for number in first.split(", ")], *POINTS]
    text = "".join(", ".join(map(repr, point)) + "\n" for point in POINTS)
    np.testing.assert_allclose(read(tmp_path / "a.xyz", f"{first}\n{text}").points, points)


def test_one_frame_of_a_table_is_a_cloud(tmp_path):
    assert read(tmp_path / "a.csv", "frame,x,y,z\n7,1,2,3\n7,4,5,6\n").points.tolist() == [[1, 2, 3], [4, 5, 6]]


PLY = "ply\nformat ascii 1.0\n{}element vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n"
PCD = "{}VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n1 2 3\n"


@pytest.mark.parametrize(
    ("comment", "unit"),
    [
        ("Units: mm", "mm"),
        ("coordinates are in feet", "ft"),
        ("unit = Meter", "m"),
        ("made with a unit test", ""),
        ("units: none", ""),
        ("", ""),
    ],
)
def test_units_that_comments_tell(tmp_path, comment, unit):
    for name, text in (
        ("a.ply", PLY.format(f"comment {comment}\n")),
        ("b.ply", PLY.format(f"obj_info {comment}\n")),
        ("a.pcd", PCD.format(f"# {comment}\n")),
        ("a.xyz", f"# {comment}\n1 2 3\n"),
        ("a.csv", f"# {comment}\nx,y,z\n1,2,3\n"),
    ):
        (tmp_path / name).write_text(text)
        cloud = read_cloud(tmp_path / name)
        assert cloud.unit == unit and cloud.points.tolist() == [[1, 2, 3]]


def test_bytes_that_are_no_text(tmp_path):
    (tmp_path / "a.txt").write_bytes(bytes(range(256)) * 4)
    with pytest.raises(DataError, match="a.txt: not text"):
        read_text(tmp_path / "a.txt")


@pytest.mark.parametrize(
    ("names", "places", "unit"),
    [
        ("x y z", [0, 1, 2], ""),
        ("X [m]|Y [m]|Z [m]", [0, 1, 2], "m"),
        ("time|Pos_X(mm)|Pos_Y(mm)|Pos_Z(mm)", [1, 2, 3], "mm"),
        ("vx vy vz posX posY posZ", [3, 4, 5], ""),
        ("field.x field.y field.z", [0, 1, 2], ""),
        ("Easting Northing Elevation", [0, 1, 2], ""),
        ("x y z pos_x pos_y pos_z", [0, 1, 2], ""),
        ("z_ft y_ft x_ft", [2, 1, 0], "ft"),
        ("point_x point_y point_z", [0, 1, 2], ""),
        ("x-coordinate y-coordinate z-coordinate", [0, 1, 2], ""),
        ("Points_m_XYZ:0 Points_m_XYZ:1 Points_m_XYZ:2 intensity", [0, 1, 2], ""),
        ("X1 (mm)|Y1 (mm)|Z1 (mm)|X2 (mm)|Y2 (mm)|Z2 (mm)", [0, 1, 2], "mm"),
        ("x (in)|y (in)|z (in)", [0, 1, 2], "in"),
        ("x [µm]|y [µm]|z [µm]", [0, 1, 2], "um"),
        ("x_um y_um z_um", [0, 1, 2], "um"),
        ("x [dm]|y [dm]|z [dm]", [0, 1, 2], "dm"),
        ('x (")|y (")|z (")', [0, 1, 2], "in"),
        ("x in mm|y in mm|z in mm", [0, 1, 2], "mm"),
        ("X-Koord. [m]|Y-Koord. [m]|Z-Koord. [m]|Höhe [cm]", [0, 1, 2], "m"),
    ],
)
def test_styles_of_headers(names, places, unit):
    assert find_axes(names.split("|") if "|" in names else names.split()) == (places, unit)


@pytest.mark.parametrize(
    ("header", "cell", "color"),
    [
        ("rgb", str(0x0A141E), [10, 20, 30]),
        ("rgb", repr(float(np.array([0x0A141E], "u4").view("f4")[0])), [10, 20, 30]),  # as PCL has them
        ("rgb", repr(float(np.array([0xFE0A141E], "u4").view("f4")[0])), [10, 20, 30]),
        ("rgb", "0.5", None),
        ("r [%],g [%],b [%]", "100,50,0", None),
    ],
)
def test_colors_in_one_column_and_in_percent(tmp_path, header, cell, color):
    (tmp_path / "a.csv").write_text(f"x,y,z,{header}\n1.5,2,3,{cell}\n")
    cloud = read_text(tmp_path / "a.csv")
    assert (cloud.color is None and cloud.unread == tuple(header.split(","))) if color is None else True
    assert color is None or cloud.color.tolist() == [color]


def test_names_that_mean_something_else():
    assert find_axes(["vx", "vy", "vz"]) is None and find_axes(["x", "y", "range"]) is None
    assert find_axes(["x", "-y", "z"]) is None and find_axes(["-x [m]", "\u2212y [m]", "z [m]"]) is None
    assert find_colors(["r", "azimuth", "g"]) == [] and find_colors(["x", "Red", "Green", "Blue"]) == [1, 2, 3]
    assert find_frame_column(["scan", "frame_id", "x"]) == "frame_id" and find_frame_column(["x", "time"]) is None


@pytest.mark.parametrize(
    ("kind", "further"), [("NCOFF", "9 8 7 255 0 0 1"), ("CNOFF", "0 0 1 9 8 7 255"), ("STCNOFF", "0 0 1")]
)
def test_places_come_first_in_every_off(tmp_path, kind, further):
    """MeshLab calls meshes with normals and colors NCOFF, and Geomview CNOFF."""
    rows = [f"{' '.join(map(str, point))} {further}" for point in POINTS]
    (tmp_path / "a.off").write_text("\n".join([kind, f"{len(rows)} 1 0", *rows, "3 0 1 2", ""]))
    assert np.array_equal(read_vertices(tmp_path / "a.off").points, POINTS)
