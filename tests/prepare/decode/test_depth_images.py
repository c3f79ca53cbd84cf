"""Depth images: whatever Pillow, OpenCV, OpenEXR and NumPy write is read back equal, in every type and compression."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from dpcli.prepare.decode.depth_files import read_frame

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


@pytest.mark.parametrize("kind", ["u1", "<u2", ">u2", "<i2", ">i4", "<u4", "f2", "<f4", ">f8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_of_numpy(tmp_path, kind, order):
    frame = np.random.default_rng(0).uniform(0, 200, (37, 23)).astype(kind)
    np.save(tmp_path / "a.npy", np.asarray(frame, order=order))
    np.testing.assert_array_equal(read_frame(tmp_path / "a.npy"), frame)
