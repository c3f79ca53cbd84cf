"""HDR and wide-gamut clips, written by FFmpeg's zscale from known colors, and the published points of their curves."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dpcli.evaluate.video.sources.open_source import open_source
from dpcli.prepare.decode.color_frames import open_frames
from dpcli.runtime.clips import wide_color

COLORS = np.array([(200, 30, 30), (30, 160, 60), (40, 60, 200), (120, 120, 120), (20, 20, 20), (230, 200, 170)])
SIDE = 32


def clip(folder: Path, transfer: str, primaries: str, matrix: str) -> Path:
    """One frame of COLORS side by side, each 32x32, whose white is 203 cd/m2, in 10 bits without loss."""
    import imageio_ffmpeg

    picture = np.repeat(np.repeat(COLORS[None], SIDE, 0), SIDE, 1).astype(np.uint8)
    Image.fromarray(picture).save(folder / "0.png")
    own = "709" if transfer == "709" else "iec61966-2-1"  # players show either as stored
    convert = f"zscale=tin={own}:pin=709:min=gbr:npl=203:t={transfer}:p={primaries}:m={matrix}:r=tv"
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", folder / "0.png"]
    command += ["-vf", f"format=gbrpf32le,{convert},format=yuv444p10le", "-c:v", "ffv1"]
    subprocess.run([*map(str, command), str(folder / "c.mkv")], check=True, capture_output=True, timeout=120)
    return folder / "c.mkv"


def colors(path: Path) -> np.ndarray:
    (frame,) = open_frames(path).read([0])
    return frame[SIDE // 2, SIDE // 2 :: SIDE, :3].astype(int)


@pytest.mark.parametrize(
    "transfer, primaries", [("709", "2020"), ("iec61966-2-1", "2020"), ("iec61966-2-1", "smpte432")]
)
def test_a_wide_gamut_becomes_srgb(tmp_path, transfer, primaries):
    path = clip(tmp_path, transfer, primaries, "2020_ncl" if primaries == "2020" else "709")
    assert np.abs(colors(path) - COLORS).max() <= (16 if transfer == "709" else 3)


def test_pq_becomes_srgb(tmp_path, capfd):
    read = colors(clip(tmp_path, "smpte2084", "2020", "2020_ncl"))
    assert "HDR clip (PQ)" in capfd.readouterr().err
    assert np.abs(read[:5] - COLORS[:5]).max() <= 6  # the curve bends only what is brighter
    hue = read[5] / read[5].max()
    assert read[5].max() < COLORS[5].max() and np.abs(hue - COLORS[5] / COLORS[5].max()).max() < 0.03


def test_gray_of_hlg_becomes_srgb(tmp_path, capfd):
    read = colors(clip(tmp_path, "arib-std-b67", "2020", "2020_ncl"))
    assert "HDR clip (HLG)" in capfd.readouterr().err
    assert np.abs(read[3:5] - COLORS[3:5]).max() <= 3
    assert (read[:3].argmax(-1) == [0, 1, 2]).all() and read[:3].max(-1).min() > 140


def test_evaluate_video_sees_the_same(tmp_path):
    path = clip(tmp_path, "smpte2084", "2020", "2020_ncl")
    source = open_source(path)
    (picture,) = source.pictures(0, [0])
    np.testing.assert_array_equal(picture.rgba, next(open_frames(path).read([0])))
    assert np.abs(picture.rgba[0, SIDE // 2, :3].astype(int) - COLORS[0]).max() <= 6


def test_published_points_of_the_curves():
    np.testing.assert_allclose(wide_color.pq_light([0, 0.508078, 0.751827, 1]), [0, 100, 1000, 10_000], rtol=1e-4)
    np.testing.assert_allclose(wide_color.hlg_scene_light([0, 0.5, 1]), [0, 1 / 12, 1], atol=1e-6)
    light = np.geomspace(0.01, 1e4, 200)
    np.testing.assert_allclose(wide_color.pq_light(wide_color.pq_signal(light)), light, rtol=1e-9)


def test_the_tone_curve_rises_from_equal_to_the_white():
    light = np.linspace(0, 1000, 2001)
    bent = wide_color.tone_curve(light)
    assert (np.diff(bent) > 0).all() and (bent <= light + 1e-6).all()
    np.testing.assert_allclose(bent[light < 80], light[light < 80], rtol=1e-9)
    np.testing.assert_allclose(bent[-1], 203, rtol=1e-6)


@pytest.mark.parametrize("transfer", [wide_color.PQ, wide_color.HLG, 1])
def test_gray_stays_gray_and_rises(transfer):
    levels = np.linspace(0, 65_535, 500).astype(np.uint16)
    out = wide_color.to_srgb(np.repeat(levels[:, None], 3, 1), transfer, 9).astype(int)
    assert (np.ptp(out, axis=1) <= 1).all() and (np.diff(out[:, 0]) >= 0).all()
    assert out[0].max() == 0 and out[-1].min() == 255
