"""Gray PNGs decoded by kornia-rs against OpenCV and Pillow: the same values, and None for whatever isn't whole."""

from __future__ import annotations

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from dpcli.errors import DataError
from dpcli.prepare.decode import png as png_module
from dpcli.prepare.decode.depth_files import read_image
from dpcli.prepare.decode.png import decode_depth_png, decode_gray_png

FILTERS = {
    "none": cv2.IMWRITE_PNG_FILTER_NONE,
    "sub": cv2.IMWRITE_PNG_FILTER_SUB,
    "up": cv2.IMWRITE_PNG_FILTER_UP,
    "average": cv2.IMWRITE_PNG_FILTER_AVG,
    "paeth": cv2.IMWRITE_PNG_FILTER_PAETH,
    "all": cv2.IMWRITE_PNG_ALL_FILTERS,
}


def image_of(shape: tuple[int, int], dtype: type, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


def png(image: np.ndarray, *options: int) -> bytes:
    ok, data = cv2.imencode(".png", image, options)
    assert ok
    return data.tobytes()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def interlaced(image: np.ndarray) -> bytes:
    """An Adam7 PNG of a u16 image (H,W): seven sparse pictures, which no writer at hand makes."""
    passes = [(0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1)]
    parts = [image[y::dy, x::dx] for y, x, dy, dx in passes]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for part in parts if part.size for row in part)
    header = struct.pack(">IIBBBBB", image.shape[1], image.shape[0], 16, 0, 0, 0, 1)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def test_kornia_is_there():
    assert set(png_module._decoders()) == {8, 16}


@settings(max_examples=60, deadline=None)
@given(
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    dtype=st.sampled_from([np.uint8, np.uint16]),
    filters=st.sampled_from(sorted(FILTERS)),
    level=st.integers(0, 9),
    seed=st.integers(0, 99),
)
def test_values_are_opencvs(height, width, dtype, filters, level, seed):
    image = image_of((height, width), dtype, seed)
    data = png(image, cv2.IMWRITE_PNG_FILTER, FILTERS[filters], cv2.IMWRITE_PNG_COMPRESSION, level)
    decoded = decode_gray_png(data)
    assert decoded.dtype == dtype and decoded.flags.c_contiguous
    np.testing.assert_array_equal(decoded, image)
    np.testing.assert_array_equal(decoded, cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))


def test_interlaced_ones_and_ones_with_notes():
    image = image_of((21, 30), np.uint16)
    np.testing.assert_array_equal(decode_gray_png(interlaced(image)), image)
    plain = png(image)
    noted = (
        plain[:33] + chunk(b"tEXt", b"Comment\0depth in mm") + chunk(b"pHYs", struct.pack(">IIB", 1, 1, 0)) + plain[33:]
    )
    np.testing.assert_array_equal(decode_gray_png(noted), image)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "LA", "P", "1"])
def test_other_kinds_of_pictures_are_left_to_opencv(mode):
    stream = io.BytesIO()
    Image.fromarray(image_of((8, 9), np.uint8)).convert(mode).save(stream, "png")
    assert decode_gray_png(stream.getvalue()) is None


@pytest.mark.parametrize("data", [b"", b"\x89PNG", b"P5 2 2 255\n0000", png(image_of((5, 6, 3), np.uint16))])
def test_what_is_no_gray_png(data):
    assert decode_gray_png(data) is None


def test_no_damage_goes_unseen():
    image = image_of((40, 50), np.uint16)
    whole = png(image)
    rng = np.random.default_rng(1)
    for place in (*range(60), *rng.integers(60, len(whole), 400), *range(len(whole) - 20, len(whole))):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        assert decode_gray_png(bytes(damaged)) is None, place
        with pytest.raises(DataError, match="x: "):
            decode_depth_png(bytes(damaged), "x", (50, 40))
    for cut in (1, 4, 11, 12, 13, 100, len(whole) - 1):
        assert decode_gray_png(whole[:-cut]) is None


def test_a_header_that_lies_about_the_size_is_no_excuse():
    """The checksum is right, the rows are too few: as a damaged writer would leave it."""
    whole = png(image_of((40, 50), np.uint16))
    header = bytearray(whole[16:29])
    for height in (60, 2**31 - 1):
        header[:8] = struct.pack(">II", 50, height)
        lying = whole[:8] + chunk(b"IHDR", bytes(header)) + whole[33:]
        assert decode_gray_png(lying) is None


def test_an_empty_picture_of_the_best_compression_is_still_read():
    image = np.zeros((2000, 2000), np.uint16)
    np.testing.assert_array_equal(decode_gray_png(png(image, cv2.IMWRITE_PNG_COMPRESSION, 9)), image)


def test_a_panic_is_no_reason_to_stop_but_ctrl_c_is(monkeypatch):
    class Panic(BaseException):
        pass

    def decode(error: type[BaseException]):
        def raising(*_):
            raise error

        return raising

    data = png(image_of((4, 4), np.uint16))
    monkeypatch.setattr(png_module, "_decoders", lambda: {16: decode(Panic)})
    assert decode_gray_png(data) is None
    monkeypatch.setattr(png_module, "_decoders", lambda: {16: decode(KeyboardInterrupt)})
    with pytest.raises(KeyboardInterrupt):
        decode_gray_png(data)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_readers_give_the_same_without_kornia(tmp_path, monkeypatch, dtype):
    image = image_of((24, 32), dtype)
    path = tmp_path / "ein bild é.png"
    path.write_bytes(png(image))

    def both() -> tuple[np.ndarray, np.ndarray]:
        return read_image(path), decode_depth_png(path.read_bytes(), "x", (32, 24), bits=(8, 16))

    with_kornia = both()
    monkeypatch.setattr(png_module, "_decoders", dict)
    for one, other in zip(with_kornia, both(), strict=True):
        assert one.dtype == other.dtype == dtype
        np.testing.assert_array_equal(one, image)
        np.testing.assert_array_equal(other, image)


def test_an_animated_one_is_refused_and_one_of_one_frame_read(tmp_path):
    frames = [Image.fromarray(image_of((6, 8), np.uint8) + add) for add in range(3)]
    frames[0].save(tmp_path / "0.png", save_all=True, append_images=frames[1:])
    with pytest.raises(DataError, match=r"0.png: an animated PNG of 3 frames; expected one"):
        read_image(tmp_path / "0.png")
    data = png(np.asarray(frames[0]))
    (tmp_path / "1.png").write_bytes(data[:33] + chunk(b"acTL", struct.pack(">II", 1, 0)) + data[33:])
    np.testing.assert_array_equal(read_image(tmp_path / "1.png"), np.asarray(frames[0]))
