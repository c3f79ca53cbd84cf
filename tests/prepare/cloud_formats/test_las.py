"""LAS and LAZ: every point format that laspy writes is read back; 8-bit colors, and the unit that a file declares."""

from __future__ import annotations

import laspy
import lazrs
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from laspy.vlrs.known import GeoAsciiParamsVlr, GeoKeyDirectoryVlr, GeoKeyEntryStruct, WktCoordinateSystemVlr

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.colors import as_bytes
from dpcli.prepare.cloud_formats.las import WITHHELD, read_las
from dpcli.prepare.scans.clouds import CloudFolders

quick = settings(
    max_examples=40, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def make(form: int, points: np.ndarray, scale: float = 0.001) -> laspy.LasData:
    las = laspy.create(point_format=form, file_version="1.4" if form > 5 else "1.3" if form > 3 else "1.2")
    las.header.scales, las.header.offsets = [scale] * 3, np.floor(points.min(0))
    las.x, las.y, las.z = points.T
    return las


@quick
@given(data=st.data())
def test_what_laspy_writes_is_read_back(tmp_path, data):
    form, suffix = data.draw(st.integers(0, 10)), data.draw(st.sampled_from([".las", ".laz"]))
    if suffix == ".laz" and form in (4, 5, 9, 10):
        suffix = ".las"  # wave packets are not compressed
    scale = data.draw(st.sampled_from([1e-4, 0.001, 0.01]))
    rng = np.random.default_rng(data.draw(st.integers(0, 9)))
    points = rng.uniform(-50, 50, (data.draw(st.integers(1, 40)), 3)) + data.draw(st.sampled_from([0, 500_000]))
    las = make(form, points, scale)
    las.intensity = rng.integers(0, 65536, len(points)).astype(np.uint16)
    colored = "red" in las.point_format.dimension_names
    color = rng.integers(1, 65536, (len(points), 3)).astype(np.uint16)
    if colored:
        las.red, las.green, las.blue = color.T
    path = tmp_path / f"a{suffix}"
    las.write(str(path))
    cloud = read_las(path, keep=["intensity"])
    np.testing.assert_allclose(cloud.points, points, atol=scale)
    np.testing.assert_array_equal(cloud.extra["intensity"], las.intensity)
    assert (cloud.color is not None) == colored
    if colored:
        np.testing.assert_array_equal(cloud.color, color)


def test_a_file_too_large_for_the_memory_is_not_called_truncated(tmp_path, monkeypatch):
    def end_of_memory(_reader):
        raise MemoryError

    make(0, np.ones((2, 3))).write(str(tmp_path / "a.las"))
    monkeypatch.setattr(laspy.LasReader, "read", end_of_memory)
    with pytest.raises(DataError, match="a.las: too large for the memory there is, or damaged"):
        read_las(tmp_path / "a.las")


def test_a_column_to_keep_that_is_not_there_is_told_with_those_that_are(tmp_path):
    make(0, np.ones((2, 3))).write(str(tmp_path / "a.las"))
    with pytest.raises(DataError, match="no column snr among those to read; found X, Y, Z, intensity, return_number"):
        read_las(tmp_path / "a.las", keep=["snr"])


@pytest.mark.parametrize("factor", [1, 257])
def test_bytes_and_words_of_color(tmp_path, factor):
    """A dark frame (all below 256) beside a bright one of 16 bits is dark, not bright."""
    points = np.random.default_rng(0).uniform(0, 1, (30, 3))
    color = np.random.default_rng(1).integers(0, 200, (30, 3))
    las = make(2, points)
    las.red, las.green, las.blue = (color * factor).astype(np.uint16).T
    las.write(str(tmp_path / "a.las"))
    (found,) = as_bytes([read_las(tmp_path / "a.las").color])
    np.testing.assert_array_equal(found, color)
    dark = np.full((2, 3), 40, np.uint16)
    assert as_bytes([read_las(tmp_path / "a.las").color, dark])[1][0, 0] == (40 if factor == 1 else 0)


def test_colors_that_nobody_filled_in_are_none(tmp_path):
    make(3, np.ones((4, 3))).write(str(tmp_path / "a.las"))
    assert read_las(tmp_path / "a.las").color is None


@pytest.mark.parametrize(("code", "name", "meters"), [(9002, "ft", 0.3048), (9003, "us-ft", 1200 / 3937)])
def test_feet_that_a_file_declares_become_meters(tmp_path, code, name, meters):
    points = np.random.default_rng(0).uniform(0, 20, (30, 3))
    las = make(0, points, 1e-4)
    keys = GeoKeyDirectoryVlr()
    keys.geo_keys = [GeoKeyEntryStruct(3076, 0, 1, code)]
    keys.geo_keys_header.number_of_keys = 1
    las.header.vlrs.append(keys)
    (tmp_path / "in").mkdir()
    las.write(str(tmp_path / "in" / "0.las"))
    assert read_las(tmp_path / "in" / "0.las").unit == name
    reader = CloudFolders(tmp_path / "in")
    sample = reader.read(reader.items()[0], np.random.default_rng(0))
    np.testing.assert_allclose(sample.sequence.points, points * meters, atol=1e-4)
    assert sample.notes == {f"sequences converted from {name} to m, as their files declare": 1}
    kept = CloudFolders(tmp_path / "in", scale=1.0)
    np.testing.assert_allclose(kept.read(kept.items()[0], np.random.default_rng(0)).sequence.points, points, atol=1e-4)


FEET_AND_METERS = (
    'COMPD_CS["a", PROJCS["b", GEOGCS["c", UNIT["degree", 0.0174532925]], UNIT["US survey foot", 0.3048006096012192]],'
    ' VERT_CS["d", VERT_DATUM["e", 2005], UNIT["metre", 1.0]]]'
)


def make_with(path, points, wkt="", keys=()):
    las = make(6, points, 1e-4)
    if wkt:
        las.header.vlrs.append(WktCoordinateSystemVlr(wkt))
    if keys:
        record = GeoKeyDirectoryVlr()
        record.geo_keys = [GeoKeyEntryStruct(key, 0, 1, value) for key, value in keys]
        record.geo_keys_header.number_of_keys = len(keys)
        las.header.vlrs.append(record)
    las.write(str(path))


@pytest.mark.parametrize("told", [{"wkt": FEET_AND_METERS}, {"keys": [(1024, 1), (3076, 9003), (4099, 9001)]}])
def test_heights_of_another_unit_than_the_map(tmp_path, told):
    points = np.random.default_rng(0).uniform(0, 20, (30, 3))
    (tmp_path / "in").mkdir()
    make_with(tmp_path / "in" / "0.las", points, **told)
    reader = CloudFolders(tmp_path / "in")
    found = reader.read(reader.items()[0], np.random.default_rng(0)).sequence.points
    np.testing.assert_allclose(found, points * [1200 / 3937, 1200 / 3937, 1], atol=1e-4)


FEET = 1200 / 3937


@pytest.mark.parametrize(
    ("name", "unit", "sizes"),
    [
        ("NAD83 / New York Long Island (ftUS)", None, [FEET, FEET, FEET]),
        ("NAD83 / Arizona East (ft)|NAD83|", None, [0.3048, 0.3048, 0.3048]),
        ("NAD83 / New York Long Island (ftUS) + NAVD88 height", None, [FEET, FEET, 1]),
        ("NAD83 / UTM zone 18N + NAVD88 height (ftUS)", None, [1, 1, FEET]),
        ("NAD83 / UTM zone 18N|NAD83|NAVD88 height (ftUS)|", None, [1, 1, 1]),
        ("NAD83 / New York Long Island (ftUS)", 9001, [1, 1, 1]),
    ],
)
def test_units_that_only_the_name_of_a_system_tells(tmp_path, name, unit, sizes):
    """As laspy's `add_crs` writes it: the number of a system, its name, and no unit, which goes before where it is there."""
    points = np.random.default_rng(0).uniform(0, 20, (30, 3))
    las = make(1, points, 1e-4)
    directory, texts = GeoKeyDirectoryVlr(), GeoAsciiParamsVlr()
    keys = [(1024, 0, 1), (3072, 0, 2263), (3073, 34737, len(name)), *([(3076, 0, unit)] if unit else [])]
    directory.geo_keys = [GeoKeyEntryStruct(key, place, 1, value) for key, place, value in keys]
    directory.geo_keys_header.number_of_keys, texts.strings = len(keys), [name]
    las.header.vlrs.extend([directory, texts])
    (tmp_path / "in").mkdir()
    las.write(str(tmp_path / "in" / "0.las"))
    reader = CloudFolders(tmp_path / "in")
    found = reader.read(reader.items()[0], np.random.default_rng(0)).sequence.points
    np.testing.assert_allclose(found, points * sizes, atol=1e-4)


@pytest.mark.parametrize(
    "told",
    [
        {"wkt": 'GEOGCS["WGS 84",DATUM["d",SPHEROID["e",6378137,298.257]],UNIT["degree",0.0174532925199433]]'},
        {"wkt": 'GEOGCRS["WGS 84",CS[ellipsoidal,3],ANGLEUNIT["degree",0.0174],LENGTHUNIT["metre",1]]'},
        {"keys": [(1024, 2), (2048, 4326)]},
    ],
)
def test_degrees_are_no_lengths(tmp_path, told):
    make_with(tmp_path / "a.las", np.array([[8.5, 47.3, 400], [8.6, 47.2, 410]]), **told)
    with pytest.raises(DataError, match="longitudes and latitudes in degrees; expected lengths: project them"):
        read_las(tmp_path / "a.las")


def test_degrees_that_no_reference_system_tells(tmp_path):
    points = np.array([[8.5, 47.3, 400], [8.6, 47.2, 410]])
    las = make(3, points)
    las.header.scales = [1e-7, 1e-7, 1e-2]
    las.x, las.y, las.z = points.T
    las.write(str(tmp_path / "a.las"))
    with pytest.raises(DataError, match="longitudes and latitudes in degrees"):
        read_las(tmp_path / "a.las")
    make(3, points, 1e-7).write(str(tmp_path / "b.las"))  # a fine scanner
    np.testing.assert_allclose(read_las(tmp_path / "b.las").points, points, atol=1e-7)


def test_withheld_points_are_dropped_and_counted(tmp_path):
    las = make(6, np.arange(30.0).reshape(10, 3))
    las.withheld = np.arange(10) < 3
    las.intensity = np.arange(10)
    (tmp_path / "in").mkdir()
    las.write(str(tmp_path / "in" / "0.las"))
    reader = CloudFolders(tmp_path / "in", keep=("intensity",))
    sample = reader.read(reader.items()[0], np.random.default_rng(0))
    assert sample.notes == {WITHHELD: 3}
    assert sample.sequence.points[:, 0].tolist() == [9, 12, 15, 18, 21, 24, 27]
    assert sample.sequence.extra["field_intensity"].tolist() == [3, 4, 5, 6, 7, 8, 9]


def test_a_damaged_laz_is_named(tmp_path):
    make(0, np.random.default_rng(0).uniform(0, 1, (500, 3))).write(str(tmp_path / "a.laz"))
    whole = (tmp_path / "a.laz").read_bytes()
    (tmp_path / "a.laz").write_bytes(whole[:-200])
    with pytest.raises(DataError, match="a.laz: (not a readable LAZ|truncated)"):
        read_las(tmp_path / "a.laz")


@pytest.mark.parametrize(("place", "value"), [(100, 0xFFFFFFFF), (96, 0xFFFFFF), (94, 0xFFFF)])
def test_a_header_that_counts_what_is_not_there_is_refused_at_once(tmp_path, place, value):
    """laspy reads records as long as the header says, into all memory."""
    path = tmp_path / "a.las"
    make(3, np.ones((9, 3))).write(str(path))
    data = bytearray(path.read_bytes())
    data[place : place + (2 if place == 94 else 4)] = value.to_bytes(2 if place == 94 else 4, "little")
    path.write_bytes(data)
    with pytest.raises(DataError, match="truncated or damaged: its header says"):
        read_las(path)


CLAIMS = ("points", "items", "size of chunks", "chunks", "late table")


@pytest.mark.parametrize(
    ("form", "what"), [*((form, what) for form in (0, 3, 6, 7) for what in CLAIMS), (6, "layer"), (7, "layer")]
)
def test_sizes_inside_a_laz_that_it_cannot_hold_are_refused(tmp_path, form, what):
    """Its parser sets memory aside for each, and ends the process without it."""
    path = tmp_path / "a.laz"
    make(form, np.random.default_rng(0).uniform(0, 1, (90, 3))).write(str(path))
    data = bytearray(path.read_bytes())
    start, length = int.from_bytes(data[96:100], "little"), int.from_bytes(data[105:107], "little")
    record, table = data.index(b"\x50\xc3\0\0") - 12, int.from_bytes(data[start : start + 8], "little")
    if what == "late table":  # of a file that was written in one go
        data[start : start + 8] = b"\xff" * 8
        data += table.to_bytes(8, "little")
    places = {"points": 247 if form > 5 else 107, "items": record + 36, "size of chunks": record + 12}
    places |= {"layer": start + 8 + length + 8}
    place = places.get(what, table + 4)
    data[place : place + 4] = bytes(255 - one for one in data[place : place + 4])
    path.write_bytes(data)
    with pytest.raises(
        DataError, match="claims .* which a (file|chunk) of .* can't hold|but .* where they are compressed"
    ):
        read_las(path)


@pytest.mark.parametrize(("count", "more"), [(90, 0), (0x70000000, 0), (90, 0x70000000)])
def test_chunks_of_a_laz_that_each_say_their_size(tmp_path, count, more):
    path = tmp_path / "a.laz"
    make(6, np.random.default_rng(0).uniform(0, 1, (90, 3))).write(str(path))
    data = bytearray(path.read_bytes())
    start, record = int.from_bytes(data[96:100], "little"), data.index(b"\x50\xc3\0\0") - 12
    table = int.from_bytes(data[start : start + 8], "little")
    data[record + 12 : record + 16] = b"\xff" * 4
    with path.open("wb+") as file:
        file.write(data[:table])
        lazrs.write_chunk_table(
            file, [(count, table - start - 8 + more)], lazrs.LazVlr(bytes(data[record : record + 40]))
        )
    if (count, more) == (90, 0):
        assert len(read_las(path).points) == 90
        return
    with pytest.raises(
        DataError, match=f"claims (a chunk of {count} points|chunks of {more + table - start - 8} bytes)"
    ):
        read_las(path)


def test_counts_of_points_that_have_no_room_are_refused(tmp_path):
    path = tmp_path / "a.las"
    make(0, np.random.default_rng(0).uniform(0, 1, (9, 3))).write(str(path))
    data = bytearray(path.read_bytes())
    data[107:111] = (242_422_355).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises(DataError, match=f"claims 242422355 points, which a file of {len(data)} bytes can't hold"):
        read_las(path)
