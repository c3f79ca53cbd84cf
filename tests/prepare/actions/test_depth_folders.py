"""Folders of depth frames: which files are frames, whatever lies beside, in images, arrays and OpenEXR."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from dpcli.errors import DataError, UsageError
from dpcli.prepare.actions.depth import DepthVideos
from dpcli.prepare.actions.depth_units import LIKE_TUM
from dpcli.prepare.decode.calibration import read_calibration

RNG = np.random.default_rng(0)


def depth(millimeters: int) -> np.ndarray:
    return np.full((6, 8), millimeters, np.uint16)


def write(folder, **images):
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in images.items():
        cv2.imwrite(str(folder / f"{name}.png"), image)
    return folder


def read(folder, **options):
    reader = DepthVideos(inputs=(folder,), **options)
    (item,) = reader.items()
    return reader, reader.read(item, RNG).sequence


def first_depths(sequence):
    return sequence.points[sequence.frame_offsets[:-1], 2].astype(float).round(3).tolist()


def test_hidden_files_and_previews_are_no_frames(tmp_path):
    folder = write(tmp_path / "v", **{"000": depth(1000), "001": depth(1001), "preview": np.zeros((6, 8, 3), np.uint8)})
    (folder / "._000.png").write_bytes(b"\0\5\x16\7")
    reader, sequence = read(folder)
    assert first_depths(sequence) == [1.0, 1.001]
    assert any("left out: preview.png" in line for line in reader.summary(reader.items()))


@pytest.mark.parametrize(
    "names", [("frame-{}.depth", "frame-{}.color"), ("{}_depth", "{}"), ("d_{}", "c_{}"), ("a{}", "b{}")]
)
def test_depth_is_told_from_the_color_beside_by_name_or_by_content(tmp_path, names):
    color = RNG.integers(0, 255, (6, 8, 3)).astype(np.uint8)
    images = {names[0].format(t): depth(1000 + t) for t in (0, 1)} | {names[1].format(t): color for t in (0, 1)}
    reader, sequence = read(write(tmp_path / "v", **images))
    assert first_depths(sequence) == [1.0, 1.001]
    assert any("left out" in line and "2 files" in line for line in reader.summary(reader.items()))


def test_two_series_of_depth_are_listed_and_a_pattern_chooses(tmp_path):
    folder = write(tmp_path / "v", **{f"{side}_{t}": depth(1000 + t) for side in ("left", "right") for t in (0, 1)})
    with pytest.raises(DataError, match="holds 2 series of frames: left_.*, right_.*--pattern"):
        read(folder)
    assert first_depths(read(folder, pattern="right_*")[1]) == [1.0, 1.001]
    with pytest.raises(DataError, match=r"no depth video in it whose names fit --pattern 'up_\*'"):
        read(folder, pattern="up_*")


def test_names_that_are_times_give_the_time(tmp_path):
    names = ("1305031102.175304", "1305031102.211214", "1305031102.4")
    reader, sequence = read(write(tmp_path / "v", **{name: depth(900) for name in names}))
    assert reader.fields == ("time",)
    np.testing.assert_allclose(sequence.time, [0, 0.03591, 0.224696], atol=1e-9)
    np.testing.assert_allclose(read(tmp_path / "v", fps=10)[1].time, [0, 0.1, 0.2])


def test_gaps_in_the_numbers_are_gaps_in_time(tmp_path):
    reader, sequence = read(write(tmp_path / "v", **{f"{n:03d}": depth(900) for n in (4, 5, 9)}), fps=10)
    np.testing.assert_allclose(sequence.time, [0, 0.1, 0.5])
    assert any("6 to 8 missing" in line for line in reader.summary(reader.items()))
    np.testing.assert_allclose(read(tmp_path / "v", fps=10, stride=2)[1].time, [0, 0.5])


def test_arrays_of_one_frame_each_are_one_clip_and_arrays_of_many_are_videos(tmp_path):
    for t in range(3):
        (tmp_path / "frames").mkdir(exist_ok=True)
        np.save(tmp_path / "frames" / f"{t}.npy", depth(1000 + t))
    assert first_depths(read(tmp_path / "frames")[1]) == [1.0, 1.001, 1.002]
    assert [item.name for item in DepthVideos(inputs=(tmp_path,)).items()] == ["frames"]
    for t in range(2):
        np.save(tmp_path / "frames" / f"{t}.npy", depth(1000 + t)[None])
    np.save(tmp_path / "frames" / "2.npy", np.stack([depth(1), depth(2)]))
    assert len(DepthVideos(inputs=(tmp_path / "frames",)).items()) == 3


def test_archives_of_one_frame_each_are_one_clip_and_one_of_many_is_a_video(tmp_path):
    (tmp_path / "frames").mkdir()
    for t in range(2):
        np.savez(tmp_path / "frames" / f"{t}.npz", depth=depth(1000 + t), color=np.zeros((6, 8, 3), np.uint8))
    np.savez(tmp_path / "many.npz", np.stack([depth(1000), depth(1001)]))
    for path in (tmp_path / "frames", tmp_path / "many.npz"):
        assert first_depths(read(path)[1]) == [1.0, 1.001]
    np.savez(tmp_path / "two.npz", a=depth(1), b=depth(2))
    with pytest.raises(DataError, match="two.npz: arrays a, b; expected one called depth"):
        read(tmp_path / "two.npz")


def test_what_an_archive_tells_beside_its_depth_is_used_or_named(tmp_path):
    told = {"K": np.array([[50.0, 0, 4], [0, 51, 3], [0, 0, 1]]), "depth_scale": np.array([0.0001])}
    (tmp_path / "frames").mkdir()
    for t in range(2):
        np.savez(tmp_path / "frames" / f"{t}.npz", depth=depth(1000 + t), times=[t], **told)
    np.savez(tmp_path / "many.npz", depth=np.stack([depth(1000), depth(1001)]), times=[0, 1], **told)
    for path in (tmp_path / "frames", tmp_path / "many.npz"):
        reader, sequence = read(path)
        np.testing.assert_allclose(sequence.points[0], [-4 / 50 / 10, -3 / 51 / 10, 0.1], rtol=1e-6)
        notes = reader.read(reader.items()[0], RNG).notes
        assert any("arrays that are not read (times)" in note for note in notes)
        assert first_depths(read(path, depth_scale=1000)[1]) == [1.0, 1.001]
        assert read(path, fov=60)[1].points[0, 0] < -0.05


@pytest.mark.parametrize(
    ("folder", "names", "what"),
    [
        ("disparity", "{}", "disparities"),
        ("v", "{}_disp", "disparities"),
        ("inv_depth", "{}", "the inverse of depth"),
        ("disparity", "{}_depth", ""),
        ("display", "{}", ""),
    ],
)
def test_what_is_no_depth_by_its_name_is_refused(tmp_path, folder, names, what):
    write(tmp_path / "in" / folder, **{names.format(t): depth(1000 + t) for t in range(2)})
    if what:
        with pytest.raises(DataError, match=f"by its name it holds {what}, not depth"):
            read(tmp_path / "in")
    else:
        assert first_depths(read(tmp_path / "in")[1]) == [1.0, 1.001]


def test_disparities_beside_depth_are_left_out(tmp_path):
    for folder, least in (("disparity", 1000), ("depth", 2000)):
        write(tmp_path / "in" / folder, **{str(t): depth(least + t) for t in range(2)})
    reader, sequence = read(tmp_path / "in")
    assert first_depths(sequence) == [2.0, 2.001]
    assert "left out, by their names beside depth: disparity" in reader.summary(reader.items())


@pytest.mark.parametrize("matrices", [np.eye(4)[None], np.eye(3)[[1, 2, 0]], [[5.0, 0, 3], [0, 5, 2], [0, 0, 1]]])
def test_matrices_of_a_camera_are_no_depth(tmp_path, matrices):
    np.save(tmp_path / "poses.npy", matrices)
    with pytest.raises(DataError, match="poses.npy: holds 1 matrices of a camera, no depth"):
        read(tmp_path / "poses.npy")


def test_files_that_are_not_read_are_named_where_nothing_else_is_there(tmp_path):
    (tmp_path / "a.xef").write_bytes(b"EVENTS1")
    with pytest.raises(DataError, match="no depth video in it.*found 1 .xef: save their depth as 16-bit PNG"):
        read(tmp_path)


def test_a_folder_of_point_clouds_is_sent_to_the_command_that_reads_them(tmp_path):
    (tmp_path / "1.ply").write_text("ply\n")
    with pytest.raises(DataError, match="found 1 .ply: `dpc prepare clouds` reads them"):
        DepthVideos(inputs=(tmp_path,)).items()


def test_a_frame_in_two_formats_is_one_frame(tmp_path):
    folder = write(tmp_path / "v", **{str(t): depth(1000 + t) for t in range(2)})
    for t in range(2):
        np.save(folder / f"{t}.npy", depth(2000 + t))
    reader, sequence = read(folder)
    assert first_depths(sequence) == [1.0, 1.001]
    assert any("left out: *.npy (2 files)" in line for line in reader.summary(reader.items()))


@pytest.mark.parametrize("picture", [np.full((6, 8), 99, np.uint8), RNG.integers(0, 255, (6, 8, 3)).astype(np.uint8)])
def test_pictures_beside_arrays_of_depth_are_left_out(tmp_path, picture):
    folder = write(tmp_path / "v", **{str(t): picture for t in range(2)})
    for t in range(2):
        np.save(folder / f"{t}.npy", depth(2000 + t))
    reader, sequence = read(folder)
    assert first_depths(sequence) == [2.0, 2.001]
    assert any("left out: *.png (2 files)" in line for line in reader.summary(reader.items()))


@pytest.mark.parametrize("channels", [("Y",), ("Z", "A"), ("R", "G", "B"), ("depth.V",), ("R", "G", "B", "Z")])
def test_openexr_frames(tmp_path, channels):
    openexr = pytest.importorskip("OpenEXR")
    for t in range(2):
        values = np.full((6, 8), 1.25 + t, np.float32)
        values[0, 0] = 1e10  # what renderers write where nothing was hit
        pixels = {name: values for name in channels}
        if channels[-1] == "Z":
            pixels |= {"R": values * 0.5}
        header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
        openexr.File(header, pixels).write(str(tmp_path / f"depth_{t:03d}.exr"))
    _, sequence = read(tmp_path)
    assert np.diff(sequence.frame_offsets).tolist() == [47, 47] and first_depths(sequence) == [1.25, 2.25]


def test_openexr_colors_and_damaged_files_are_named(tmp_path):
    openexr = pytest.importorskip("OpenEXR")
    pixels = {name: np.full((6, 8), k, np.float32) for k, name in enumerate("RGB")}
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    openexr.File(header, pixels).write(str(tmp_path / "0.exr"))
    with pytest.raises(DataError, match="0.exr: holds channels B, G, R; expected one called Z or depth"):
        read(tmp_path)
    (tmp_path / "0.exr").write_bytes((tmp_path / "0.exr").read_bytes()[:100])
    with pytest.raises(DataError, match="0.exr: not a readable OpenEXR"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("depth_at", "beside"),
    [
        ("scene/depth", ["scene/confidence", "scene/rgb"]),
        ("scene/lowres_depth", ["scene/lowres_wide_confidence"]),
        ("depth/anna", ["confidence/anna", "ir/anna"]),
        ("depth", ["depth_vis", "masks"]),
        ("depth_left", ["seg_left"]),
    ],
)
def test_folders_beside_depth_are_left_out_by_name(tmp_path, depth_at, beside):
    write(tmp_path / "in" / depth_at, **{"0": depth(1000), "1": depth(1001)})
    for name in beside:
        write(tmp_path / "in" / name, **{str(t): np.full((6, 8), 255, np.uint8) for t in (0, 1)})
    reader, sequence = read(tmp_path / "in")
    assert first_depths(sequence) == [1.0, 1.001]
    assert f"left out, by their names beside depth: {', '.join(sorted(beside))}" in reader.summary(reader.items())
    reader = DepthVideos(inputs=(tmp_path / "in" / beside[0],))
    assert len(reader.items()) == 1  # who names it, gets it


def test_masks_of_each_object_beside_depth_need_no_pattern(tmp_path):
    """Folders as BOP has them: depth, and masks named FRAME_OBJECT."""
    write(tmp_path / "depth", **{f"{t:06d}": depth(1000 + t) for t in (0, 1)})
    for folder in ("mask", "mask_visib"):
        write(tmp_path / folder, **{f"{t:06d}_{k:06d}": np.zeros((6, 8), np.uint8) for t in (0, 1) for k in (0, 1)})
    reader, sequence = read(tmp_path)
    assert first_depths(sequence) == [1.0, 1.001]
    assert "left out, by their names beside depth: mask, mask_visib" in reader.summary(reader.items())


@pytest.mark.parametrize(("name", "told"), [("associations.txt", True), ("depth.txt", True), ("notes.txt", False)])
def test_far_depths_beside_the_lists_of_tum_are_told(tmp_path, name, told):
    write(tmp_path / "depth", **{str(t): depth(7003 + t) for t in (0, 1)})
    (tmp_path / name).write_text("0 depth/0.png\n1 depth/1.png\n")
    reader = DepthVideos(inputs=(tmp_path,))
    assert (LIKE_TUM.format(name) in reader.read(reader.items()[0], RNG).notes) is told
    near = DepthVideos(inputs=(tmp_path,), depth_scale=5000)
    assert not near.read(near.items()[0], RNG).notes


def test_depth_aligned_to_color_is_not_of_the_depth_camera(tmp_path):
    """What a file of both cameras of a RealSense says, in pictures as DexYCB names them."""
    cameras = {name: {"fx": f, "fy": f, "ppx": 3.5, "ppy": 2.5} for name, f in (("color", 16.0), ("depth", 10.0))}
    (tmp_path / "both.json").write_text(json.dumps(cameras))
    (tmp_path / "color.json").write_text(json.dumps(cameras["color"]))
    folder = write(tmp_path / "v", **{f"aligned_depth_to_color_{t}": depth(1000) for t in (0, 1)})
    both, color = (read_calibration(tmp_path / f"{name}.json") for name in ("both", "color"))
    with pytest.raises(
        DataError, match=r"aligned to the color camera, but of the cameras in .*both.json the one called depth"
    ):
        read(folder, calibration=both)
    np.testing.assert_allclose(read(folder, calibration=color)[1].points[0], [-3.5 / 16, -2.5 / 16, 1])
    assert f"{tmp_path / 'both.json'}: the camera called depth is taken" in both.notes()
    (tmp_path / "rgb.json").write_text(json.dumps({"rgb_intrinsics": cameras["color"]}))
    colors = read_calibration(tmp_path / "rgb.json")
    assert "rgb_intrinsics is taken, which is right for depth that was aligned to the colors" in colors.notes()[0]
    assert read(folder, calibration=colors)[1].points[0, 0] == pytest.approx(-3.5 / 16)


def test_folders_of_other_names_stay(tmp_path):
    for name in ("anna", "depth", "ben"):
        write(tmp_path / "in" / name, **{"0": depth(1000)})
    write(tmp_path / "other" / "image_browsing", **{"0": depth(1000)})
    assert len(DepthVideos(inputs=(tmp_path / "in", tmp_path / "other")).items()) == 4


@pytest.mark.parametrize("beside", ["ir", "thermal", "ab", "nir", "left", "camera2", "reflectivity", "body_index", "x"])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_folder_of_the_same_frames_beside_depth_is_no_other_video(tmp_path, beside, kind):
    for name, first in (("depth", 1000), (beside, 50)):
        write(
            tmp_path / "v" / name,
            **{f"{t:03d}": depth(first + t).astype(kind if first < 99 else np.uint16) for t in (0, 1)},
        )
    reader, sequence = read(tmp_path / "v")
    assert first_depths(sequence) == [1.0, 1.001]
    assert any(beside in line and "left out" in line for line in reader.summary(reader.items()))


@pytest.mark.parametrize("names", ["abcde", ("wave_a", "wave_d"), ("axis y", "axis z"), ("D", "E")])
def test_a_take_that_a_letter_counts_is_no_folder_of_depth(tmp_path, names):
    for name in names:
        write(tmp_path / "push" / name, **{f"{t:03}": depth(1000 + t) for t in range(3)})
    reader = DepthVideos(inputs=(tmp_path,))
    assert [item.name for item in reader.items()] == [f"push/{name}" for name in sorted(names)]


def test_brightness_beside_each_frame_is_left_out_and_the_advised_pattern_takes_one_series(tmp_path):
    folder = write(tmp_path / "v", **{f"{t}{end}": depth(1000 + t) for t in (0, 1) for end in ("", "_ab")})
    reader, sequence = read(folder)
    assert first_depths(sequence) == [1.0, 1.001]
    assert any("left out: *_ab.png (2 files)" in line for line in reader.summary(reader.items()))
    folder = write(tmp_path / "w", **{f"{t}{end}": depth(1000 + t) for t in (0, 1) for end in ("", "_b")})
    with pytest.raises(DataError, match="holds 2 series") as told:
        read(folder)
    assert first_depths(read(folder, pattern=str(told.value).split("'")[1])[1]) == [1.0, 1.001]


@pytest.mark.parametrize(
    "name",
    [
        "camera_matrix.csv",
        "intrinsic/intrinsic_depth.txt",
        "cam_params.json",
        "cameras/17.json",
        "K.txt",
        "../calib.txt",
    ],
)
def test_a_camera_beside_the_frames_that_is_not_read_is_named(tmp_path, name):
    write(tmp_path / "scene" / "depth", **{"0": depth(1000), "1": depth(1001)})
    place = tmp_path / "scene" / name
    place.parent.mkdir(exist_ok=True)
    place.write_text("50 0 4\n0 50 3\n0 0 1\n")
    (tmp_path / "scene" / "scale.txt").write_text("1")
    readers = [DepthVideos(inputs=(tmp_path / "scene",), fov=fov) for fov in (None, 60)]
    told = [reader.summary(reader.items()) for reader in readers]
    said = f"{'scene/' if name[0] != '.' else ''}{name.removeprefix('../')}: not read; if the camera is in there"
    assert [any(line.startswith(said) for line in lines) for lines in told] == [True, False]


@pytest.mark.parametrize(
    "name", ["../groundtruth.txt", "frame-000000.pose.txt", "../pose/0.txt", "odometry.csv", "noposes.txt"]
)
def test_poses_beside_the_frames_that_are_not_read_are_named(tmp_path, name):
    folder = write(tmp_path / "scene" / "depth", **{"000": depth(1000), "001": depth(1001)})
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_text("0 0 0 0 0 0 0 1")
    reader = DepthVideos(inputs=(tmp_path / "scene",), fov=60)
    where = "scene/" if name[:2] == ".." else "scene/depth/"
    told = f"{where}{name.removeprefix('../')}: not read; if the camera moved, points stay in its axes of each moment"
    assert (told in reader.summary(reader.items())) is (name != "noposes.txt")


def test_the_camera_of_one_video_is_not_that_of_all(tmp_path):
    """Two Kinects, each with its own calibration beside its pictures, and ScanNet's files of intrinsics."""
    for number in (1, 2):
        write(tmp_path / f"cam{number}" / "depth", **{str(t): depth(1000 + t) for t in (0, 1)})
        text = json.dumps({"fx": 10.0 * number, "fy": 10.0 * number, "cx": 3.5, "cy": 2.5})
        (tmp_path / f"cam{number}" / "intrinsics.json").write_text(text)
    first = read_calibration(tmp_path / "cam1" / "intrinsics.json")
    reader = DepthVideos(inputs=(tmp_path,), calibration=first)
    assert any("for all 2 videos, cam2/intrinsics.json for none" in line for line in reader.summary(reader.items()))
    alone = DepthVideos(inputs=(tmp_path / "cam1",), calibration=first)
    assert not any("for none" in line for line in alone.summary(alone.items()))
    (tmp_path / "cam1" / "intrinsics.json").unlink()
    for name in ("extrinsic_color", "extrinsic_depth", "intrinsic_color", "intrinsic_depth"):
        (tmp_path / "cam1" / f"{name}.txt").write_text("1 0 0\n0 1 0\n0 0 1\n")
    guess = DepthVideos(inputs=(tmp_path / "cam1",))
    assert any(line.startswith("cam1/intrinsic_depth.txt: not read") for line in guess.summary(guess.items()))


@pytest.mark.parametrize("name", ["../depth_scale.txt", "depth_units.json", "../scale.txt", "timescale.txt"])
def test_the_unit_of_depth_beside_the_frames_that_is_not_read_is_named(tmp_path, name):
    """An L515 counts quarters of millimeters, which nothing else tells."""
    folder = write(tmp_path / "scene" / "depth", **{"000": depth(1000), "001": depth(1001)})
    (folder / name).write_text("0.00025")
    told = f"scene/{'' if name[:2] == '..' else 'depth/'}{name.removeprefix('../')}: not read; if it tells the unit of depth,"
    for scale in (None, 4000.0):
        reader = DepthVideos(inputs=(tmp_path / "scene",), depth_scale=scale)
        lines = reader.summary(reader.items())
        assert any(line.startswith(told) for line in lines) is (scale is None and name != "timescale.txt")


def test_a_topic_without_a_recording_is_refused(tmp_path):
    write(tmp_path / "a", **{"000": depth(1000), "001": depth(1001)})
    with pytest.raises(UsageError, match="--topic /depth: no recording"):
        DepthVideos(inputs=(tmp_path,), topic="/depth").items()


def test_what_is_not_read_beside_the_videos_is_counted(tmp_path):
    write(tmp_path / "a" / "good", **{"000": depth(1000), "001": depth(1001)})
    write(tmp_path / "a" / "empty")
    for name in ("a/jpegs/0.jpg", "a/jpegs/1.JPG", "clip.wmv", "a/good/0.zip", ".hidden/x.zip"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "b.zarr" / "c").mkdir(parents=True)
    (tmp_path / "b.zarr" / "c" / "0").write_bytes(b"x")
    lines = DepthVideos(inputs=(tmp_path,)).summary(DepthVideos(inputs=(tmp_path,)).items())
    assert "not read: 1 .wmv file, 1 .zarr file, a/empty (empty), a/jpegs/2 .jpg files" in lines


def test_folders_of_people_beside_one_another_stay_videos_whatever_their_frames_are_called(tmp_path):
    for name in ("left", "right", "anna"):
        write(tmp_path / "v" / name, **{f"{t:03d}": depth(1000 + t) for t in (0, 1)})
    assert len(DepthVideos(inputs=(tmp_path / "v",)).items()) == 3


@pytest.mark.parametrize("name", ["ir", "IR", "cam_ir", "infra1", "Infrared", "thermal", "abimage"])
def test_pictures_of_an_infrared_camera_alone_are_refused_by_their_name(tmp_path, name):
    folder = write(tmp_path / "v" / name, **{f"{t:03d}": depth(1000 + t) for t in (0, 1)})
    for given in (folder, tmp_path / "v"):
        with pytest.raises(DataError, match="infrared camera, not depth; give the folder of the depth"):
            read(given)


@pytest.mark.parametrize("name", ["ir_depth", "air", "first", "stir", "mirror"])
def test_names_that_only_hold_these_letters_are_read(tmp_path, name):
    folder = write(tmp_path / "v" / name, **{f"{t:03d}": depth(1000 + t) for t in (0, 1)})
    assert first_depths(read(folder)[1]) == [1.0, 1.001]
