"""Truncated videos of every container: what is lost is told, and whole files pass."""

import re
import zlib

import av
import numpy as np
import pytest
from PIL import Image

from dpcli.errors import DataError
from dpcli.prepare.decode.depth_files import JOINED, read_depth_video
from dpcli.runtime.clips.animations import animation_times
from dpcli.runtime.clips.container_ends import ends_early
from dpcli.runtime.clips.video_frames import look_at_video
from dpcli.runtime.progress import log

FRAMES = 20
CONTAINERS = {
    **{f"a.{suffix}": ("libx264", "yuv420p", {}) for suffix in ("mp4", "mov", "mkv", "avi", "ts", "m2ts", "flv")},
    "front.mp4": ("libx264", "yuv420p", {"options": {"movflags": "faststart"}}),
    "pieces.mp4": ("libx264", "yuv420p", {"options": {"movflags": "frag_keyframe+empty_moov"}}),
    "a.webm": ("libvpx", "yuv420p", {}),
    "a.ogv": ("libvpx", "yuv420p", {"format": "ogg"}),
    "a.wmv": ("wmv2", "yuv420p", {}),
    "a.y4m": ("wrapped_avframe", "yuv420p", {}),
    "full.y4m": ("wrapped_avframe", "yuv444p", {}),
    "deep.y4m": ("wrapped_avframe", "gray16le", {"options": {"strict": "-1"}}),
    "deep.nut": ("ffv1", "gray16le", {}),
    "deep.mkv": ("ffv1", "gray16le", {}),
}


def write(path, codec, pixels, options):
    gray = (np.random.default_rng(0).random((FRAMES, 24, 32)) * 255).astype(np.uint8)
    with av.open(str(path), "w", **options) as container:
        stream = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = 32, 24, pixels
        for frame in gray:
            picture = av.VideoFrame.from_ndarray(np.repeat(frame[..., None], 3, -1), format="rgb24")
            container.mux(stream.encode(picture.reformat(format=pixels)))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize("name", CONTAINERS)
def test_a_video_that_lost_its_end_ends_early_and_a_whole_one_does_not(name, tmp_path):
    path = write(tmp_path / name, *CONTAINERS[name])
    whole = path.read_bytes()
    assert not ends_early(path)
    for cut in np.linspace(0.4 * len(whole), len(whole) - 1, 20).astype(int):
        path.write_bytes(whole[:cut])
        boxes = name == "pieces.mp4" and cut > len(whole) - 60  # its last box is an index that nobody needs
        assert ends_early(path) or boxes, cut


@pytest.mark.parametrize(
    ("tag", "pixels"),
    [("420jpeg", "yuv420p"), ("411", "yuv411p"), ("422p10", "yuv422p10le"), ("444", "yuv444p"), ("mono", "gray")],
)
@pytest.mark.parametrize(("width", "height"), [(70, 65), (71, 32), (72, 33)])
def test_frames_of_odd_sides_end_where_ffmpeg_has_them_end(tag, pixels, width, height, tmp_path):
    deep = 2 if "10" in pixels else 1
    frame = sum(plane.width * plane.height * deep for plane in av.VideoFrame(width, height, pixels).planes)
    path = tmp_path / "a.y4m"
    for count, early in ((3 * frame, False), (3 * frame - 1, True)):
        head = f"YUV4MPEG2 W{width} H{height} F10:1 C{tag}\n".encode()
        path.write_bytes((head + 3 * (b"FRAME\n" + bytes(frame)))[: len(head) + 18 + count])
        assert ends_early(path) == early


@pytest.mark.parametrize("name", ["a.ts", "a.mkv", "a.flv", "a.mp4", "a.y4m"])
def test_fewer_frames_are_an_error_or_a_warning(name, tmp_path, monkeypatch):
    path = write(tmp_path / name, *CONTAINERS[name])
    whole, said = path.read_bytes(), []
    monkeypatch.setattr(log, "warn", said.append)
    assert look_at_video(path).count == FRAMES and not said
    for cut in np.linspace(0.3, 0.97, 5):
        path.write_bytes(whole[: int(cut * len(whole))])
        said.clear()
        try:
            look_at_video(path)
        except DataError as error:
            said.append(str(error))
        assert len(said) == 1 and name in said[0], cut


@pytest.mark.parametrize("name", ["deep.nut", "deep.mkv"])
def test_depth_says_what_is_missing_down_to_one_frame(name, tmp_path):
    path = write(tmp_path / name, *CONTAINERS[name])
    whole = path.read_bytes()
    assert not (video := read_depth_video(path)).missing and not video.ends_early and len(video.frames) == FRAMES
    for cut in (0.5, 0.8, 0.9, 0.95):
        path.write_bytes(whole[: int(cut * len(whole))])
        video = read_depth_video(path)
        assert video.ends_early and len(video.frames) < FRAMES
        assert name == "deep.nut" or len(video.frames) + video.missing == FRAMES  # NUT counts nothing


def test_videos_one_behind_another_in_a_file_are_told(tmp_path, monkeypatch):
    path, said = write(tmp_path / "a.mp4", *CONTAINERS["a.mp4"]), []
    assert JOINED not in read_depth_video(path).notes
    path.write_bytes(3 * path.read_bytes())
    assert read_depth_video(path).notes[JOINED] == 2
    monkeypatch.setattr(log, "warn", said.append)
    look_at_video(path)
    assert any("holds 3 videos, one behind another" in line for line in said)


def test_a_live_recording_promises_no_end(tmp_path):
    path = write(tmp_path / "a.mkv", "libx264", "yuv420p", {"options": {"live": "1"}})
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert not ends_early(path)


@pytest.mark.parametrize("begun", [0, 2])
def test_what_lies_between_two_frames_ends_the_video_with_a_sentence(begun, tmp_path):
    frame = bytes(24 * 32 * 3 // 2)
    between = b"FRAME\n" + frame
    (tmp_path / "a.y4m").write_bytes(b"YUV4MPEG2 W32 H24 F10:1 C420\n" + between * begun + b"NOISE\n" + frame + between)
    with pytest.raises(DataError, match="only 2 can be decoded" if begun else "no frame can be decoded"):
        look_at_video(tmp_path / "a.y4m")


@pytest.mark.parametrize("kind", ["png", "webp"])
def test_pictures_behind_those_that_an_animation_counts_are_told(kind, tmp_path, monkeypatch):
    path, said = tmp_path / f"a.{kind}", []
    monkeypatch.setattr(log, "warn", said.append)
    pictures = [Image.fromarray(np.full((8, 8, 3), 40 * k, np.uint8)) for k in range(5)]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=100, lossless=True)
    data = bytearray(path.read_bytes())
    assert len(animation_times(path)) == 5 and not said
    if kind == "png":
        at = data.find(b"acTL")
        data[at + 4 : at + 8] = (3).to_bytes(4, "big")
        data[at + 12 : at + 16] = zlib.crc32(bytes(data[at : at + 12])).to_bytes(4, "big")
    else:
        at = [one.start() for one in re.finditer(b"ANMF", bytes(data))][3]
        data[4:8] = (at - 8).to_bytes(4, "little")
    path.write_bytes(data)
    assert len(animation_times(path)) == 3 and said == [
        f"{path}: 2 pictures behind the 3 that its header counts: left out"
    ]
