"""Frames in folders: what belongs to a clip, the order of its frames, their times, and gaps in their numbers."""

from __future__ import annotations

import unicodedata
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError
from dpcli.prepare.series import about_series, choose_series, is_beside, missing_numbers

CLOUDS = (".ply", ".pcd", ".npy", ".bin", ".csv", ".txt")


def chosen(*names, **options):
    return choose_series(Path("clip"), names, suffixes=CLOUDS, **options)


@pytest.mark.parametrize(
    ("names", "frames", "left_out"),
    [
        (["._0.ply", "0.ply", ".hidden.ply", "1.ply", "~$1.ply"], ["0.ply", "1.ply"], ()),
        (["0.npy", "1.npy", "README.txt"], ["0.npy", "1.npy"], ("README.txt",)),
        (["0.csv", "1.csv", "calib_cam.txt", "times.txt"], ["0.csv", "1.csv"], ("calib_cam.txt", "times.txt")),
        (["0.npy", "1.npy", "0.csv", "1.csv"], ["0.npy", "1.npy"], ("*.csv (2 files)",)),
        (["a_0.pcd", "a_1.pcd", "a_0.ply", "a_1.ply"], ["a_0.ply", "a_1.ply"], ("a_*.pcd (2 files)",)),
        (["0.ply", "1.pcd", "2.ply"], ["0.ply", "1.pcd", "2.ply"], ()),
        (["f1.ply", "f2.ply", "whole.ply"], ["f1.ply", "f2.ply"], ("whole.ply",)),
        (["s_1.bin", "s_2.bin", "s_3.bin", "map7.bin"], ["s_1.bin", "s_2.bin", "s_3.bin"], ("map7.bin",)),
        (["b.ply", "a.ply", "c.ply"], ["a.ply", "b.ply", "c.ply"], ()),
        (["9bc1.ply", "3f2a.ply", "77aa.ply", "1e5f.ply"], ["1e5f.ply", "3f2a.ply", "9bc1.ply", "77aa.ply"], ()),
        (["IMG_2.PLY", "img_1.ply"], ["img_1.ply", "IMG_2.PLY"], ()),
    ],
)
def test_what_belongs_to_a_clip(names, frames, left_out):
    series = chosen(*names)
    assert list(series.names) == frames and series.left_out == left_out


@pytest.mark.parametrize(
    "names",
    [
        ["cup_0.ply", "cup_1.ply", "bowl_0.ply", "bowl_1.ply"],
        ["cup1_0.ply", "cup1_1.ply", "cup2_0.ply", "cup2_1.ply"],
        ["cam1_100.ply", "cam1_105.ply", "cam1_111.ply", "cam2_100.ply", "cam2_105.ply", "cam2_111.ply"],
        [
            "20240101_100000_cam0.ply",
            "20240101_100001_cam0.ply",
            "20240101_100000_cam1.ply",
            "20240101_100001_cam1.ply",
        ],
        ["1700000000000_1.bin", "1700000000100_1.bin", "1700000000000_2.bin", "1700000000090_2.bin"],
        ["left-3.bin", "left-4.bin", "right-3.bin", "right-4.bin", "right-5.bin"],
        [  # of nuScenes: when the log began, and when the frame was taken
            "n008-2018-08-01-15-16-36-0400__LIDAR_TOP__1533151603547590.pcd.bin",
            "n008-2018-08-01-15-16-36-0400__LIDAR_TOP__1533151606547590.pcd.bin",
            "n008-2018-08-28-16-43-51-0400__LIDAR_TOP__1535489296047917.pcd.bin",
            "n008-2018-08-28-16-43-51-0400__LIDAR_TOP__1535489299047917.pcd.bin",
        ],
    ],
)
def test_several_clips_in_a_folder_are_listed_and_one_can_be_named(names):
    with pytest.raises(DataError, match="clip: holds 2 series of frames: .*name one: --pattern '") as caught:
        chosen(*names)
    pattern = str(caught.value).split("--pattern '")[1].split("'")[0]
    series = chosen(*names, pattern=pattern)
    assert 1 < len(series.names) < len(names) and len(series.left_out) == 1
    assert chosen(*names, pattern="none*") is None


def test_a_pattern_may_join_what_no_rule_would():
    assert len(chosen("cup_0.ply", "bowl_0.ply", "README.txt", pattern="*.ply").names) == 2


def test_a_pattern_that_fits_several_series_is_told():
    series = chosen(
        *(f"{thing}_{k}.ply" for thing in ("cup", "bowl") for k in range(3)), "door_0.ply", pattern="*[lp]_*"
    )
    assert series.joined == ("bowl_*.ply (3 files)", "cup_*.ply (3 files)") and series.left_out == ("door_0.ply",)
    told = "v: the pattern joins 2 series in the order of their names: bowl_*.ply (3 files), cup_*.ply (3 files)"
    assert told in about_series([("v", series)])


def test_nothing_but_texts_about_frames_is_no_clip():
    assert chosen("poses.txt", "README.txt", "labels.csv") is None
    assert chosen("poses.npy", "camera_intrinsics.npy", "timestamps.npz") is None
    assert chosen("0.npy", "1.npy", "K.npy").left_out == ("K.npy",)
    assert not is_beside("pose_1.npy") and not is_beside("camera1.npy")
    assert is_beside("calib_cam_to_cam.txt") and not is_beside("frame_1.txt") and not is_beside("poses.ply")


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["a_22.334Z.xyz", "a_22.3405Z.xyz", "a_22.4Z.xyz", "a_23Z.xyz"], None),
        (
            ["t_2022-11-07T19_50_22.334Z.xyz", "t_2022-11-07T19_50_22.4Z.xyz", "t_2022-11-07T19_51_00Z.xyz"],
            [0, 0.066, 37.666],
        ),
        (["28-02-2024_10-00-00.ply", "29-02-2024_10-00-00.5.ply", "13-03-2024_10-00-00.ply"], [0, 86400.5, 1209600]),
        (["28.02.2024 10.00.00.ply", "13.03.2024 10.00.00.ply"], [0, 1209600]),
        (["02-28-2024 10.00.00.ply", "03-13-2024 10.00.00.ply"], [0, 1209600]),
        (["01-02-2024_10-00-00.ply", "02-02-2024_10-00-00.ply"], None),
        (["20241027T025959.5+0200.ply", "20241027T020000+0100.ply", "20241027T020001+0100.ply"], [0, 0.5, 1.5]),
        (["20221107_195059.ply", "20221107_195100.ply", "20221107_195101.ply"], [0, 1, 2]),
        (["1305031102.175304.png", "1305031102.211214.png"], [0, 0.03591]),
        (["1305031102_175304000.png", "1305031102_211214000.png"], [0, 0.03591]),
        (["1403636579763555584.png", "1403636579813555456.png"], [0, 0.049999872]),
        (["1700000000_5000000.png", "1700000000_50000000.png", "1700000000_105000000.png"], [0, 0.045, 0.1]),
        (["1700000000000.bin", "1700000000100.bin"], [0, 0.1]),
        ([f"20240101_10000{k // 2}_{1704103200000 + 400 * k}.bin" for k in range(4)], [0, 0.4, 0.8, 1.2]),
        (["7_1305031102.175304.png", "8_1305031102.211214.png"], [0, 0.03591]),
        (["1305031102.9.pcd", "1305031102.50.pcd", "1305031102.500000000.pcd"], [0, 41e-9, 0.499999991]),
        (["12.345000.pcd", "12.400000.pcd"], [0, 0.055]),
        (["41048190_99.916.png", "41048190_100.016.png", "41048190_100.132.png"], [0, 0.1, 0.216]),
        (
            ["0000001-000000000000.png", "0000002-000000033369.png", "0000003-001000066737.png"],
            [0, 0.033369, 1000.066737],
        ),
        (["scan_99.916.png", "scan_100.016.png"], None),
        (["0000001-000000000001.png", "0000002-000000000002.png", "0000003-000000000003.png"], None),
        (["315966265259836000.bin", "315966265359836000.bin"], [0, 0.1]),
        (["v1.2.ply", "v1.9.ply", "v1.10.ply"], None),
        (["frame_1.ply", "frame_2.ply", "frame_10.ply"], None),
        ([f"f_{k:03x}.ply" for k in range(0x98, 0xA4)], None),
        (["1234567890_000001.ply", "1234567890_000002.ply"], None),
        (["1234567890_0000001.ply", "1234567890_0000002.ply"], None),
        (["10-00.ply", "10-30.ply", "11-00.ply", "11-30.ply"], None),
        (["1305031102-100000.ply", "1305031102-200000.ply", "1305031103-100000.ply", "1305031103-200000.ply"], None),
    ],
)
def test_order_and_times_that_names_tell(names, times):
    series = choose_series(Path("clip"), list(reversed(names)))
    assert list(series.names) == names
    if times is None:
        assert series.times() is None
    else:
        np.testing.assert_allclose(series.times(), times, atol=1e-9)


@given(st.lists(st.integers(0, 999_999_999), min_size=1, max_size=30, unique=True), st.booleans())
@settings(max_examples=100, derandomize=True)
def test_cut_fractions_and_padded_ones_are_in_the_order_of_time(nanoseconds, cut):
    ordered = sorted(nanoseconds)
    names = [f"s_5.{n:09d}" for n in ordered]
    names = [name.rstrip("0").rstrip(".") if cut else name for name in names]
    found = choose_series(Path("clip"), [f"{name}.ply" for name in sorted(names, reverse=True)])
    # cut fractions that all could be whole numbers, such as 5.9 and 5.10, can't be told from versions
    if not cut or any(name.partition(".")[2].startswith("0") for name in names):
        assert [name.removesuffix(".ply") for name in found.names] == names


_WRITTEN = {
    "sec_nsec": (1e9, lambda t, when: f"{t // 10**9}_{t % 10**9}"),
    "sec_nsec, padded": (1e9, lambda t, when: f"{t // 10**9}_{t % 10**9:09d}"),
    "sec-nsec": (1e9, lambda t, when: f"{t // 10**9}-{t % 10**9:09d}"),
    "frame, sec_nsec": (1e9, lambda t, when: f"cam_{t // 10**9}_{t % 10**9}"),
    "sec_usec": (1e6, lambda t, when: f"{t // 10**9}_{t % 10**9 // 1000}"),
    "sec_msec": (1e3, lambda t, when: f"{t // 10**9}_{t % 10**9 // 10**6}"),
    "sec_msec, padded": (1e3, lambda t, when: f"{t // 10**9}_{t % 10**9 // 10**6:03d}"),
    "ms with fractions": (1e6, lambda t, when: f"x_Depth_{t // 10**6}.{t % 10**6 // 1000:03d}000"),
    "us with fractions": (1e6, lambda t, when: f"x_Depth_{t // 1000}.000000"),
    "ticks": (1e7, lambda t, when: f"{(t + 62135596800 * 10**9) // 100}"),
    "ticks of Windows": (1e7, lambda t, when: f"{(t + 11644473600 * 10**9) // 100}"),
    "date_us": (1e6, lambda t, when: when.strftime("%Y%m%d_%H%M%S_") + str(when.microsecond)),
    "date-us": (1e6, lambda t, when: when.strftime("%Y-%m-%d-%H-%M-%S-%f")),
    "date_ms": (1e3, lambda t, when: when.strftime("%Y%m%d_%H%M%S_") + str(when.microsecond // 1000)),
    "date-ms": (1e3, lambda t, when: when.strftime("%Y-%m-%d_%H-%M-%S-") + f"{when.microsecond // 1000:03d}"),
}


@pytest.mark.parametrize("written", list(_WRITTEN))
@given(moments=st.lists(st.integers(0, 10_000), min_size=12, max_size=40, unique=True), start=st.integers(0, 10**9 - 1))
@settings(max_examples=40, deadline=None)
def test_parts_of_a_second_are_told_from_all_names_together(written, moments, start):
    resolution, write = _WRITTEN[written]
    first = 1_700_000_000 * 10**9 + start
    every = [first + moment * 2_345_678 for moment in [*moments, *range(10_001, 10_900, 9)]]  # some have all digits
    epoch = datetime(1970, 1, 1, tzinfo=timezone.utc)
    names = {t: write(t, epoch + timedelta(microseconds=t // 1000)) + ".ply" for t in every}
    series = chosen(*sorted(names.values()))
    assert list(series.names) == [names[t] for t in sorted(every)]
    expected = (np.array(sorted(every)) - min(every)) / 1e9
    np.testing.assert_allclose(series.times(), expected, atol=2 / resolution)


@pytest.mark.parametrize(
    "stem", ["20240305_143000_{}", "rec_2024-03-05_14-30-00_{}", "20240305_1430{1:02d}_{0}", "1700000000_{}"]
)
@pytest.mark.parametrize("form", ["{}", "{:04d}", "{:06d}"])
def test_numbers_that_go_on_from_name_to_name_are_no_parts_of_a_second(stem, form):
    names = [stem.format(form.format(k), k) + ".ply" for k in range(1, 25)]
    series = chosen(*names)
    assert list(series.names) == names
    seconds = np.arange(24) if "{1" in stem else None
    assert series.times() is None if seconds is None else np.array_equal(series.times(), seconds)


def test_gaps_stay_gaps_in_time_and_are_named():
    series = chosen(*(f"{n:010d}.bin" for n in (0, 1, 2, 7, 8)))
    np.testing.assert_allclose(series.frame_times(10), [0, 0.1, 0.2, 0.7, 0.8])
    assert series.frame_times(None) is None
    assert missing_numbers(series.numbers()) == ["3 to 6"]
    both = chosen("0000001-000000033369.bin", "0000002-000000066738.bin", "0000004-000000133476.bin")
    np.testing.assert_allclose(both.frame_times(10), [0, 0.1, 0.3])
    assert about_series([("a", series)]) == ["a: its frames are numbered with gaps: 3 to 6 missing"]
    np.testing.assert_allclose(chosen("10.bin", "15.bin", "20.bin", "30.bin").frame_times(5), [0, 0.2, 0.4, 0.8])


def test_the_name_that_says_depth_is_taken_and_the_color_named():
    for names in (
        ["frame-1.depth.png", "frame-1.color.png"],
        ["1.png", "1_depth.png"],
        ["rgb1.png", "depth1.png", "depth_vis1.png"],
    ):
        again = [name.replace("1", "2") for name in names]
        series = choose_series(Path("clip"), names + again, wanted=r"^(?!.*vis).*depth")
        assert len(series.names) == 2 and all("depth" in name for name in series.names)
        assert len(series.left_out) == len(names) - 1


@pytest.mark.parametrize("form", ("take{}_{:03d}.ply", "{}/{:d}", "rec-{}-frame-{:04d}.pcd"))
@pytest.mark.parametrize("firsts", ((0, 3), (2, 5, 7), (1, 1, 4)))
def test_counts_that_overlap_are_several_series(tmp_path, form, firsts):
    names = [form.replace("/", "+").format(k, first + t) for k, first in enumerate(firsts) for t in range(5 + k)]
    with pytest.raises(DataError, match=f"holds {len(firsts)} series"):
        choose_series(tmp_path, names)


def test_counts_that_go_on_are_one_series_of_which_the_log_tells_two_numbers(tmp_path):
    names = [f"seq{k}_{t:03d}.ply" for k, some in enumerate((range(5), range(5, 12), range(14, 18))) for t in some]
    series = choose_series(tmp_path, names)
    assert len(series.names) == 16
    assert any("two numbers vary" in line and "not the 3" in line for line in about_series([("a", series)]))


def test_minutes_and_seconds_are_one_count(tmp_path):
    names = [f"{k // 60:02d}_{k % 60:02d}.ply" for k in range(630, 730, 7)]
    series = choose_series(tmp_path, names[::-1])
    assert list(series.names) == names and about_series([("a", series)]) == []


@pytest.mark.parametrize("pair", (("Frame_", "frame_"), ("Bänd_", unicodedata.normalize("NFD", "Bänd_"))))
def test_names_that_differ_in_spelling_alone_are_one_count_unless_numbers_come_twice(tmp_path, pair):
    names = [f"{pair[t % 2]}{t:02d}.ply" for t in range(12)]
    assert list(choose_series(tmp_path, sorted(names)).names) == names
    with pytest.raises(DataError, match="holds 2 series"):
        choose_series(tmp_path, [f"{one}{t}.ply" for one in pair for t in range(4)])


def test_an_order_that_no_number_tells_is_told(tmp_path):
    words = choose_series(tmp_path, ["first.ply", "second.ply", "third.ply"])
    assert "no number counts its frames" in about_series([("a", words)])[0]
    assert about_series([("a", choose_series(tmp_path, ["a1.ply", "a2.ply"]))]) == []
    hexadecimal = [f"{number:02x}.ply" for number in range(20)]
    assert about_series([("a", choose_series(tmp_path, hexadecimal))]) == []


def test_a_link_to_another_sample_is_told(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "latest").symlink_to("a")
    twice = [(name, choose_series(tmp_path / name, ["0.ply", "1.ply"])) for name in ("a", "latest")]
    assert about_series(twice) == ["a and latest are the same files by a link: samples that are there twice"]
