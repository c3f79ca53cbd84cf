"""MSR-Action3D: official bytes written by hand, both file forms, splits, and every kind of bad file."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import savemat

from dpcli.errors import DataError, UsageError
from dpcli.prepare.actions.msraction3d import CLASS_NAMES, MSRAction3D, published_names, read_bin, read_mat
from dpcli.prepare.decode.pinhole_camera import Intrinsics, back_project
from tests.support.prepare_helpers import bin_bytes, make_depth, write_msr

RNG = np.random.default_rng(0)


def one(folder: Path, **options):
    reader = MSRAction3D(folder, **options)
    return reader.read(reader.items()[0], RNG).sequence


def plain_points(depth: np.ndarray, focal: float, scale: float) -> list[np.ndarray]:
    """The published back-projection, pixel by pixel."""
    frames = []
    for frame in depth:
        height, width = frame.shape
        frames.append(
            [
                ((u - width / 2) / focal * z / scale, (v - height / 2) / focal * z / scale, z / scale)
                for v in range(height)
                for u in range(width)
                if (z := float(frame[v, u])) > 0
            ]
        )
    return [np.array(points) for points in frames]


@pytest.mark.parametrize(("focal", "scale"), [(280.0, 300.0), (365.5, 1.0)])
def test_clouds_equal_the_published_formula(tmp_path, focal, scale):
    write_msr(tmp_path, ["a01_s01_e01"])
    sequence = one(tmp_path, focal=focal, scale=scale)
    expected = plain_points(make_depth(0), focal, scale)
    assert sequence.num_frames == 3
    for t, points in enumerate(expected):
        np.testing.assert_allclose(sequence.frame(t), points, rtol=3e-7)


@given(st.integers(0, 2**32 - 1), st.floats(100, 1000), st.floats(-3, 12), st.floats(-3, 12))
def test_back_projection_projects_back_onto_its_pixels(seed, focal, cx, cy):
    depth = make_depth(seed, frames=2)
    camera = Intrinsics(focal, focal * 1.1, cx, cy)
    points, counts = back_project(depth, camera)
    x, y, z = points.astype(np.float64).T
    rows = np.rint(y / z * camera.fy + cy).astype(int)
    columns = np.rint(x / z * camera.fx + cx).astype(int)
    again = np.zeros_like(depth)
    again[np.repeat([0, 1], counts), rows, columns] = np.rint(z)
    np.testing.assert_array_equal(again, depth)


def test_a_shifted_principal_point_would_be_noticed():
    depth = make_depth(1, frames=1)
    right, _ = back_project(depth, Intrinsics(280, 280, 4, 3))
    wrong, _ = back_project(depth, Intrinsics(280, 280, 3.5, 3))
    assert np.abs(right - wrong).max() > 1e-3


def test_bin_and_mat_give_equal_clouds(tmp_path):
    depth = make_depth(7, frames=4)
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "a03_s07_e02_sdepth.bin").write_bytes(bin_bytes(depth))
    for form in ("mat5", "mat73"):
        folder = tmp_path / form
        folder.mkdir()
        path = folder / "a03_s07_e02_sdepth.mat"
        if form == "mat5":
            savemat(path, {"depth": depth.astype(np.uint16).transpose(1, 2, 0)}, do_compression=True)
        else:
            with h5py.File(path, "w", userblock_size=512) as file:
                file["depth"] = depth.astype(np.uint16).transpose(0, 2, 1)  # MATLAB's (H,W,T), axes reversed
            with path.open("r+b") as file:
                file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64")
        sequence, official = one(folder), one(tmp_path / "bin")
        np.testing.assert_array_equal(sequence.points, official.points)
        np.testing.assert_array_equal(sequence.frame_offsets, official.frame_offsets)
        assert (sequence.label, sequence.subject, sequence.split) == (2, 7, "test")


def test_the_official_form_wins_over_the_other(tmp_path):
    write_msr(tmp_path, ["a01_s01_e01"])
    savemat(tmp_path / "a01_s01_e01_sdepth.mat", {"depth": np.ones((6, 8, 1), np.uint16)})
    assert [item.path.suffix for item in MSRAction3D(tmp_path).items()] == [".bin"]


def test_videos_that_are_there_twice_and_files_that_are_not_read_are_named(tmp_path):
    for folder in ("one", "two"):
        write_msr(tmp_path / folder, ["a01_s01_e01"])
    (tmp_path / "link").symlink_to(tmp_path / "one")
    for name in ("a01_s01_e01_sdepth.mat", "a02_s01_e01_sdepth (1).bin", "a3_s1_e1_sdepth.bin", "README"):
        (tmp_path / name).touch()
    reader = MSRAction3D(tmp_path)
    kept, twice = reader.items()
    assert kept.path.parent.name == "link" and twice.problem.endswith(f"is there twice; {kept.path} is read")
    lines = reader.summary([kept, twice])
    left = "a01_s01_e01_sdepth.mat, a02_s01_e01_sdepth (1).bin, a3_s1_e1_sdepth.bin"
    assert lines[-1] == f"not read, called otherwise, or beside the .bin of the same video: {left}"
    assert lines[0].startswith("1 of the 567")


@pytest.mark.parametrize("order", ["HWT", "THW", "WHT", "TWH", "HTW", "WTH"])
def test_the_size_of_the_pictures_tells_the_order_of_the_axes(tmp_path, order):
    path, depth = tmp_path / "a01_s01_e01_sdepth.mat", np.zeros((2, 240, 320), np.uint16)
    depth[0, 7, 300], depth[1, 230, 9] = 5, 6
    savemat(path, {"depth": depth.transpose(["THW".index(axis) for axis in order])})
    np.testing.assert_array_equal(read_mat(path), depth)


def test_a_mat_of_one_frame_lost_its_last_axis(tmp_path):
    path = tmp_path / "a01_s01_e01_sdepth.mat"
    savemat(path, {"depth": np.ones((6, 8), np.uint16)})
    assert read_mat(path).shape == (1, 6, 8)


def test_real_files_survive_the_way_through_the_official_bytes(shared_data, tmp_path):
    names = ["a01_s01_e01", "a13_s04_e02", "a20_s09_e03"]
    for name in names:
        depth = read_mat(shared_data / "msraction3d" / f"{name}_sdepth.mat")
        header = np.array([len(depth), depth.shape[2], depth.shape[1]], "<u4").tobytes()
        (tmp_path / f"{name}_sdepth.bin").write_bytes(header + depth.astype("<u4").tobytes())
    official = MSRAction3D(tmp_path)
    matlab = {item.name: item for item in MSRAction3D(shared_data / "msraction3d").items()}
    for item in official.items():
        a, b = official.read(item, RNG).sequence, official.read(matlab[item.name], RNG).sequence
        np.testing.assert_array_equal(a.points, b.points)
        np.testing.assert_array_equal(a.frame_offsets, b.frame_offsets)


def test_the_shared_videos_are_counted_against_the_published(shared_data):
    reader = MSRAction3D(shared_data / "msraction3d")
    lines = reader.summary(reader.items())
    assert lines[0] == "497 of the 567 published videos found"
    assert lines[1].startswith("train: 266/270") and "s03: 3, s04: 1" in lines[1]
    assert lines[2].startswith("test: 231/297") and "s10: 60" in lines[2]


def test_published_counts():
    names = published_names()
    by_class = [sum(name.startswith(f"a{a:02}") for name in names) for a in range(1, 21)]
    subjects = [int(name[5:7]) for name in names]
    assert len(names) == 567 and len(CLASS_NAMES) == 20
    assert by_class == [27] * 3 + [26] * 3 + [28] + [30] * 7 + [20] + [30] * 5
    assert sum(s <= 5 for s in subjects) == 270 and sum(s > 5 for s in subjects) == 297


def test_summary_names_what_is_missing_and_what_is_extra(tmp_path):
    write_msr(
        tmp_path, [n for n in published_names() if n != "a20_s10_e03"] + ["a01_s04_e01"], frames=1, height=1, width=1
    )
    reader = MSRAction3D(tmp_path)
    lines = reader.summary(reader.items())
    assert lines[0].startswith("566 of the 567")
    assert lines[1:] == [
        "train: 270/270",
        "test: 296/297; missing by subject s10: 1",
        "not among the published: a01_s04_e01",
    ]


@given(st.integers(1, 20), st.integers(1, 10), st.integers(1, 3), st.sampled_from(["bin", "mat", "BIN"]))
def test_names_give_label_subject_and_split(tmp_path_factory, action, subject, trial, form):
    folder = tmp_path_factory.mktemp("names")
    (folder / f"a{action:02}_s{subject:02}_e{trial:02}_sdepth.{form}").touch()
    item = MSRAction3D(folder).items()[0]
    split = "train" if subject <= 5 else "test"
    assert (item.name, item.label, item.subject, item.split, item.problem) == (
        f"a{action:02}_s{subject:02}_e{trial:02}",
        action - 1,
        subject,
        split,
        "",
    )


@given(st.text(st.characters(codec="ascii", exclude_characters="/\0"), min_size=1, max_size=20))
def test_other_names_are_not_taken(tmp_path_factory, name):
    if name in (".", ".."):
        return
    folder = tmp_path_factory.mktemp("names")
    (folder / name).touch()
    with pytest.raises(DataError, match="aAA_sSS_eEE_sdepth"):
        MSRAction3D(folder).items()


def test_items_are_found_below_and_sorted(tmp_path):
    write_msr(tmp_path / "Depth", ["a02_s01_e01", "a01_s10_e01", "a01_s02_e01"])
    assert [i.name for i in MSRAction3D(tmp_path).items()] == ["a01_s02_e01", "a01_s10_e01", "a02_s01_e01"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (bin_bytes(make_depth(0))[:-1], "truncated: 3 frames of 8x6 take 588 bytes, found 587"),
        (bin_bytes(make_depth(0))[:7], "7 bytes; the header alone takes 12"),
        (b"", "0 bytes"),
        (bin_bytes(np.zeros((0, 6, 8), int)), "empty video: 0 frames"),
        (bin_bytes(np.zeros((3, 0, 8), int)), "8x0 pixels"),
        (bin_bytes(np.zeros((3, 6, 8), int)), r"none of its frames \(3\) has a valid depth"),
        (b"\xff" * 100, "frames of 4294967295x4294967295 pixels"),
    ],
)
def test_bad_bin_files(tmp_path, content, message):
    (tmp_path / "a01_s01_e01_sdepth.bin").write_bytes(content)
    with pytest.raises(DataError, match=message) as error:
        one(tmp_path)
    assert "a01_s01_e01_sdepth.bin" in str(error.value)


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"other": np.ones((2, 2))}, "no variable 'depth'; found \\['other'\\]"),
        ({"depth": np.full((6, 8, 2), np.nan)}, "NaN or infinity"),
        ({"depth": "text"}, "expected numbers"),
        ({"depth": np.ones((2, 2, 2, 2))}, "expected \\(height, width, frames\\)"),
        ({"depth": np.zeros((6, 8, 0))}, "empty video"),
    ],
)
def test_bad_mat_files(tmp_path, variables, message):
    savemat(tmp_path / "a01_s01_e01_sdepth.mat", variables)
    with pytest.raises(DataError, match=message):
        one(tmp_path)


@pytest.mark.parametrize("keep", [0, 50, 200, 400])
def test_truncated_mat_files(tmp_path, keep):
    path = tmp_path / "a01_s01_e01_sdepth.mat"
    savemat(path, {"depth": make_depth(0, 5).transpose(1, 2, 0)}, do_compression=True)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(DataError, match="a01_s01_e01"):
        one(tmp_path)


def test_truncated_mat_73(tmp_path):
    path = tmp_path / "a01_s01_e01_sdepth.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(600, b"\0"))
    with pytest.raises(DataError, match="7.3"):
        one(tmp_path)


@pytest.mark.parametrize("kind", ["link", "storage", "virtual"])
def test_nothing_is_read_from_the_files_that_a_mat_73_names(tmp_path, kind):
    other = tmp_path / "other"
    with h5py.File(other, "w") as file:
        file["depth"] = np.ones((2, 8, 6), np.uint16)
    with h5py.File(tmp_path / "a01_s01_e01_sdepth.mat", "w", userblock_size=512) as file:
        if kind == "link":
            file["depth"] = h5py.ExternalLink(str(other), "depth")
        elif kind == "storage":
            file.create_dataset("depth", (2, 8, 6), "u2", external=[(str(other), 0, 192)])
        else:
            layout = h5py.VirtualLayout((2, 8, 6), "u2")
            layout[:] = h5py.VirtualSource(str(other), "depth", (2, 8, 6))
            file.create_virtual_dataset("depth", layout)
    with (tmp_path / "a01_s01_e01_sdepth.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file")
    with pytest.raises(DataError, match="of its own; found depth|keeps its data in another file"):
        one(tmp_path)


def test_frames_without_depth_are_dropped_and_counted(tmp_path):
    depth = make_depth(0, frames=4)
    depth[[0, 2]] = 0
    (tmp_path / "a01_s01_e01_sdepth.bin").write_bytes(bin_bytes(depth))
    reader = MSRAction3D(tmp_path)
    sample = reader.read(reader.items()[0], RNG)
    assert sample.sequence.num_frames == 2
    assert sample.notes == {"frames without points dropped": 2}


def test_bytes_after_the_last_frame_are_counted_not_read(tmp_path):
    path = tmp_path / "a01_s01_e01_sdepth.bin"
    path.write_bytes(bin_bytes(make_depth(0)) + b"tail")
    depth, notes = read_bin(path)
    np.testing.assert_array_equal(depth, make_depth(0))
    assert notes == {"files with bytes after the last frame": 1}


def test_an_action_out_of_range_is_a_problem_of_that_item(tmp_path):
    write_msr(tmp_path, ["a01_s01_e01", "a21_s01_e01", "a00_s01_e01"])
    problems = {item.name: item.problem for item in MSRAction3D(tmp_path).items()}
    assert problems["a01_s01_e01"] == ""
    assert "action 21" in problems["a21_s01_e01"] and "action 0 " in problems["a00_s01_e01"]


def test_folders_that_are_none(tmp_path):
    with pytest.raises(DataError, match="does not exist; expected a folder with MSR-Action3D"):
        MSRAction3D(tmp_path / "nowhere").items()
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="is a file"):
        MSRAction3D(tmp_path / "file").items()
    with pytest.raises(UsageError, match="positive"):
        MSRAction3D(tmp_path, focal=0)


@pytest.mark.parametrize(("height", "width"), [(240, 320), (120, 160), (480, 640), (240, 240)])
def test_resized_pictures_need_a_focal_length_of_their_own(tmp_path, height, width):
    write_msr(tmp_path, ["a01_s01_e01"], frames=1, height=height, width=width)
    notes = {}
    for focal in (280.0, 140.0):
        reader = MSRAction3D(tmp_path, focal=focal)
        notes[focal] = " ".join(reader.read(reader.items()[0], RNG).notes)
    assert ("resized, not 320x240" in notes[280.0]) == ((height, width) != (240, 320)) and not notes[140.0]
