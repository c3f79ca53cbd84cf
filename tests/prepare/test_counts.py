"""Files of every format, cut at many places and with other counts in their headers: never silently less, never silently more."""

import io
import re
import struct

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.evaluate.video.sources.media import ArraySource
from dpcli.prepare.articulated.ogc_meshes import load_shape
from dpcli.prepare.cloud_formats.cloud import BEYOND
from dpcli.prepare.decode.cloud_files import read_cloud
from dpcli.prepare.decode.color_frames import read_rgba
from dpcli.prepare.decode.depth_files import read_array, read_frame

COUNT = 40
POINTS = np.random.default_rng(0).random((COUNT, 3)).astype(np.float32)


def _lines(rows):
    return "".join(" ".join(f"{v:.4f}" for v in row) + "\n" for row in rows).encode()


def _ply(form, more=b"", body=None):
    head = f"ply\nformat {form} 1.0\nelement vertex {COUNT}\n".encode()
    head += b"".join(b"property float %s\n" % axis for axis in (b"x", b"y", b"z")) + more + b"end_header\n"
    return head + (body or POINTS.astype(">f4" if "big" in form else "<f4").tobytes())


def _pcd(form, body):
    head = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {COUNT}\nHEIGHT 1\n"
    return f"{head}POINTS {COUNT}\nDATA {form}\n".encode() + body


def _las(suffix, form, version):
    import laspy

    made, las = io.BytesIO(), laspy.create(point_format=form, file_version=version)
    las.x, las.y, las.z = POINTS.T.astype(float)
    las.return_number[:] = 1
    las.write(made, do_compress=suffix == "laz")
    return made.getvalue()


def _saved(save, *arrays, **named):
    made = io.BytesIO()
    save(made, *arrays, **named)
    return made.getvalue()


def _mesh(kind):
    import trimesh

    made = trimesh.creation.icosphere(1).export(file_type=kind)
    return made if isinstance(made, bytes) else made.encode()


FACES = b"element face 2\nproperty list uchar int vertex_indices\n"
TWO_FACES = np.array([(3, (0, 1, 2)), (3, (1, 2, 3))], [("n", "u1"), ("v", "<i4", 3)]).tobytes()
CLOUDS = {
    "text.ply": lambda: _ply("ascii", body=_lines(POINTS)),
    "little.ply": lambda: _ply("binary_little_endian"),
    "big.ply": lambda: _ply("binary_big_endian"),
    "faces.ply": lambda: _ply("binary_little_endian", FACES, POINTS.tobytes() + TWO_FACES),
    "text.pcd": lambda: _pcd("ascii", _lines(POINTS)),
    "binary.pcd": lambda: _pcd("binary", POINTS.tobytes()),
    "v12.las": lambda: _las("las", 0, "1.2"),
    "v14.las": lambda: _las("las", 6, "1.4"),
    "v12.laz": lambda: _las("laz", 1, "1.2"),
    "v14.laz": lambda: _las("laz", 6, "1.4"),
    "a.npy": lambda: _saved(np.save, POINTS),
    "a.npz": lambda: _saved(np.savez_compressed, points=POINTS),
    "a.pts": lambda: f"{COUNT}\n".encode() + _lines(POINTS),
}


def shape_of(path):
    return load_shape(path, "y").triangles


def _image(kind, **options):
    from PIL import Image

    made = io.BytesIO()
    rows = np.random.default_rng(0).integers(0, 255, (24, 32, 3)).astype(np.uint8)
    Image.fromarray(rows).save(made, kind, **options)
    return made.getvalue()


def _depth(suffix):
    import cv2

    rows = np.random.default_rng(0).integers(1000, 2000, (24, 32))
    return cv2.imencode(suffix, rows.astype(np.float32 if suffix == ".pfm" else np.uint16))[1].tobytes()


OTHERS = {
    **{f"a.{kind}": (shape_of, lambda kind=kind: _mesh(kind)) for kind in ("off", "stl", "glb", "dae", "ply")},
    "text.stl": (shape_of, lambda: _mesh("stl_ascii")),
    **{f"a.{kind}": (read_rgba, lambda kind=kind: _image(kind)) for kind in ("png", "webp", "bmp")},
    "a.tif": (read_rgba, lambda: _image("tiff", compression="tiff_lzw")),
    "a.jpg": (read_rgba, lambda: _image("jpeg", progressive=True)),
    **{
        f"depth{suffix}": (read_frame, lambda suffix=suffix: _depth(suffix))
        for suffix in (".png", ".tiff", ".pgm", ".pfm")
    },
}


@pytest.mark.parametrize("name", [*CLOUDS, *OTHERS])
def test_a_cut_file_is_refused_or_gives_all_that_the_whole_one_gave(name, tmp_path):
    read, make = OTHERS.get(name) or (lambda path: read_cloud(path).points, CLOUDS.get(name))
    path, data = tmp_path / name, make()
    path.write_bytes(data)
    whole, refused = read(path), 0
    for cut in sorted({*np.linspace(1, len(data) - 1, 20).astype(int).tolist(), len(data) - 8}):
        path.write_bytes(data[:cut])
        try:
            found = read(path)
        except DataError as error:
            assert name in str(error)
            refused += 1
        else:  # the last digit of a text may be lost
            assert found.shape == whole.shape and np.allclose(found, whole, atol=1e-3 if cut > len(data) - 10 else 0), (
                cut
            )
    assert refused > 15


def _counted(data, name, count):
    """The bytes of a cloud with another number of points in its header."""
    new = str(count).encode()
    if name.endswith(".ply"):
        return re.sub(rb"element vertex \d+", b"element vertex " + new, data)
    if name.endswith(".pcd"):
        return re.sub(rb"(WIDTH|POINTS) \d+", lambda found: found[1] + b" " + new, data)
    if name.endswith(".pts"):
        return data.replace(str(COUNT).encode(), new, 1)
    if name.endswith(".npy"):
        return data.replace(f"({COUNT}, 3), }}".encode(), f"({count}, 3), }}".encode())
    data = data[:107] + struct.pack("<I", min(count, 2**32 - 1)) + data[111:]
    return data[:247] + struct.pack("<Q", count) + data[255:] if data[25] == 4 else data


@pytest.mark.parametrize("name", [name for name in CLOUDS if name != "a.npz"])
def test_other_counts_are_told(name, tmp_path):
    path, data = tmp_path / name, CLOUDS[name]()
    path.write_bytes(_counted(data, name, 10))
    try:
        cloud = read_cloud(path)
        assert len(cloud.points) == 10 and cloud.dropped == {BEYOND: COUNT - 10}
    except DataError as error:
        assert name in str(error)
    for count in (45, 10**11):
        path.write_bytes(_counted(data, name, count))
        with pytest.raises(DataError, match=name):
            read_cloud(path)


def test_a_record_without_bytes_is_no_panic(tmp_path):
    path, data = tmp_path / "a.laz", CLOUDS["v14.laz"]()
    item, none = (struct.pack("<HHH", 10, size, 3) for size in (30, 0))  # what LAZ says of its kind of records
    assert item in data
    path.write_bytes(data.replace(item, none))
    with pytest.raises(DataError, match="a.laz: damaged: its points have 30 bytes, but 0 where they are compressed"):
        read_cloud(path)


def test_several_arrays_in_one_file_are_not_one(tmp_path):
    path = tmp_path / "a.npy"
    with path.open("wb") as file:
        for _ in range(3):
            np.save(file, np.ones((2, 4, 5), np.uint16))
    for read in (read_array, ArraySource):
        with pytest.raises(DataError, match="a.npy: 416 bytes follow the array of shape .*save each array"):
            read(path)


def test_a_header_that_contradicts_itself_is_refused(tmp_path):
    path = tmp_path / "a.pcd"
    path.write_bytes(_pcd("binary", POINTS.tobytes()).replace(b"WIDTH 40", b"WIDTH 10"))
    with pytest.raises(DataError, match="says 40 points and WIDTH x HEIGHT of 10"):
        read_cloud(path)


@pytest.mark.parametrize(
    "kind, change",
    [
        ("off", (b"OFF\n42 80", b"OFF\n42 70")),
        ("off", (b"OFF\n42 80", b"OFF\n42 100000000000")),
        ("stl", (struct.pack("<I", 80), struct.pack("<I", 70))),
        ("stl", (struct.pack("<I", 80), struct.pack("<I", 2**31))),
    ],
)
def test_other_counts_of_meshes_are_refused(kind, change, tmp_path):
    path, data = tmp_path / f"a.{kind}", _mesh(kind)
    assert change[0] in data
    path.write_bytes(data.replace(*change, 1))
    with pytest.raises(DataError, match=f"a.{kind}: (damaged|truncated): its header counts"):
        shape_of(path)


def test_an_stl_that_ends_within_its_header_is_refused(tmp_path):
    (tmp_path / "a.stl").write_bytes(_mesh("stl")[:60])
    with pytest.raises(DataError, match="a.stl: truncated: its header alone has 84 bytes, it holds 60"):
        shape_of(tmp_path / "a.stl")


@pytest.mark.parametrize("behind", [b"\r\n", b"made by a program", bytes(100)])
def test_bytes_behind_the_triangles_of_an_stl_are_passed_over_and_told(behind, tmp_path, capfd):
    path, data = tmp_path / "a.stl", _mesh("stl")
    path.write_bytes(data)
    whole = shape_of(path)
    path.write_bytes(data + behind)
    np.testing.assert_array_equal(shape_of(path), whole)
    assert f"a.stl: {len(behind)} bytes behind its 80 triangles were ignored" in capfd.readouterr().err
    path.write_bytes(data + data[-50:])
    with pytest.raises(DataError, match="damaged: its header counts 80 triangles, it holds 81"):
        shape_of(path)
