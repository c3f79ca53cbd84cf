"""Images as they are shown: upright, and colors of a profile as sRGB, in folders and in animations."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import av
import numpy as np
import PIL
import pytest
from PIL import Image

from dpcli.errors import DataError
from dpcli.evaluate.video.sources.media import FolderSource
from dpcli.prepare.decode.color_frames import open_frames, read_rgba
from dpcli.prepare.views.masks import read_mask
from dpcli.runtime.clips.images import as_shown, open_image
from dpcli.runtime.clips.name_numbers import in_order
from tests.support.color_profile import BT709, P3, color_profile, to_xyz

TURNS = {
    2: lambda rgb: rgb[:, ::-1],
    3: lambda rgb: rgb[::-1, ::-1],
    5: lambda rgb: rgb.transpose(1, 0, 2),
    6: lambda rgb: np.rot90(rgb),
    8: lambda rgb: np.rot90(rgb, -1),
}


@pytest.mark.parametrize("orientation", TURNS)
def test_images_are_upright_as_their_exif_says(tmp_path, orientation):
    rgb = np.zeros((20, 40, 3), np.uint8)
    rgb[:8, :10], rgb[:8, 30:] = (255, 0, 0), (0, 0, 255)
    turned = Image.fromarray(np.ascontiguousarray(TURNS[orientation](rgb)))
    exif = turned.getexif()
    exif[0x0112] = orientation
    turned.save(tmp_path / "0.png", exif=exif)
    np.testing.assert_array_equal(read_rgba(tmp_path / "0.png")[..., :3], rgb)
    for kind in ("png", "webp"):  # the one is laid here, the other by Pillow
        other = Image.new("RGB", turned.size)
        turned.save(tmp_path / f"moving.{kind}", exif=exif, save_all=True, append_images=[other], lossless=True)
        np.testing.assert_array_equal(next(open_frames(tmp_path / f"moving.{kind}").read([0]))[..., :3], rgb)


@pytest.mark.parametrize("color_type, bits", [(0, 1), (0, 2), (0, 4), (0, 8), (0, 16), (2, 8), (2, 16)])
def test_the_level_that_a_png_names_is_see_through_at_any_depth(tmp_path, color_type, bits):
    """As programs that make PNGs smaller write sprites of few grays: clear, dark and bright, by 8 pixels each."""
    top, wide = 2**bits - 1, 3 if color_type == 2 else 1
    levels = np.repeat([1, 0, top], 8) if bits > 1 else np.repeat([1, 0, 0], 8)
    samples = np.repeat(levels, wide)
    if bits < 8:
        row = np.packbits((samples[:, None] >> np.arange(bits)[::-1]) & 1).tobytes()
    else:
        row = samples.astype(">u2" if bits == 16 else "u1").tobytes()
    if bits == 16:  # more than the low byte tells it apart
        row = row.replace(b"\0\1", b"\x40\0")
    clear = struct.pack(">H", 0x4000 if bits == 16 else 1) * wide
    chunks = [(b"IHDR", struct.pack(">2I5B", 24, 1, bits, color_type, 0, 0, 0)), (b"tRNS", clear)]
    chunks += [(b"IDAT", zlib.compress(b"\0" + row)), (b"IEND", b"")]
    data = (struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in chunks)
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(data))
    rgba = read_rgba(tmp_path / "a.png")
    np.testing.assert_array_equal(rgba[0, :, 3], np.repeat([0, 255, 255], 8))
    np.testing.assert_array_equal(rgba[0, 8:, 0], np.repeat([0, 255 if bits > 1 else 0], 8))
    if (color_type, bits) != (0, 16):  # there labels are what counts
        np.testing.assert_array_equal(read_mask(tmp_path / "a.png")[0], rgba[0, :, 3])


def shown(rgb: np.ndarray, primaries, gamma: float) -> np.ndarray:
    """sRGB codes u8 (...,3) of codes in these primaries, by the definitions."""
    return srgb((rgb / 255.0) ** gamma @ (np.linalg.inv(to_xyz(BT709)) @ to_xyz(primaries)).T)


def srgb_light(codes: np.ndarray) -> np.ndarray:
    signal = codes / 255.0
    return np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)


def srgb(light: np.ndarray) -> np.ndarray:
    light = light.clip(0, 1)
    return np.round(255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055))


WIDE = {
    "png": {},
    "webp": {"lossless": True, "exact": True},
    "tif": {},
    "avif": {"quality": 100, "subsampling": "4:4:4"},
}


@pytest.mark.parametrize(
    ("suffix", "moves"), [*((suffix, False) for suffix in WIDE), ("png", True), ("webp", True), ("avif", True)]
)
def test_colors_of_a_profile_are_shown_in_srgb(tmp_path, suffix, moves):
    rgba = np.full((2, 16, 24, 4), (120, 90, 60, 200), np.uint8)
    rgba[1, :, 12:, :3] = (100, 140, 90)
    images = [Image.fromarray(picture) for picture in rgba]
    words = WIDE[suffix] | {"icc_profile": color_profile(P3, 1.8)}
    if moves:
        images[0].save(tmp_path / f"a.{suffix}", save_all=True, append_images=images[1:], duration=100, **words)
        read = np.stack(list(open_frames(tmp_path / f"a.{suffix}").read([0, 1])))
    else:
        images[1].save(tmp_path / f"a.{suffix}", **words)
        read = read_rgba(tmp_path / f"a.{suffix}")[None]
    np.testing.assert_allclose(read[..., :3], shown(rgba[-len(read) :, ..., :3], P3, 1.8), atol=3)
    assert (read[..., 3] == 200).all()


@pytest.mark.parametrize("profile", [color_profile(P3, name=b"sRGB IEC61966-2.1"), b"no profile at all"])
def test_images_that_are_srgb_or_have_a_damaged_profile_stay(tmp_path, profile):
    Image.new("RGB", (8, 8), (120, 90, 60)).save(tmp_path / "a.png", icc_profile=profile)
    assert tuple(read_rgba(tmp_path / "a.png")[0, 0]) == (120, 90, 60, 255)


@pytest.mark.parametrize("gray", [np.float32(0.4), np.float32(102), np.uint16(102 * 257), np.uint16(102)])
def test_gray_of_any_type_has_its_own_range(tmp_path, capsys, gray):
    values = np.zeros((8, 8), gray.dtype)
    values[2:] = gray
    Image.fromarray(values).save(tmp_path / "a.tif")
    read = read_rgba(tmp_path / "a.tif")
    assert read[0, 0].tolist() == [0, 0, 0, 255] and read[4, 4].tolist() == [102, 102, 102, 255]
    assert ("is taken for 0 to 255" in capsys.readouterr().err) == (gray.dtype == np.uint16 and gray < 256)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_level_of_gray_that_is_see_through_is(tmp_path, dtype):
    """The chunk tRNS of PNG, which Pillow follows in 8 bits alone."""
    levels = np.full((8, 8), 40 if dtype == np.uint8 else 40 * 257, dtype)
    levels[2:] = 102 * (1 if dtype == np.uint8 else 257)
    Image.fromarray(levels).save(tmp_path / "a.png", transparency=int(levels[0, 0]))
    read = read_rgba(tmp_path / "a.png")
    assert read[0, 0, 3] == 0 and read[4, 4].tolist() == [102, 102, 102, 255]


@pytest.mark.parametrize(
    "names",
    [
        ["t_0.1", "t_0.25", "t_0.3", "t_1.05", "t_1.2"],
        ["v2.1", "v2.9", "v2.10", "v2.20"],  # counted, as its trailing 0 tells
        ["at 31-12-2023 23.59.59", "at 13-01-2024 00.00.01", "at 13-02-2024 00.00.01"],
        ["f (1)", "f (2)", "f (10)"],
    ],
)
def test_a_clip_and_its_evaluation_take_images_in_the_order_that_their_names_tell(tmp_path, names):
    for level, name in enumerate(names):
        Image.new("RGB", (8, 8), (level, 0, 0)).save(tmp_path / f"{name}.png")
    frames = open_frames(tmp_path)
    assert list(frames.names) == [f"{name}.png" for name in names]
    assert sorted(set(frames.numbers)) == list(frames.numbers)
    assert [int(one.rgba[0, 0, 0]) for one in FolderSource(tmp_path).pictures(0, range(len(names)))] == [
        *range(len(names))
    ]


def tiff_of(pixels: np.ndarray, photometric: int, extra: int | None = None) -> bytes:
    """A TIFF of pixels (H,W,C) as they are, byte for byte; extra: what its last channel is, 1 for alpha that is in the others."""
    height, width, channels = pixels.shape
    data, bits = pixels.astype(pixels.dtype.newbyteorder("<")).tobytes(), 8 * pixels.itemsize
    tags = [(256, width), (257, height), (258, bits | (bits << 16) * (channels > 1)), (259, 1), (262, photometric)]
    tags += [(273, 8), (277, channels), (278, height), (279, len(data)), *([(338, extra)] if extra is not None else [])]
    made = b"".join(struct.pack("<HHII", tag, 3, channels if tag == 258 else 1, value) for tag, value in tags)
    return b"II*\0" + struct.pack("<I", 8 + len(data)) + data + struct.pack("<H", len(tags)) + made + bytes(4)


def test_white_at_0_and_alpha_in_the_gray_of_a_tiff_are_read(tmp_path):
    """Pillow turns round 8 bits with white at 0, not 16, and converts no gray that alpha was multiplied into."""
    gray = np.arange(0, 64, dtype=np.uint8).reshape(8, 8) * 4
    clear = np.full_like(gray, 51)
    cases = {
        "8.tif": (tiff_of(255 - gray[..., None], 0), 255),
        "16.tif": (tiff_of(65535 - gray[..., None].astype(np.uint16) * 257, 0), 255),
        "up.tif": (tiff_of(gray[..., None].astype(np.uint16) * 257, 1), 255),
        "la.tif": (tiff_of(np.dstack([np.rint(gray / 5).astype(np.uint8), clear]), 1, 1), 51),
    }
    if int(PIL.__version__.split(".")[0]) < 13:  # which reads no gray with alpha from TIFF
        (tmp_path / "la.tif").write_bytes(cases.pop("la.tif")[0])
        with pytest.raises(DataError, match="la.tif: not a readable image"):
            read_rgba(tmp_path / "la.tif")
    for name, (data, alpha) in cases.items():
        (tmp_path / name).write_bytes(data)
        read = read_rgba(tmp_path / name).astype(int)
        assert (read[..., 3] == alpha).all() and np.abs(read[..., 0] - gray).max() <= (3 if alpha < 255 else 0), name


def test_a_channel_of_a_tiff_that_may_be_alpha_is_told_when_it_is_not_read(tmp_path, capsys):
    """Pillow takes four samples of which the last has no meaning for three; straight and multiplied alpha it reads."""
    Image.fromarray(np.full((8, 8, 4), 100, np.uint8)).save(tmp_path / "a.tif")
    data, tag = (tmp_path / "a.tif").read_bytes(), struct.pack("<HHI", 338, 3, 1)
    assert data.count(tag) == 1
    for extra, color, alpha in ((0, 100, 255), (1, 255, 100), (2, 100, 100)):
        (tmp_path / "a.tif").write_bytes(data.replace(tag + b"\2", tag + bytes([extra])))
        read = read_rgba(tmp_path / "a.tif")
        assert (read == (color, color, color, alpha)).all(), extra
        assert ("further channel" in capsys.readouterr().err) == (extra == 0)


def with_chunk(png: bytes, name: bytes, data: bytes) -> bytes:
    """A PNG with one chunk more behind its head."""
    chunk = struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
    return png[:33] + chunk + png[33:]


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("kind", ["gamma", "cicp", "nclx"])
def test_colors_of_tags_are_shown_in_srgb(tmp_path, kind, moves):
    """A linear PNG by gAMA, one of Display P3 by cICP, and an AVIF of it by nclx; against the definitions."""
    color, data, suffix = (120, 90, 60), io.BytesIO(), "avif" if kind == "nclx" else "png"
    images = [Image.new("RGBA", (16, 16), (*color, 200)), Image.new("RGBA", (16, 16), (9, 9, 9, 255))]
    words = {"quality": 100, "subsampling": "4:4:4"} if suffix == "avif" else {}
    images[0].save(data, suffix.upper(), save_all=moves, append_images=images[1:] if moves else [], **words)
    stored = data.getvalue()
    if kind == "nclx":
        tag = b"colrnclx" + struct.pack(">HH", 1, 13)
        assert tag in stored
        stored = stored.replace(tag, b"colrnclx" + struct.pack(">HH", 12, 13))
    else:
        chunk = (b"gAMA", struct.pack(">I", 100_000)) if kind == "gamma" else (b"cICP", bytes([12, 13, 0, 1]))
        stored = with_chunk(stored, *chunk)
    (tmp_path / f"0.{suffix}").write_bytes(stored)
    read = next(iter(open_frames(tmp_path / f"0.{suffix}").read([0]))) if moves else read_rgba(tmp_path / f"0.{suffix}")
    if kind == "gamma":
        expected = shown(np.array(color), BT709, 1.0)
    else:
        expected = srgb(srgb_light(np.array(color)) @ (np.linalg.inv(to_xyz(BT709)) @ to_xyz(P3)).T)
    np.testing.assert_allclose(read[8, 8, :3], expected, atol=2)
    assert read[8, 8, 3] == 200


@pytest.mark.parametrize("suffix", ["gif", "webp", "png", "avif"])
def test_frames_shown_for_less_than_browsers_can_stay_a_tenth_of_a_second(tmp_path, suffix):
    images = [Image.new("RGB", (16, 16), (60 * k, 0, 0)) for k in range(4)]
    if suffix == "gif":
        images = [image.quantize(4) for image in images]
    lasting = [10, 20, 40, 30] if suffix == "gif" else [10, 17, 40, 30]
    images[0].save(tmp_path / f"a.{suffix}", save_all=True, append_images=images[1:], duration=lasting)
    expected = np.cumsum([0, 100, *lasting[1:-1]]) / 1000
    np.testing.assert_allclose(open_frames(tmp_path / f"a.{suffix}").times, expected, atol=1e-6)


def test_an_avif_of_sixty_pictures_a_second_keeps_its_rate(tmp_path):
    with av.open(str(tmp_path / "a.avif"), "w") as file:
        stream = file.add_stream("libsvtav1", rate=60, options={"preset": "12"})
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        for k in range(13):
            picture = np.full((64, 64, 3), 10 * k, np.uint8)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
        file.mux(stream.encode())
    np.testing.assert_allclose(open_frames(tmp_path / "a.avif").times, np.arange(13) / 60, atol=6e-4)


def test_pages_of_a_tiff_are_no_clip(tmp_path):
    images = [Image.new("RGB", (8, 8), (k, 0, 0)) for k in range(3)]
    images[0].save(tmp_path / "a.tif", save_all=True, append_images=images[1:])
    with pytest.raises(DataError, match="3 pages without times; write each as an image into a folder"):
        open_frames(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["01-02-2024 10.00.00.png", "02-01-2024 10.00.00.png"], "whether day or month stands first in 01-02-2024"),
        (["01-02-2024 10.00.00.png", "01-02-2024 10.00.05.png"], ""),
        (["13-02-2024 10.00.00.png", "14-01-2024 10.00.00.png"], ""),
        (["shot 12.00.00 PM.png", "shot 1.00.00 PM.png"], "clocks of 12 hours"),
        (["cam 1pma.png", "cam 2pma.png"], ""),
        (["a 23-59-59.png", "a 00-00-01.png"], "whether these times of day go on past midnight"),
        (["a 13-59-59.png", "a 14-00-01.png"], ""),
        (["2024-02-13 23.59.59.png", "2024-02-14 00.00.01.png"], ""),
    ],
)
def test_names_that_may_mean_two_times_are_told(names, words, tmp_path, capfd):
    in_order([tmp_path / name for name in names])
    told = capfd.readouterr().err
    assert words in told if words else not told


@pytest.mark.parametrize("kind", ["webp", "png", "tif", "preview.tif"])
def test_files_of_several_pictures_are_no_frames(tmp_path, kind):
    """A folder of stickers is no clip of their first pictures; a TIFF may hold a smaller one of itself."""
    pictures = [Image.new("RGB", (40, 30), (9 * k, 0, 0)) for k in range(3)]
    pictures = [pictures[0], pictures[0].resize((20, 15))] if kind == "preview.tif" else pictures
    for number in range(2):
        pictures[0].save(tmp_path / f"{number}.{kind}", save_all=True, append_images=pictures[1:])
    for read in (
        lambda: next(open_frames(tmp_path).read([0])),
        lambda: read_mask(tmp_path / f"0.{kind}"),
        lambda: FolderSource(tmp_path),
    ):
        if kind == "preview.tif":
            read()
            continue
        with pytest.raises(
            DataError, match=f"0.{kind}: 3 pictures in one file; an animation is a clip itself, name it"
        ):
            read()


def tiff_of_planes(pixels: np.ndarray, order: str, alpha: int) -> bytes:
    """A TIFF of pixels (H,W,C), u1 or u2, whose channels lie one after the other; alpha: 1 associated, 2 not, of four."""
    height, width, count = pixels.shape
    planes = [pixels[..., k].astype(pixels.dtype.newbyteorder(order)).tobytes() for k in range(count)]
    tags = [(256, [width]), (257, [height]), (258, [8 * pixels.itemsize] * count), (259, [1]), (262, [2])]
    starts = [8 + len(planes[0]) * k for k in range(count)]
    tags += [(273, starts), (277, [count]), (278, [height]), (279, [len(planes[0])] * count), (284, [2])]
    tags += [(338, [alpha])] * (count == 4)
    at = 8 + sum(map(len, planes))
    far, head = at + 2 + 12 * len(tags) + 4, struct.pack(order + "H", len(tags))
    lists = b""
    for tag, values in tags:
        whole = struct.pack(f"{order}{len(values)}I", *values)
        head += struct.pack(order + "HHI", tag, 4, len(values))
        head += whole if len(values) == 1 else struct.pack(order + "I", far + len(lists))
        lists += whole if len(values) > 1 else b""
    mark = b"II" if order == "<" else b"MM"
    return mark + struct.pack(order + "HI", 42, at) + b"".join(planes) + head + bytes(4) + lists


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", ["u1", "u2"])
@pytest.mark.parametrize(("channels", "alpha"), [(3, 0), (4, 1), (4, 2)])
def test_channels_of_a_tiff_may_lie_one_after_the_other(tmp_path, order, kind, channels, alpha):
    straight = np.random.default_rng(0).integers(40, 256, (9, 13, channels))
    stored = straight.astype(float)
    if alpha == 1:
        stored[..., :3] *= stored[..., 3:] / 255
    stored = np.round(stored * (257 if kind == "u2" else 1)).astype(kind)
    (tmp_path / "a.tif").write_bytes(tiff_of_planes(stored, order, alpha))
    with open_image(tmp_path / "a.tif") as image:
        found = np.asarray(as_shown(image).convert("RGBA")).astype(int)
    np.testing.assert_allclose(found[..., :channels], straight, atol=6 if alpha == 1 else 1)


def gray_tiff(data: bytes, order: str, tags: dict[int, int]) -> bytes:
    """Returns a TIFF of one strip of 4x3 gray pixels in this byte order ("<" or ">"), with tags beside those of every one."""
    told = sorted(({256: 4, 257: 3, 259: 1, 262: 1, 273: 8, 277: 1, 278: 3, 279: len(data)} | tags).items())
    entries = b"".join(struct.pack(f"{order}HHII", tag, 4, 1, value) for tag, value in told)
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}I", 8 + len(data))
    return head + data + struct.pack(f"{order}H", len(told)) + entries + bytes(4)


@pytest.mark.parametrize(
    ("kind", "tags", "words"),
    [
        ("<u2", {258: 12}, "a TIFF of 12 bits a channel"),  # nearly black in Pillow
        ("<u4", {258: 32}, "gray from -?[0-9]+ to [0-9]+; expected 0 to 255"),  # white
        (">f4", {258: 32, 259: 8, 339: 3}, "compressed numbers of 32 bits, high byte first"),  # any numbers at all
        (">i2", {258: 16, 259: 8, 339: 2}, "compressed numbers of 16 bits, high byte first"),
    ],
)
def test_gray_that_pillow_changes_is_refused(tmp_path, kind, tags, words):
    data = np.linspace(1, 2**31 if kind == "<u4" else 200, 12).astype(kind).tobytes()
    (tmp_path / "a.tif").write_bytes(gray_tiff(zlib.compress(data) if tags.get(259) else data, kind[0], tags))
    with pytest.raises(DataError, match=f"a.tif: {words}"):
        read_rgba(tmp_path / "a.tif")


def tell(path: Path, kind: bytes, *numbers: int) -> None:
    """Puts numbers, in hundred thousandths, behind the header of a PNG."""
    data = path.read_bytes()
    chunk = kind + struct.pack(f">{len(numbers)}I", *numbers)
    told = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    path.write_bytes(data[:33] + told + data[33:])


def test_primaries_of_an_hdr_clip_without_its_curve_are_told(tmp_path, capsys):
    for name, xy in (
        ("wide", (70800, 29200, 17000, 79700, 13100, 4600)),
        ("plain", (64000, 33000, 30000, 60000, 15000, 6000)),
    ):
        (tmp_path / name).mkdir()
        Image.new("RGB", (8, 8), (200, 30, 30)).save(tmp_path / name / "0.png")
        tell(tmp_path / name / "0.png", b"cHRM", 31270, 32900, *xy)
        read_rgba(tmp_path / name / "0.png")
        assert ("primaries of BT.2020 alone (cHRM)" in capsys.readouterr().err) is (name == "wide")


def test_frames_that_ffmpeg_took_from_a_video_show_as_the_video(tmp_path):
    """Before it had cICP, FFmpeg wrote the gamma of the camera's curve beside unchanged levels of BT.709, 601 and 2020."""
    colors = np.arange(0, 240, 5, dtype=np.uint8).reshape(4, 4, 3)
    Image.fromarray(colors).save(tmp_path / "a.png")
    tell(tmp_path / "a.png", b"gAMA", round(100_000 / 1.961))
    np.testing.assert_array_equal(read_rgba(tmp_path / "a.png")[..., :3], colors)


def test_the_gamma_of_gray_counts_in_sixteen_bits_as_in_eight(tmp_path):
    gray = np.linspace(0, 255, 48).astype(np.uint8).reshape(6, 8)
    for name, own in (("8", gray), ("16", gray.astype(np.uint16) * 257)):
        Image.fromarray(own).save(tmp_path / f"{name}.png")
        tell(tmp_path / f"{name}.png", b"gAMA", 100_000)
    eight, sixteen = (read_rgba(tmp_path / f"{name}.png") for name in ("8", "16"))
    np.testing.assert_array_equal(sixteen, eight)
    assert not np.array_equal(eight[..., 0], gray)
