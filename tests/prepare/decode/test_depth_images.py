"""Depth images: whatever Pillow, OpenCV, OpenEXR and NumPy write is read back equal, in every type and compression."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from dpcli.errors import DataError
from dpcli.prepare.decode.depth_files import TURNED, WHITE_AT_ZERO, read_array, read_depth_video, read_frame

quick = settings(
    max_examples=120, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
LARGEST = {"u1": 255, "<u2": 65535, ">u2": 65535, "<i4": 2**31 - 1, "<f4": 1e4}


def frame_of(kind: str, shape: tuple[int, int], seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(0, LARGEST[kind], shape).astype(kind)


def by_pillow(path, frame, data):
    options = {}
    if path.suffix == ".tif":
        options["compression"] = data.draw(st.sampled_from([None, "tiff_lzw", "tiff_adobe_deflate", "packbits"]))
    if path.suffix == ".png":
        options["compress_level"] = data.draw(st.integers(0, 9))
    if path.suffix == ".jp2":
        options["num_resolutions"] = 1
    Image.fromarray(frame).save(path, **options)


def by_opencv(path, frame, data):
    options = []
    if path.suffix == ".pgm":
        options = [cv2.IMWRITE_PXM_BINARY, data.draw(st.sampled_from([0, 1]))]
    if path.suffix == ".tif":
        options = [cv2.IMWRITE_TIFF_COMPRESSION, data.draw(st.sampled_from([1, 5, 8, 32946]))]
    if path.suffix == ".jp2":
        options = [cv2.IMWRITE_JPEG2000_COMPRESSION_X1000, 1000]
    assert cv2.imwrite(str(path), frame.astype(frame.dtype.newbyteorder("=")), options)


WRITERS = {
    **{("pil", ".tif", kind): by_pillow for kind in ("u1", "<u2", ">u2", "<i4", "<f4")},
    **{("pil", ".png", kind): by_pillow for kind in ("u1", "<u2", ">u2")},
    **{("pil", ".pgm", kind): by_pillow for kind in ("u1", "<u2")},
    **{("pil", ".jp2", kind): by_pillow for kind in ("u1", "<u2")},
    **{("pil", ".pfm", kind): by_pillow for kind in ("<f4",)},
    **{("cv2", ".tif", kind): by_opencv for kind in ("u1", "<u2", "<f4")},
    **{("cv2", ".png", kind): by_opencv for kind in ("u1", "<u2")},
    **{("cv2", ".pgm", kind): by_opencv for kind in ("u1", "<u2")},
    **{("cv2", ".jp2", kind): by_opencv for kind in ("u1", "<u2")},
    **{("cv2", ".pfm", kind): by_opencv for kind in ("<f4",)},
}


@quick
@given(data=st.data())
def test_images_of_independent_writers_arrive_as_they_were(tmp_path, data):
    key = data.draw(st.sampled_from(sorted(WRITERS)))
    least = 33 if key[1] == ".jp2" else 1  # OpenCV's writer of JPEG 2000 takes no less
    shape = data.draw(st.integers(least, 50)), data.draw(st.integers(least, 50))
    frame = frame_of(key[2], shape, data.draw(st.integers(0, 9)))
    path = tmp_path / f"a{key[1]}"
    WRITERS[key](path, frame, data)
    np.testing.assert_array_equal(read_frame(path), frame)


@pytest.mark.parametrize("kind", ["f2", "f4", "u4"])
@pytest.mark.parametrize("packed", ["NO", "RLE", "ZIPS", "ZIP", "PIZ"])
@pytest.mark.parametrize("tiled", [False, True])
def test_openexr_of_every_lossless_packing(tmp_path, kind, packed, tiled):
    openexr = pytest.importorskip("OpenEXR")
    frame = np.random.default_rng(0).uniform(0, 900, (37, 23)).astype(kind)
    header = {"compression": getattr(openexr, f"{packed}_COMPRESSION"), "type": openexr.scanlineimage}
    if tiled:
        header |= {"type": openexr.tiledimage, "tiles": openexr.TileDescription()}
    openexr.File(header, {"Z": frame, "A": np.ones((37, 23), np.float32)}).write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_frame(tmp_path / "a.exr"), frame)


def test_openexr_of_several_parts_and_with_an_alpha_that_comes_first(tmp_path):
    openexr = pytest.importorskip("OpenEXR")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    frame = np.random.default_rng(0).uniform(1, 2, (6, 8)).astype(np.float32)
    ones = np.ones((6, 8), np.float32)
    openexr.File(dict(header), {name: ones if name == "A" else frame for name in "ABGR"}).write(
        str(tmp_path / "gray.exr")
    )
    np.testing.assert_array_equal(read_frame(tmp_path / "gray.exr"), frame)
    for channel, name in (("Z", "far"), ("Y", "depth")):
        parts = [openexr.Part(dict(header), {"Y": ones}, "mask"), openexr.Part(dict(header), {channel: frame}, name)]
        openexr.File(parts).write(str(tmp_path / "parts.exr"))
        np.testing.assert_array_equal(read_frame(tmp_path / "parts.exr"), frame)
    parts = [openexr.Part(dict(header), {"Y": one}, name) for one, name in ((ones, "a"), (frame, "b"))]
    openexr.File(parts).write(str(tmp_path / "which.exr"))
    with pytest.raises(DataError, match=r"which.exr: holds channels a\.Y, b\.Y; expected one called Z or depth"):
        read_frame(tmp_path / "which.exr")


@pytest.mark.parametrize(
    ("depth", "beside"),
    [
        (["ViewLayer.Depth.Z"], ["ViewLayer.Mist.Z"]),  # of Blender
        (["ViewLayer.Depth.Z"], ["ViewLayer.Denoising Depth.Z"]),
        ([f"MovieRenderQueue_WorldDepth.{one}" for one in "RGB"], ["MovieRenderQueue_WorldDepth.A"]),  # of Unreal
        ([], ["ViewLayer.Mist.Z"]),
    ],
)
def test_openexr_of_renderers_that_write_many_layers(tmp_path, depth, beside):
    openexr = pytest.importorskip("OpenEXR")
    frame, *others = np.random.default_rng(0).uniform(1, 2, (4, 6, 8)).astype(np.float32)
    channels = {f"Combined.{one}": other for one, other in zip("RGB", others)} | dict.fromkeys(beside, others[0])
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    openexr.File(header, channels | dict.fromkeys(depth, frame)).write(str(tmp_path / "a.exr"))
    if depth:
        np.testing.assert_array_equal(read_frame(tmp_path / "a.exr"), frame)
    else:
        with pytest.raises(DataError, match=r"a.exr: holds channels .*Mist.Z; expected one called Z or depth"):
            read_frame(tmp_path / "a.exr")


@pytest.mark.parametrize("names", [["depth"], ["mask", "depth"]])
def test_openexr_that_lost_its_end_is_not_taken_for_what_is_left(tmp_path, names):
    openexr = pytest.importorskip("OpenEXR")
    frame = np.random.default_rng(0).uniform(1, 2, (60, 80)).astype(np.float32)
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    parts = [openexr.Part(dict(header), {"Z" if name == "depth" else "Y": frame}, name) for name in names]
    openexr.File(parts).write(str(tmp_path / "a.exr"))
    (tmp_path / "a.exr").write_bytes((tmp_path / "a.exr").read_bytes()[:-3000])
    with pytest.raises(DataError, match="a.exr: not a readable OpenEXR image"):
        read_frame(tmp_path / "a.exr")


@pytest.mark.parametrize("kind", ["u1", "<u2", ">u2", "<i2", ">i4", "<u4", "f2", "<f4", ">f8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_of_numpy(tmp_path, kind, order):
    frame = np.random.default_rng(0).uniform(0, 200, (37, 23)).astype(kind)
    np.save(tmp_path / "a.npy", np.asarray(frame, order=order))
    np.testing.assert_array_equal(read_frame(tmp_path / "a.npy"), frame)


@pytest.mark.parametrize(("most", "kind"), [(100, "u1"), (255, "u1"), (4095, "u2")])
def test_texts_of_gray_levels_are_what_they_say(tmp_path, most, kind):
    path = tmp_path / "a.pgm"
    path.write_text(f"P2 # of depth\n3 2\n{most}\n0 1 2 # a row\n50 99 {most}\n")
    found = read_frame(path)
    assert found.tolist() == [[0, 1, 2], [50, 99, most]] and found.dtype == kind
    path.write_text(f"P2\n3 2\n{most}\n0 1 2\n50 99\n")
    with pytest.raises(DataError, match="5 levels of 3x2 pixels, .* truncated or damaged"):
        read_frame(path)


@pytest.mark.parametrize("orientation", [1, 6])
def test_a_tiff_that_is_shown_turned_is_told(tmp_path, orientation):
    frame = np.arange(20, dtype=np.uint16).reshape(4, 5)
    Image.fromarray(frame).save(tmp_path / "0.tif", tiffinfo={274: orientation})
    video = read_depth_video(tmp_path)
    np.testing.assert_array_equal(video.frames[0], frame if orientation == 1 else np.rot90(frame, -1))
    assert video.notes == ({TURNED: 1} if orientation == 6 else {})


def tiff_of(data: bytes, shape: tuple[int, int], tags: dict[int, int]) -> bytes:
    """Returns a TIFF of one strip that holds these bytes, of a picture (H,W), with tags beside those of every one."""
    plain = {256: shape[1], 257: shape[0], 259: 1, 262: 1, 273: 8, 277: 1, 278: shape[0], 279: len(data)}
    told = sorted((plain | tags).items())
    entries = b"".join(struct.pack("<HHII", tag, 4 if tag in (273, 279) else 3, 1, value) for tag, value in told)
    even = data + bytes(len(data) % 2)
    return b"II*\0" + struct.pack("<I", 8 + len(even)) + even + struct.pack("<H", len(told)) + entries + bytes(4)


@pytest.mark.parametrize("kind", ["u1", "u2", "f4"])
def test_white_at_zero_is_told_and_changes_no_number(tmp_path, kind):
    frame = np.arange(10, 30).reshape(4, 5).astype(kind)
    tags = {258: 8 * frame.itemsize, 262: 0, 339: 3 if kind == "f4" else 1}
    (tmp_path / "0.tif").write_bytes(tiff_of(frame.tobytes(), frame.shape, tags))
    np.testing.assert_array_equal(read_frame(tmp_path / "0.tif"), frame)
    assert read_depth_video(tmp_path).notes == {WHITE_AT_ZERO: 1}
    Image.fromarray(frame).save(tmp_path / "0.tif")
    assert read_depth_video(tmp_path).notes == {}


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_tiffs_of_ten_to_fourteen_bits_keep_their_numbers(tmp_path, bits):
    frame = np.random.default_rng(0).integers(0, 1 << bits, (4, 8)).astype(np.uint16)
    packed = np.packbits((frame[..., None] >> np.arange(bits)[::-1] & 1).astype(np.uint8))
    (tmp_path / "0.tif").write_bytes(tiff_of(packed.tobytes(), frame.shape, {258: bits}))
    np.testing.assert_array_equal(read_frame(tmp_path / "0.tif"), frame)


@pytest.mark.parametrize(
    ("tags", "words"),
    [
        ({258: 8, 259: 34712}, "whose compression"),  # JPEG 2000, which OpenCV gives as zeros
        ({258: 16, 259: 32773, 317: 2}, "whose compression"),  # differences, which it gives as they are
        ({258: 16, 277: 2}, "holds 2 channels of gray"),
        ({258: 8, 277: 3, 284: 2}, "holds 3 channels of gray"),
        ({258: 4}, "4 bits a pixel"),
    ],
)
def test_tiffs_that_opencv_would_change_are_refused(tmp_path, tags, words):
    (tmp_path / "0.tif").write_bytes(tiff_of(bytes(80), (4, 5), tags))
    with pytest.raises(DataError, match=f"0.tif: .*{words}"):
        read_frame(tmp_path / "0.tif")


def test_portable_maps_of_several_pictures_or_of_one_bit_are_refused(tmp_path):
    frame = np.arange(3000, 3020, dtype=np.uint16).reshape(4, 5)
    one = b"P5 # by a program\n5 4\n65535\n" + frame.astype(">u2").tobytes()
    path = tmp_path / "0.pgm"
    path.write_bytes(one)
    np.testing.assert_array_equal(read_frame(path), frame)
    path.write_bytes(one + one)
    with pytest.raises(DataError, match="0.pgm: holds several pictures, one behind another"):
        read_frame(path)
    path.write_bytes(b"P4\n5 4\n" + bytes(range(4)))
    with pytest.raises(DataError, match="0.pgm: 1 bit a pixel"):
        read_frame(path)


def test_pictures_that_opencv_would_change_are_refused(tmp_path):
    values = np.ones((2, 3), np.float32)
    for scale in ("-2.0", "-10", "0.5"):
        (tmp_path / "a.pfm").write_bytes(f"Pf\n3 2\n{scale}\n".encode() + values.tobytes())
        with pytest.raises(DataError, match=f"its header gives the scale {scale}"):
            read_frame(tmp_path / "a.pfm")
    for scale in (b"-1", b"-1.0", b"-1.000000"):
        (tmp_path / "a.pfm").write_bytes(b"Pf\n3 2\n" + scale + b"\n" + values.tobytes())
        np.testing.assert_array_equal(read_frame(tmp_path / "a.pfm"), values)
    Image.fromarray(values > 0).save(tmp_path / "a.png")
    with pytest.raises(DataError, match="1 bits a pixel, too few for depth"):
        read_frame(tmp_path / "a.png")
    gray = np.arange(6, dtype=np.uint8).reshape(2, 3)
    Image.merge("LA", [Image.fromarray(gray), Image.new("L", (3, 2), 255)]).save(tmp_path / "b.png")
    np.testing.assert_array_equal(read_frame(tmp_path / "b.png"), gray)
    Image.merge("LA", [Image.fromarray(gray), Image.new("L", (3, 2), 9)]).save(tmp_path / "b.png")
    with pytest.raises(DataError, match="a color image"):
        read_frame(tmp_path / "b.png")


@pytest.mark.parametrize("shape", [(6, 8), (1, 6, 8), (6, 8, 1), (1, 6, 8, 1), (1, 1, 6, 8)])
def test_one_frame_of_any_shape_is_one(tmp_path, shape):
    frames = np.arange(3 * 48, dtype=np.uint16).reshape(3, 6, 8) + 500
    for k, frame in enumerate(frames):
        np.save(tmp_path / f"{k}.npy", frame.reshape(shape))
        np.testing.assert_array_equal(read_array(tmp_path / f"{k}.npy"), frame[None])
    if shape in ((6, 8), (6, 8, 1)):  # as the frames of a folder; others may be videos of one frame
        np.testing.assert_array_equal(read_depth_video(tmp_path).frames, frames)


@pytest.mark.parametrize("shape", [(48, 80, 6), (480, 640, 300), (424, 512, 100)])
def test_an_array_whose_frames_come_last_is_refused(tmp_path, shape):
    np.lib.format.open_memmap(tmp_path / "a.npy", "w+", np.uint16, shape)  # a sparse file, which is not read
    with pytest.raises(DataError, match=r"save numpy.moveaxis\(array, -1, 0\)"):
        read_array(tmp_path / "a.npy")


@pytest.mark.parametrize("shape", [(6, 48, 80), (2, 640, 480), (40, 60, 16), (3, 37, 5)])
def test_an_array_whose_frames_come_first_is_read(tmp_path, shape):
    np.save(tmp_path / "a.npy", np.broadcast_to(np.uint16(1), shape))
    assert read_array(tmp_path / "a.npy").shape == shape


@pytest.mark.parametrize("name", ["0.png", "0.tif", "0.npy", "0.mp4"])
def test_what_stands_in_for_a_file_is_told(tmp_path, name):
    (tmp_path / name).write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1234\n")
    with pytest.raises(DataError, match=f"{name}: a pointer of Git LFS; `git lfs pull` brings the file itself"):
        read_depth_video(tmp_path if name.endswith(("png", "tif")) else tmp_path / name)


@pytest.mark.parametrize("corner", [(10, 5), (-3, -2), (90, -4), (0, 0)])
def test_the_frame_of_an_openexr_is_its_display_window(tmp_path, corner):
    openexr = pytest.importorskip("OpenEXR")
    pixels = np.random.default_rng(0).uniform(1, 2, (6, 20)).astype(np.float32)
    (x, y), (height, width) = corner, (9, 100)
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    windows = {"dataWindow": (x, y, x + 19, y + 5), "displayWindow": (0, 0, width - 1, height - 1)}
    header |= {name: tuple(np.array(own, np.int32).reshape(2, 2)) for name, own in windows.items()}
    openexr.File(header, {"Z": pixels}).write(str(tmp_path / "a.exr"))
    wide = np.zeros((height + 20, width + 40), np.float32)  # the picture and 10 rows, 20 columns around it
    wide[y + 10 : y + 16, x + 20 : x + 40] = pixels
    np.testing.assert_array_equal(read_frame(tmp_path / "a.exr"), wide[10:-10, 20:-20])


def test_the_z_of_a_normal_is_no_depth_and_disparities_are_refused(tmp_path):
    openexr = pytest.importorskip("OpenEXR")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    path, frame = tmp_path / "a.exr", np.random.default_rng(0).uniform(1, 2, (6, 8)).astype(np.float32)
    normal = {f"Normal.{axis}": np.full_like(frame, value) for axis, value in zip("XYZ", (0.6, 0.0, 0.8))}
    openexr.File(dict(header), normal).write(str(path))
    with pytest.raises(DataError, match=r"holds channels Normal\.X, Normal\.Y, Normal\.Z; expected one called Z"):
        read_frame(path)
    openexr.File(dict(header), {**normal, "Layer.Depth.Z": frame}).write(str(path))
    np.testing.assert_array_equal(read_frame(path), frame)
    openexr.File(dict(header), {"disparity": frame}).write(str(path))
    with pytest.raises(DataError, match="by its name it holds disparities"):
        read_frame(path)
    deep = np.empty(frame.shape, object)
    for place in np.ndindex(frame.shape):
        deep[place] = np.full(2, 1.5, np.float32)
    header |= {"compression": openexr.ZIPS_COMPRESSION, "type": openexr.deepscanline}
    openexr.File(header, {"Z": deep, "A": deep}).write(str(path))
    with pytest.raises(DataError, match="holds deep pixels"):
        read_frame(path)
