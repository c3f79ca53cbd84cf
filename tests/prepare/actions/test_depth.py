"""Depth videos of any container: all 16 bits arrive, geometry, background, labels, and bad inputs."""

from __future__ import annotations

import subprocess
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from dpcli.errors import DataError, UsageError
from dpcli.prepare.actions.depth import DepthVideos, background_depth
from dpcli.prepare.decode.depth_files import read_depth_video, read_image, read_video
from dpcli.prepare.decode.pinhole_camera import Intrinsics
from dpcli.prepare.labels import labels_of_folders, read_labels
from dpcli.prepare.reader import Item
from tests.support.prepare_helpers import write_video

RNG = np.random.default_rng(0)
CAMERA = Intrinsics(20.0, 21.0, 15.5, 11.5)


def depth16(seed: int = 0, frames: int = 4, shape: tuple[int, int] = (24, 32)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 65536, (frames, *shape)).astype(np.uint16)


def write_pngs(folder, frames):
    folder.mkdir(parents=True)
    for t, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"depth_{t + 8}.png"), frame)  # 8, 9, 10, 11: natural order, not that of letters
    return folder


def read(path, **options):
    reader = DepthVideos(inputs=(path,), **options)
    return reader.read(reader.items()[0], RNG).sequence


@pytest.mark.parametrize("kind", ["png", "mkv", "avi", "npy"])
def test_all_sixteen_bits_arrive_in_order(tmp_path, kind):
    frames = depth16()
    if kind == "png":
        path = write_pngs(tmp_path / "video", frames)
    elif kind == "npy":
        path = tmp_path / "video.npy"
        np.save(path, frames)
    else:
        path = write_video(tmp_path / f"video.{kind}", frames)
    found = read_depth_video(path).frames
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, frames)
    np.testing.assert_array_equal(read_depth_video(path, stride=3).frames, frames[::3])
    np.testing.assert_allclose(read(path, intrinsics=CAMERA).points[:, 2].max(), frames.max() / 1000, rtol=1e-6)


def test_eight_bits(tmp_path):
    frames = (depth16() >> 8).astype(np.uint8)
    path = write_video(tmp_path / "v.avi", frames, fps=10)
    np.testing.assert_array_equal(read_depth_video(path).frames, frames)
    sequence = read(path)
    np.testing.assert_allclose(sequence.points[:, 2], frames[frames > 0] / 100, rtol=1e-6)
    np.testing.assert_allclose(sequence.time, np.arange(4) / 10)
    inverted = read(path, invert=True, depth_scale=50)
    levels = frames[(frames > 0) & (frames < 255)]
    np.testing.assert_allclose(inverted.points[:, 2], (255 - levels.astype(float)) / 50, rtol=1e-6)


def test_geometry_near_far_and_scale(tmp_path):
    frames = depth16()
    np.save(tmp_path / "v.npy", frames)
    sequence = read(tmp_path / "v.npy", intrinsics=CAMERA, depth_scale=5000, near=2.0, far=9.0)
    meters = frames / 5000
    kept = (meters >= 2) & (meters <= 9)
    assert len(sequence.points) == kept.sum()
    x, y, z = sequence.points.astype(float).T
    _, rows, columns = np.nonzero(kept)
    np.testing.assert_allclose(z, meters[kept], rtol=1e-6)
    np.testing.assert_allclose(x / z * 20 + 15.5, columns, atol=1e-3)
    np.testing.assert_allclose(y / z * 21 + 11.5, rows, atol=1e-3)


def test_field_of_view_spans_the_image():
    camera = Intrinsics.from_field_of_view(90, 64, 48)
    edge = (63.5 - camera.cx) / camera.fx  # the outer rim of the last pixel
    assert np.degrees(np.arctan(edge)) == pytest.approx(45)
    assert camera.fx == camera.fy and camera.cy == 23.5


def test_float_depths_are_meters_and_their_nan_is_nothing(tmp_path):
    frames = np.full((2, 3, 4), 1.5, np.float32)
    frames[0, 0, 0], frames[1, 2, 3] = np.nan, np.inf
    np.save(tmp_path / "v.npy", frames)
    sequence = read(tmp_path / "v.npy")
    assert np.diff(sequence.frame_offsets).tolist() == [11, 11]
    assert (sequence.points[:, 2] == 1.5).all()


@pytest.mark.parametrize("kind", ["<u2", "<i2", "<i4", "<u4"])
def test_whole_numbers_are_millimeters_whatever_their_width(tmp_path, kind):
    np.save(tmp_path / "v.npy", np.full((2, 8, 8), 1500, kind))
    np.testing.assert_allclose(read(tmp_path / "v.npy").points[:, 2], 1.5, rtol=1e-6)


def test_a_video_of_a_color_map_is_no_depth_and_gray_ones_are(tmp_path):
    rng = np.random.default_rng(0)
    gray = cv2.GaussianBlur(rng.integers(0, 255, (6, 48, 64)).astype(np.uint8).transpose(1, 2, 0), (7, 7), 0).transpose(
        2, 0, 1
    )
    for codec, name in (("mp4v", "lossy.mp4"), ("FFV1", "exact.avi"), ("MJPG", "jpeg.avi")):
        for colored in (False, True):
            writer = cv2.VideoWriter(str(tmp_path / name), cv2.VideoWriter_fourcc(*codec), 10.0, (64, 48))
            for frame in gray:
                writer.write(cv2.applyColorMap(frame, cv2.COLORMAP_JET) if colored else np.dstack([frame] * 3))
            writer.release()
            if colored:
                with pytest.raises(DataError, match=f"{name}: frame 0 is colored"):
                    read_video(tmp_path / name)
            else:
                assert len(read_video(tmp_path / name)[0]) == 6


@pytest.mark.parametrize("compression", ["lzma", "zstd", "cut"])
def test_a_tiff_that_opencv_cannot_read_is_named(tmp_path, compression):
    path = tmp_path / "one.tif"
    frame = Image.fromarray(np.arange(600, dtype=np.uint16).reshape(20, 30))
    frame.save(path, compression=None if compression == "cut" else compression)
    path.write_bytes(path.read_bytes()[: 300 if compression == "cut" else None])
    with pytest.raises(DataError, match="one.tif: a TIFF that is damaged, or whose compression .* LZW or deflate"):
        read_image(path)


def test_a_tiff_of_several_pages_is_refused(tmp_path):
    frames = depth16(frames=3)
    cv2.imwrite(str(tmp_path / "one.tiff"), frames[0])
    np.testing.assert_array_equal(read_image(tmp_path / "one.tiff"), frames[0])
    cv2.imwritemulti(str(tmp_path / "many.tiff"), list(frames))
    with pytest.raises(DataError, match="many.tiff: holds 3 pages; expected one depth image a file"):
        read_image(tmp_path / "many.tiff")


def test_val_in_a_table_is_validation_as_the_folder_is(tmp_path):
    (tmp_path / "labels.csv").write_text("name,label,split\na,0,val\nb,1,train\nc,1,mine\n")
    assert [row.split for row in read_labels(tmp_path / "labels.csv").rows.values()] == ["validation", "train", "mine"]


@pytest.mark.parametrize(
    "text, encoding",
    [
        ("name,label,subject,split\na/1.avi,push,3,Train\nb/2.avi,wave,,test\n", "utf-8-sig"),
        ("name;label;subject;split\r\na/1.avi;push;3;training\r\nb/2.avi;wave;;Test\r\n", "utf-16"),
        ("Path\tClass\tPerson\tSubset\na\\1.avi\tpush\t3\tTRAIN\nb\\2.avi\twave\t\ttesting\n", "utf-8"),
        ("# mine\nfile,category,seconds,subject,split,\n./a/1,push,2.5,3,train,\n./b/2,wave,,,test,\n", "utf-8"),
    ],
)
def test_label_tables_as_people_write_them(tmp_path, capsys, text, encoding):
    (tmp_path / "labels.csv").write_bytes(text.encode(encoding))
    items = [Item(name, tmp_path) for name in ("a/1.avi", "b/2.avi", "b/3.avi")]
    table = read_labels(tmp_path / "labels.csv")
    found = [(item.label, item.subject, item.split) for item in table.apply(items)]
    assert found == [(0, 3, "train"), (1, -1, "test"), (-1, -1, "")] and table.class_names == ["push", "wave"]
    assert ("columns not read: seconds" in capsys.readouterr().err) is ("seconds" in text)
    assert table.unnamed(table.apply(items)) == [f"1 without a label in {tmp_path / 'labels.csv'}: b/3.avi"]


def test_names_of_samples_in_either_spelling_of_unicode_and_as_folders(tmp_path):
    whole, split = "M\u00fcller/1", "Mu\u0308ller/2"  # as macOS writes letters
    text = "name,label\nMu\u0308ller/1/,wave\n./M\u00fcller/2,push\n"
    (tmp_path / "labels.csv").write_text(text, encoding="utf-8")
    items = read_labels(tmp_path / "labels.csv").apply([Item(name, tmp_path) for name in (whole, split)])
    assert [(item.name, item.label) for item in items] == [(whole, 1), (split, 0)]


@pytest.mark.parametrize(
    ("labels", "said"),
    [
        ("1 2", "no sample has label 0; labels count from 0"),
        ("0 2", ""),
        ("Wave wave", "Wave and wave are different classes"),
        ("wave push", ""),
    ],
)
def test_classes_that_are_hardly_meant_are_told(tmp_path, capsys, labels, said):
    first, second = labels.split()
    (tmp_path / "labels.csv").write_text(f"name,label\na,{first}\nb,{second}\n")
    read_labels(tmp_path / "labels.csv")
    err = capsys.readouterr().err
    assert said in err and bool(said) == bool(err)


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["data/wave/a", "data/push/b"], "one class, 'data'; if its folders are the classes (push, wave)"),
        (["anna/wave/1", "anna/push/1", "ben/wave/1", "ben/push/1"], "the classes are anna, ben; the folders below"),
        (["Wave/a", "wave/b"], "Wave and wave are different classes"),
        (["wave /a", "wave/b"], "wave and 'wave ' are different classes"),
        (["wave/a", "push/a"], ""),
        (["wave/a/depth", "push/a/depth"], ""),
        (["wave/anna/1", "wave/ben/1", "push/anna/1"], ""),
        (["wave/train/1", "wave/test/1", "push/train/1", "push/test/1"], ""),
    ],
)
def test_folders_that_are_hardly_the_classes_are_told(tmp_path, capsys, names, said):
    labels_of_folders(tmp_path, names, "CLASS/VIDEO")
    err = capsys.readouterr().err
    assert said in " ".join(err.split()) if said else not err


def test_labels_that_a_program_wrote_as_fractions_are_whole(tmp_path):
    (tmp_path / "labels.csv").write_text("name,label\na,10.0\nb,2.0\n")
    table = read_labels(tmp_path / "labels.csv")
    assert [row.label for row in table.rows.values()] == [10, 2] and len(table.class_names) == 11


@pytest.mark.parametrize(
    "rows, names, words",
    [
        ("run1.7,a", ["run1.5"], "names 'run1.7', which is not among"),
        ("a,x", ["a.avi", "a.npy"], "names 'a', which is not among"),
        ("a.avi,x\na,y", ["a.avi"], "names 'a.avi' twice, with and without its suffix"),
    ],
)
def test_names_that_may_mean_another_sample_are_refused(tmp_path, rows, names, words):
    (tmp_path / "labels.csv").write_text("name,label\n" + rows)
    with pytest.raises(DataError, match=words):
        read_labels(tmp_path / "labels.csv").apply([Item(name, tmp_path) for name in names])


def test_folders_of_splits_in_any_spelling():
    table = labels_of_folders(Path("own"), ["Train/a/1", "Train/b/1", "Testing/a/2"], "CLASS/VIDEO")
    assert table.class_names == ["a", "b"] and [row.split for row in table.rows.values()] == ["train", "train", "test"]


@given(st.integers(0, 2**32 - 1), st.integers(1, 9))
def test_background_median_against_plain_loops(seed, frames):
    rng = np.random.default_rng(seed)
    depth = rng.integers(1, 20, (frames, 3, 4)) * (rng.random((frames, 3, 4)) < 0.6)
    found = background_depth(depth.astype(np.float32), "median")
    for row in range(3):
        for column in range(4):
            seen = sorted(v for v in depth[:, row, column] if v > 0)
            assert found[row, column] == (seen[(len(seen) - 1) // 2] if seen else 0)


@pytest.mark.parametrize("kind", ["median", "first"])
def test_background_removal_leaves_what_moves(tmp_path, kind):
    frames = np.full((9, 10, 20), 3000, np.uint16)
    for t in range(1, 9):
        frames[t, 4:6, 2 * t : 2 * t + 2] = 2000
    np.save(tmp_path / "v.npy", frames)
    sequence = read(tmp_path / "v.npy", background=kind, intrinsics=CAMERA)
    assert sequence.num_frames == 8  # the first frame shows nothing but the background
    assert (sequence.points[:, 2] == 2).all() and len(sequence.points) == 8 * 4
    assert sequence.time is None
    np.testing.assert_allclose(read(tmp_path / "v.npy", background=kind, intrinsics=CAMERA, fps=30).time[0], 1 / 30)


def test_folders_of_videos_with_labels(tmp_path):
    raw = tmp_path / "raw"
    write_pngs(raw / "a b" / "vidéo 10", depth16(1))
    write_pngs(raw / "a b" / "vidéo 9", depth16(2))
    np.save(raw / "c.npy", depth16(3))
    table = tmp_path / "labels.csv"
    table.write_text("name,label,subject,split\nc.npy,wave,3,train\na b/vidéo 9,jump,4,test\n")
    reader = DepthVideos(inputs=(raw,), labels=table)
    found = [(i.name, i.label, i.subject, i.split) for i in reader.items()]
    assert found == [("a b/vidéo 9", 0, 4, "test"), ("a b/vidéo 10", -1, -1, ""), ("c.npy", 1, 3, "train")]
    assert reader.class_names == ["jump", "wave"]
    assert "1 without a label" in reader.summary(reader.items())[-1]


def test_labels_from_folders(tmp_path):
    for name in ("wave/2.npy", "wave/10.npy", "a clap/deep/1.npy"):
        (tmp_path / "own" / name).parent.mkdir(parents=True, exist_ok=True)
        np.save(tmp_path / "own" / name, depth16())
    reader = DepthVideos(inputs=(tmp_path / "own",), label_from_folder=True)
    assert reader.class_names == ["a clap", "wave"]
    found = [(i.name, i.label, i.split) for i in reader.items()]
    assert found == [("a clap/deep/1.npy", 0, ""), ("wave/2.npy", 1, ""), ("wave/10.npy", 1, "")]
    assert reader.read(reader.items()[1], np.random.default_rng(0)).sequence.label == 1
    with pytest.raises(
        DataError, match=r"'2.npy' is in no folder of its class; --label-from-folder expects CLASS/VIDEO"
    ):
        DepthVideos(inputs=(tmp_path / "own" / "wave",), label_from_folder=True).items()
    with pytest.raises(UsageError, match="use one"):
        DepthVideos(inputs=(tmp_path,), label_from_folder=True, labels=tmp_path / "x.csv")
    assert "label_from_folder" in reader.config and "label_from_folder" not in DepthVideos(inputs=(tmp_path,)).config


@pytest.mark.parametrize(
    ("names", "layout", "expected"),
    [
        (["train/a/1", "val/b/2", "test/a/3"], "CLASS/VIDEO", [(0, "train"), (1, "validation"), (0, "test")]),
        (["train/a", "test/b"], "CLASS/VIDEO", [(1, ""), (0, "")]),  # two classes of these names
        (["train/a", "test/b"], "CLASS", [(0, "train"), (1, "test")]),
        (["train/a/1", "b/a/2"], "CLASS/VIDEO", [(1, ""), (0, "")]),
        (["train/a/1", "train/b/2", "b/3"], "CLASS/VIDEO", [(1, ""), (1, ""), (0, "")]),
        (["a", "b/x"], "CLASS", [(0, ""), (1, "")]),
    ],
)
def test_folders_of_splits_hold_those_of_classes(names, layout, expected):
    table = labels_of_folders(Path("own"), names, layout)
    assert [(table.rows[name].label, table.rows[name].split) for name in names] == expected


@pytest.mark.parametrize("odd", ["test/a", "train/b", "other/a/2"])
def test_a_stray_sample_does_not_make_classes_of_the_splits(odd):
    with pytest.raises(DataError, match=rf"own: '{odd}': not SPLIT/CLASS/VIDEO, as 'train/a/1' and 2 in all are"):
        labels_of_folders(Path("own"), ["train/a/1", "test/a/3", odd], "CLASS/VIDEO")
    with pytest.raises(DataError, match="own: 'train': not SPLIT/CLASS"):
        labels_of_folders(Path("own"), ["train/a", "train"], "CLASS")


def test_a_stray_picture_beside_the_videos_of_a_class_is_named(tmp_path):
    for name in ("train/a/1.npy", "train/b/1.npy", "test/a/1.npy", "test/b/1.npy"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        np.save(tmp_path / name, depth16())
    reader = DepthVideos(inputs=(tmp_path,), label_from_folder=True)
    assert reader.class_names == ["a", "b"] and {item.split for item in reader.items()} == {"train", "test"}
    cv2.imwrite(str(tmp_path / "test" / "b" / "thumb.png"), depth16()[0])
    with pytest.raises(DataError, match="'test/b': not SPLIT/CLASS/VIDEO"):
        DepthVideos(inputs=(tmp_path,), label_from_folder=True).items()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,label\na,-1\n", "labels.csv:2: label -1 is out of range"),
        ("name,label\na,1\na,2\n", "labels.csv:3: 'a' appears twice"),
        ("name,label\na,1,2\n", "labels.csv:2: 'a,1,2'; expected name,label"),
        ("name,label\na,\n", "labels.csv:2: 'a,'; expected name,label .leave the line out where the label isn't known"),
        ("name,label\na\n", "labels.csv:2"),
        (50 * '{"name":"a","label":1},', "labels.csv:1: '{.{70,90}'; expected name,label$"),  # not all of it
        ("name,color\na,1\n", "labels.csv:1: columns name,color"),
        ("name,label\na,1\nb,two\n", "some labels are numbers and some are words"),
        ("name,label,subject\na,1,x1y\n", "labels.csv:2: subject 'x1y'"),
        ("", "no rows"),
    ],
)
def test_bad_label_tables(tmp_path, text, message):
    (tmp_path / "labels.csv").write_text(text)
    with pytest.raises(DataError, match=message):
        read_labels(tmp_path / "labels.csv")


def test_a_label_for_no_video_is_refused(tmp_path):
    np.save(tmp_path / "v.npy", depth16())
    (tmp_path / "labels.csv").write_text("v.npy,0\nw.npy,1\n")
    with pytest.raises(DataError, match="names 'w.npy', which is not among the samples"):
        DepthVideos(inputs=(tmp_path,), labels=tmp_path / "labels.csv").items()


def save_png(path, image):
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), image)
    return path.parent


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda d: save_png(d / "v" / "1.png", np.zeros((4, 5), np.uint16)),
            r"none of its frames \(1\) has a valid depth",
        ),
        (lambda d: save_png(d / "v" / "1.png", np.arange(60, dtype=np.uint8).reshape(4, 5, 3)), "a color image"),
        (lambda d: (np.save(d / "v.npy", np.zeros((0, 4, 5), np.uint16)), d / "v.npy")[1], "empty video"),
        (lambda d: (np.save(d / "v.npy", np.ones((4, 5, 6, 7))), d / "v.npy")[1], "expected numbers \\(frames, height"),
        (lambda d: (np.save(d / "v.npy", np.array([None])), d / "v.npy")[1], "not a readable .npy"),
        (lambda d: ((d / "v.avi").write_bytes(b""), d / "v.avi")[1], "not a readable video"),
        (lambda d: ((d / "v.txt").write_bytes(b""), d / "v.txt")[1], "unknown kind"),
    ],
)
def test_bad_videos(tmp_path, make, message):
    with pytest.raises(DataError, match=message):
        read(make(tmp_path))


def test_bad_images_are_named(tmp_path):
    folder = write_pngs(tmp_path / "v", depth16())
    whole = (folder / "depth_9.png").read_bytes()
    (folder / "depth_9.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"depth_9.png: a truncated PNG"):
        read(folder)
    cv2.imwrite(str(folder / "depth_9.png"), np.ones((3, 3), np.uint16))
    with pytest.raises(DataError, match=r"depth_9.png: 3x3 uint16; the first image is 32x24 uint16"):
        read(folder)


def test_a_truncated_video_gives_the_frames_it_has(tmp_path):
    path = write_video(tmp_path / "v.avi", depth16(frames=20))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    found, _ = read_video(path)
    assert 0 < len(found) < 20
    np.testing.assert_array_equal(found[0], depth16(frames=20)[0])


@pytest.mark.parametrize(
    "suffix, codec", [(".avi", "ffv1"), (".mkv", "ffv1"), (".avi", "libx264"), (".mp4", "libx264")]
)
def test_frames_that_a_video_declares_and_lacks_are_counted(tmp_path, suffix, codec):
    """Written by ffmpeg, cut at several places; the whole one tells nothing of the kind."""
    path, count = tmp_path / f"v{suffix}", 90
    shape = {"libx264": "gray", "ffv1": "gray16le"}[codec]
    depth = np.random.default_rng(0).integers(1, 200, (count, 32, 48)).astype("<u2" if "16" in shape else "u1")
    words = [
        "-f",
        "rawvideo",
        "-pix_fmt",
        shape,
        "-s",
        "48x32",
        "-r",
        "30",
        "-i",
        "-",
        "-c:v",
        codec,
        "-pix_fmt",
        shape,
    ]
    subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *words, "-movflags", "faststart", "-y", path],
        input=depth.tobytes(),
        check=True,
    )
    reader = DepthVideos(inputs=(tmp_path,), fps=30)
    whole = reader.read(reader.items()[0], RNG)
    assert whole.sequence.num_frames == count and not any("declare" in note for note in whole.notes)
    data = path.read_bytes()
    for share in (0.5, 0.8):
        path.write_bytes(data[: int(share * len(data))])
        try:
            cut = reader.read(reader.items()[0], RNG)
        except DataError as error:
            assert "v" + suffix in str(error)
            continue
        lost = sum(number for note, number in cut.notes.items() if "declare" in note)
        assert 0 < cut.sequence.num_frames < count and abs(cut.sequence.num_frames + lost - count) <= 2


def test_folders_without_videos(tmp_path):
    with pytest.raises(DataError, match="no depth video in it"):
        DepthVideos(inputs=(tmp_path,)).items()
    with pytest.raises(DataError, match="no such file or folder"):
        DepthVideos(inputs=(tmp_path / "none",)).items()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"near": 500, "far": 4000},
            "sees depths of 1.5 to 1.501 m, and --near 500 --far 4000 .meters. takes all of them",
        ),
        ({"background": "median", "margin": 50}, "--background median --margin 50 .meters. takes all"),
        ({"background": "first", "far": 1.0}, "--background first --margin 0.05 and --near 0 --far 1"),
    ],
)
def test_options_that_leave_nothing_are_named(tmp_path, options, words):
    np.save(tmp_path / "a.npy", np.stack([np.full((6, 8), 1500 + t, np.uint16) for t in range(2)]))
    reader = DepthVideos(inputs=(tmp_path,), **options)
    (item,) = reader.items()
    with pytest.raises(DataError, match=words):
        reader.read(item, np.random.default_rng(0))
    assert ("in meters" in str(reader.summary([item]))) is (options.get("far") == 4000)


@pytest.mark.parametrize(
    "options",
    [
        {"near": 2, "far": 1},
        {"background": "magic"},
        {"depth_scale": 0},
        {"fps": -1},
        {"fov": 60, "intrinsics": CAMERA},
        {"fov": 200},
        {"margin": -0.1},
    ],
)
def test_impossible_options(tmp_path, options):
    with pytest.raises(UsageError):
        DepthVideos(inputs=(tmp_path,), **options)
