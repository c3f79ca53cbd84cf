"""Videos to compare: folders of images, arrays, video files, views, and inputs that are none of them."""

from __future__ import annotations

import subprocess
import unicodedata
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dpcli.errors import DataError
from dpcli.evaluate.video.comparison import VideoReport, evaluate_video
from dpcli.evaluate.video.picture_statistics import PSNR_CAP
from dpcli.evaluate.video.sources.open_source import open_source
from dpcli.runtime.progress import log
from dpcli.store.gaussians import write_scene
from tests.support.scenes import toy_scene
from tests.support.video_clips import HEIGHT, WIDTH, clip, header, white, write, write_folder


def numbers(report: VideoReport, name: str) -> list[float]:
    return [getattr(view.metrics, name) for view in report.views]


@pytest.mark.parametrize("name", ["{}.png", "{:03d}_rgba.png", "frame_{:04d}.webp"])
def test_a_folder_of_any_naming_is_the_same_video(tmp_path: Path, name: str) -> None:
    one = write(tmp_path / "one.h5", clip(views=1, frames=12), header(("reference",), 12))
    noisy = clip(1, noise=6, views=1, frames=12)
    expected = evaluate_video(write(tmp_path / "noisy.h5", noisy, header(("reference",), 12)), one)
    if name.endswith("webp"):
        (tmp_path / "f").mkdir()
        for t, frame in enumerate(noisy[0]):
            Image.fromarray(frame).save(tmp_path / "f" / name.format(t), lossless=True, exact=True)
    else:
        write_folder(tmp_path / "f", noisy[0], name)
    assert numbers(evaluate_video(tmp_path / "f", one), "psnr") == numbers(expected, "psnr")


def test_folders_of_views_match_by_name(tmp_path: Path, truth: Path, said: Path) -> None:
    noisy = clip(1, noise=6)
    for folder, names in (
        ("a", ("0", "1", "2", "3")),
        ("b", ("reference", "train_0", "eval_0", "eval_1")),
        ("c", ("view_00", "view_01", "view_02", "view_03")),
    ):
        for view, name in enumerate(names):
            write_folder(tmp_path / folder / name, noisy[view])
        found = evaluate_video(tmp_path / folder, truth)
        assert numbers(found, "ssim") == numbers(evaluate_video(said, truth), "ssim"), folder
    both = evaluate_video(tmp_path / "b", tmp_path / "b")  # folders on both sides
    assert [view.role for view in both.views].count("reference") == 1 and len(both.views) == 4
    tests = evaluate_video(tmp_path / "b", tmp_path / "b", protocol="consistent4d")
    assert "reference" not in [view.title for view in tests.views]


def test_masks_beside_the_pictures_are_not_compared_as_frames(tmp_path: Path) -> None:
    """Of the same names but for their suffixes; the mean was one over pictures and masks."""
    write_folder(tmp_path / "f", clip()[0], "{:03d}.png")
    for path in list((tmp_path / "f").iterdir()):
        Image.new("L", (WIDTH, HEIGHT)).save(path.with_suffix(".bmp"))
    with pytest.raises(DataError, match="'000' is there with two suffixes; move those of one kind into a folder"):
        open_source(tmp_path / "f")


def test_a_lone_folder_is_the_reference(tmp_path: Path, truth: Path) -> None:
    flat = write_folder(tmp_path / "flat", clip()[0])
    with pytest.raises(DataError, match="flat: has no view '1', '2', '3' of .*truth.h5; .*--intersect"):
        evaluate_video(flat, truth)
    report = evaluate_video(flat, truth, intersect=True)
    assert numbers(report, "psnr") == [PSNR_CAP] and report.left_out[0].names == ["1", "2", "3"]
    assert len(evaluate_video(flat, truth, protocol="thesis").views) == 1  # the others aren't asked for


def test_arrays_of_bytes_and_floats(tmp_path: Path, truth: Path) -> None:
    noisy = clip(1, noise=6)
    expected = numbers(evaluate_video(write(tmp_path / "noisy.h5", noisy), truth), "psnr")
    np.save(tmp_path / "bytes.npy", noisy)
    np.save(tmp_path / "floats.npy", (noisy / 255).astype(np.float32))
    np.save(tmp_path / "opaque.npy", white(noisy).astype(np.float32))
    for name in ("bytes", "floats", "opaque"):
        assert numbers(evaluate_video(tmp_path / f"{name}.npy", truth), "psnr") == pytest.approx(expected, abs=1e-3)


def test_a_video_file_is_opaque(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    frames = np.floor(white(clip(views=1))[0] * 255 + 0.5).astype(np.uint8)
    writer = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter_fourcc(*"FFV1"), 10, (WIDTH, HEIGHT))
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
    one = write(tmp_path / "one.h5", clip(views=1), header(("reference",)))
    report = evaluate_video(tmp_path / "a.avi", one)
    assert not any("frames a second" in note for note in report.notes)
    assert report.views[0].metrics.psnr > 38 and any("has no alpha" in note for note in report.notes)
    turned = evaluate_video(one, tmp_path / "a.avi")
    assert turned.names == ("psnr", "ssim")  # without alpha nobody knows the object
    with pytest.raises(DataError, match="no alpha, so the object's pixels are unknown"):
        evaluate_video(one, tmp_path / "a.avi", metrics=("psnr_foreground",))


def gif(path: Path, duration: int) -> Path:
    images = [Image.new("RGB", (16, 16), (80 * k, 0, 0)).quantize(2) for k in range(3)]
    images[0].save(path, save_all=True, append_images=images[1:], duration=duration)
    return path


def test_clips_of_other_rates_are_told(tmp_path: Path) -> None:
    report = evaluate_video(gif(tmp_path / "a.gif", 40), gif(tmp_path / "b.gif", 100))
    assert "The prediction plays 25 frames a second, the truth 10: compared by their number." in report.notes


@pytest.mark.parametrize(
    ("ours", "theirs", "told"),
    [
        ([0, 1, 3, 4, 5], [0, 1, 2, 4, 5], "frame 2: after 0.3 s and 0.2 s"),  # each lacks another frame of six
        ([0, 1, 2, 3, 4], [7, 8, 9, 10, 11], ""),
        ([0, 1.1, 1.9, 3.1, 4], [0, 0.9, 2.2, 3, 4], ""),  # a camera that isn't even
    ],
)
def test_frames_of_other_moments_are_told(tmp_path: Path, ours: list, theirs: list, told: str) -> None:
    """Sides of as many frames and the same mean rate, of which each lacks another one: all between are shifted."""
    for name, own in (("a.h5", ours), ("b.h5", theirs)):
        write(tmp_path / name, clip(frames=5), replace(header(frames=5), time=np.array(own) / 10))
    notes = " ".join(evaluate_video(tmp_path / "a.h5", tmp_path / "b.h5", metrics=("psnr",)).notes)
    assert (f"({told})" in notes) if told else "other moments" not in notes


@pytest.mark.parametrize(
    ("ours", "theirs", "told"),
    [
        ([0, 1, 2, 3], [5, 6, 7, 8], ""),
        ([0, 10, 20, 30], [100, 110, 120, 130], ""),
        ([0, 1, 3, 4], [0, 1, 2, 3], "3 with 2"),
        ([0, 2, 4, 6], [0, 1, 2, 3], "2 with 1"),
        ([0, 2, 4], [0, 1, 2, 3, 4, 5], "2 with 1"),
        ([0, 1, 2], [0, 1, 2, 3], ""),
        ([0, 1, 3, 4], [0, 1, 2, 3, 4], "3 with 2"),
        ([1, 2, 3], [0, 1, 2, 3], "1 with 0"),
    ],
)
def test_frames_that_names_number_otherwise_are_told(tmp_path: Path, ours: list, theirs: list, told: str) -> None:
    for folder, own in (("a", ours), ("b", theirs)):
        (tmp_path / folder).mkdir()
        for number in own:
            Image.new("RGB", (16, 16), (number, 0, 0)).save(tmp_path / folder / f"v2_{number:04}_rgba.png")
    report = evaluate_video(tmp_path / "a", tmp_path / "b", metrics=("psnr",), intersect=len(ours) != len(theirs))
    notes = " ".join(report.notes)
    assert (f"({told})" in notes) if told else "number them otherwise" not in notes
    alone = evaluate_video(tmp_path / "a", tmp_path / "b", metrics=("warping",), intersect=len(ours) != len(theirs))
    assert [note for note in alone.notes if "number them" in note] == [
        note for note in report.notes if "number them" in note
    ]
    if told and report.left_out:
        with pytest.raises(DataError, match=rf"compares the first \d, though their names .*{told}"):
            evaluate_video(tmp_path / "a", tmp_path / "b", metrics=("psnr",))


@pytest.mark.parametrize(
    "numbers, told", [([0, 1, 3, 4], "3 right after 1"), ([7, 9, 11, 13], ""), ([0, 3, 7, 10], ""), ([4], "")]
)
def test_a_gap_in_the_names_is_told_where_the_other_side_has_none(tmp_path: Path, numbers: list, told: str) -> None:
    (tmp_path / "a").mkdir()
    for number in numbers:
        Image.new("RGB", (16, 16), (number, 0, 0)).save(tmp_path / "a" / f"{number:03}.png")
    np.save(tmp_path / "all.npy", np.zeros((5, 16, 16, 3), np.uint8))
    np.save(tmp_path / "as_many.npy", np.zeros((len(numbers), 16, 16, 3), np.uint8))
    for pair in (("a", "all.npy"), ("all.npy", "a"), ("a", "as_many.npy")):
        notes = " ".join(evaluate_video(*(tmp_path / x for x in pair), metrics=("psnr",), intersect=True).notes)
        assert (f"({told})" in notes) if told else "number them otherwise" not in notes


@pytest.mark.parametrize("cut_out", [(), (0,), (1,), (0, 1, 2)])
def test_a_folder_has_alpha_where_any_of_its_pictures_has(tmp_path: Path, cut_out: tuple) -> None:
    for frame in range(3):
        picture = Image.new("RGBA" if frame in cut_out else "RGB", (16, 16), (80, 0, 0))
        if frame in cut_out:
            picture.putalpha(0)
            picture.paste((80, 0, 0, 255), (0, 0, 8, 16))
        picture.save(tmp_path / f"{frame}.png")
    report = evaluate_video(tmp_path, tmp_path)
    assert ("silhouette_iou" in report.names) == bool(cut_out) and (not report.notes) == bool(cut_out)


@pytest.mark.parametrize("digits", [1, 2, 5])
def test_views_of_any_number_of_digits_are_the_same(tmp_path: Path, digits: int) -> None:
    for view in range(11):
        write_folder(tmp_path / "a" / f"{view:0{digits}}", clip(1, views=1)[0])
        write_folder(tmp_path / "b" / f"cam{view}", clip(1, views=1)[0])
    assert len(evaluate_video(tmp_path / "a", tmp_path / "b", metrics=("psnr",)).views) == 11


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_views_are_the_same_whatever_system_spelled_their_names(tmp_path: Path, form: str) -> None:
    for folder, spelled in (("a", form), ("b", "NFC")):
        for name in ("Ä", "é", "c"):
            write_folder(tmp_path / folder / unicodedata.normalize(spelled, name), clip(1, views=1)[0])
    assert len(evaluate_video(tmp_path / "a", tmp_path / "b", metrics=("psnr",)).views) == 3


def test_floats_about_zero_are_refused(tmp_path: Path) -> None:
    pictures = np.random.default_rng(0).random((3, 16, 16, 3), np.float32)
    np.save(tmp_path / "truth.npy", pictures)
    np.save(tmp_path / "sharpened.npy", pictures * 1.1 - 0.05)  # overshoots a little
    assert evaluate_video(tmp_path / "sharpened.npy", tmp_path / "truth.npy", metrics=("psnr",)).views
    np.save(tmp_path / "model.npy", 2 * pictures - 1)
    with pytest.raises(DataError, match=r"frame 0 has values down to -.*save \(x \+ 1\) / 2"):
        evaluate_video(tmp_path / "model.npy", tmp_path / "truth.npy", metrics=("psnr",))


def test_a_folder_of_videos_lists_them(tmp_path: Path, capsys) -> None:
    """The loop of the advice names all of them, and images beside a video are compared alone."""
    folder = tmp_path / "my clips"
    folder.mkdir()
    for name in ("b.gif", "a.gif"):
        gif(folder / name, 100)
    with pytest.raises(
        DataError, match=r"(?s)2 videos, one clip is wanted: a.gif, b.gif\n.*compare all with those"
    ) as error:
        open_source(folder)
    loop = str(error.value).partition("folder TRUTH: ")[2].replace("dpc evaluate video", "echo")
    said = subprocess.run(["bash", "-c", loop], capture_output=True, text=True).stdout
    assert said.split("\n")[:-1] == [f"{folder / name} --truth TRUTH/{name}" for name in ("a.gif", "b.gif")]
    Image.new("RGB", (16, 16)).save(folder / "0.png")
    assert open_source(folder).frames == [1]
    assert "its images are compared; left out: a.gif, b.gif" in capsys.readouterr().err


def test_inputs_that_are_no_video(tmp_path: Path, truth: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "0.png").write_bytes(b"\x89PNG\r\n\x1a\nrest")
    (tmp_path / "bad.mp4").write_bytes(b"not a film")
    (tmp_path / "bad.npy").write_bytes(b"\x93NUMPY")
    np.save(tmp_path / "ints.npy", np.zeros((2, 8, 8, 3), np.int32))
    Image.new("RGB", (8, 8)).save(tmp_path / "one.jpg")
    for name, what in (
        ("empty", "no images"),
        ("bad", "not a readable image"),
        ("bad.mp4", "not a readable video"),
        ("bad.npy", "not a readable .npy"),
        ("ints.npy", "int32"),
        ("one.jpg", "one image; expected its folder"),
        ("absent.h5", "no such file"),
    ):
        with pytest.raises(DataError, match=what):
            open_source(tmp_path / name)
    scene = tmp_path / "scene.h5"
    write_scene(scene, toy_scene())
    with pytest.raises(DataError, match="can't be the truth"):
        evaluate_video(truth, scene)
    flat = write_folder(tmp_path / "flat", clip()[0])
    with pytest.raises(DataError, match="a folder of images has no cameras to render"):
        evaluate_video(scene, flat)


def test_weights_that_no_metric_needs_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, said = write(tmp_path / "one.h5", clip(views=1, frames=2), header(("reference",), 2)), []
    monkeypatch.setattr(log, "warn", said.append)
    evaluate_video(path, path, metrics=["psnr", "warping"])
    assert not said
    evaluate_video(path, path, metrics=["psnr"], weights=tmp_path)
    assert said == [f"--weights {tmp_path}: nothing in it is read; none of the metrics asked for needs a network"]
    with pytest.raises(DataError, match="no such folder"):
        evaluate_video(path, path, metrics=["psnr"], weights=tmp_path / "nowhere")
