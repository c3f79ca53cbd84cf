"""Depth videos of every pixel format: gray of 9 to 16 bits arrives as it was stored, and what isn't known is refused."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from imageio_ffmpeg import get_ffmpeg_exe

from dpcli.errors import DataError
from dpcli.prepare.actions.depth import BLIND, DepthVideos
from dpcli.prepare.decode.depth_files import TURNED, read_depth_video, rising_times
from dpcli.prepare.decode.pinhole_camera import LensIntrinsics
from dpcli.prepare.decode.video_streams import how_shown, video_streams

RNG = np.random.default_rng(0)
LOSSLESS = {
    "libx264": ("-qp", "0"),
    "libx265": ("-x265-params", "lossless=1:log-level=none"),
    "jpeg2000": ("-pred", "1"),
}
FORMATS = [
    ("gray16le", "ffv1", "mkv"),
    ("gray16be", "png", "mkv"),
    ("gray16be", "png", "avi"),
    ("gray16le", "tiff", "mkv"),
    ("gray16le", "jpeg2000", "mkv"),
    ("gray12le", "jpeg2000", "mov"),
    ("gray14le", "ffv1", "mov"),
    ("gray12le", "ffv1", "avi"),
    ("gray12le", "libx265", "mp4"),
    ("gray10le", "libx265", "mkv"),
    ("gray10le", "libx264", "mp4"),
    ("gray10le", "ffv1", "mkv"),
    ("gray9le", "ffv1", "mkv"),
    ("gray16be", "rawvideo", "nut"),
    ("gray10be", "rawvideo", "nut"),
    ("gray16le", "ffvhuff", "avi"),
]


def encode(path: Path, frames: np.ndarray, pixel_format: str, codec: str, *options: str, rate: int = 10) -> Path:
    """Writes frames (T,H,W), or (T,H,W,3) of 16 bits, by ffmpeg."""
    big = pixel_format.endswith("be")
    data = frames.astype(frames.dtype.newbyteorder(">" if big else "<")).tobytes()
    source = ["-f", "rawvideo", "-pix_fmt", pixel_format, "-s", f"{frames.shape[2]}x{frames.shape[1]}", "-r", str(rate)]
    command = [
        get_ffmpeg_exe(),
        "-v",
        "error",
        "-y",
        *source,
        "-i",
        "-",
        *options,
        "-c:v",
        codec,
        *LOSSLESS.get(codec, ()),
    ]
    if codec == "rawvideo":
        command += ["-strict", "-1"]
    subprocess.run([*command, str(path)], input=data, check=True)
    return path


def bits_of(pixel_format: str) -> int:
    return int(pixel_format.removeprefix("gray")[:-2])


def frames_of(bits: int, count: int = 3, shape: tuple[int, int] = (48, 64)) -> np.ndarray:
    return (np.random.default_rng(bits).integers(0, 2**16, (count, *shape)) >> (16 - bits)).astype(np.uint16)


@pytest.mark.parametrize(("pixel_format", "codec", "container"), FORMATS)
def test_every_bit_of_every_pixel_format_arrives(tmp_path, pixel_format, codec, container):
    frames = frames_of(bits_of(pixel_format))
    found = read_depth_video(encode(tmp_path / f"d.{container}", frames, pixel_format, codec))
    np.testing.assert_array_equal(found.frames, frames)
    np.testing.assert_allclose(found.time, [0, 0.1, 0.2], atol=1e-9)
    np.testing.assert_array_equal(read_depth_video(tmp_path / f"d.{container}", stride=2).frames, frames[::2])


@settings(max_examples=10, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(FORMATS), st.integers(9, 40), st.integers(9, 40), st.integers(1, 4))
def test_sizes_that_fit_no_block(tmp_path, how, height, width, count):
    pixel_format, codec, container = how
    shape = (2 * height, 2 * width) if codec.startswith("lib") else (height, width)  # these pad odd sizes
    shape = (max(shape[0], 64), max(shape[1], 64)) if codec in ("libx265", "jpeg2000") else shape
    frames = frames_of(bits_of(pixel_format), count, shape)
    found = read_depth_video(encode(tmp_path / f"d.{container}", frames, pixel_format, codec))
    np.testing.assert_array_equal(found.frames, frames)


@pytest.mark.parametrize("pixel_format", ["yuv420p10le", "rgb48le", "yuv444p16le", "gbrp12le"])
def test_what_is_no_gray_of_known_range_is_refused_by_name(tmp_path, pixel_format):
    encode(tmp_path / "d.mkv", frames_of(16), "gray16le", "ffv1", "-pix_fmt", pixel_format)
    found = video_streams(tmp_path / "d.mkv")[0].pixel_format
    with pytest.raises(DataError, match=f"d.mkv: its pixel format is {found}; expected gray of 8 to 16 bits"):
        read_depth_video(tmp_path / "d.mkv")


def test_colors_in_ten_bits_are_no_depth(tmp_path):
    picture = np.random.default_rng(0).integers(0, 65536, (2, 48, 64, 3)).astype(np.uint16)
    full = ("-vf", "scale=out_range=pc", "-pix_fmt", "yuv420p10le", "-color_range", "pc")
    encode(tmp_path / "d.mkv", picture, "rgb48le", "ffv1", *full)
    with pytest.raises(DataError, match="frame 0 is colored"):
        read_depth_video(tmp_path / "d.mkv")


def test_sixteen_bits_as_an_avi_loses_them_are_refused(tmp_path):
    encode(tmp_path / "d.avi", frames_of(16), "gray16le", "rawvideo")
    with pytest.raises(DataError, match="pixel format is rgb555le|d.avi: not a readable video"):
        read_depth_video(tmp_path / "d.avi")


def two_streams(path: Path, second: np.ndarray, *titles: str) -> Path:
    """Writes a color stream and one of depth into one file, each with its title."""
    encode(path.with_name("depth.mkv"), second, "gray16le", "png")
    color = ["-f", "lavfi", "-i", f"testsrc=s=64x48:r=10:d={len(second) / 10}", "-i", str(path.with_name("depth.mkv"))]
    named = [part for k, title in enumerate(titles) for part in (f"-metadata:s:v:{k}", f"title={title}")]
    streams = ["-map", "0:v", "-map", "1:v", "-c:v:0", "mjpeg", "-pix_fmt:v:0", "yuvj420p", "-c:v:1", "copy"]
    subprocess.run([get_ffmpeg_exe(), "-v", "error", "-y", *color, *streams, *named, str(path)], check=True)
    return path


def test_the_stream_of_depth_is_taken_from_a_file_with_color_beside(tmp_path):
    frames = frames_of(16)
    np.testing.assert_array_equal(read_depth_video(two_streams(tmp_path / "k.mkv", frames)).frames, frames)
    titled = two_streams(tmp_path / "t.mkv", frames, "COLOR", "DEPTH")
    np.testing.assert_array_equal(read_depth_video(titled).frames, frames)


KINECT = [0.513, 0.517, 0.4928, 0.4929, 0.548, -0.021, -0.0027, 0.8897, 0.0861, -0.0139, 0, 0, -7.2e-05, 2.1e-05]


def kinect_recording(path, depth, parameters=KINECT):
    """Writes frames of depth (T,H,W) u16 with the calibration that the recorder of the Azure Kinect attaches."""
    lens = {"ModelType": "CALIBRATION_LensDistortionModelBrownConrady", "ModelParameters": parameters}
    camera = {"Location": "CALIBRATION_CameraLocationD0", "SensorWidth": 1024, "SensorHeight": 1024, "Intrinsics": lens}
    text = json.dumps({"CalibrationInformation": {"Cameras": [{"Location": "CALIBRATION_CameraLocationPV0"}, camera]}})
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.height, stream.width, stream.pix_fmt = *depth.shape[1:], "gray16le"
        container.add_attachment("calibration.json", "application/octet-stream", text.encode() + b"\0")
        frames = [av.VideoFrame.from_ndarray(frame, format="gray16le") for frame in depth]
        container.mux([packet for frame in [*frames, None] for packet in stream.encode(frame)])
    return path


def test_the_calibration_that_an_azure_kinect_attaches_is_used(tmp_path):
    """By the equations of its SDK; 60 degrees, as without, are 10 % off, and those of a wide mode 76 %."""
    side, corner, depth = 512, (96, 90), np.zeros((1, 288, 320), np.uint16)
    depth[:, ::31, ::29] = 1500
    reader = DepthVideos(inputs=(kinect_recording(tmp_path / "k.mkv", depth),))
    x, y, z = reader.read(reader.items()[0], np.random.default_rng(0)).sequence.points.T.astype(np.float64)
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = KINECT
    x, y = x / z, y / z
    r = x * x + y * y
    bend = (1 + k1 * r + k2 * r**2 + k3 * r**3) / (1 + k4 * r + k5 * r**2 + k6 * r**3)
    u = side * (fx * (x * bend + 2 * p1 * x * y + p2 * (r + 2 * x * x)) + cx) - corner[0] - 0.5
    v = side * (fy * (y * bend + 2 * p2 * x * y + p1 * (r + 2 * y * y)) + cy) - corner[1] - 0.5
    rows, columns = np.nonzero(depth[0])
    np.testing.assert_allclose(np.stack([u, v]), np.stack([columns, rows]), atol=1e-3)
    camera = read_depth_video(tmp_path / "k.mkv").camera
    for size, side, corner in (((640, 576), 1024, (192, 180)), ((512, 512), 512, (0, 0)), ((1024, 1024), 1024, (0, 0))):
        own = camera.of_pictures(*size)
        assert (own.fx, own.fy) == pytest.approx((fx * side, fy * side))
        assert (own.cx, own.cy) == pytest.approx((cx * side - corner[0] - 0.5, cy * side - corner[1] - 0.5))


def test_what_of_an_azure_kinect_can_not_be_used_is_told(tmp_path):
    depth = np.full((1, 64, 64), 1500, np.uint16)
    small = DepthVideos(inputs=(kinect_recording(tmp_path / "small.mkv", depth),))
    with pytest.raises(
        DataError, match="whose depth has 640x576, .* these pictures have 64x64; if they were transformed"
    ):
        small.read(small.items()[0], np.random.default_rng(0))
    odd = read_depth_video(kinect_recording(tmp_path / "odd.mkv", depth, KINECT[:4]))
    assert odd.camera is None and "attached calibration is not used" in "".join(odd.notes)


def test_pixels_that_no_ray_reaches_through_a_lens_are_dropped_and_counted(tmp_path):
    """Its radius r (1 - r^2 / 2) grows up to 0.5443 of the focal length; OpenCV sends what lies beyond anywhere."""
    np.save(tmp_path / "v.npy", depth := np.full((1, 48, 64), 1500, np.uint16))
    reader = DepthVideos(inputs=(tmp_path / "v.npy",), intrinsics=LensIntrinsics(20, 20, 31.5, 23.5, (-0.5, 0, 0, 0)))
    read = reader.read(reader.items()[0], np.random.default_rng(0))
    inside = np.hypot(*np.meshgrid((np.arange(64) - 31.5) / 20, (np.arange(48) - 23.5) / 20)) < 0.5443
    assert len(read.sequence.points) == inside.sum() and read.notes[BLIND] == depth.size - inside.sum()
    assert np.hypot(*read.sequence.points.T[:2]).max() < 1.5 * np.sqrt(2 / 3)


def test_two_streams_that_may_both_be_depth_are_listed(tmp_path):
    for name in ("a", "b"):
        encode(tmp_path / f"{name}.mkv", frames_of(16), "gray16le", "ffv1")
    both = ["-i", str(tmp_path / "a.mkv"), "-i", str(tmp_path / "b.mkv"), "-map", "0", "-map", "1", "-c", "copy"]
    subprocess.run([get_ffmpeg_exe(), "-v", "error", *both, str(tmp_path / "both.mkv")], check=True)
    with pytest.raises(DataError, match="holds 2 video streams .*none is called depth"):
        read_depth_video(tmp_path / "both.mkv")


def test_time_stamps_count_and_not_the_rate_that_the_header_says(tmp_path):
    frames = frames_of(16, 6)
    stamps = "setpts='if(lt(N,3),N,N+12)*0.04/TB'"
    encode(tmp_path / "v.mkv", frames, "gray16le", "ffv1", "-vf", stamps, "-fps_mode", "passthrough", rate=25)
    encode(tmp_path / "p.mkv", frames, "gray16le", "png", "-vf", stamps, "-fps_mode", "passthrough", rate=25)
    for name in ("v.mkv", "p.mkv"):
        np.testing.assert_allclose(read_depth_video(tmp_path / name).time, [0, 0.04, 0.08, 0.6, 0.64, 0.68], atol=1e-3)
        np.testing.assert_allclose(read_depth_video(tmp_path / name, stride=3).time, [0, 0.6], atol=1e-3)


def test_times_are_true_or_absent(tmp_path):
    assert rising_times([0.0, None, 0.2], 10) is None and rising_times([0.0, 0.2, 0.1], 10) is None
    np.testing.assert_allclose(rising_times([0.5, 0.533, 0.567], 30), [0, 1 / 30, 2 / 30], atol=1e-12)
    np.save(tmp_path / "a.npy", frames_of(12))
    encode(tmp_path / "b.mkv", frames_of(12), "gray12le", "ffv1")
    both = DepthVideos(inputs=(tmp_path,))
    assert both.fields == () and both.read(both.items()[1], RNG).sequence.time is None
    assert any("no times are written: a.npy says none" in line for line in both.summary(both.items()))
    given_rate = DepthVideos(inputs=(tmp_path,), fps=5)
    np.testing.assert_allclose(given_rate.read(given_rate.items()[0], RNG).sequence.time, [0, 0.2, 0.4])


@pytest.mark.parametrize("pixel_format, container", [("gray16le", "avi"), ("gray16le", "mkv"), ("gray12le", "avi")])
@pytest.mark.parametrize("place", [2, 4])
def test_frames_lost_to_one_whose_bytes_are_damaged_are_counted(tmp_path, pixel_format, container, place):
    import av

    frames = frames_of(bits_of(pixel_format), count=5)
    path = encode(tmp_path / f"a.{container}", frames, pixel_format, "ffv1", "-g", "1")
    assert read_depth_video(path).missing == 0
    with av.open(str(path)) as file:
        packet = [bytes(packet) for packet in file.demux() if packet.size][place]
    data = path.read_bytes()
    path.write_bytes(data.replace(packet, b"\xff" * len(packet)))
    video = read_depth_video(path)
    assert len(video.frames) in (place, 4) and video.missing == 5 - len(video.frames)  # OpenCV ends there


def test_damaged_files_are_refused_or_give_the_frames_they_have(tmp_path):
    whole = encode(tmp_path / "d.mkv", frames_of(12, 9), "gray12le", "ffv1").read_bytes()
    (tmp_path / "d.mkv").write_bytes(whole[: len(whole) // 2])
    assert 0 < len(read_depth_video(tmp_path / "d.mkv").frames) < 9
    for kept in (0, 50):
        (tmp_path / "d.mkv").write_bytes(whole[:kept])
        with pytest.raises(DataError, match="d.mkv: not a readable video"):
            read_depth_video(tmp_path / "d.mkv")


@pytest.mark.parametrize("name", ["a.mkv", "a.mov"])  # one read by OpenCV, one by ffmpeg
def test_pictures_are_turned_as_they_are_shown(tmp_path, name):
    frames = frames_of(16)
    codec = {"a.mkv": ("gray16le", "ffv1"), "a.mov": ("gray16be", "png")}[name]
    encode(tmp_path / f"plain_{name}", frames, *codec)
    command = [get_ffmpeg_exe(), "-v", "error", "-display_rotation", "90", "-i", str(tmp_path / f"plain_{name}")]
    subprocess.run([*command, "-c", "copy", str(tmp_path / name)], check=True)
    video = read_depth_video(tmp_path / name)
    np.testing.assert_array_equal(video.frames, np.rot90(frames, 1, axes=(1, 2)))
    assert video.notes == {TURNED: 1}
    assert read_depth_video(tmp_path / f"plain_{name}").notes == {}


@pytest.mark.parametrize(("bits", "name"), [(8, "a.mp4"), (16, "a.mkv")])
@pytest.mark.parametrize("how", [["-display_hflip"], ["-display_vflip"], ["-display_hflip", "-display_rotation", "90"]])
def test_mirrored_videos_are_refused_and_the_advice_helps(tmp_path, bits, name, how):
    """They were turned by half a turn."""
    frames = frames_of(bits).astype(np.uint8 if bits == 8 else np.uint16)
    encode(tmp_path / f"plain_{name}", frames, "gray" if bits == 8 else "gray16le", "ffv1")
    command = [get_ffmpeg_exe(), "-v", "error"]
    subprocess.run(
        [*command, *how, "-i", str(tmp_path / f"plain_{name}"), "-c", "copy", str(tmp_path / name)], check=True
    )
    with pytest.raises(DataError, match=f"shown mirrored.*ffmpeg -display_rotation 0 -i {name} -c copy depth"):
        read_depth_video(tmp_path / name)
    advised = [
        *command,
        "-display_rotation",
        "0",
        "-i",
        str(tmp_path / name),
        "-c",
        "copy",
        str(tmp_path / f"b_{name}"),
    ]
    subprocess.run(advised, check=True)
    np.testing.assert_array_equal(read_depth_video(tmp_path / f"b_{name}").frames, frames)


def test_interlaced_frames_are_refused_and_the_advice_helps(tmp_path):
    """OpenCV 5 gives other numbers in their place, and no error."""
    frames = frames_of(16)
    woven = encode(tmp_path / "woven.mkv", frames, "gray16le", "ffv1", "-vf", "setfield=tff")
    with pytest.raises(DataError, match="interlaced.*ffmpeg -i woven.mkv -vf setfield=prog"):
        read_depth_video(woven)
    command = [get_ffmpeg_exe(), "-v", "error", "-i", str(woven), "-vf", "setfield=prog,format=gray16le"]
    subprocess.run([*command, "-c:v", "ffv1", str(tmp_path / "depth.mkv")], check=True)
    np.testing.assert_array_equal(read_depth_video(tmp_path / "depth.mkv").frames, frames)


def test_frames_that_are_interlaced_behind_others_are_refused(tmp_path):
    frames = frames_of(16, count=6)
    for name, some, mode in (("plain", frames[:3], "prog"), ("woven", frames[3:], "tff")):
        encode(tmp_path / f"{name}.mkv", some, "gray16le", "ffv1", "-vf", f"setfield={mode}")
    (tmp_path / "list.txt").write_text("file plain.mkv\nfile woven.mkv\n")
    joined = [get_ffmpeg_exe(), "-v", "error", "-f", "concat", "-i", str(tmp_path / "list.txt"), "-c", "copy"]
    subprocess.run([*joined, str(tmp_path / "a.mkv")], check=True)
    assert how_shown(tmp_path / "a.mkv") == (False, 0) and how_shown(tmp_path / "a.mkv", every=True) == (True, 0)
    with pytest.raises(DataError, match="interlaced"):
        read_depth_video(tmp_path / "a.mkv")


def test_raw_gray_of_quicktime_whose_white_is_unknown_is_refused(tmp_path):
    """Of ffmpeg's own files ffmpeg gives 255 less the numbers that were written."""
    frames = np.arange(48 * 64, dtype=np.uint8).reshape(1, 48, 64)
    with pytest.raises(DataError, match="raw gray of 8 bits in QuickTime"):
        read_depth_video(encode(tmp_path / "a.mov", frames, "gray", "rawvideo"))
    for name, codec in (("a.mkv", "rawvideo"), ("b.mov", "ffv1")):
        np.testing.assert_array_equal(read_depth_video(encode(tmp_path / name, frames, "gray", codec)).frames, frames)


def test_columns_that_a_codec_cuts_off_on_the_left_are_refused(tmp_path):
    """OpenCV stretches the uncut picture to the size of the cut one."""
    whole = encode(tmp_path / "a.mp4", frames_of(8).astype(np.uint8), "gray", "libx264")
    for cut, refused in (("crop_left=8", True), ("crop_right=8", False)):
        command = [
            get_ffmpeg_exe(),
            "-v",
            "error",
            "-y",
            "-i",
            str(whole),
            "-c",
            "copy",
            "-bsf:v",
            f"h264_metadata={cut}",
        ]
        subprocess.run([*command, str(tmp_path / "b.mp4")], check=True)
        if refused:
            with pytest.raises(DataError, match="margins of its frames are cut off"):
                read_depth_video(tmp_path / "b.mp4")
        else:
            assert read_depth_video(tmp_path / "b.mp4").frames.shape == (3, 48, 56)
