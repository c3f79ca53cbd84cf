"""`prepare video`: frames in every naming, cut-outs, one crop for a clip, further views, and what bad clips are told."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from unittest import mock

import av
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from dpcli.errors import DataError, UsageError
from dpcli.ops.cameras import orbit_of, orbit_pose
from dpcli.prepare.decode.color_frames import frame_numbers, open_frames
from dpcli.prepare.views import matting, video
from dpcli.prepare.views.given_views import read_cameras
from dpcli.prepare.views.orbit_world import shares_of_boxes, up_of_cameras
from dpcli.prepare.views.square_crop import Crop, crop_around, resize, visible_box
from dpcli.prepare.views.transforms_json import is_transforms, transforms_clip, transforms_config
from dpcli.prepare.views.video import VideoOptions, spread_frames, video_clip
from dpcli.prepare.views.views_check import ClipIndex
from dpcli.runtime.clips.video_frames import frame_times, lasts
from dpcli.store import ViewsReader
from tests.support.commands import exit_code, piped

RED = (200, 40, 30)


def disc(center: tuple[float, float], radius: float, size: tuple[int, int] = (64, 48), color=RED) -> np.ndarray:
    """u8 (H,W,4): a disc with an exact soft edge (4 x 4 samples a pixel)."""
    width, height = size
    y, x = (np.mgrid[: 4 * height, : 4 * width] + 0.5) / 4
    inside = ((x - center[0]) ** 2 + (y - center[1]) ** 2 <= radius**2).astype(float)
    alpha = inside.reshape(height, 4, width, 4).mean(axis=(1, 3))
    rgba = np.zeros((height, width, 4), np.uint8)
    rgba[alpha > 0, :3] = color
    rgba[..., 3] = np.round(255 * alpha)
    return rgba


def on(rgba: np.ndarray, background=(255, 255, 255)) -> np.ndarray:
    alpha = rgba[..., 3:] / 255
    return np.round(rgba[..., :3] * alpha + np.array(background) * (1 - alpha)).astype(np.uint8)


def moving(frames: int = 4, **options) -> list[np.ndarray]:
    return [disc((20 + 5 * k, 24), 8, **options) for k in range(frames)]


def save(folder: Path, pictures: list[np.ndarray], pattern: str = "{}.png") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for number, picture in enumerate(pictures):
        path = folder / pattern.format(number)
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(picture).save(path)
    return folder


def read(clip) -> dict[tuple[int, int], np.ndarray]:
    return {(view, frame): rgba for view, frame, rgba in clip.pictures()}


def centroid(rgba: np.ndarray) -> np.ndarray:
    """Middle of the alpha, pixels (x, y), pixel centers at +0.5."""
    weight = rgba[..., 3].astype(float)
    y, x = np.mgrid[: len(rgba), : rgba.shape[1]] + 0.5
    return np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()


SMALL = VideoOptions(size=64)


@pytest.mark.parametrize(
    "pattern",
    ["{}.png", "{}_rgba.png", "{:03d}.png", "{:03}_rgba.png", "frame_{:04d}.png", "4_cam2_{}.webp", "v1-{}-2.png"],
)
def test_every_naming_is_ordered_by_its_number(tmp_path, pattern):
    pictures = [disc((20 + 2 * k, 24), 8) for k in range(12)]
    frames = open_frames(save(tmp_path / "clip", pictures, pattern))
    assert frames.numbers == tuple(range(12))
    for picture, found in zip(pictures, frames.read(range(12)), strict=True):
        np.testing.assert_array_equal(picture[..., 3], found[..., 3])


@given(st.lists(st.integers(0, 10**6), unique=True, min_size=2, max_size=30), st.sampled_from(["", "7_", "a3b"]))
def test_numbers_survive_any_prefix_and_suffix(numbers, prefix):
    assert frame_numbers([f"{prefix}{number}_rgba" for number in numbers]) == numbers


@pytest.mark.parametrize(
    "stems",
    [
        [f"1305031102.{675304 + 77 * k:06d}" for k in range(4)] + [f"1305031103.{1000 + 77 * k:06d}" for k in range(4)],
        [f"{h:02d}-{m:02d}-{s:02d}" for h, m, s in ((9, 59, 58), (9, 59, 59), (10, 0, 0), (10, 0, 1), (10, 1, 0))],
        [f"{k:03d}_{noise}" for k, noise in enumerate((77, 3, 500, 41))],
    ],
)
def test_names_of_several_numbers_are_read_from_left_to_right(tmp_path, stems):
    pictures = [disc((20 + 2 * k, 24), 8) for k in range(len(stems))]
    (tmp_path / "clip").mkdir()
    for k in np.random.default_rng(0).permutation(len(stems)):
        Image.fromarray(pictures[k]).save(tmp_path / "clip" / f"{stems[k]}.png")
    frames = open_frames(tmp_path / "clip")
    assert [name[:-4] for name in frames.names] == stems and frames.numbers == tuple(range(len(stems)))
    assert frame_numbers(stems[::-1]) == list(range(len(stems)))[::-1]


def test_frame_times_follow_the_stamps_where_a_rate_cannot():
    steady = np.arange(12) / 29.97
    np.testing.assert_array_equal(frame_times(np.round(steady, 3), 29.97), steady)  # milliseconds only
    np.testing.assert_array_equal(frame_times(np.zeros(12), 29.97), steady)  # a container without stamps
    assert frame_times(np.zeros(12), None) is None
    uneven = np.array([0.5, 0.55, 0.6, 0.9, 1.2, 1.5])
    np.testing.assert_allclose(frame_times(uneven, 4.0), uneven - 0.5)
    np.testing.assert_allclose(frame_times(uneven, None), uneven - 0.5)
    stamps = np.array([0, 0.033, 0.067, 0.9, 0.9, 0.933, 1.5])  # two frames at 0.9, as browsers record
    twice = frame_times(stamps, 30.0)
    np.testing.assert_allclose(twice, stamps, atol=2e-4)
    assert (np.diff(twice) > 0).all() and frame_times(np.floor(np.arange(12) / 4), None) is None
    assert lasts(uneven - 0.5, 1.3) and not lasts(uneven - 0.5, 3.0) and not lasts(np.zeros(1), 3.0)


def uneven_video(path: Path, kept: str = "lt(n,10)+not(mod(n,6))") -> Path:
    """Two seconds at 20 frames a second of which ffmpeg drops some: the first half second whole, then every sixth."""
    import imageio_ffmpeg

    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-v",
        "error",
        "-f",
        "lavfi",
        "-i",
        "testsrc=size=64x48:rate=20:duration=2",
    ]
    subprocess.run([*command, "-vf", f"select='{kept}'", "-fps_mode", "vfr", str(path)], check=True, timeout=60)
    return path


@pytest.mark.parametrize("name", ["clip.mkv", "clip.webm", "clip.mp4"])
def test_a_recording_of_uneven_rate_keeps_its_times(tmp_path, name):
    frames = open_frames(uneven_video(tmp_path / name))
    expected = [n / 20 for n in range(40) if n < 10 or n % 6 == 0]
    np.testing.assert_allclose(frames.times, expected, atol=2e-3)
    assert len(list(frames.read(range(len(expected))))) == len(expected)


@pytest.mark.parametrize("name", ["clip.mkv", "clip.webm"])
def test_half_a_recording_is_told(tmp_path, name):
    path = uneven_video(tmp_path / name, "1")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DataError, match="can be decoded; it is truncated or damaged|not a readable video"):
        open_frames(path)


def test_gif_and_video_give_the_same_frames_as_the_folder(tmp_path):
    import cv2

    pictures = [on(picture) for picture in moving(5)]
    folder = save(tmp_path / "clip", pictures)
    stills = [Image.fromarray(picture) for picture in pictures]
    stills[0].save(tmp_path / "clip.gif", save_all=True, append_images=stills[1:], duration=[100, 100, 200, 100, 100])
    writer = cv2.VideoWriter(str(tmp_path / "clip.avi"), cv2.VideoWriter_fourcc(*"FFV1"), 10.0, (64, 48))
    for picture in pictures:
        writer.write(picture[..., ::-1])
    writer.release()
    expected = list(open_frames(folder).read([0, 2, 4]))
    for name, times in (("clip.gif", (0, 0.1, 0.2, 0.4, 0.5)), ("clip.avi", (0, 0.1, 0.2, 0.3, 0.4))):
        frames = open_frames(tmp_path / name)
        assert len(frames) == 5 and np.allclose(frames.times, times)
        for want, have in zip(expected, frames.read([0, 2, 4]), strict=True):
            assert np.abs(want.astype(int) - have).max() <= (12 if name.endswith("gif") else 1)  # gif: 256 colors
    clip = video_clip(tmp_path / "clip.gif", VideoOptions(frames=3, size=32))
    np.testing.assert_allclose(clip.header.time, [0, 0.2, 0.5])


def test_alpha_comes_back_from_a_plain_background():
    truth = disc((30.3, 24.6), 14)
    for background in ((255, 255, 255), (0, 0, 0), (20, 160, 60)):
        rgba, gaps = matting.key_out(on(truth, background), np.array(background, np.float32))
        assert gaps == 0
        assert np.abs(rgba[..., 3].astype(int) - truth[..., 3]).max() <= 20  # a faint share below the tolerance is lost
        assert np.abs(rgba[..., 3].astype(int) - truth[..., 3]).mean() < 0.5
        seen = rgba[..., 3] > 60
        assert np.abs(rgba[seen][:, :3].astype(int) - RED).max() <= 12  # no fringe of the background
        assert np.abs(on(rgba, background).astype(int) - on(truth, background)).max() <= 15


def test_holes_only_where_the_background_shines_through():
    picture = on(disc((32, 24), 20))
    picture[11:13, 31:33] = 255  # a small highlight
    picture[20:30, 18:26] = 246  # an eye: bright, but not the background's white
    picture[20:30, 38:46] = 255  # a gap
    white = np.full(3, 255, np.float32)
    expected = {"keep": (255, 255, 255, 0), "auto": (255, 255, 0, 80), "cut": (0, 0, 0, 164)}
    for holes, (highlight, eye, gap, pixels) in expected.items():
        rgba, count = matting.key_out(picture, white, holes=holes)
        assert (rgba[12, 32, 3], rgba[24, 22, 3], rgba[24, 42, 3], count) == (highlight, eye, gap, pixels), holes


def test_the_plain_background_is_found_beside_an_object_that_touches_the_border():
    rng = np.random.default_rng(0)
    picture = np.clip(rng.normal((90, 120, 200), 2, (40, 60, 3)), 0, 255).astype(np.uint8)
    picture[10:, 20:40] = RED
    color = matting.plain_background([matting.border_pixels(picture)], ["a"], matting.TOLERANCE)
    np.testing.assert_allclose(color, (90, 120, 200), atol=1.5)
    busy = rng.integers(0, 256, (40, 60, 3), np.uint8)
    with pytest.raises(DataError, match="not plain"):
        matting.plain_background([matting.border_pixels(busy)], ["a"], matting.TOLERANCE)


def test_a_noisy_background_without_any_tolerance_is_told():
    noisy = np.random.default_rng(0).integers(120, 124, (40, 40, 1), np.uint8).repeat(3, axis=2)
    with pytest.raises(DataError, match="not plain: 0% of the border is #7"):
        matting.plain_background([matting.border_pixels(noisy)], ["frame"], 0.0)


def test_one_crop_keeps_the_motion(tmp_path):
    folder = save(tmp_path / "clip", moving(4))
    clip = video_clip(folder, VideoOptions(size=50, border=0.2))
    found = read(clip)
    crop = crop_around((12, 16, 43, 32), 0.2)  # discs from x = 12 to 43
    assert crop.side == round(31 / 0.8)
    scale = 50 / crop.side
    for frame in range(4):
        expected = (np.array([20 + 5 * frame, 24]) - (crop.left, crop.top)) * scale
        np.testing.assert_allclose(centroid(found[0, frame]), expected, atol=0.1)
    boxes = np.array([visible_box(picture[..., 3]) for picture in found.values()])
    assert boxes[:, 2].max() - boxes[:, 0].min() == pytest.approx(0.8 * 50, abs=2)
    whole = read(video_clip(folder, VideoOptions(size=64, recenter=False)))
    np.testing.assert_array_equal(whole[0, 2][8:56], moving(4)[2])  # 64 x 48 padded to a square, not resampled


@given(st.integers(-20, 40), st.integers(-20, 40), st.integers(5, 60), st.integers(5, 60))
def test_intrinsics_follow_the_crop(left, top, side, size):
    crop, camera = Crop(left, top, side), np.array([[50.0, 0, 31], [0, 55.0, 23], [0, 0, 1]])
    point = np.array([0.3, -0.2, 2.0])
    u, v = (camera @ point)[:2] / 2
    np.testing.assert_allclose(
        (crop.intrinsics(camera, size) @ point)[:2] / 2, [(u - left) * size / side, (v - top) * size / side], atol=1e-9
    )


def test_pictures_follow_the_same_crop_as_intrinsics():
    picture, crop = disc((30.5, 20.25), 9), Crop(12, 4, 36)
    camera = np.array([[1.0, 0, 30.5], [0, 1.0, 20.25], [0, 0, 1]])  # the axis looks at the disc's middle
    for size in (18, 36, 72):
        np.testing.assert_allclose(centroid(crop.apply(picture, size)), crop.intrinsics(camera, size)[:2, 2], atol=0.05)


def test_resizing_does_not_bleed_hidden_colors():
    picture = disc((24, 24), 12, (48, 48))
    picture[picture[..., 3] == 0, :3] = (0, 255, 0)
    for size in (20, 100):
        small = resize(picture, size)
        assert np.abs(small[small[..., 3] > 30][:, :3].astype(int) - RED).max() <= 2


def test_a_stray_piece_does_not_widen_the_crop():
    picture = disc((40, 24), 12)
    alone = visible_box(picture[..., 3], 0.01)
    picture[2:4, 2:3] = 255
    assert visible_box(picture[..., 3], 0.01) == alone != visible_box(picture[..., 3])


def write_masks(path: Path, masks: list[np.ndarray]) -> Path:
    """Masks u8 (H,W) as a video."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10, options={"crf": "8"})
        stream.height, stream.width, stream.pix_fmt = *masks[0].shape, "yuv420p"
        for mask in masks:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.repeat(mask[..., None], 3, -1), "rgb24")))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize(("start", "said"), [(0, ""), (1, "masks in order: 1.png for 0.png to 3.png for 2.png")])
def test_masks_of_other_numbers_are_taken_in_order_and_told(tmp_path, capfd, start, said):
    """As trackers count frames from 0, and programs that write frames from 1."""
    discs = moving(3)
    folder = save(tmp_path / "clip", [on(picture) for picture in discs], "{}.png")
    for number, picture in enumerate(discs, start):
        save(tmp_path / "masks", [picture[..., 3]], f"{number}.png")
    assert len(read(video_clip(folder, VideoOptions(size=32, mask=tmp_path / "masks")))) == 3
    error = capfd.readouterr().err
    assert (said in error) if said else "in order" not in error


def test_masks_cut_a_busy_background(tmp_path):
    rng = np.random.default_rng(0)
    busy = [rng.integers(0, 256, (48, 64, 3), np.uint8) for _ in range(3)]
    discs = moving(3)
    folder = save(tmp_path / "clip", busy, "{:02d}.png")
    gray = save(tmp_path / "gray", [picture[..., 3] for picture in discs], "m_{}.png")
    ids = save(tmp_path / "ids", [(picture[..., 3] > 127).astype(np.uint8) for picture in discs])
    film = write_masks(tmp_path / "masks.mp4", [picture[..., 3] for picture in discs])
    for masks in (gray, ids, film):
        found = read(video_clip(folder, VideoOptions(size=64, recenter=False, mask=masks)))
        for frame in range(3):
            strong = discs[frame][..., 3] > 200
            np.testing.assert_array_equal(found[0, frame][8:56][strong][:, :3], busy[frame][strong])
            assert found[0, frame][8:56][discs[frame][..., 3] < 8].max() == 0
    save(tmp_path / "short", [discs[0][..., 3]])
    for number in (0, 1):  # of two objects in each frame
        save(tmp_path / "each", [picture[..., 3] for picture in discs], f"{{}}_{number}.png")
    save(tmp_path / "wide", [np.zeros((10, 10), np.uint8)] * 3)
    save(tmp_path / "inverse", [255 - picture[..., 3] for picture in discs])
    save(tmp_path / "empty", [np.zeros((48, 64), np.uint8)] * 3)
    save(
        tmp_path / "colors", [np.where(picture[..., 3:] > 127, RED, (0, 0, 255)).astype(np.uint8) for picture in discs]
    )
    write_masks(tmp_path / "short.mp4", [discs[0][..., 3]] * 2)
    write_masks(tmp_path / "dark.mp4", [np.zeros((48, 64), np.uint8)] * 3)
    for name, message in (
        ("short.mp4", "2 masks for 3 frames"),
        ("dark.mp4", "an empty mask"),
        ("colors", "every mask covers its whole picture, so nothing is cut out"),
        ("short", "1 mask for 3 frames"),
        ("each", "masks for 3 frames; expected one for each, named alike, with all its objects"),
        ("wide", "10x10.*64x48"),
        ("inverse", "inverted"),
        ("empty", "an empty mask"),
        ("none", "does not exist"),
    ):
        with pytest.raises(DataError, match=message):
            video_clip(folder, VideoOptions(size=64, mask=tmp_path / name))


def bad_clip(tmp_path: Path, kind: str) -> Path:
    rng = np.random.default_rng(0)
    clips = {
        "busy": [rng.integers(0, 256, (48, 64, 3), np.uint8) for _ in range(2)],
        "sizes": [disc((20, 20), 8), disc((20, 20), 8, (50, 48))],
        "white": [np.full((48, 64, 3), 255, np.uint8)] * 2,
        "one empty": [*moving(2), np.zeros((48, 64, 4), np.uint8)],
        "mixed": [disc((20, 20), 8), np.full((48, 64, 4), 255, np.uint8)],
        "nothing": [],
    }
    if kind in clips:
        return save(tmp_path / "clip", clips[kind])
    if kind == "corrupt png":
        folder = save(tmp_path / "clip", moving(3))
        (folder / "1.png").write_bytes((folder / "1.png").read_bytes()[:60])
        return folder
    path = tmp_path / {"corrupt mp4": "a.mp4", "corrupt gif": "a.gif", "text": "a.txt", "image": "a.png"}[kind]
    path.write_bytes(b"\0\0\0 ftypisom" + b"x" * 500)
    return path


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("busy", "not plain.*\n.*--mask FOLDER"),
        ("sizes", "1.png is 50x48, 0.png is 64x48"),
        ("white", "no object in any frame.*one color only"),
        ("one empty", r"no object in 1 frame: 2.png \(fully transparent\)\n.*--on-error skip"),
        ("mixed", "1 frame: 1.png without alpha"),
        ("nothing", "no frames"),
        ("corrupt png", "1.png: not a readable image"),
        ("corrupt mp4", "not a readable video|no frame can be decoded"),
        ("corrupt gif", "not a readable video"),  # the content tells what it is, not the name
        ("text", "unknown kind"),
        ("image", "not a readable video"),
    ],
)
def test_bad_clips_are_told_what_to_do(tmp_path, kind, message):
    with pytest.raises(DataError, match=message):
        video_clip(bad_clip(tmp_path, kind), SMALL)


def test_a_picture_of_another_size_is_refused_before_it_is_decoded(tmp_path, monkeypatch):
    """A damaged header may tell of 16 million pixels, which took 300 MB; pictures that EXIF turns are of one size."""
    folder = save(tmp_path / "clip", moving(3))
    turned = Image.Exif()
    turned[0x0112] = 6
    Image.fromarray(np.rot90(moving(1)[0])).save(folder / "1.png", exif=turned)
    assert video_clip(folder, SMALL).header is not None
    assert [item.problem for item in ClipIndex(folder, SMALL).items()] == [""] * 3
    Image.new("RGBA", (400, 400)).save(folder / "2.png")
    assert "400x400, 0.png is 64x48" in ClipIndex(folder, SMALL).items()[2].problem
    monkeypatch.setattr("dpcli.prepare.decode.color_frames.read_rgba", None)
    with pytest.raises(DataError, match="2.png is 400x400, 0.png is 64x48"):
        video_clip(folder, SMALL)


@pytest.mark.parametrize(("kind", "left"), [("one empty", [0, 1]), ("corrupt png", [0, 2])])
def test_skip_leaves_bad_frames_out_and_keeps_the_times(tmp_path, kind, left):
    clip = video_clip(bad_clip(tmp_path, kind), VideoOptions(size=32, on_error="skip", fps=10))
    np.testing.assert_allclose(clip.header.time, np.array(left) / 10)
    assert len(read(clip)) == 2


def test_a_truncated_video_is_refused(tmp_path):
    import cv2

    path = tmp_path / "a.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 16.0, (64, 48))
    rng = np.random.default_rng(0)
    for _ in range(30):
        writer.write(rng.integers(0, 256, (48, 64, 3), np.uint8))
    writer.release()
    assert len(open_frames(path)) == 30
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DataError, match="a.mp4"):
        open_frames(path)


def test_warnings_name_the_frames(tmp_path, capsys):
    pictures = [disc((x, 24), 8) for x in (20, 2, 60)]
    video_clip(save(tmp_path / "leaving", pictures), SMALL)
    assert "leaves the picture in 2 frames: 1.png, 2.png" in capsys.readouterr().err
    video_clip(save(tmp_path / "single", pictures[:1]), SMALL)
    assert "one frame only" in capsys.readouterr().err
    both = np.maximum(disc((14, 24), 8), disc((44, 24), 5))
    video_clip(save(tmp_path / "two", [both, both, pictures[0]]), SMALL)
    assert "several objects apart in 2 frames: 0.png, 1.png" in capsys.readouterr().err
    crumb = np.maximum(disc((14, 24), 8), disc((44, 24), 2))
    video_clip(save(tmp_path / "crumbs", [crumb, crumb, both]), SMALL)
    assert "several objects" not in capsys.readouterr().err
    gap = save(tmp_path / "gap", pictures[:1] * 5)
    (gap / "2.png").unlink()
    video_clip(gap, SMALL)
    assert "3.png follows 1.png" in capsys.readouterr().err


@pytest.mark.parametrize(("fitting", "cuts"), [(1 << 28, 4), (4 * 18 * 18, 7), (0, 8)])
def test_frames_are_cut_once_as_far_as_they_fit_into_memory(tmp_path, monkeypatch, fitting, cuts):
    monkeypatch.setattr(video, "_KEPT", fitting)
    cut = mock.Mock(side_effect=matting.key_out)
    monkeypatch.setattr(matting, "key_out", cut)
    pictures = read(video_clip(save(tmp_path, [on(picture) for picture in moving()]), SMALL))
    assert cut.call_count == cuts
    for (_, frame), picture in pictures.items():
        whole = matting.key_out(on(moving()[frame]), np.full(3, 255.0))[0]
        np.testing.assert_array_equal(picture, crop_around((12, 16, 43, 32), 0.2).apply(whole, 64))


def test_an_alpha_of_0_everywhere_is_none(tmp_path, capsys):
    pictures = [np.dstack([on(picture), np.zeros((48, 64), np.uint8)]) for picture in moving()]
    clip = read(video_clip(save(tmp_path / "clear", pictures), SMALL))
    assert "its alpha is 0 everywhere, which is none" in capsys.readouterr().err
    plain = read(video_clip(save(tmp_path / "plain", [picture[..., :3] for picture in pictures]), SMALL))
    assert all((clip[key] == plain[key]).all() for key in plain)


@pytest.mark.parametrize(("drift", "right", "told"), [(0, 50, True), (1, 50, False), (0, 86, False)])
def test_what_stands_still_beside_the_object_is_told(tmp_path, capsys, drift, right, told):
    """A small logo, which is hidden once; a small piece that moves is the object's, and one outside of the crop is none."""
    pictures = [on(disc((12 + 5 * k, 24), 8, size=(96, 48))) for k in range(7)]
    for k, picture in enumerate(pictures):
        picture[40 - drift * k : 43 - drift * k, right : right + 2] = 90 if k < 6 else 255
    video_clip(save(tmp_path, pictures), SMALL)
    said = "something apart from the object stands still in 2x3 pixels at (50, 40), as a logo does"
    assert (said in capsys.readouterr().err) is told


@pytest.mark.parametrize(("top", "left"), [(0, 40), (30, 0), (6, 8)])
def test_bars_around_a_picture_are_told(tmp_path, capsys, top, left):
    """A clip recorded from a screen: the white picture between black bars was the object, without a word."""
    inside = np.stack([on(picture) for picture in moving()])
    framed = np.pad(inside, ((0, 0), (top, top), (left, left), (0, 0)))
    video_clip(save(tmp_path / "framed", list(framed)), SMALL)
    assert f"ffmpeg -i IN -vf crop=64:48:{left}:{top} OUT" in (said := capsys.readouterr().err) and "leaves" not in said
    video_clip(save(tmp_path / "plain", list(inside)), SMALL)
    square = inside[0, 8:20, :16] // 2
    moved = [np.pad(square, ((k, 40 - k), (k, 60 - k), (0, 0))) for k in (9, 14)]
    video_clip(save(tmp_path / "moved", moved), SMALL)
    assert "rectangle" not in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["straight", "premultiplied", "black", "outlined", "hard"])
def test_colors_that_were_multiplied_by_alpha_are_told(tmp_path, capfd, kind):
    """A soft disc, textured; black, with a black outline, or with a hard one it is told nothing of."""
    y, x = np.mgrid[:96, :96] + 0.5
    away = np.hypot(x - 48, y - 48)
    for frame in range(2):
        rgba = np.zeros((96, 96, 4), np.uint8)
        rgba[..., 3] = 255 * np.clip((40 - away) / (0.01 if kind == "hard" else 4), 0, 1)
        rgba[..., :3] = 150 + 80 * np.sin(x[..., None] / 5 + frame + np.arange(3))
        if kind == "premultiplied":
            rgba[..., :3] = np.round(rgba[..., :3] * (rgba[..., 3:] / 255))
        if kind in ("black", "outlined"):
            rgba[away > (0 if kind == "black" else 33), :3] = 4
        Image.fromarray(rgba).save(tmp_path / f"{frame}.png")
    video_clip(tmp_path, VideoOptions(size=64))
    assert ("colors fade to black with the alpha in 2 frames" in capfd.readouterr().err) == (kind == "premultiplied")


def test_keep_takes_the_whole_picture(tmp_path):
    busy = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    found = read(video_clip(save(tmp_path / "c", [busy] * 2), VideoOptions(size=64, background="keep", recenter=False)))
    np.testing.assert_array_equal(found[0, 1][8:56, :, :3], busy)
    assert (found[0, 1][8:56, :, 3] == 255).all() and found[0, 1][:8].max() == 0


@pytest.mark.parametrize(
    "options",
    [
        {"border": 1.0},
        {"border": 0.3, "recenter": False},
        {"border": 0.3, "views": Path("views")},
        {"background": "pink"},
        {"background": "1,2"},
        {"background": "300,0,0"},
        {"fps": 0.0},
        {"holes": "some"},
        {"radius": 0.0},
        {"elevation": 91.0},
        {"elevation": -91.0},
        {"mask": Path("m"), "background": "white"},
        {"views_cameras": Path("c.json")},
        {"on_error": "go"},
        {"tolerance": 0.7},
    ],
)
def test_wrong_options_are_wrong_use(options):
    with pytest.raises(UsageError):
        VideoOptions(**options)


@given(st.integers(1, 500), st.integers(0, 100))
def test_frames_are_spread_from_the_first_to_the_last(total, count):
    chosen = spread_frames(total, count)
    assert len(chosen) == (min(count, total) or total) == len(set(chosen)) and chosen == sorted(chosen)
    assert chosen[0] == 0 and (chosen[-1] == total - 1 or len(chosen) == 1)


def six(folder: Path, frames: range) -> Path:
    for frame in frames:
        save(folder / f"{frame}_rgba", [disc((16 + view, 16 + frame), 9, (32, 32)) for view in range(6)])
    return folder


def test_views_of_stag4d_and_of_a_camera_file(tmp_path):
    folder = save(tmp_path / "ref", moving(3), "{}_rgba.png")
    views = six(tmp_path / "zero123", range(3))
    clip = video_clip(folder, VideoOptions(size=32, views=views, elevation=10.0))
    angles = np.rad2deg([orbit_of(pose)[:2] for pose in clip.header.world_to_camera])
    expected = [(0, 10), (30, 30), (90, -20), (150, 30), (210, -20), (270, 30), (330, -20)]
    np.testing.assert_allclose((angles - expected + 180) % 360, 180, atol=1e-9)
    assert clip.header.role == ["reference"] + ["train"] * 6
    found = read(clip)
    for view in range(6):  # only resized: no crop of their own
        np.testing.assert_allclose(centroid(found[view + 1, 2]), (16 + view, 18), atol=0.05)
    cameras = tmp_path / "cameras.json"
    cameras.write_text(
        json.dumps([{"azimuth": 90, "elevation": 0, "radius": 3}, {"azimuth": 180, "elevation": 5, "role": "test"}])
    )
    by_view = tmp_path / "by_view"
    for view in range(2):
        save(by_view / f"eval_{view}", [disc((10 + view, 16 + frame), 7, (32, 32)) for frame in range(3)])
    clip = video_clip(folder, VideoOptions(size=32, views=by_view, views_cameras=cameras))
    assert clip.header.role == ["reference", "train", "test"]
    assert orbit_of(clip.header.world_to_camera[1])[2] == pytest.approx(3)
    np.testing.assert_allclose(centroid(read(clip)[2, 1]), (11, 17), atol=0.05)


@pytest.mark.parametrize("by_frame", [False, True])
@pytest.mark.parametrize(
    ("names", "azimuths", "order", "told"),
    [
        (
            ["az-90", "az-30", "az30", "az150"],
            [-90, -30, 30, 150],
            [0, 1, 2, 3],
            "az-90 at 270, az-30 at 330, az30 at 30",
        ),
        (["r_330", "r_0", "r_90"], [330, 0, 90], [0, 1, 2], "r_330 at 330, r_0 at 0, r_90 at 90"),
        (["cam2", "cam10", "cam1"], [20, 100, 10], [2, 0, 1], "cam1 at 20, cam2 at 100, cam10 at 10"),
        (
            ["front", "left", "back"],
            [0, 90, 180],
            [2, 0, 1],
            "back at 0, front at 90, left at 180; taken in the order of",
        ),
    ],
)
def test_views_belong_to_the_cameras_that_their_names_say(tmp_path, capsys, by_frame, names, azimuths, order, told):
    """A sign or words in names make another order than the list's, which is noticed, or told."""
    clip = save(tmp_path / "clip", [disc((20 + 2 * k, 24), 8) for k in range(2)])
    for number, name in enumerate(names):
        for frame in range(2):
            place = tmp_path / "v" / (f"frame{frame}/{name}.png" if by_frame else f"{name}/{frame}.png")
            place.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(disc((24, 24), 8, color=(200, 40 + 40 * number, 30))).save(place)
    (tmp_path / "c.json").write_text(json.dumps([{"azimuth": a, "elevation": 0} for a in azimuths]))
    found = read(video_clip(clip, VideoOptions(size=64, views=tmp_path / "v", views_cameras=tmp_path / "c.json")))
    seen = [round((int(found[view, 1][32, 24, 1]) - 40) / 40) for view in range(1, len(names) + 1)]
    assert seen == order and told in capsys.readouterr().err


@pytest.mark.parametrize("recenter", [False, True])
@pytest.mark.parametrize("shape", [(32, 32), (61, 40), (40, 61)])
def test_the_angle_of_a_camera_spans_its_own_whole_pictures_height(tmp_path, shape, recenter):
    """A small ball is seen where each camera's intrinsics in the file say, of pictures of any shape, and where the first is cropped."""
    ball, (width, height) = np.array([0.35, -0.2, 0.1]), shape
    entries = [
        {"azimuth": 0, "elevation": 0},
        {"azimuth": 90, "elevation": 20, "fovy": 35},
        {"azimuth": 200, "elevation": -30},
    ]
    poses = [orbit_pose(*np.deg2rad([entry["azimuth"], entry["elevation"]])) for entry in entries]
    folders = [tmp_path / "ref", tmp_path / "views" / "view_0", tmp_path / "views" / "view_1"]
    for entry, pose, folder in zip(entries, poses, folders):
        x, y, depth = pose[:3, :3] @ ball + pose[:3, 3]
        focal = 0.5 * height / np.tan(0.5 * np.deg2rad(entry.get("fovy", 50)))
        save(folder, [disc((width / 2 + focal * x / depth, height / 2 + focal * y / depth), 3, shape)])
    (tmp_path / "c.json").write_text(json.dumps(entries[1:]))
    options = VideoOptions(
        size=64, fovy=50, recenter=False, views=tmp_path / "views", views_cameras=tmp_path / "c.json"
    )
    clip = video_clip(folders[0], options)
    for view, picture in enumerate(read(clip).values()):
        seen = clip.header.intrinsics[view] @ (poses[view][:3, :3] @ ball + poses[view][:3, 3])
        np.testing.assert_allclose(centroid(picture), seen[:2] / seen[2], atol=0.1)


@pytest.mark.parametrize("scale, told", [(np.pi / 180, True), (1, False)])
def test_cameras_in_radians_are_told(tmp_path, capfd, scale, told):
    angles = [(0, 10), (90, 10), (200, -20)]
    entries = [{"azimuth": scale * azimuth, "elevation": scale * elevation} for azimuth, elevation in angles]
    (tmp_path / "c.json").write_text(json.dumps(entries))
    read_cameras(tmp_path / "c.json")
    assert ("are they radians?" in capfd.readouterr().err) == told


def test_views_belong_to_the_frames_that_are_used(tmp_path):
    folder = save(tmp_path / "ref", moving(6))
    clip = video_clip(folder, VideoOptions(frames=3, size=32, views=six(tmp_path / "views", range(6))))
    found = read(clip)
    for row, frame in enumerate(spread_frames(6, 3)):
        np.testing.assert_allclose(centroid(found[1, row]), (16, 16 + frame), atol=0.05)


@pytest.mark.parametrize(
    ("names", "of_view", "told"),
    [("view{}", True, False), ("Cam_{}", True, False), ("{}_rgba", False, False), ("{}", False, True)],
)
def test_as_many_frames_as_views_are_told_apart_by_the_names_of_folders(tmp_path, capfd, names, of_view, told):
    folder = save(tmp_path / "ref", moving(6))
    for outer in range(6):
        own = [disc((16 + outer, 16 + inner), 7, (32, 32)) for inner in range(6)]
        save(tmp_path / "views" / names.format(outer), own)
    found = read(video_clip(folder, VideoOptions(size=32, views=tmp_path / "views")))
    x, y = (1, 4) if of_view else (4, 1)
    np.testing.assert_allclose(centroid(found[1 + 1, 4]), (16 + x, 16 + y), atol=0.05)
    assert ("6 folders of 6 pictures are taken for FRAME/VIEW.png" in capfd.readouterr().err) == told


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        ("{}", "list of cameras"),
        ("[]", "list of cameras"),
        ("[1", "not readable JSON"),
        ('[{"azimuth": 1}]', "camera 0"),
        ('[{"azimuth": 1, "elevation": "x"}]', "finite number"),
        ('[{"azimuth": 1, "elevation": NaN}]', "finite number"),
        ('[{"azimuth": 1, "elevation": 1, "fov": 3}]', "camera 0"),
        ('[{"azimuth": 1, "elevation": 1, "role": "reference"}]', "train or test"),
        ('[{"azimuth": 1, "elevation": 95}]', "-90"),
        ('[{"azimuth": 1, "elevation": 1}]', "3 folders of 6 pictures"),
    ],
)
def test_bad_cameras_of_views(tmp_path, cameras, message):
    path = tmp_path / "cameras.json"
    path.write_text(cameras)
    folder, views = save(tmp_path / "ref", moving(3)), six(tmp_path / "views", range(3))
    with pytest.raises(DataError, match=message):
        video_clip(folder, VideoOptions(size=32, views=views, views_cameras=path))


def test_views_without_cameras_frames_or_objects(tmp_path):
    folder = save(tmp_path / "ref", moving(3))
    for frame in range(3):
        save(tmp_path / "four" / str(frame), [disc((16, 16), 9, (32, 32))] * 4)
    with pytest.raises(DataError, match="--views-cameras"):
        video_clip(folder, VideoOptions(size=32, views=tmp_path / "four"))
    with pytest.raises(DataError, match="no pictures of frame 0"):
        video_clip(folder, VideoOptions(size=32, views=six(tmp_path / "late", range(1, 4))))
    with pytest.raises(DataError, match="no folders inside"):
        video_clip(folder, VideoOptions(size=32, views=folder))
    views = six(tmp_path / "hollow", range(3))
    Image.fromarray(np.zeros((32, 32, 4), np.uint8)).save(views / "1_rgba" / "4.png")
    with pytest.raises(DataError, match="4.png: no object in this view"):
        read(video_clip(folder, VideoOptions(size=32, views=views)))


# ---- transforms_*.json -------------------------------------------------------------------------------------------------


def blender_folder(folder: Path, cameras: int = 3, frames: int = 3, moving_camera: bool = False) -> tuple[Path, list]:
    """A ball at (0.5, -0.3, 1) of radius 0.4 that rises, seen by still cameras in Blender's world (z up, OpenGL axes)."""
    angle_x, width, height, rows, poses = 0.7, 64, 48, [], []
    focal = 0.5 * width / np.tan(angle_x / 2)
    for view in range(cameras):
        for frame in range(frames):
            azimuth = 0.4 + 1.7 * view + (0.2 * frame if moving_camera else 0)
            place = np.array([4 * np.cos(azimuth), 4 * np.sin(azimuth), 2.0])
            back = place / np.linalg.norm(place)
            right = np.cross([0, 0, 1], back) / np.linalg.norm(np.cross([0, 0, 1], back))
            pose = np.eye(4)
            pose[:3] = np.column_stack([right, np.cross(back, right), back, place])
            ball = np.array([0.2, -0.1, 0.1 + 0.1 * frame])
            x, y, z = pose[:3, :3].T @ (ball - place)
            center = (width / 2 + focal * x / -z, height / 2 - focal * y / -z)
            name = f"train/r_{view}_{frame}"
            (folder / "train").mkdir(parents=True, exist_ok=True)
            Image.fromarray(disc(center, 0.4 * focal / -z)).save(folder / f"{name}.png")
            rows.append({"file_path": f"./{name}", "time": frame / (frames - 1), "transform_matrix": pose.tolist()})
        poses.append(pose)
    (folder / "transforms_train.json").write_text(json.dumps({"camera_angle_x": angle_x, "frames": rows}))
    return folder, poses


@pytest.mark.parametrize(("high", "more"), [(True, {}), (True, {"fl_x": 80}), (False, {})])
def test_an_angle_across_pictures_higher_than_wide_is_doubted(tmp_path, capsys, high, more):
    folder, _ = blender_folder(tmp_path / "scene")
    for file in folder.glob("train/*.png"):
        picture = Image.open(file).convert("RGBA")
        Image.fromarray(np.pad(np.array(picture), ((20, 20), (0, 0), (0, 0))) if high else np.array(picture)).save(file)
    path = folder / "transforms_train.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | more))
    transforms_clip(folder, SMALL)
    assert ("camera_angle_x is taken for the angle across" in capsys.readouterr().err) == (high and not more)


def test_known_cameras_are_turned_into_our_world_exactly(tmp_path):
    folder, poses = blender_folder(tmp_path / "scene")
    assert is_transforms(folder) and not is_transforms(tmp_path)
    clip = transforms_clip(folder, VideoOptions(size=64, fps=10))
    header = clip.header
    np.testing.assert_allclose(header.time, [0, 0.1, 0.2])
    fewer = transforms_clip(folder, VideoOptions(size=64, fps=10, frames=2)).header
    np.testing.assert_allclose(fewer.time, [0, 0.2])  # as long a clip, of fewer pictures
    azimuths = np.rad2deg([orbit_of(pose)[0] for pose in header.world_to_camera])
    assert abs(azimuths[0]) < 1e-6
    assert all(orbit_of(pose)[1] > 0 for pose in header.world_to_camera)  # Blender's up became ours
    # the ball's middle, found from all cameras in our world, is one point: rays through the centroids meet
    found = read(clip)
    heights = []
    for frame in range(3):
        rays, centers = [], []
        for view in range(3):
            u = np.array([*centroid(found[view, frame]), 1])
            ray = header.world_to_camera[view, :3, :3].T @ np.linalg.inv(header.intrinsics[view]) @ u
            rays.append(ray / np.linalg.norm(ray))
            centers.append(-header.world_to_camera[view, :3, :3].T @ header.world_to_camera[view, :3, 3])
        across = np.eye(3) - np.einsum("vi,vj->vij", rays, rays)
        point = np.linalg.solve(across.sum(0), np.einsum("vij,vj->i", across, np.array(centers)))
        off = [np.linalg.norm(a @ (point - c)) for a, c in zip(across, centers)]
        assert max(off) < 0.02 and np.linalg.norm(point) < 0.4
        heights.append(point[1])
    assert (np.diff(heights) > 0.05).all()  # what rises in the scene rises along +y


def test_masks_that_the_file_names_cut_the_object_out(tmp_path):
    folder, _ = blender_folder(tmp_path / "scene")
    whole = read(transforms_clip(folder, VideoOptions(size=64)))
    data = json.loads((folder / "transforms_train.json").read_text())
    (folder / "masks").mkdir()
    for number, frame in enumerate(data["frames"]):
        path = folder / f"{frame['file_path']}.png"
        rgba = np.asarray(Image.open(path))
        Image.fromarray(rgba[..., 3]).save(folder / "masks" / f"{number}.png")
        Image.fromarray(np.dstack([rgba[..., :3], np.full(rgba.shape[:2], 255, np.uint8)])).save(path)
        frame["mask_path"] = f"masks/{number}.png"
    data.update(camera_model="OPENCV", k1=0.0, k2=0.0)  # no distortion is no lens
    (folder / "transforms_train.json").write_text(json.dumps(data))
    cut = read(transforms_clip(folder, VideoOptions(size=64)))
    assert cut.keys() == whole.keys()
    for key, picture in cut.items():
        np.testing.assert_array_equal(picture, whole[key])


def test_a_moving_camera_is_told_apart(tmp_path):
    folder, _ = blender_folder(tmp_path / "scene", cameras=1, moving_camera=True)
    with pytest.raises(DataError, match="the camera moves"):
        transforms_clip(folder, SMALL)


FOCAL = 0.5 * 64 / np.tan(0.7 / 2)
LENS = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": 32, "cy": 24, "w": 64, "h": 48}
DIALECTS = {
    "nerfstudio": lambda d: d.update(**LENS, camera_model="OPENCV", k1=0.0, p1=0.0, applied_transform=[[1, 0, 0, 0]]),
    "instant-ngp": lambda d: d.update(**LENS, camera_angle_y=0.5, aabb_scale=4, offset=[0, 0, 0], is_fisheye=False),
    "of larger pictures": lambda d: d.update({key: 2 * value for key, value in LENS.items()}),
    "a lens a frame": lambda d: [frame.update({key: 2 * LENS[key] for key in LENS}) for frame in d["frames"]],
    "vertical angle": lambda d: d.update(camera_angle_y=2 * np.arctan(24 / FOCAL) + 0 * d.pop("camera_angle_x")),
    "3 x 4": lambda d: [frame.update(transform_matrix=frame["transform_matrix"][:3]) for frame in d["frames"]],
    "other names": lambda d: [
        frame.update(file_path=frame["file_path"].replace("./train/", ".\\train\\..\\train\\") + ".png")
        for frame in d["frames"]
    ],
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_dialects_of_transforms_json_give_the_same_views(tmp_path, dialect):
    folder, _ = blender_folder(tmp_path / "scene", cameras=2)
    path = folder / "transforms_train.json"
    expected = transforms_clip(folder, SMALL).header
    data = json.loads(path.read_text())
    DIALECTS[dialect](data)
    path.write_text(json.dumps(data))
    (folder / "cameras of mine.json").write_text(path.read_text())
    for named in (folder, path, folder / "cameras of mine.json"):
        assert is_transforms(named)
        clip = transforms_clip(named, SMALL)
        np.testing.assert_allclose(clip.header.intrinsics, expected.intrinsics)
        np.testing.assert_allclose(clip.header.world_to_camera, expected.world_to_camera)
        np.testing.assert_allclose(clip.header.time, expected.time)
        assert clip.header.name == "scene"


@pytest.mark.parametrize(
    ("times", "fps", "seconds", "said"),
    [
        ((0, 0.25, 1), None, (0, 0.03125, 0.125), "0 to 1 are taken for shares of a clip of 16 frames per second"),
        ((0, 0.5, 2.5), None, (0, 0.5, 2.5), "0 to 2.5 are taken for seconds"),
        ((0, 0.5, 2.5), 10, (0, 0.04, 0.2), "0 to 2.5 are taken for shares of a clip of 10 frames per second"),
        ((10, 20, 50), 10, (0, 0.1, 0.4), "10 to 50 are taken for numbers of frames in steps of 10, 10 steps per"),
        ((10, 11, 14), 10, (0, 0.1, 0.4), "10 to 14 are taken for numbers of frames, 10 per second"),
        ((1.7e9, 1.7e9 + 0.5, 1.7e9 + 2), None, (0, 0.5, 2), "1700000000 to 1700000002 are taken for seconds"),
    ],
)
def test_times_of_transforms_json_are_seconds_numbers_or_shares(tmp_path, capsys, times, fps, seconds, said):
    folder, _ = blender_folder(tmp_path / "scene", cameras=2)
    path = folder / "transforms_train.json"
    data = json.loads(path.read_text())
    for number, frame in enumerate(data["frames"]):
        frame["time"] = times[number % 3]
    data["test_filenames"] = [frame["file_path"] for frame in data["frames"][3:]]
    path.write_text(json.dumps(data))
    header = transforms_clip(folder, VideoOptions(size=64, fps=fps)).header
    np.testing.assert_allclose(header.time, seconds)
    assert said in capsys.readouterr().err and header.role == ["reference", "test"]
    before = transforms_config(folder, SMALL)
    path.write_text(json.dumps({**data, "camera_angle_x": 0.8}))
    assert transforms_config(folder, SMALL) != before  # the cameras are an input, too


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("camera_angle_x"), "views without cameras"),
        (lambda d: d["frames"][0].pop("time"), "a still scene"),
        (lambda d: d["frames"][0].pop("transform_matrix"), "no 'transform_matrix'"),
        (lambda d: d["frames"][0].update(file_path="train/none"), "no such image"),
        (lambda d: d["frames"][0].update(file_path="../../x"), "outside the folder"),
        (lambda d: d["frames"][0].update(transform_matrix=[[1, 2], [3, 4]]), "4 x 4 numbers, nor 3 x 4"),
        (lambda d: d["frames"][0].update(time=None), "a still scene"),
        (lambda d: d["frames"][0].update(time="soon"), "time 'soon'; expected a number"),
        (lambda d: d["frames"][0].update(time=1e300), "time 1e.300; expected shares"),
        (lambda d: d.update(fl_x=float("nan")), "fl_x nan; expected a number"),
        (
            lambda d: d.update(fl_x=1.04),
            "a focal length of 1.04 pixels for pictures of 64x48; expected pixels, not shares",
        ),
        (lambda d: d.update(fl_x=0), "fl_x 0; expected more than 0"),
        (lambda d: d.update(camera_angle_x=1e-9), "a focal length of 6.4e.10 pixels .* no camera sees so little"),
        (lambda d: d.update(cx=0.5, cy=0.52), "a principal point at 0.5, 0.52; expected pixels, not shares"),
        (lambda d: d.update(distortion_params=[0.1, 0, 0, 0]), "distortion_params .0.1, 0, 0, 0.; expected pictures"),
        (lambda d: d.update(w=48, h=64), "is 64x48, its camera is of 48x64, which is another shape"),
        (lambda d: d["frames"][1].update(time=0), "r_0_1.png and r_0_0.png are of one camera at one time, 0"),
        (lambda d: d["frames"][1].update(fl_x=90), "the camera moves or zooms"),
        (lambda d: d.update(ftheta_p1=0.001), "ftheta_p1 0.001; expected pictures without lens"),
        (lambda d: d.update(rolling_shutter=[0, 0, 0.1, 0]), "rolling_shutter"),
        (lambda d: d["frames"][0].update(transform_matrix=np.diag([1, 1, -1, 1]).tolist()), "not a camera-to-world"),
        (lambda d: d.update(frames=[]), "no frames"),
        (lambda d: d.update(k1=-0.1, camera_model="OPENCV"), "k1 -0.1; expected pictures without lens distortion"),
        (lambda d: d["frames"][0].update(p2=0.01), "p2 0.01; expected"),
        (lambda d: d.update(camera_model="OPENCV_FISHEYE"), "camera_model OPENCV_FISHEYE"),
        (lambda d: d.update(is_fisheye=True), "fisheye"),
        (lambda d: d["frames"][0].update(mask_path="../m.png"), "outside the folder"),
        (lambda d: d.update(camera_angle_x=40.1), "camera_angle_x 40.1; expected radians, below pi"),
        (
            lambda d: d["frames"][0].update(transform_matrix=np.transpose(d["frames"][0]["transform_matrix"]).tolist()),
            "expected 0, 0, 0, 1 .is it transposed",
        ),
    ],
)
def test_bad_transforms(tmp_path, change, message):
    folder, _ = blender_folder(tmp_path / "scene", cameras=1)
    data = json.loads((folder / "transforms_train.json").read_text())
    change(data)
    (folder / "transforms_train.json").write_text(json.dumps(data))
    with pytest.raises(DataError, match=message):
        transforms_clip(folder, SMALL)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({}, ""),
        ({"fl_x": FOCAL, "camera_angle_y": 2 * np.arctan(24 / FOCAL)}, ""),
        ({"fl_x": 1.1 * FOCAL}, "3 cameras: fl_x 96.43 is taken, though camera_angle_x 0.7 makes it 87.66 pixels"),
        ({"fl_y": FOCAL, "camera_angle_y": 0.7}, "fl_y 87.66 is taken, though camera_angle_y 0.7 makes it 65.75"),
        (
            {"fl_x": 2 * FOCAL, "cx": 64, "cy": 48},
            "a principal point at 64, 48 in pictures of 64x48, far from their middle",
        ),
        ({"cx": 64, "cy": 48, "w": 128, "h": 96}, ""),
    ],
)
def test_a_lens_that_can_hardly_be_that_of_its_pictures_is_told(tmp_path, capsys, change, told):
    """Pictures that were made smaller beside the camera of the large ones, and numbers of one lens that disagree."""
    folder, _ = blender_folder(tmp_path / "scene")
    path = folder / "transforms_train.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    transforms_clip(folder, SMALL)
    said = capsys.readouterr().err
    assert told in said and ("warning" in said) == bool(told)


@pytest.mark.parametrize(
    ("listed", "tested", "roles"),
    [
        ((0, 1, 2), (2,), ["reference", "train", "test"]),
        ((0, 1, 2), (0,), ["reference", "train", "test"]),
        ((0, 1), (0, 1), ["reference", "train"]),
        ((0, 1), (0, 1, 2), ["reference", "train", "test"]),
        ((0, 1), (2,), ["reference", "train", "test"]),
    ],
)
def test_a_camera_listed_for_training_and_for_testing_is_of_one_of_them(tmp_path, capsys, listed, tested, roles):
    folder, _ = blender_folder(tmp_path / "scene")
    path = folder / "transforms_train.json"
    data = json.loads(path.read_text())
    for name, cameras in (("transforms_train.json", listed), ("transforms_test.json", tested)):
        frames = [data["frames"][3 * camera + frame] for camera in cameras for frame in range(3)]
        (folder / name).write_text(json.dumps({**data, "frames": frames}))
    assert transforms_clip(folder, SMALL).header.role == roles
    twice = len(set(listed) & set(tested))
    assert capsys.readouterr().err.count(f"{twice} of {len(listed) + len(tested)} cameras listed for training") == bool(
        twice
    )


def test_cameras_left_out_are_told_once(tmp_path, capfd):
    folder, _ = blender_folder(tmp_path / "scene")
    path = folder / "transforms_train.json"
    data = json.loads(path.read_text())
    path.write_text(json.dumps({**data, "frames": data["frames"][:-1]}))
    assert exit_code("prepare", "video", folder, "-o", tmp_path / "v.h5", "--size", "32") == 0
    assert capfd.readouterr().err.count("1 of 3 cameras without a picture at some of the 3 times") == 1


def seen_points(seed: int, views: int) -> tuple[np.ndarray, np.ndarray, list, list]:
    """Lenses, poses, and the exact boxes of points about the origin in pictures of 320x240, cut at their borders."""
    rng = np.random.default_rng(seed)
    points = np.c_[rng.normal(0, 0.3, (30, 3)) * rng.uniform(0.4, 1.6, 3), np.ones(30)]
    poses = np.stack([orbit_pose(*rng.uniform((0, -0.3), (6.3, 1)), rng.uniform(2, 4)) for _ in range(views)])
    poses[:, :2, 3] += rng.normal(0, 0.15, (views, 2))
    lenses = np.array(
        [
            [[f, 0, x], [0, g, y], [0, 0, 1]]
            for f, g, x, y in rng.uniform((250, 250, 140, 100), (400, 400, 180, 140), (views, 4))
        ]
    )
    boxes = []
    for lens, pose in zip(lenses, poses):
        pixels = points @ (lens @ pose[:3]).T
        pixels = np.clip(pixels[:, :2] / pixels[:, 2:], 0, (320, 240))
        boxes.append((*pixels.min(0), *pixels.max(0)))
    return lenses, poses, boxes, [(320, 240)] * views


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(1, 6))
def test_right_cameras_leave_all_of_every_box_possible(seed, views):
    shares = shares_of_boxes(*seen_points(seed, views))
    assert shares.shape == (views,) and shares.min() > 1 - 1e-6


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("wrong", ["inverted", "lens of larger pictures", "exchanged", "mirrored"])
def test_wrong_cameras_leave_less(seed, wrong):
    lenses, poses, boxes, sizes = seen_points(seed, 8)
    if wrong == "inverted":
        poses = np.linalg.inv(poses)
    elif wrong == "exchanged":
        poses = poses[[1, 0, *range(2, 8)]]
    elif wrong == "mirrored":
        poses = np.diag([1, -1, 1, 1.0]) @ poses @ np.diag([1, -1, 1, 1.0])
    else:
        lenses = lenses * np.array([2, 2, 1])[:, None]
    assert shares_of_boxes(lenses, poses, boxes, sizes).min() < 0.95


def test_cameras_that_contradict_one_another_are_told(tmp_path, capsys):
    """World to camera in place of camera to world, of cameras that don't look at the world's origin."""
    folder, _ = blender_folder(tmp_path / "scene")
    path = folder / "transforms_train.json"
    data = json.loads(path.read_text())
    for frame in data["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] += (0.5, 1, 0)
        frame["transform_matrix"] = np.linalg.inv(pose).tolist()
    path.write_text(json.dumps(data))
    transforms_clip(folder, SMALL)
    assert "scene: the cameras contradict one another: of the box around the object in r_" in capsys.readouterr().err


def test_a_camera_that_the_object_leaves_contradicts_no_other(tmp_path, capsys):
    folder, _ = blender_folder(tmp_path / "scene")
    for frame in (0, 2):
        Image.fromarray(np.zeros((48, 64, 4), np.uint8)).save(folder / f"train/r_1_{frame}.png")
    transforms_clip(folder, SMALL)
    assert "contradict" not in capsys.readouterr().err


@pytest.mark.parametrize("option", ["elevation", "radius", "fovy", "border"])
def test_options_of_a_camera_that_is_known_are_wrong_use(tmp_path, option):
    folder, _ = blender_folder(tmp_path / "scene", cameras=1)
    with pytest.raises(UsageError, match=f"--{option} 0.7: belongs to clips without cameras"):
        transforms_clip(folder, VideoOptions(**{option: 0.7}))


@pytest.mark.parametrize("unit", [1, 1000])
@pytest.mark.parametrize("noise", [0, 1e-7, 3e-6])
def test_a_still_camera_whose_poses_have_noise_is_one(tmp_path, capsys, noise, unit):
    folder, _ = blender_folder(tmp_path / "scene")
    path = folder / "transforms_train.json"
    data, rng = json.loads(path.read_text()), np.random.default_rng(0)
    for frame in data["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] *= unit
        pose[:3] += noise * rng.uniform(-1, 1, (3, 4)) * [1, 1, 1, unit]
        frame["transform_matrix"] = pose.tolist()
    path.write_text(json.dumps(data))
    header = transforms_clip(folder, SMALL).header
    assert header.num_views == 3 and header.num_frames == 3 and "left out" not in capsys.readouterr().err


def level_cameras(angles: list[tuple[float, float]], turn: np.ndarray) -> np.ndarray:
    """World_to_camera, OpenCV axes, of cameras at (azimuth, elevation) held level in a world of z up, which `turn` turns."""
    poses = []
    for azimuth, elevation in angles:
        back = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
        pose = np.eye(4)
        pose[:3] = np.column_stack([turn @ right, turn @ -np.cross(back, right), turn @ -back, 3 * turn @ back])
        poses.append(np.linalg.inv(pose))
    return np.array(poses)


@given(
    st.lists(st.tuples(st.one_of(st.floats(0, 6), st.just(0.0)), st.floats(-0.5, 0.7)), min_size=1, max_size=6),
    st.permutations([0, 1, 2]),
    st.tuples(*[st.sampled_from([-1.0, 1.0])] * 3),
)
def test_the_upright_is_the_axis_about_which_cameras_stand_level(angles, order, signs):
    turn = np.eye(3)[order] * np.array(signs)[:, None]
    turn = turn * np.linalg.det(turn)  # no mirror
    poses, up = level_cameras(angles, turn), turn @ [0, 0, 1]
    assume(up[2] or np.abs(poses[:, 0, 2]).max() > 0.11)  # else they may look down in a world of z up
    np.testing.assert_allclose(up_of_cameras("a", poses), up, atol=1e-9)


def test_cameras_from_straight_above_and_rolled_ones_leave_z_up(capsys):
    above = level_cameras([(0.0, np.pi / 2), (1.0, np.pi / 2)], np.eye(3))
    assert up_of_cameras("a", above).tolist() == [0, 0, 1] and not capsys.readouterr().err
    spin = Rotation.from_euler("zyx", [0.7, 1.3, -0.4]).as_matrix()
    assert up_of_cameras("a", level_cameras([(0, 0.2), (2, 0.3)], spin)).tolist() == [0, 0, 1]
    assert "z is taken for up" in capsys.readouterr().err


def test_an_upright_that_the_file_names_counts(tmp_path):
    folder, poses = blender_folder(tmp_path / "scene")
    plain = transforms_clip(folder, VideoOptions(size=64)).header.world_to_camera
    data = json.loads((folder / "transforms_train.json").read_text())
    spin = np.eye(4)
    spin[:3, :3] = Rotation.from_euler("zyx", [0.7, 0.3, -0.4]).as_matrix()
    for frame in data["frames"]:
        frame["transform_matrix"] = (spin @ frame["transform_matrix"]).tolist()
    data["up"] = (2 * spin[:3, 2]).tolist()
    (folder / "transforms_train.json").write_text(json.dumps(data))
    np.testing.assert_allclose(transforms_clip(folder, VideoOptions(size=64)).header.world_to_camera, plain, atol=1e-6)
    (folder / "transforms_train.json").write_text(json.dumps(data | {"up": "y"}))
    with pytest.raises(DataError, match="up 'y'; expected a direction"):
        transforms_clip(folder, VideoOptions(size=64))


def test_inverted_poses_are_noticed(tmp_path):
    """Cameras around the origin, as world to camera: all seem to stand in one place."""
    folder, _ = blender_folder(tmp_path / "scene")
    data = json.loads((folder / "transforms_train.json").read_text())
    for frame in data["frames"]:
        frame["transform_matrix"] = np.linalg.inv(frame["transform_matrix"]).tolist()
    (folder / "transforms_train.json").write_text(json.dumps(data))
    with pytest.raises(DataError, match="its 3 cameras stand in one place, turned differently; .* are they inverted"):
        transforms_clip(folder, SMALL)


@pytest.mark.parametrize("cameras, message", [(1, ""), (2, "scene: the cameras don't look at one object")])
def test_cameras_that_do_not_tell_how_far_the_object_is(tmp_path, cameras, message):
    """A phone on a stand has the pose of no motion; two cameras back to back see two things."""
    folder, _ = blender_folder(tmp_path / "scene", cameras=cameras)
    data = json.loads((folder / "transforms_train.json").read_text())
    for number, frame in enumerate(data["frames"]):
        frame["transform_matrix"] = np.diag([1, 1, 1, 1] if number < 3 else [-1, 1, -1, 1]).tolist()
    (folder / "transforms_train.json").write_text(json.dumps(data))
    if message:
        with pytest.raises(DataError, match=message):
            transforms_clip(folder, SMALL)
        return
    clip = transforms_clip(folder, SMALL)
    shift = clip.header.world_to_camera[0, :3, 3]
    assert np.isfinite(shift).all() and shift[2] > 0.75 and len(read(clip)) == 3


# ---- the command -------------------------------------------------------------------------------------------------------


def test_the_command_writes_once_and_tells_other_configurations_apart(tmp_path, dpc_here):
    folder = save(tmp_path / "clip", moving(3))
    out = tmp_path / "clip.h5"
    assert dpc_here("prepare", "video", folder, "--size", 32, "-o", out).returncode == 0
    with ViewsReader(out) as reader:
        assert reader.header.size == (32, 32) and reader.header.name == "clip"
        assert reader.provenance[0]["config"]["size"] == 32
    before = out.read_bytes()
    again = dpc_here("prepare", "video", folder, "--size", 32, "-o", out)
    assert again.returncode == 0 and b"already complete" in again.stderr and out.read_bytes() == before
    other = dpc_here("prepare", "video", folder, "--size", 48, "-o", out)
    assert other.returncode == 2 and b"size 32, now 48" in other.stderr
    save(folder, moving(4))
    assert dpc_here("prepare", "video", folder, "--size", 32, "-o", out).returncode == 2  # another input
    through = piped("prepare", "video", folder, "--size", 32, "-o", "-")
    assert through.returncode == 0 and through.stdout.startswith(b"\x89HDF")
    bad = dpc_here("prepare", "video", tmp_path, "-o", tmp_path / "b.h5")
    assert bad.returncode == 3 and b"no frames" in bad.stderr and not (tmp_path / "b.h5").exists()


@pytest.mark.parametrize(
    ("name", "frames"), [("consistent4d/roaring_t-rex", 32), ("actionmesh/kangaroo", 16), ("l4gm/lifting1_fg.mp4", 300)]
)
def test_real_clips(shared_data, name, frames):
    path = shared_data / "video" / name
    if not path.exists():
        pytest.skip(f"no {path}")
    assert len(open_frames(path)) == frames
    clip = video_clip(path, VideoOptions(frames=4, size=128))
    for rgba in read(clip).values():
        share = (rgba[..., 3] > 127).mean()
        assert 0.05 < share < 0.6 and rgba[0].max() == rgba[-1].max() == 0


def test_images_and_animations_are_known_by_their_content(tmp_path):
    """One image is no clip, half an animation is damaged, and an animation is read under any name."""
    pictures = [on(picture) for picture in moving(4)]
    Image.fromarray(pictures[0]).save(tmp_path / "one.png")
    with pytest.raises(DataError, match="one image; expected its folder"):
        open_frames(tmp_path / "one.png")
    stills = [Image.fromarray(picture) for picture in pictures]
    for form in ("gif", "png", "webp"):
        path = tmp_path / f"moving-{form}"
        stills[0].save(path, form, save_all=True, append_images=stills[1:], duration=100, lossless=True)
        frames = open_frames(path)
        assert len(frames) == 4 and frames.times == pytest.approx([0.0, 0.1, 0.2, 0.3])
    (tmp_path / "half").write_bytes((tmp_path / "moving-gif").read_bytes()[:200])
    with pytest.raises(DataError, match="not a readable animation"):
        open_frames(tmp_path / "half")


def test_annotations_given_as_masks_and_cameras_beside_frames_are_told(tmp_path, capfd):
    """Neither LabelMe's polygons nor COLMAP's cameras are read; the clip is, with a word."""
    folder = save(tmp_path / "clip", [disc((20 + 2 * k, 24), 8) for k in range(3)], "{}.png")
    (folder / "sparse").mkdir()
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "0.json").write_text('{"shapes": []}')
    words = ("prepare", "video", folder, "-o", tmp_path / "v.h5", "--size", "32")
    assert exit_code(*words, "--mask", tmp_path / "labels") == 3
    assert "labels: 0.json: annotations and arrays are not read as masks; draw" in capfd.readouterr().err
    assert exit_code(*words) == 0
    assert "clip: sparse: not read; the camera of a clip is assumed to stand still" in capfd.readouterr().err


@pytest.mark.parametrize(("other", "pattern"), [("fox_{}.png", "anya_*.png"), ("preview.png", "")])
def test_what_is_left_out_is_told_once(tmp_path, capfd, other, pattern):
    folder = save(tmp_path / "clip", [disc((20 + 2 * k, 24), 8) for k in range(3)], "anya_{}.png")
    save(folder, [disc((20, 24), 8)], other)
    chosen = ("--pattern", pattern) if pattern else ()
    assert exit_code("prepare", "video", folder, "-o", tmp_path / "v.h5", "--size", "32", *chosen) == 0
    assert capfd.readouterr().err.count("left out") == 1


@pytest.mark.parametrize(
    ("folder", "beside", "words", "told"),
    [
        ("scene/images", "sparse", "", True),
        ("scene/images", "../transforms.json", "", True),
        ("scene/images", "../cameras", "", True),
        ("scene/images", "../../sparse", "", False),
        ("scene/images", "0.xmp", '<x:xmpmeta xcr:Position="1"/>', True),
        ("scene/images", "edits.xmp", "<x:xmpmeta/>", False),
        ("scene/images_4", "../poses_bounds.npy", "", True),
        ("scene/rgb/1x", "../../camera", "", True),
        ("scene/images/01", "../../intri.yml", "", True),
        ("scene/train", "../transforms_train.json", "", True),
        ("scene/Camera_B1", "../annots.npy", "", True),
        ("scene/Camera_B1", "../cameras.json", "", False),
        ("scene/rgb", "../metadata.json", '{"w": 1440, "poses": [[0, 0, 0, 1, 0, 0, 0]]}', True),
        ("scene/rgb", "../metadata.json", '{"title": "a fox"}', False),
        ("scene/7", "0.pose.txt", "1 0 0 0", True),
        ("scene/scan", "0.json", '{"cameraPoseARFrame": [1, 0]}', True),
        ("scene/scan", "0.json", '{"shapes": []}', False),
    ],
)
def test_cameras_of_other_programs_are_told_in_the_folder_and_above_one_of_pictures(
    tmp_path, capfd, folder, beside, words, told
):
    place = save(tmp_path / folder, [disc((20 + 2 * k, 24), 8) for k in range(3)], "{}.png")
    (place / beside).write_text(words)
    name = beside.rpartition("/")[2]
    said = f"{place.name}: {name}: not read; the camera of a clip is assumed to stand still"
    video_clip(place, SMALL)
    assert (said in capfd.readouterr().err) == told
    open_frames(place)  # as masks are
    assert "assumed" not in capfd.readouterr().err


def test_a_list_of_cameras_that_is_read_is_not_told_as_unread(tmp_path, capfd):
    place = save(tmp_path / "rgba", [disc((20 + 2 * k, 24), 8) for k in range(3)], "{}.png")
    views = save(tmp_path / "views" / "view0", [disc((20 + 2 * k, 24), 8) for k in range(3)], "{}.png").parent
    (tmp_path / "cameras.json").write_text('[{"azimuth": 90, "elevation": 0}]')
    video_clip(place, VideoOptions(size=64, views=views, views_cameras=tmp_path / "cameras.json"))
    assert "not read" not in capfd.readouterr().err


def test_cameras_beside_a_video_are_told(tmp_path, capfd):
    path = uneven_video(tmp_path / "rgb.mp4")
    (tmp_path / "camera_matrix.csv").write_text("1,0,0")
    video_clip(path, VideoOptions(size=64, background="keep"))
    assert "rgb.mp4: camera_matrix.csv: not read" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("name", "start", "said"),
    [
        ("0.heic", b"\0\0\0\x18ftypheic", "0.heic: a HEIC picture, which is not read; convert it to PNG"),
        ("0.exr", b"v/1\x01\2", "0.exr: an EXR picture, which is not read"),
        ("0.dng", b"II*\0", "0.dng: a raw picture of a camera"),
        ("frame", b"\x89PNG", "frame is an image without the suffix of one"),
        (".frame", b"\x89PNG", r"ppm\)$"),
    ],
)
def test_a_folder_without_frames_says_what_it_holds(tmp_path, name, start, said):
    (tmp_path / name).write_bytes(start + bytes(20))
    with pytest.raises(DataError, match=f"no frames; expected images .*{said}"):
        open_frames(tmp_path)


@pytest.mark.parametrize("suffix", ["tga", "jp2", "ppm", "jfif"])
def test_images_of_rarer_suffixes_are_frames(tmp_path, suffix):
    folder = save(tmp_path / "clip", [disc((20 + 2 * k, 24), 8) for k in range(3)], "{}.png")
    for path in list(folder.iterdir()):
        image = Image.open(path)
        (image if suffix in ("tga", "jp2") else image.convert("RGB")).save(
            path.with_suffix(f".{suffix}"), "JPEG" if suffix == "jfif" else None, quality=95
        )
        path.unlink()
    frames = open_frames(folder)
    read, written = next(frames.read([0])), disc((20, 24), 8)
    assert len(frames) == 3 and np.abs(read[24, 20].astype(int) - written[24, 20]).max() <= 6
    assert (read[0, 0, 3] == 0) == (suffix in ("tga", "jp2"))


def test_a_square_that_no_camera_takes_is_refused():
    """The size that a damaged GIF tells: the picture itself is narrow, the square around it would take 25 GB."""
    with pytest.raises(DataError, match="a square of 82,000 pixels would be cut out; expected at most 12,000"):
        Crop(-41_000, 0, 82_000).apply(np.zeros((65_559, 32, 4), np.uint8), 16)
