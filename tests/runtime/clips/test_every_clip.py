"""Clips of any legal kind, written by PyAV, OpenCV, imageio and Pillow, read back: pictures, their number and times."""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory

import av
import cv2
import imageio.v3 as imageio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from dpcli.errors import DataError
from dpcli.prepare.decode.color_frames import open_frames
from dpcli.runtime.clips.animations import animation_frames

RATES = [Fraction(24000, 1001), Fraction(25), Fraction(30), Fraction(25, 2), Fraction(60), Fraction(30000, 1001)]


SQUARE = Fraction(1)


@dataclass(frozen=True)
class Kind:
    """One way to store a clip: `error` bounds the mean difference of levels, `step` divides both sides."""

    codec: str
    pixels: str
    containers: str
    error: float = 0.0
    step: int = 1
    options: tuple[tuple[str, str], ...] = ()

    @property
    def has_alpha(self) -> bool:
        return any(component.is_alpha for component in av.VideoFormat(self.pixels).components)


Clip = tuple[Kind, str, Fraction, tuple[int, int], list[int]]  # how, in what, frames a second, size, ticks of frames
EXACT = [
    *(Kind("ffv1", p, "mkv avi nut") for p in ("bgr0", "bgra")),
    *(Kind("ffv1", p, "mkv nut") for p in ("gbrp10le", "gbrp16le", "rgb48le", "rgba64le")),
    *(Kind("png", p, "mov avi") for p in ("rgb24", "rgba", "rgb48be", "rgba64be")),
    *(Kind("qtrle", p, "mov") for p in ("rgb24", "argb")),
    *(Kind("rawvideo", p, "nut") for p in ("rgb24", "bgr24", "rgba", "bgra", "gbrp")),
    Kind("rawvideo", "bgr24", "avi"),
    Kind("rawvideo", "rgb24", "mov", step=2),  # FFmpeg's own writer leaves rows of odd length unpadded there
    *(Kind("utvideo", p, "avi nut") for p in ("gbrp", "gbrap")),
    *(Kind("huffyuv", p, "avi nut") for p in ("rgb24", "bgra")),
    *(Kind("ffvhuff", p, "avi nut") for p in ("rgb24", "bgra", "gbrp10le", "gbrap")),
    *(Kind("magicyuv", p, "avi nut") for p in ("gbrp", "gbrap")),
    *(Kind("ffv1", p, "mkv avi nut", error) for p, error in (("gray", 0.0), ("gray16le", 1), ("gray10le", 1))),
    Kind("libx264rgb", "bgr24", "mp4 mkv mov", options=(("qp", "0"), ("preset", "ultrafast"))),
    Kind("libvpx-vp9", "gbrp", "webm mkv mp4", options=(("lossless", "1"), ("deadline", "realtime"))),
]
FINE = (("crf", "8"), ("preset", "ultrafast"))
CLOSE = [
    *(Kind("ffv1", p, "mkv avi nut", 4, 2) for p in ("yuv444p", "yuv422p", "yuv420p", "yuva420p", "yuva444p")),
    *(Kind("ffv1", p, "mkv nut", 3, 2) for p in ("yuv420p10le", "yuv444p12le", "yuva444p10le", "yuv422p16le")),
    *(Kind("ffv1", p, "mkv nut", 5, 1) for p in ("yuv444p", "yuv420p", "yuva444p")),
    *(Kind("utvideo", p, "avi nut", 4, 2) for p in ("yuv420p", "yuv422p", "yuv444p")),
    *(Kind("libx264", p, "mp4 mov mkv ts flv", 4, 2, FINE) for p in ("yuv420p", "yuv422p", "yuvj420p")),
    *(Kind("libx264", p, "mp4 mkv", 4, 2, FINE) for p in ("yuv444p", "yuv420p10le", "yuv444p10le")),
    *(Kind("libvpx-vp9", p, "webm mkv mp4", 5, 1, (("crf", "8"), ("b:v", "0"))) for p in ("yuv420p", "yuv444p")),
    Kind("libvpx-vp9", "yuva420p", "webm mkv", 5, 2, (("crf", "8"), ("auto-alt-ref", "0"))),
    Kind("libvpx", "yuv420p", "webm mkv", 6, 1, (("crf", "4"), ("b", "4000000"))),
    Kind("libvpx", "yuva420p", "webm mkv", 6, 2, (("crf", "4"), ("b", "4000000"), ("auto-alt-ref", "0"))),
    *(Kind("prores_ks", p, "mov mkv", 4, 2) for p in ("yuv422p10le", "yuv444p10le", "yuva444p10le")),
    *(Kind("mjpeg", p, "avi mov mkv", 5, 2, (("qscale", "2"),)) for p in ("yuvj420p", "yuvj422p", "yuvj444p")),
    Kind("jpeg2000", "rgb24", "mov mkv avi", 5, 2),
    Kind("mpeg4", "yuv420p", "mp4 avi mkv mov", 6, 2, (("b", "8000000"),)),
    Kind("mpeg2video", "yuv420p", "mpg mkv", 6, 2, (("b", "8000000"),)),
    Kind("wmv2", "yuv420p", "wmv avi", 6, 2, (("b", "8000000"),)),
    Kind("flv", "yuv420p", "flv", 6, 2, (("b", "8000000"),)),
]
STAMPED = ("mkv", "mp4", "mov", "webm", "nut", "flv")  # containers that keep a time for each frame
UNSTEADY = ("ffv1", "png", "qtrle", "rawvideo", "utvideo", "libx264", "libvpx-vp9", "mjpeg")


def pictures(count: int, width: int, height: int, alpha: bool, gray: bool = False) -> np.ndarray:
    """Smooth colors that move, u8 (T,H,W,4); where asked for, half transparent on the left."""
    y, x = np.mgrid[:height, :width]
    t = np.arange(count)[:, None, None]
    made = np.full((count, height, width, 4), 255, np.uint8)
    for channel, (a, b, c) in enumerate(((5, 1, 9), (1, 5, 6), (3, 3, 13))):
        made[..., channel] = 128 + 100 * np.sin((a * x / width + b * y / height) / 4 + c * t / count / 2 + channel)
    if gray:
        made[..., :3] = made[..., :1]
    if alpha:
        made[..., 3] = 127 + 128 * (x >= width // 2)
    return made


def write(
    path: Path, kind: Kind, rgba: np.ndarray, rate: Fraction, ticks: list[int], turn: int = 0, aspect: Fraction = SQUARE
) -> None:
    """Writes frames at `ticks` of a clock that ticks `rate` times a second. turn: in degrees to the left, as it plays."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(kind.codec, rate=rate, options=dict(kind.options))
        stream.height, stream.width, stream.pix_fmt = *rgba.shape[1:3], kind.pixels
        stream.codec_context.time_base = 1 / rate
        if aspect != SQUARE:
            stream.codec_context.sample_aspect_ratio = aspect
        if turn:
            stream.set_display_rotation(turn)
        for picture, tick in zip(rgba, ticks):
            frame = av.VideoFrame.from_ndarray(picture, "rgba").reformat(format=kind.pixels, threads=1)
            frame.pts, frame.time_base = tick, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@st.composite
def clips(draw, kinds: list[Kind]) -> Clip:
    kind = draw(st.sampled_from(kinds))
    container = draw(st.sampled_from(kind.containers.split()))
    width, height = (kind.step * draw(st.integers(32 // kind.step, 70 // kind.step)) for _ in range(2))
    rate = draw(st.sampled_from([r for r in RATES if kind.codec != "mpeg2video" or r != 12.5]))
    ticks = list(range(draw(st.integers(2, 7))))
    if container in STAMPED and kind.codec in UNSTEADY and draw(st.booleans()):
        ticks = np.cumsum([0, *(draw(st.integers(1, 5)) for _ in ticks[1:])]).tolist()
    return kind, container, rate, (width, height), ticks


def check(clip: Clip) -> None:
    kind, container, rate, size, ticks = clip
    rgba = pictures(len(ticks), *size, kind.has_alpha, kind.pixels.startswith("gray"))
    with TemporaryDirectory() as folder:
        path = Path(folder, f"clip.{container}")
        write(path, kind, rgba, rate, ticks)
        frames = open_frames(path)
        read = np.stack(list(frames.read(range(len(frames)))))
    assert_like(read, rgba, kind.error)
    np.testing.assert_allclose(frames.times, [float(tick / rate) for tick in ticks], atol=2e-3)


def assert_like(read: np.ndarray, rgba: np.ndarray, error: float) -> None:
    """Pictures u8 (T,H,W,4) that are equal, or differ by `error` in the mean, and nowhere along a whole row or column."""
    assert read.shape == rgba.shape
    off = np.abs(read.astype(int) - rgba)
    assert off.mean(axis=(1, 2)).max() <= error
    assert max(off.mean(axis=1).max(), off.mean(axis=2).max()) <= 8 * error


@settings(max_examples=120, deadline=None)
@given(clips(EXACT))
def test_what_is_stored_exactly_is_read_exactly(clip):
    check(clip)


@settings(max_examples=120, deadline=None)
@given(clips(CLOSE))
def test_what_is_stored_nearly_is_read_nearly(clip):
    check(clip)


TURNING = {"mp4", "mov", "mkv", "webm"}  # containers that tell how a picture is turned and its pixels' shape
SHOWN = [
    replace(kind, containers=" ".join(sorted(known)))
    for kind in (*EXACT, *CLOSE)
    if (known := {*kind.containers.split()} & TURNING) and not kind.has_alpha
]


@settings(max_examples=40, deadline=None)
@given(clips(SHOWN), st.sampled_from([0, 90, 180, 270]), st.sampled_from([SQUARE, Fraction(4, 3), Fraction(10, 11)]))
def test_what_is_turned_and_stretched_is_read_as_it_plays(clip, turn, aspect):
    kind, container, rate, (width, height), ticks = clip
    aspect = aspect if container in ("mp4", "mov") else SQUARE  # PyAV tells Matroska's writer none
    rgba = pictures(len(ticks), width, height, False, kind.pixels.startswith("gray"))
    with TemporaryDirectory() as folder:
        write(path := Path(folder, f"clip.{container}"), kind, rgba, rate, ticks, turn, aspect)
        frames = open_frames(path)
        read = np.stack(list(frames.read(range(len(frames)))))
    wide = pictures(len(ticks), round(width * aspect), height, False, kind.pixels.startswith("gray"))
    assert_like(read, np.rot90(wide, turn // 90, axes=(1, 2)), max(kind.error, 4))


CV2_CODES = {"FFV1": ("avi mkv", 0.0), "MJPG": ("avi mov mkv", 5), "mp4v": ("mp4 mov", 6), "XVID": ("avi", 6)}
CV2_CODES |= {"VP80": ("webm", 6), "VP90": ("webm", 6), "HFYU": ("avi", 6), "PNG ": ("avi mov", 0.0)}


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(sorted(CV2_CODES)), st.integers(12, 35), st.integers(12, 35), st.sampled_from(RATES), st.data())
def test_what_opencv_writes(code, half_width, half_height, rate, data):
    containers, error = CV2_CODES[code]
    rgba = pictures(data.draw(st.integers(2, 7)), 2 * half_width, 2 * half_height, False)
    with TemporaryDirectory() as folder:
        path = Path(folder, f"clip.{data.draw(st.sampled_from(containers.split()))}")
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), float(rate), rgba.shape[2:0:-1])
        assert writer.isOpened()
        for picture in rgba:
            writer.write(np.ascontiguousarray(picture[..., 2::-1]))
        writer.release()
        frames = open_frames(path)
        read = np.stack(list(frames.read(range(len(frames)))))
    assert_like(read, rgba, error)
    np.testing.assert_allclose(frames.times, np.arange(len(rgba)) / float(rate), atol=2e-3)


BY_IMAGEIO = {"a.mp4": {}, "a.mkv": {}, "a.mov": {}, "a.avi": {}}
BY_IMAGEIO |= {
    f"{pixels}.{suffix}": {"codec": "libx265", "output_params": ["-pix_fmt", pixels, "-x265-params", "crf=8"]}
    for pixels in ("yuv420p", "yuv420p10le", "yuv444p12le")
    for suffix in ("mp4", "mkv")
}


@pytest.mark.parametrize("name", BY_IMAGEIO)
def test_what_imageio_writes(tmp_path, name):
    rgba = pictures(5, 50, 34, False)
    words = {"plugin": "FFMPEG", "fps": 12.5, "quality": 9, "macro_block_size": 1} | BY_IMAGEIO[name]
    imageio.imwrite(tmp_path / name, rgba[..., :3], **words)
    frames = open_frames(tmp_path / name)
    read = np.stack(list(frames.read(range(len(frames)))))
    assert_like(read, rgba, 6)
    np.testing.assert_allclose(frames.times, np.arange(5) / 12.5, atol=2e-3)


ANIMATIONS = {
    "PNG": ({}, 0.0),
    "WEBP": ({"lossless": True, "exact": True}, 0.0),
    "GIF": ({"disposal": 2}, 12),
    "AVIF": ({"quality": 95, "subsampling": "4:4:4"}, 5),
}


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(sorted(ANIMATIONS)), st.integers(24, 60), st.integers(24, 60), st.booleans(), st.data())
def test_what_pillow_writes(form, width, height, alpha, data):
    options, error = ANIMATIONS[form]
    rgba = pictures(data.draw(st.integers(2, 6)), width, height, alpha and form != "GIF")
    lasting = [10 * data.draw(st.integers(2, 30)) for _ in rgba]
    images = [Image.fromarray(picture) for picture in rgba]
    with TemporaryDirectory() as folder:
        path = Path(folder, f"clip.{'apng' if form == 'PNG' else form.lower()}")
        images[0].save(path, form, save_all=True, append_images=images[1:], duration=lasting, loop=0, **options)
        frames = open_frames(path)
        read = np.stack(list(frames.read(range(len(frames)))))
    assert_like(read, rgba, error)
    np.testing.assert_allclose(frames.times, np.cumsum([0, *lasting[:-1]]) / 1000, atol=2e-3)


@pytest.mark.parametrize("disposal", [0, 1, 2])
@pytest.mark.parametrize("blend", [0, 1])
@pytest.mark.parametrize("other_still", [False, True])
def test_frames_of_an_apng_lie_over_one_another_as_browsers_have_them(tmp_path, disposal, blend, other_still):
    """Soft alpha over what is below; the image for viewers that play none is no frame."""
    soft = pictures(4, 32, 24, True)
    soft[..., 3] = np.linspace(0, 255, 32)[None, None] * (np.arange(4)[:, None, None] + 1) / 4
    images = [Image.fromarray(picture) for picture in soft]
    words = {"disposal": disposal, "blend": blend, "default_image": other_still, "duration": 100}
    images[3 if other_still else 0].save(
        tmp_path / "a.png", save_all=True, append_images=images[not other_still :], **words
    )
    below, shown = Image.new("RGBA", (32, 24)), []
    for image in images:
        shown.append(Image.alpha_composite(below, image) if blend else image)
        below = (shown[-1], Image.new("RGBA", (32, 24)), below)[disposal]
    frames = open_frames(tmp_path / "a.png")
    read = np.stack(list(frames.read(range(len(frames)))))
    expected = np.stack([np.asarray(one) for one in shown])
    np.testing.assert_array_equal(read[..., 3], expected[..., 3])
    light = [colors[..., :3] * (colors[..., 3:] / 255) for colors in (read, expected)]  # faint colors are rounded
    np.testing.assert_allclose(*light, atol=2)
    np.testing.assert_allclose(frames.times, [0, 0.1, 0.2, 0.3])


def gif_of(width: int, height: int, pictures: list[tuple[int, int, np.ndarray, int, int | None]]) -> bytes:
    """A GIF of left, top, colors u8 (H,W) into a palette, what becomes of them, and the color that is clear; uncompressed."""
    palette = b"\0\0\0\xff\xff\xff\xff\0\0\0\xff\0" + bytes(3 * 252)
    data = b"GIF89a" + struct.pack("<2H3B", width, height, 0xF7, 1, 0) + palette  # white is the background
    for left, top, colors, after, clear in pictures:
        codes = [256, *colors.reshape(-1).tolist(), 257]
        body = sum(code << 9 * place for place, code in enumerate(codes)).to_bytes(9 * len(codes) // 8 + 1, "little")
        data += struct.pack("<4BH2B", 0x21, 0xF9, 4, after << 2 | (clear is not None), 10, clear or 0, 0)
        data += struct.pack("<B4H", 0x2C, left, top, *colors.shape[::-1]) + bytes([0, 8, len(body)]) + body + b"\0"
    return data + b";"


def test_what_no_picture_of_a_gif_covers_is_clear_as_in_browsers(tmp_path):
    red, green = (np.full((2, 3), color, np.uint8) for color in (2, 3))
    laid = [(1, 1, red, 2, None), (0, 0, green, 1, None), (2, 1, red, 3, None), (3, 2, green, 0, None)]
    holes = np.array([[2, 3, 2], [2, 2, 3]], np.uint8)
    (tmp_path / "a.gif").write_bytes(gif_of(5, 3, [*laid, (0, 0, holes, 0, 2)]))  # the last but one lies half outside
    frames = open_frames(tmp_path / "a.gif")
    letters = np.array([".", "R", "G"])
    read = [
        " ".join("".join(row) for row in letters[(one[..., 3] > 0) * (1 + (one[..., 1] > 0))])
        for one in frames.read(range(5))
    ]
    assert read == [
        "..... .RRR. .RRR.",
        "GGG.. GGG.. .....",
        "GGG.. GGRRR ..RRR",
        "GGG.. GGG.. ...GG",
        "GGG.. GGG.. ...GG",
    ]


def test_what_no_picture_of_a_webp_covers_is_clear_as_in_browsers(tmp_path):
    """Pillow marks a file as without alpha where every picture in it is opaque, though they are smaller than the canvas."""
    frames = np.zeros((3, 8, 12, 4), np.uint8)
    for t, frame in enumerate(frames):
        frame[2:6, 2 + 2 * t : 6 + 2 * t] = (200, 30, 40, 255)
    first, *others = map(Image.fromarray, frames)
    first.save(tmp_path / "a.webp", save_all=True, append_images=others, duration=100, lossless=True)
    assert not (tmp_path / "a.webp").read_bytes()[20] & 16
    np.testing.assert_array_equal(list(open_frames(tmp_path / "a.webp").read(range(3))), frames)
    whole = [Image.fromarray(np.full((4, 4), level, np.uint8)) for level in (9, 200)]
    whole[0].save(tmp_path / "b.webp", save_all=True, append_images=whole[1:], duration=100, lossless=True)
    assert np.stack(list(open_frames(tmp_path / "b.webp").read(range(2))))[..., [0, 3]].reshape(2, -1, 2)[
        :, 0
    ].tolist() == [[9, 255], [200, 255]]


def test_a_canvas_that_a_gif_cannot_fill_is_refused_before_it_is_laid_out(tmp_path):
    frames = [Image.fromarray(np.full((8, 8), level, np.uint8)) for level in (0, 255)]
    frames[0].save(tmp_path / "a.gif", save_all=True, append_images=frames[1:], duration=100)
    data = bytearray((tmp_path / "a.gif").read_bytes())
    data[6:10] = b"\xff\xff\xff\x00"  # 65535 x 255
    (tmp_path / "b.gif").write_bytes(data)
    open_frames(tmp_path / "a.gif")
    with pytest.raises(DataError, match=r"b.gif: its canvas claims 16711425 pixels"):
        open_frames(tmp_path / "b.gif")
    place = data.rindex(b",\0\0\0\0")
    data[6:10], data[place + 5 : place + 9] = b"\x08\0\x08\0", b"\0\x30\0\x30"  # its second picture, not its canvas
    (tmp_path / "b.gif").write_bytes(data)
    with pytest.raises(DataError, match=r"b.gif: its canvas claims 150994944 pixels"):
        list(animation_frames(tmp_path / "b.gif", [0, 1]))
