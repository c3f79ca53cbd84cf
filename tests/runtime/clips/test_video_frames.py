"""Videos as they play: written by FFmpeg in the codecs, containers and tags people have, read back against the pictures."""

from __future__ import annotations

import re
import struct
import subprocess
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image, ImageFilter

from dpcli.errors import DataError, UsageError
from dpcli.prepare.decode.color_frames import image_size, open_frames, read_rgba
from dpcli.prepare.views.masks import read_mask
from dpcli.runtime.clips.video_frames import look_at_video, video_frames

SIDE, COUNT = 64, 8


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of PNGs 0.png ...: a red square with a black foot walks over nothing, u8 (64,64,4), straight alpha."""
    folder = tmp_path_factory.mktemp("pictures")
    for frame in range(COUNT):
        rgba = np.zeros((SIDE, SIDE, 4), np.uint8)
        rgba[16:40, 8 + 4 * frame : 28 + 4 * frame] = (200, 30, 30, 255)
        rgba[40:48, 8 + 4 * frame : 28 + 4 * frame] = (0, 0, 0, 255)
        Image.fromarray(rgba).save(folder / f"{frame}.png")
    return folder


def ffmpeg(*words: object) -> None:
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def film(pictures: Path, target: Path, *words: object) -> Path:
    """The pictures as a video of 10 frames a second."""
    ffmpeg("-framerate", 10, "-i", pictures / "%d.png", *words, target)
    return target


def decoded(path: Path) -> np.ndarray:
    return np.stack(list(video_frames(path, range(look_at_video(path).count))))


def stored(pictures: Path) -> np.ndarray:
    return np.stack([read_rgba(pictures / f"{frame}.png") for frame in range(COUNT)])


ALPHA = {
    "vp9.webm": ("-c:v", "libvpx-vp9", "-pix_fmt", "yuva420p", "-crf", 4, "-b:v", 0),
    "vp8.webm": ("-c:v", "libvpx", "-pix_fmt", "yuva420p", "-auto-alt-ref", 0, "-b:v", "2M"),
    "prores.mov": ("-c:v", "prores_ks", "-profile:v", 4, "-pix_fmt", "yuva444p10le"),
    "animation.mov": ("-c:v", "qtrle", "-pix_fmt", "argb"),
    "png.mov": ("-c:v", "png", "-pix_fmt", "rgba"),
    "ffv1.mkv": ("-c:v", "ffv1", "-pix_fmt", "bgra"),
    "tiff.mov": ("-c:v", "tiff", "-pix_fmt", "rgba"),  # with side data that PyAV doesn't know
}


@pytest.mark.parametrize("name", ALPHA)
def test_alpha_that_a_container_has_is_used(pictures, tmp_path, name):
    path = film(pictures, tmp_path / name, *ALPHA[name])
    assert look_at_video(path).has_alpha and look_at_video(path).count == COUNT
    read, written = decoded(path), stored(pictures)
    assert (np.abs(read[..., 3].astype(int) - written[..., 3]) > 64).mean() < 0.01
    inside = (written[..., 3] == 255) & (read[..., 3] > 250)
    assert np.abs(read[inside][:, :3].astype(int) - written[inside][:, :3]).mean() < 6


def test_alpha_in_a_layer_of_hevc_is_refused_by_name(pictures, tmp_path):
    """FFmpeg 8 decodes only what lies below it, which is opaque."""
    words = ("-c:v", "libx265", "-tag:v", "hvc1", "-pix_fmt", "yuva420p", "-x265-params", "alpha=1:log-level=none")
    path = film(pictures, tmp_path / "sticker.mov", *words)
    ffmpeg("-i", path, "-c", "copy", tmp_path / "sticker.mkv")
    for name in ("sticker.mov", "sticker.mkv"):
        with pytest.raises(DataError, match="its alpha is in a layer of HEVC that is not decoded; FFmpeg 9"):
            look_at_video(tmp_path / name)


def test_pictures_that_stay_in_theora_end_no_clip(pictures, tmp_path):
    """Its packets without bytes, as recorders of screens write them, in the middle and at the end."""
    held = ("-vf", "fps=30,tpad=stop_mode=clone:stop_duration=2", "-c:v", "libtheora", "-q:v", 10, "-g", 60)
    path = film(pictures, tmp_path / "screen.ogv", *held)
    look, read = look_at_video(path), decoded(path)
    assert look.times[-1] > look.times[COUNT - 1] - 1e-6 and look.count >= COUNT
    for frame, at in enumerate(np.searchsorted(look.times, np.arange(COUNT) / 10 + 0.01) - 1):
        assert abs(look.times[at] - frame / 10) < 1e-3
        assert read[at, 28, :, 0].argmax() in range(6 + 4 * frame, 30 + 4 * frame)


@pytest.mark.parametrize("codec", ["libx264", "libx265"])
def test_a_title_in_any_encoding_hinders_nothing(codec, pictures, tmp_path):
    """Of HEVC, whose file is opened once more for its layers, as well."""
    path = film(
        pictures, tmp_path / "k.mkv", "-pix_fmt", "yuv420p", "-c:v", codec, "-metadata", "title=caf_ in Latin-1"
    )
    path.write_bytes(path.read_bytes().replace(b"caf_", b"caf\xe9"))
    assert look_at_video(path).count == COUNT


@pytest.mark.parametrize("name", ["h264.mp4", "ffv1.avi"])
def test_without_alpha_everything_is_opaque(pictures, tmp_path, name):
    words = {"h264.mp4": ("-pix_fmt", "yuv420p"), "ffv1.avi": ("-c:v", "ffv1", "-pix_fmt", "bgr0")}[name]
    path = film(pictures, tmp_path / name, *words)
    assert not look_at_video(path).has_alpha and (decoded(path)[..., 3] == 255).all()


@pytest.mark.parametrize("name", ["raw.avi", "animation.mov"])
def test_an_alpha_of_0_everywhere_is_none(pictures, tmp_path, capfd, name):
    """Windows leaves the fourth byte of its pixels empty, and so do programs that record them."""
    words = {
        "raw.avi": ("-c:v", "rawvideo", "-pix_fmt", "bgra"),
        "animation.mov": ("-c:v", "qtrle", "-pix_fmt", "argb"),
    }
    path = film(pictures, tmp_path / name, "-vf", "format=rgba,lutrgb=a=0", *words[name])
    read = decoded(path)
    assert (read[..., 3] == 255).all() and read[0, 20, 12].tolist() == [200, 30, 30, 255]
    assert not look_at_video(path).has_alpha and "its alpha is 0 everywhere" in capfd.readouterr().err


PLAIN = ("-pix_fmt", "yuv420p", "-c:v", "libx264", "-crf", 10)
SUFFIXES = {
    "av1.mp4": ("-pix_fmt", "yuv420p", "-c:v", "libsvtav1", "-crf", 20),
    "av1.mkv": ("-pix_fmt", "yuv420p", "-c:v", "libsvtav1", "-crf", 20),
    "k.ts": PLAIN,
    "k.mts": (*PLAIN, "-f", "mpegts"),
    "k.flv": PLAIN,
    "k.3gp": PLAIN,
    "k.wmv": ("-c:v", "wmv2", "-q:v", 2),
    "k.y4m": ("-pix_fmt", "yuv420p"),
    "no_suffix": (*PLAIN, "-f", "mp4"),
    "k.swf": ("-c:v", "flv", "-q:v", 2),
    "k.rm": ("-c:v", "rv20", "-q:v", 2),
    "k.h264": PLAIN,
    "hevc_without_suffix": ("-pix_fmt", "yuv420p", "-c:v", "libx265", "-x265-params", "log-level=none", "-f", "hevc"),
    "k.mjpg": ("-c:v", "mjpeg", "-q:v", 2, "-f", "mjpeg"),
}
RATE_UNKNOWN = ("k.mjpg",)


@pytest.mark.parametrize("name", SUFFIXES)
def test_the_decoder_says_what_can_be_read_not_the_suffix(pictures, tmp_path, name):
    frames = open_frames(film(pictures, tmp_path / name, *SUFFIXES[name]))
    assert len(frames) == COUNT
    if name in RATE_UNKNOWN:
        assert frames.times is None
    else:
        np.testing.assert_allclose(frames.times, np.arange(COUNT) / 10, atol=2e-3)
    first = next(iter(frames.read([0])))
    assert np.abs(first[28, 18, :3].astype(int) - (200, 30, 30)).max() < 24


def test_a_trimmed_clip_has_the_frames_that_play(pictures, tmp_path):
    whole = film(pictures, tmp_path / "whole.mp4", *PLAIN, "-g", 100)
    ffmpeg("-ss", "0.3", "-i", whole, "-c", "copy", tmp_path / "cut.mp4")
    frames = open_frames(tmp_path / "cut.mp4")
    assert len(frames) == COUNT - 3
    last = list(frames.read(range(len(frames))))[-1]
    assert np.abs(last[28, 18 + 4 * (COUNT - 1), :3].astype(int) - (200, 30, 30)).max() < 24


@pytest.mark.parametrize("name", ["late.mkv", "late.webm", "late.nut", "late.ts"])
def test_a_clip_that_begins_late_is_whole(pictures, tmp_path, name):
    codec = ("-c:v", "libvpx", "-pix_fmt", "yuv420p", "-b:v", "2M") if name.endswith("webm") else PLAIN
    path = film(pictures, tmp_path / name, *codec, "-output_ts_offset", 3)
    np.testing.assert_allclose(look_at_video(path).times, np.arange(COUNT) / 10, atol=2e-3)


def test_a_truncated_clip_is_no_trimmed_one(pictures, tmp_path):
    path = film(pictures, tmp_path / "t.mp4", *PLAIN, "-g", 2, "-movflags", "+faststart", "-qp", 0)
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * 0.75)])
    with pytest.raises(DataError, match="truncated(,| or damaged)"):  # PyAV before 18 gives none of its frames
        look_at_video(path)


def test_square_pixels_and_rotation_are_what_plays(pictures, tmp_path, capfd):
    wide = film(pictures, tmp_path / "wide.mp4", *PLAIN, "-vf", "setsar=2/1")
    assert decoded(wide).shape[1:3] == (SIDE, 2 * SIDE) and "2:1" in capfd.readouterr().err
    straight = film(pictures, tmp_path / "straight.mp4", *PLAIN)
    plays = {
        ("-display_rotation", 90): lambda p: np.rot90(p, 1, (1, 2)),
        ("-display_rotation", 180): lambda p: p[:, ::-1, ::-1],
        ("-display_hflip",): lambda p: p[:, :, ::-1],
        ("-display_vflip",): lambda p: p[:, ::-1],
        ("-display_rotation", 90, "-display_hflip"): lambda p: p[:, ::-1, ::-1].transpose(0, 2, 1, 3),
    }
    for words, turn in plays.items():
        ffmpeg(*words, "-i", straight, "-c", "copy", tmp_path / "turned.mp4")
        np.testing.assert_array_equal(decoded(tmp_path / "turned.mp4"), turn(decoded(straight)))
        assert ("mirrored" if "flip" in str(words) else "turned by") in capfd.readouterr().err


@pytest.mark.parametrize("matrix, number", [("bt709", 1), ("smpte170m", 6), ("bt2020nc", 9)])
@pytest.mark.parametrize("full", [False, True])
def test_colors_follow_the_tagged_matrix_and_range(tmp_path, matrix, number, full):
    Image.new("RGB", (64, 64), (200, 30, 30)).save(tmp_path / "0.png")
    kind = "pc" if full else "tv"
    scale = f"scale=out_color_matrix={matrix.removesuffix('nc')}:out_range={kind}"
    tags = ("-colorspace", matrix, "-color_range", kind)
    film(tmp_path, tmp_path / "c.mp4", *PLAIN, "-vf", scale, *tags)
    assert np.abs(decoded(tmp_path / "c.mp4")[0, 32, 32, :3].astype(int) - (200, 30, 30)).max() <= 4


@pytest.mark.parametrize("codec, name", [("libvpx", "c.webm"), ("libvpx-vp9", "c.webm"), ("libx265", "c.mp4")])
def test_colors_that_the_container_alone_tells_count(tmp_path, codec, name):
    """As a copy of a stream with tags leaves it; FFmpeg's decoders forget them."""
    Image.new("RGB", (64, 64), (200, 30, 30)).save(tmp_path / "0.png")
    scaled = "scale=out_color_matrix=bt709:out_range=pc,format=yuv420p"
    untold = "setparams=range=unknown:color_primaries=unknown:color_trc=unknown:colorspace=unknown"
    film(tmp_path, tmp_path / name, "-vf", f"{scaled},{untold}", "-c:v", codec, "-crf", 4, "-b:v", "4M")
    tags = ("-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709", "-color_range", "pc")
    ffmpeg("-i", tmp_path / name, "-c", "copy", *tags, tmp_path / f"told_{name}")
    assert np.abs(decoded(tmp_path / f"told_{name}")[0, 32, 32, :3].astype(int) - (200, 30, 30)).max() <= 4


WEIGHTS = {
    1: (0.2126, 0.0722),
    5: (0.299, 0.114),
    9: (0.2627, 0.0593),
}  # of red and blue in brightness, by H.273's matrices
PATCHES = np.array(
    [[255, 255, 255], [0, 0, 0], [128, 128, 128], [255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [250, 240, 230]]
    + [
        [0, 255, 255],
        [255, 0, 255],
        [17, 200, 90],
        [200, 17, 90],
        [90, 30, 220],
        [5, 10, 15],
        [64, 32, 16],
        [180, 160, 140],
    ]
)


@pytest.mark.parametrize("shrunk", [(2, 2), (2, 1), (1, 1), (1, 2)])
@pytest.mark.parametrize("bits", [8, 10, 12])
@pytest.mark.parametrize("matrix", WEIGHTS)
@pytest.mark.parametrize("full", [False, True])
def test_stored_brightness_and_colors_become_the_levels_of_the_standard(tmp_path, shrunk, bits, matrix, full):
    """Flat patches of 16 pixels in YCbCr, by the formulas of H.273, without loss; 8 bits round by a level."""
    red, blue = WEIGHTS[matrix]
    r, g, b = PATCHES.T / 255
    luma = red * r + (1 - red - blue) * g + blue * b
    chroma = [(b - luma) / (2 - 2 * blue), (r - luma) / (2 - 2 * red)]
    top, step = 2**bits - 1, 2 ** (bits - 8)
    levels = [luma * top if full else (16 + 219 * luma) * step]
    levels += [one * (top if full else 224 * step) + 128 * step for one in chroma]
    kind = {(2, 2): "420", (2, 1): "422", (1, 1): "444", (1, 2): "440"}[shrunk]
    pixels = f"yuv{kind}p" + (f"{bits}le" if bits > 8 else "")
    place = np.kron(np.arange(16).reshape(4, 4), np.ones((16, 16), int))
    frame = av.VideoFrame(64, 64, pixels)
    frame.pts, frame.time_base, frame.colorspace, frame.color_range = 0, Fraction(1, 10), matrix, 2 if full else 1
    for plane, values, (across, down) in zip(frame.planes, levels, ((1, 1), shrunk, shrunk)):
        stored = values.round().clip(0, top)[place][::down, ::across].astype(np.uint8 if bits == 8 else np.uint16)
        lines = np.zeros((plane.height, plane.line_size // stored.itemsize), stored.dtype)
        lines[:, : stored.shape[1]] = stored
        plane.update(lines.tobytes())
    with av.open(str(tmp_path / "c.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 64, pixels
        stream.codec_context.colorspace, stream.codec_context.color_range = matrix, 2 if full else 1
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    shown = decoded(tmp_path / "c.mkv")[0, 8::16, 8::16, :3].reshape(-1, 3)
    assert np.abs(shown.astype(int) - PATCHES).max() <= (3 if bits == 8 else 2)


def with_box(mp4: bytes, box: bytes, depth: int = 7) -> bytes:
    """An MP4 whose index comes last, with a box at the end of the sample entry of its one video, or `depth` boxes down."""
    data, (start, stop), above = bytearray(mp4), (0, len(mp4)), []
    names = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"avc1")
    for name, skipped in zip(names[:depth], (8, 8, 8, 8, 8, 16, 86)):
        while data[start + 4 : start + 8] != name:
            start += int.from_bytes(data[start : start + 4], "big")
        above.append(start)
        start, stop = start + skipped, start + int.from_bytes(data[start : start + 4], "big")
    data[stop:stop] = box
    for at in above:
        data[at : at + 4] = struct.pack(">I", int.from_bytes(data[at : at + 4], "big") + len(box))
    return bytes(data)


@pytest.mark.parametrize("name", ["c.mp4", "c.mov", "c.mkv"])
def test_margins_that_a_container_cuts_off_are_not_shown(pictures, tmp_path, capfd, name):
    """40 x 30, whose middle lies 4 to the right of the frame's and 3 above: columns 16 to 56, rows 14 to 44."""
    whole = film(pictures, tmp_path / "whole.mp4", *PLAIN)
    cut = with_box(whole.read_bytes(), struct.pack(">I4s8i", 40, b"clap", 40, 1, 30, 1, 4, 1, -6, 2))
    (tmp_path / "c.mp4").write_bytes(cut)
    if name != "c.mp4":
        ffmpeg("-i", tmp_path / "c.mp4", "-c", "copy", tmp_path / name)
    np.testing.assert_array_equal(decoded(tmp_path / name), decoded(whole)[:, 14:44, 16:56])
    assert "its margins are cut off, as it plays: 40x30 of 64x64" in capfd.readouterr().err


@pytest.mark.parametrize("margins", ["crop_left=8", "crop_left=2:crop_top=4:crop_right=6"])
def test_margins_that_a_codec_cuts_off_are_not_shown(pictures, tmp_path, margins):
    left, right, top = {"crop_left=8": (8, 0, 0)}.get(margins, (2, 6, 4))
    whole = film(pictures, tmp_path / "whole.mp4", *PLAIN)
    ffmpeg("-i", whole, "-c", "copy", "-bsf:v", f"h264_metadata={margins}", tmp_path / "cut.mp4")
    np.testing.assert_array_equal(
        decoded(tmp_path / "cut.mp4")[..., 3, 3, :], decoded(whole)[:, top:, left : SIDE - right][..., 3, 3, :]
    )
    assert decoded(tmp_path / "cut.mp4").shape[1:3] == (SIDE - top, SIDE - left - right)


def test_dolby_vision_of_its_own_colors_is_refused_and_of_others_colors_is_not(pictures, tmp_path):
    whole = film(pictures, tmp_path / "whole.mp4", *PLAIN).read_bytes()
    for name, profile in ((b"dvcC", 5), (b"dvvC", 8)):
        box = struct.pack(">I4s2B20s", 32, name, 1, 0, bytes([profile << 1, 3 << 3 | 5]))
        (tmp_path / "c.mp4").write_bytes(with_box(whole, box + bytes(2)))
        if profile == 5:
            with pytest.raises(DataError, match="c.mp4: Dolby Vision of profile 5"):
                look_at_video(tmp_path / "c.mp4")
        else:
            assert look_at_video(tmp_path / "c.mp4").count == COUNT


def test_a_file_that_says_it_holds_two_views_or_a_panorama_is_told(pictures, tmp_path, capfd):
    whole = film(pictures, tmp_path / "whole.mp4", *PLAIN)
    ffmpeg("-i", whole, "-c", "copy", "-metadata:s:v", "stereo_mode=left_right", tmp_path / "two.mkv")
    words = {"Spherical": "true", "Stitched": "true", "StitchingSoftware": "x", "ProjectionType": "equirectangular"}
    text = "".join(f"<GSpherical:{key}>{value}</GSpherical:{key}>" for key, value in words.items()).encode()
    box = b"uuid" + bytes.fromhex("ffcc8263f8554a938814587a02521fdd") + text
    (tmp_path / "round.mp4").write_bytes(with_box(whole.read_bytes(), struct.pack(">I", len(box) + 4) + box, depth=2))
    for name, said in (("two.mkv", "two views side by side"), ("round.mp4", "a panorama"), ("whole.mp4", "")):
        look_at_video(tmp_path / name)
        error = capfd.readouterr().err
        assert f"{name}: {said}, as the file says" in error if said else not error


def test_of_a_turn_that_is_no_quarter_is_told(pictures, tmp_path, capfd):
    straight = film(pictures, tmp_path / "straight.mp4", *PLAIN)
    ffmpeg("-display_rotation", 30, "-i", straight, "-c", "copy", tmp_path / "turned.mp4")
    np.testing.assert_array_equal(decoded(tmp_path / "turned.mp4"), decoded(straight))
    said = capfd.readouterr().err
    assert "turns it by 30 degrees, of which only quarter turns are applied" in said and "as it plays" not in said


@pytest.mark.parametrize("name, flags, read", [("d.mkv", ("0", "default"), 1), ("n.ts", (), 1), ("f.mp4", (), 0)])
def test_of_several_videos_in_a_file_the_one_that_plays_is_read(pictures, tmp_path, capfd, name, flags, read):
    """The default, else the largest; mp4 marks the first as the default."""
    halves = ("-filter_complex", "[0]split[a][b];[a]scale=32:32[c]", "-map", "[c]", "-map", "[b]")
    marks = [word for place, flag in enumerate(flags) for word in (f"-disposition:v:{place}", flag)]
    path = film(pictures, tmp_path / name, *halves, *PLAIN, *marks)
    assert decoded(path).shape[1] == (32, 64)[read]
    assert f"2 videos in it; {read}, " in capfd.readouterr().err


@pytest.mark.parametrize("codec", [("-c:v", "mjpeg", "-q:v", 1), ("-c:v", "ffv1"), PLAIN])
def test_an_avi_whose_program_dropped_frames_is_whole(pictures, tmp_path, capfd, codec):
    """Chunks without bytes keep the frame before; with B-frames an AVI tells no times."""
    words = ("-vf", "fps=30,select='not(mod(n,3))'", "-fps_mode", "vfr", "-enc_time_base", "1/30")
    look = look_at_video(film(pictures, tmp_path / "d.avi", *codec, *words))
    assert look.count == COUNT
    assert re.search(r"d.avi: \d+ frames? without bytes", capfd.readouterr().err)
    if codec is PLAIN:
        assert look.times is None
    else:
        np.testing.assert_allclose(look.times, np.arange(COUNT) / 10, atol=1e-6)


def test_linear_light_becomes_srgb(tmp_path, capfd):
    """EXR holds light: half of it is the level 188."""
    Image.new("RGB", (16, 16), (128, 0, 255)).save(tmp_path / "0.png")
    film(tmp_path, tmp_path / "l.mov", "-c:v", "exr", "-pix_fmt", "gbrpf32le")
    assert np.abs(decoded(tmp_path / "l.mov")[0, 8, 8, :3].astype(int) - (188, 0, 255)).max() <= 1
    assert "linear light; converted to sRGB" in capfd.readouterr().err


def test_colors_that_are_not_converted_are_refused(pictures, tmp_path):
    tag = ("-bsf:v", "h264_metadata=matrix_coefficients=8")
    with pytest.raises(DataError, match="its colors are YCgCo; expected RGB, or YCbCr"):
        look_at_video(film(pictures, tmp_path / "c.mp4", *PLAIN, *tag))


def test_interlaced_lines_are_told_in_some_frames_as_in_all(pictures, tmp_path, capfd):
    words = ("-c:v", "mpeg2video", "-r", 25, "-vf", "setfield=tff,interlace", "-flags", "+ilme+ildct")
    woven = film(pictures, tmp_path / "i.ts", *words)
    count = look_at_video(woven).count
    assert "i.ts: interlaced: each shows two moments" in capfd.readouterr().err
    plain = film(pictures, tmp_path / "p.ts", "-c:v", "mpeg2video", "-r", 25)
    (tmp_path / "both.ts").write_bytes(plain.read_bytes() + woven.read_bytes())
    whole = look_at_video(tmp_path / "both.ts").count
    assert f"both.ts: interlaced in {count} of {whole} frames: each shows" in capfd.readouterr().err


def test_an_hdr_clip_is_named(pictures, tmp_path, capfd):
    tags = "setparams=color_trc=arib-std-b67:color_primaries=bt2020:colorspace=bt2020nc"
    look_at_video(film(pictures, tmp_path / "hdr.mp4", *PLAIN, "-vf", tags))
    assert "HDR" in capfd.readouterr().err


def test_two_series_of_a_folder_are_named(pictures, tmp_path):
    for frame in range(3):
        for name in ("anya_rgba_{:03d}.png", "luigi_rgba_{:03d}.png"):
            Image.open(pictures / f"{frame}.png").save(tmp_path / name.format(frame))
    with pytest.raises(
        DataError, match=r"(?s)images of 2 series: anya_rgba_.*luigi_rgba_.*--pattern 'anya_rgba_\*\.png'"
    ):
        open_frames(tmp_path)


def test_the_pattern_of_the_advice_fits_one_series_alone(pictures, tmp_path):
    """`*.png` would fit `000_mask.png`, too: color and masks in turn."""
    for frame in range(12):
        for name in ("{:03d}.png", "{:03d}_mask.png"):
            Image.open(pictures / "0.png").save(tmp_path / name.format(frame))
    with pytest.raises(DataError, match="Name one: --pattern") as error:
        open_frames(tmp_path)
    pattern = str(error.value).split("'")[1]
    assert len(open_frames(tmp_path, pattern)) == 12


@pytest.mark.parametrize("pattern, names", [("luigi_*", "luigi_0 luigi_2 luigi_10"), ("*_2.png", "anya_2 luigi_2")])
def test_a_pattern_says_which_images_are_the_clip(pictures, tmp_path, capfd, pattern, names):
    for number in (0, 2, 10):
        for name in ("anya", "luigi"):
            Image.open(pictures / "0.png").save(tmp_path / f"{name}_{number}.png")
    frames = open_frames(tmp_path, pattern)
    assert frames.names == tuple(f"{name}.png" for name in names.split())
    assert "left out: " in capfd.readouterr().err


def test_a_pattern_that_chooses_nothing_is_told(pictures, tmp_path):
    with pytest.raises(DataError, match=r"no images whose names fit --pattern 'b_\*', such as 0.png"):
        open_frames(pictures, "b_*")
    with pytest.raises(UsageError, match="chooses among the images of a folder"):
        open_frames(pictures / "0.png", "b_*")


@pytest.mark.parametrize(
    "start, said",
    [
        (b"PK\3\4", "a zip archive; unpack it first"),
        (b"Kaydara FBX Binary  \0", "FBX; for a clip of a model, export glTF 2.0"),
        (b"\0\0\0\x18ftypheic", "a HEIC picture, which is not read; convert it"),
        (b"\x93NUMPY\1\0", "an array of NumPy"),
        (b"\0\0\0\x18stypmsdh", "a piece of a streamed video; put its beginning before it"),
        (b"version https://git-lfs.github.com/spec/v1\n", "a pointer of Git LFS"),
        (b"<!DOCTYPE html>", "a web page; download it again"),
        (b'\xef\xbb\xbf{"annotations": []}', "JSON; where it holds annotations, draw their masks"),
        (b"", "(empty)"),
    ],
)
def test_what_is_no_video_is_told_by_what_it_is(tmp_path, start, said):
    (tmp_path / "clip.mp4").write_bytes(start)
    with pytest.raises(DataError, match=f"clip.mp4: not a readable video .*{re.escape(said)}"):
        look_at_video(tmp_path / "clip.mp4")
    (tmp_path / "0.jpg").write_bytes(start)  # and so is what is called an image
    said = re.escape(said if start else "")
    for reads in (image_size, read_rgba, read_mask):
        with pytest.raises(DataError, match=f"0.jpg: not a readable (image|mask) .*{said}"):
            reads(tmp_path / "0.jpg")


def test_a_folder_of_videos_lists_them(pictures, tmp_path):
    folder = tmp_path / "my clips"
    folder.mkdir()
    (folder / "notes.txt").write_text("no clip")
    for name in ("b.mp4", "a.mp4"):
        film(pictures, folder / name, *PLAIN)
    with pytest.raises(DataError, match="2 videos, one clip is wanted: a.mp4, b.mp4") as error:
        open_frames(folder)
    loop = (
        str(error.value).partition("of its own: ")[2].replace('dpc prepare video "$clip" -o "$clip.h5"', 'echo "$clip"')
    )
    said = subprocess.run(["bash", "-c", loop], capture_output=True, text=True).stdout
    assert said.split("\n")[:-1] == [str(folder / "a.mp4"), str(folder / "b.mp4")]


LABELS = np.zeros((48, 64), np.uint8)
LABELS[8:24, 8:40], LABELS[24:40, 20:50] = 1, 2


def colors_of(*rgb: tuple[int, int, int]) -> Image.Image:
    return Image.fromarray(np.array([(0, 0, 0), *rgb], np.uint8)[LABELS])


@pytest.mark.parametrize(
    "image",
    [
        pytest.param(Image.fromarray(np.array([0, 38, 200], np.uint8)[LABELS]), id="few values"),
        pytest.param(Image.fromarray(np.array([0, 128, 255], np.uint8)[LABELS]), id="instances"),
        pytest.param(Image.fromarray(LABELS).convert("P"), id="palette"),
        pytest.param(Image.fromarray(LABELS > 0), id="1 bit"),
        pytest.param(colors_of((128, 0, 0), (0, 128, 0)), id="colors"),
        pytest.param(colors_of((0, 0, 1), (2, 0, 0)), id="numbers in colors"),
        pytest.param(Image.fromarray(np.array([0, 300, 40_000], np.uint16)[LABELS]), id="16 bits"),
        pytest.param(Image.fromarray(np.array([0, 1000, 1000], np.uint16)[LABELS]), id="one label of 16 bits"),
        pytest.param(Image.fromarray(np.array([0, 70_000, 80_000], np.int32)[LABELS]), id="32 bits"),
        pytest.param(Image.fromarray(np.array([0, 1, 1], np.float32)[LABELS]), id="floats"),
        pytest.param(Image.fromarray(LABELS), id="small values"),
    ],
)
def test_masks_of_labels_are_opaque_wherever_the_label_is_not_zero(tmp_path, image):
    image.save(tmp_path / "m.tif")
    np.testing.assert_array_equal(read_mask(tmp_path / "m.tif"), np.where(LABELS > 0, 255, 0))


@pytest.mark.parametrize("image", [colors_of((128, 0, 0), (230, 25, 75)), colors_of((128, 128, 128), (255, 255, 255))])
@pytest.mark.parametrize("suffix", ["jpg", "webp"])
def test_labels_that_were_compressed_are_told_from_soft_masks(tmp_path, image, suffix):
    image.save(tmp_path / f"m.{suffix}", quality=75)
    wrong = read_mask(tmp_path / f"m.{suffix}") != np.where(LABELS > 0, 255, 0)
    assert wrong.mean() < 0.01
    soft = Image.fromarray(np.where(LABELS > 0, 255, 0).astype(np.uint8)).filter(ImageFilter.GaussianBlur(5))
    soft.save(tmp_path / f"s.{suffix}", quality=90)
    np.testing.assert_allclose(read_mask(tmp_path / f"s.{suffix}"), np.asarray(soft).astype(int), atol=12)


@pytest.mark.parametrize(
    "void, scale, said", [(255, 1, "255 beside labels below 64"), (10_000, 1001, "10000 beside other labels")]
)
def test_every_label_but_0_is_opaque_and_what_may_mean_undecided_is_told(tmp_path, capfd, void, scale, said):
    labels = (LABELS.astype(np.uint16) * scale).astype(np.uint8 if void == 255 else np.uint16)
    labels[LABELS != np.roll(LABELS, 1, 1)] = void
    Image.fromarray(labels).save(tmp_path / "m.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), np.where(labels > 0, 255, 0))
    assert f"{said} is read as the object" in capfd.readouterr().err


def with_palette(numbers: np.ndarray, *colors: tuple[int, int, int]) -> Image.Image:
    image = Image.fromarray(np.asarray(numbers, np.uint8), "L").convert("P")
    image.putpalette(bytes(value for color in colors for value in color))
    return image


BLACK, WHITE, RED, GREEN = (0, 0, 0), (255, 255, 255), (255, 0, 0), (0, 200, 0)


@pytest.mark.parametrize(
    "image",
    [
        pytest.param(with_palette(LABELS == 0, WHITE, BLACK), id="white is number 0"),
        pytest.param(with_palette(np.choose(LABELS, [1, 0, 2]), RED, BLACK, GREEN), id="black is number 1"),
        pytest.param(with_palette(LABELS, WHITE, RED, GREEN), id="on white paper"),
        pytest.param(with_palette(LABELS, (128, 128, 128), WHITE, (200, 200, 200)), id="on gray paper"),
        pytest.param(with_palette(LABELS, BLACK, BLACK, BLACK), id="without colors"),
        pytest.param(with_palette(LABELS * 0, WHITE), id="white alone"),
        pytest.param(colors_of(RED, GREEN).quantize(4), id="made smaller"),
        pytest.param(Image.fromarray(np.dstack([LABELS, LABELS * 0 + 60, 70 * LABELS]), "RGB"), id="overlay"),
    ],
)
def test_numbers_of_a_palette_are_labels_unless_its_colors_say_otherwise(tmp_path, image):
    """Programs that make files smaller number the colors of a mask as they like."""
    if image.mode == "RGB":  # as tools draw a mask over a picture: nowhere opaque
        image.putalpha(Image.fromarray((153 * (LABELS > 0)).astype(np.uint8)))
    image.save(tmp_path / "m.png")
    whole = image.mode == "P" and image.getextrema() == (0, 0)
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), np.where((LABELS > 0) | whole, 255, 0))


@pytest.mark.parametrize(
    ("image", "several"),
    [
        pytest.param(with_palette(LABELS, BLACK, RED, GREEN), True, id="palette"),
        pytest.param(colors_of(RED, GREEN), True, id="colors"),
        pytest.param(Image.fromarray(LABELS), True, id="numbers"),
        pytest.param(with_palette(LABELS > 0, BLACK, RED), False, id="one of a palette"),
        pytest.param(colors_of(RED, RED).filter(ImageFilter.BoxBlur(1)), False, id="one color with a soft outline"),
        pytest.param(Image.fromarray((LABELS > 0).astype(np.uint8) * 255), False, id="one mask"),
    ],
)
def test_labels_that_are_taken_together_are_told(tmp_path, capfd, image, several):
    """As of a rider and a horse, which touch."""
    image.save(tmp_path / "m.png")
    read_mask(tmp_path / "m.png")
    assert ("several labels in a picture are read as one object" in capfd.readouterr().err) is several


def test_labels_in_a_webp_without_loss_are_labels(tmp_path):
    for name, words in (("a.webp", {}), ("b.webp", {"exif": b"Exif\0\0MM\0*\0\0\0\x08\0\0\0\0\0\0"})):
        Image.fromarray(LABELS).convert("RGB").save(tmp_path / name, lossless=True, **words)
        np.testing.assert_array_equal(read_mask(tmp_path / name), np.where(LABELS > 0, 255, 0))


@pytest.mark.parametrize(
    ("values", "name", "message"),
    [
        (LABELS, "m.jpg", "labels up to [1-9] in a file that was compressed with loss"),
        (np.arange(48 * 64, dtype=np.uint16).reshape(48, 64), "m.png", "a mask with values up to 3071; expected 255"),
    ],
)
def test_masks_that_cannot_be_told_are_refused(tmp_path, values, name, message):
    Image.fromarray(values).save(tmp_path / name)
    with pytest.raises(DataError, match=message):
        read_mask(tmp_path / name)


@pytest.mark.parametrize("kind", ["8 bits", "16 bits", "floats", "overshot", "alpha", "transparency", "palette"])
def test_a_soft_mask_stays_soft(tmp_path, kind):
    y, x = np.mgrid[:48, :64]
    soft = np.clip(255 * (16.5 - np.hypot(x - 32, y - 24)), 0, 255).round().astype(np.uint8)
    soft = np.asarray(Image.fromarray(soft).resize((128, 96), Image.Resampling.BICUBIC))
    image = {
        "8 bits": Image.fromarray(soft),
        "16 bits": Image.fromarray(soft.astype(np.uint16) * 257),
        "floats": Image.fromarray(soft.astype(np.float32) / 255),
        "overshot": Image.fromarray(
            np.where(soft == 255, 1.04, np.where(soft == 0, -0.02, soft / 255)).astype(np.float32)
        ),
        "alpha": Image.fromarray(np.stack([soft * 0, soft], -1)),
        "transparency": Image.fromarray(soft).convert("P"),
        "palette": Image.fromarray(soft).convert("RGB").quantize(256),
    }[kind]
    name, words = ("m.tif", {}) if kind in ("floats", "overshot") else ("m.png", {})
    words = {"transparency": bytes(range(256))} if kind == "transparency" else words
    image.save(tmp_path / name, **words)
    np.testing.assert_array_equal(read_mask(tmp_path / name), soft)
