"""Small files that claim much: each is refused with a sentence, before any memory is taken for the claim."""

import io
import re
import struct
import subprocess
import sys
import zipfile
import zlib

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.evaluate.video.sources.media import _read_image
from dpcli.prepare.array_files.safe_pickle import read_npz_member
from dpcli.prepare.decode.cloud_files import read_cloud
from dpcli.prepare.decode.color_frames import read_rgba
from dpcli.prepare.decode.depth_files import read_array, read_image
from dpcli.prepare.decode.npz_frames import read_frames
from dpcli.prepare.views.masks import read_mask
from dpcli.runtime.clips.animations import animation_times

SIDE = 13_000  # 169 million pixels, just below the size from which Pillow refuses by itself


def _chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _png(bits, color, side=SIDE):
    """A whole picture of one color, a thousand times smaller than its pixels."""
    row = (side * bits * {0: 1, 2: 3, 3: 1}[color] + 7) // 8 + 1
    pack, rows = zlib.compressobj(1), bytes(row * 100)
    body = b"".join(pack.compress(rows) for _ in range(side // 100)) + pack.flush()
    head = _chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, bits, color, 0, 0, 0))
    palette = _chunk(b"PLTE", b"\0\0\0") if color == 3 else b""
    return b"\x89PNG\r\n\x1a\n" + head + palette + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")


def _jpeg():
    from PIL import Image

    made = io.BytesIO()
    Image.new("L", (64, 64)).save(made, "JPEG")
    data = bytearray(made.getvalue())
    at = data.find(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", SIDE, SIDE)
    return bytes(data)


def _gif():
    screen = b"GIF89a" + struct.pack("<HHBBB", SIDE, SIDE, 0x80, 0, 0) + bytes(6)
    return screen + b"\x2c" + struct.pack("<HHHHB", 0, 0, SIDE, SIDE, 0) + b"\x02\x02\x4c\x01\0;"


def _tiff():
    tags = [(256, 4, 1, SIDE), (257, 4, 1, SIDE), (258, 3, 1, 16), (259, 3, 1, 1), (262, 3, 1, 1), (273, 4, 1, 8)]
    tags += [(277, 3, 1, 1), (278, 4, 1, SIDE), (279, 4, 1, 2 * SIDE * SIDE)]
    return (
        b"II*\0\x08\0\0\0"
        + struct.pack("<H", len(tags))
        + b"".join(struct.pack("<HHII", *one) for one in tags)
        + bytes(4)
    )


PICTURES = {
    "gray.png": lambda: _png(16, 0, 9000),
    "bits.png": lambda: _png(1, 0, 32_000),
    "palette.png": lambda: _png(8, 3),
    "a.jpg": _jpeg,
    "a.gif": _gif,
    "a.tif": _tiff,
    "a.pgm": lambda: b"P5\n30000 30000\n65535\n" + bytes(100),
}


def _read_exr_bomb(folder):
    """An OpenEXR picture whose window was made large."""
    OpenEXR = pytest.importorskip("OpenEXR")
    path = folder / "a.exr"
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Z": np.zeros((16, 16), np.float32)}).write(str(path))
    data = path.read_bytes()
    window = re.compile(rb"((?:data|display)Window\0box2i\0.{4}).{16}", re.DOTALL)
    path.write_bytes(window.sub(lambda found: found[1] + struct.pack("<iiii", 0, 0, 29_999, 29_999), data))
    return read_image(path)


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_of_far_more_pixels_than_bytes_is_refused(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(PICTURES[name]())
    for read in (animation_times,) if name == "a.gif" else (read_rgba, read_mask, _read_image, read_image):
        with pytest.raises(DataError, match=rf"{name}: .*(can't hold such a picture|decompression bomb)"):
            read(path)


def test_an_exr_of_far_more_pixels_than_bytes_is_refused(tmp_path):
    with pytest.raises(DataError, match="a.exr: claims 30000 x 30000 pixels"):
        _read_exr_bomb(tmp_path)


def test_large_pictures_that_are_plausible_pass(tmp_path):
    from PIL import Image

    path = tmp_path / "a.png"
    Image.new("L", (2000, 2000)).save(path)
    assert read_rgba(path).shape == (2000, 2000, 4)


def _npz(path, name, megabytes):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        with archive.open(f"{name}.npy", "w") as member:
            head = {"descr": "|u1", "fortran_order": False, "shape": (megabytes, 1 << 10, 1 << 10)}
            np.lib.format.write_array_header_1_0(member, head)
            for _ in range(megabytes):
                member.write(bytes(1 << 20))
    return path


def test_packed_arrays_that_claim_far_more_are_refused(tmp_path):
    path = _npz(tmp_path / "a.npz", "frames", 150)
    with pytest.raises(DataError, match="a.npz: claims .* can't hold"):
        read_frames(path, "frames")
    with zipfile.ZipFile(path) as archive, pytest.raises(DataError, match="a.npz: claims .* can't hold"):
        read_npz_member(archive, path, "frames")


def test_a_table_that_claims_far_more_rows_is_refused(tmp_path):
    parquet, pyarrow = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow")
    path, rows = tmp_path / "a.parquet", pyarrow.array(np.zeros(6_000_000))
    parquet.write_table(pyarrow.table({name: rows for name in "xyz"}), path, compression="zstd")
    with pytest.raises(DataError, match="a.parquet: claims 144000000 bytes .* can't hold"):
        read_cloud(path)


MEASURED = """
import sys
from pathlib import Path
from dpcli.errors import DataError
from dpcli.prepare.decode.color_frames import read_rgba
from dpcli.prepare.decode.depth_files import read_array, read_image
from dpcli.prepare.decode.npz_frames import read_frames
import cv2, PIL.Image

def peak():
    return int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])

before = peak()
for name in sys.argv[1:]:
    for read in (lambda path: read_frames(path, "frames"),) if name.endswith("npz") else (read_rgba, read_image):
        try:
            read(Path(name))
        except DataError:
            continue
        sys.exit(f"{name} was read")
print(peak() - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the peak of memory is Linux's")
def test_none_of_them_takes_memory(tmp_path):
    names = [name for name in PICTURES if name != "a.gif"]
    for name in names:
        (tmp_path / name).write_bytes(PICTURES[name]())
    _npz(tmp_path / "a.npz", "frames", 150)
    command = [sys.executable, "-c", MEASURED, *(str(tmp_path / name) for name in [*names, "a.npz"])]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert ended.returncode == 0, ended.stderr
    assert int(ended.stdout) < 100_000  # kilobytes; decoded, the smallest takes 170 MB


@pytest.mark.parametrize(
    "shape, kind", [((4,), "|V2000000000"), ((2**32, 2**32, 3), "<f4"), ((-4, 3), "<f4"), ((3, 3), "<f4")]
)
@pytest.mark.parametrize(
    "read", [read_cloud, read_array, lambda path: read_npz_member(zipfile.ZipFile(path), path, "xyz")]
)
def test_an_array_in_an_archive_has_the_bytes_that_its_header_claims(read, shape, kind, tmp_path):
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    data = b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header + bytes(48)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("xyz.npy", data)
    with pytest.raises(DataError, match=re.escape(f"claims shape {shape} of ") + "[0-9]+ bytes each and has 48 bytes"):
        read(tmp_path / "a.npz")


@pytest.mark.parametrize("scale", [0.0, float("nan"), 1e300, -1e-300])
def test_a_laser_scan_is_scaled_by_a_number_that_can_be(scale, tmp_path):
    import laspy

    las = laspy.create(point_format=0, file_version="1.2")
    las.x, las.y, las.z = np.random.default_rng(0).random((3, 20))
    las.write(str(tmp_path / "a.las"))
    data = bytearray((tmp_path / "a.las").read_bytes())
    data[139:147] = struct.pack("<d", scale)
    (tmp_path / "a.las").write_bytes(data)
    with pytest.raises(DataError, match="its header scales y by"):
        read_cloud(tmp_path / "a.las")
