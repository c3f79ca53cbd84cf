"""What raw depths mean: marks of no depth are dropped and counted, and a scene that can't be true stops the conversion."""

from __future__ import annotations

import zlib

import cv2
import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.prepare.actions.depth import DepthVideos
from dpcli.prepare.actions.depth_units import (
    LIKE_KITTI,
    LIKE_RANGES,
    LIKE_VIRTUAL_KITTI,
    UP_TO_ONE,
    require_plausible,
    without_marks,
)
from dpcli.prepare.decode.depth_files import SPREAD
from dpcli.prepare.decode.folder_listing import unreadable_entries
from dpcli.prepare.decode.pinhole_camera import Calibration, Intrinsics
from dpcli.prepare.scans.clouds import CloudFolders

RNG = np.random.default_rng(0)


def sample_of(path, frames, **options):
    np.save(path, frames)
    reader = DepthVideos(inputs=(path,), **options)
    return reader.read(reader.items()[0], RNG)


@pytest.mark.parametrize(
    ("kind", "value", "mark"),
    [
        ("u2", 1500, 65535),
        ("u2", 1500, 65534),
        ("i2", 1500, 32767),
        ("i4", 1500, 65535),
        ("i4", 1500, 2**31 - 1),
        ("u4", 1500, 2**32 - 1),
        ("f4", 1.5, np.nan),
        ("f4", 1.5, np.inf),
        ("f4", 1.5, -np.inf),
        ("f4", 1.5, 1e30),
        ("f8", 1.5, 1e10),
        ("f4", 1.5, 65504),
        ("f4", 1.5, 65535),
    ],
)
def test_marks_of_no_depth_are_dropped_and_counted(tmp_path, kind, value, mark):
    frames = np.full((2, 6, 7), value, kind)
    frames[0, 0, :3] = mark
    frames[1, 5, 5] = 0  # nothing seen, as everybody says it: not worth a word
    sample = sample_of(tmp_path / "v.npy", frames)
    assert np.diff(sample.sequence.frame_offsets).tolist() == [39, 41]
    np.testing.assert_allclose(sample.sequence.points[:, 2], 1.5)
    assert list(sample.notes.values()) == [3] and "dropped" in next(iter(sample.notes))


@pytest.mark.parametrize("frames", [np.full((2, 3, 4), 255, np.uint8), np.full((2, 3, 4), 65532, np.uint16)])
def test_what_may_be_a_depth_is_kept(frames):
    found, notes = without_marks(frames)
    assert found is frames and not notes


@pytest.mark.parametrize(
    ("frames", "options", "message"),
    [
        (
            np.full((1, 4, 5), 4000, "u2"),
            {"depth_scale": 0.00025},
            "at 1.6e[+]07 m .*did you mean --depth-scale 4000, .* 1 m",
        ),
        (
            np.full((1, 4, 5), 1500, "u2"),
            {"depth_scale": 0.001},
            "did you mean --depth-scale 1000, which makes it 1.5 m",
        ),
        (
            np.full((1, 4, 5), 1500, "f4"),
            {},
            "at 1,500 m .*--depth-scale 1000, .*If it is true, say so: --depth-scale 1",
        ),
        (
            np.full((1, 4, 5), 1.5, "f4"),
            {"depth_scale": 1000},
            "at 0.0015 m .*did you mean --depth-scale 1, which makes it 1.5 m",
        ),
    ],
)
def test_units_the_other_way_round_stop_with_the_right_ones(tmp_path, frames, options, message):
    with pytest.raises(DataError, match=message):
        sample_of(tmp_path / "v.npy", frames, **options)


SCENE = np.add.outer(np.arange(48) * 5, 1000 + np.arange(64) * 2).astype(np.uint16)[None]


@pytest.mark.parametrize(
    ("frames", "scale"), [(SCENE * 8, 8000), (SCENE * 8 + 2, 8000), (SCENE * 5, 5000), (SCENE, 0), (SCENE * 16, 0)]
)
def test_steps_of_raw_depths_tell_how_data_sets_store_millimeters(tmp_path, frames, scale):
    notes = sample_of(tmp_path / "v.npy", frames).notes
    assert [scale] == [int(note.split()[-1]) for note in notes] if scale else not notes
    assert not sample_of(tmp_path / "v.npy", frames, depth_scale=5000).notes


def test_wide_pictures_with_few_depths_may_be_those_of_kitti(tmp_path):
    rng = np.random.default_rng(0)
    wide = np.where(rng.random((2, 40, 130)) < 0.2, rng.integers(1280, 20480, (2, 40, 130)), 0).astype(np.uint16)
    assert sample_of(tmp_path / "v.npy", wide).notes == {LIKE_KITTI: 1}
    for scale in (256, 1000):
        assert not sample_of(tmp_path / "v.npy", wide, depth_scale=scale).notes
    assert not sample_of(tmp_path / "v.npy", wide[:, :, :100]).notes
    assert sample_of(tmp_path / "v.npy", np.where(wide == 0, 5001, wide)).notes == {LIKE_VIRTUAL_KITTI: 1}


def test_pictures_of_angles_are_no_cameras(tmp_path):
    """Depth of Structured3D and range images of Ouster's driver would be flat pictures before a camera."""
    with pytest.raises(DataError, match=r"by its name and its shape \(96x48\) it holds panoramas.*cut views out"):
        sample_of(tmp_path / "panorama.npy", np.tile(SCENE, (1, 1, 2))[:, :, :96])
    assert not sample_of(tmp_path / "panorama.npy", SCENE).notes
    assert not sample_of(tmp_path / "v.npy", np.tile(SCENE, (1, 1, 2))[:, :, :96]).notes
    assert sample_of(tmp_path / "v.npy", np.tile(SCENE[:, :16], (1, 1, 4))).notes == {LIKE_RANGES: 1}


def test_floats_that_end_at_one_may_be_shares_of_a_range(tmp_path):
    shares = np.minimum(SCENE / 1200, 1).astype(np.float32)
    assert sample_of(tmp_path / "v.npy", shares).notes == {UP_TO_ONE: 1}
    assert not sample_of(tmp_path / "v.npy", shares, depth_scale=1).notes
    for meters in (shares * 0.99, shares + 0.001 * (shares == 1), np.ones_like(shares)):
        assert not sample_of(tmp_path / "v.npy", meters).notes


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("frame.{}.depth_meters", "depth_meters"),
        ("Depth Long Throw_{}", "Long Throw"),
        ("DepthPerspective_{}", "DepthPerspective"),
        ("distance_to_image_plane_{}", ""),
        ("distance_{}", "distance"),
        ("{}-dpt_beit_large_512", "dpt_beit"),
        ("depth_{}", ""),
        ("distances_walked_at_{}", "distances"),
        ("instance_{}", ""),
    ],
)
def test_names_that_speak_against_depth_in_meters_are_told(tmp_path, name, said):
    for frame in range(2):
        np.save(tmp_path / f"{name.format(frame)}.npy", np.full((6, 8), 1.5, np.float32))
    reader = DepthVideos(inputs=(tmp_path,))
    notes = reader.read(reader.items()[0], RNG).notes
    assert [f"({said})" in note for note in notes] == [True] * bool(said)


@pytest.mark.parametrize(("significant", "most", "told"), [(12, 40000, True), (12, 4000, False), (16, 40000, False)])
def test_pngs_whose_numbers_were_spread_over_all_bits_are_told(tmp_path, significant, most, told):
    data = cv2.imencode(".png", np.linspace(500, most, 48).astype(np.uint16).reshape(6, 8))[1].tobytes()
    chunk = b"sBIT" + bytes([significant])
    (tmp_path / "0.png").write_bytes(data[:33] + b"\0\0\0\1" + chunk + zlib.crc32(chunk).to_bytes(4, "big") + data[33:])
    reader = DepthVideos(inputs=(tmp_path,))
    assert list(reader.read(reader.items()[0], RNG).notes) == [SPREAD.format(significant)] * told


def test_bytes_the_wrong_way_round_are_no_depth(tmp_path):
    with pytest.raises(DataError, match="two bytes of each are the wrong way round"):
        sample_of(tmp_path / "v.npy", SCENE.byteswap())
    noise = RNG.integers(1, 3000, (1, 48, 64)).astype(np.uint16)
    assert not sample_of(tmp_path / "v.npy", noise).notes


def test_values_of_fewer_bits_are_not_counted_back_from_sixteen(tmp_path):
    with pytest.raises(DataError, match="its raw values end at 3095, and --invert counts back from 65535"):
        sample_of(tmp_path / "v.npy", 4095 - SCENE, invert=True)
    assert sample_of(tmp_path / "v.npy", 65535 - SCENE, invert=True).sequence.points[0, 2] == 1
    sample_of(tmp_path / "v.npy", 4095 - SCENE, invert=True, depth_scale=30_000)


def test_one_channel_is_no_other_dimension(tmp_path):
    for frames in (SCENE[..., None], SCENE[:, None]):
        np.testing.assert_allclose(sample_of(tmp_path / "v.npy", frames).sequence.points[0, 2], 1.0)


def test_far_scenes_pass_when_the_user_says_so():
    require_plausible("v", np.full(9, 500, np.float32), 1.0, asked=True)
    with pytest.raises(DataError, match="500 m"):
        require_plausible("v", np.full(9, 500, np.float32), 1.0, asked=False)
    require_plausible("v", np.empty(0, np.float32), 1.0, asked=False)
    with pytest.raises(DataError, match="did you mean --depth-scale 100, which makes it 1.2 m"):  # centimeters
        require_plausible("v", np.full(9, 120, np.float32), 1.0, asked=False)


def test_the_units_of_a_calibration_are_used_unless_others_are_given(tmp_path):
    frames, camera = np.full((1, 4, 5), 1000, np.uint16), Intrinsics(5, 5, 2, 2)
    calibration = Calibration(camera, depth_scale=4000.0)
    assert sample_of(tmp_path / "v.npy", frames, calibration=calibration).sequence.points[0, 2] == 0.25
    assert sample_of(tmp_path / "v.npy", frames, calibration=calibration, depth_scale=500).sequence.points[0, 2] == 2
    with pytest.raises(DataError, match="hardly meant"):
        sample_of(tmp_path / "v.npy", frames, calibration=Calibration(camera, depth_scale=1.0))
    floats = np.full((1, 4, 5), 1.5, np.float32)
    assert (
        sample_of(tmp_path / "v.npy", floats, calibration=Calibration(camera, depth_scale=1.0)).sequence.points[0, 2]
        == 1.5
    )


@pytest.mark.parametrize(
    ("kind", "mark", "largest", "told"),
    [
        ("u2", 2047, 1100, True),
        ("u2", 4095, 3000, True),
        ("u2", 2047, 2046, False),
        ("u2", 60000, 3000, True),
        ("u2", 3000, 1100, False),  # a wall
        ("u1", 255, 120, True),
        ("u1", 255, 253, False),
        ("f4", 1000, 3, True),
        ("f4", 5, 3, False),
    ],
)
def test_the_largest_number_is_told_where_it_seems_a_mark(tmp_path, kind, mark, largest, told):
    frame = np.linspace(largest / 3, largest, 48 * 64).reshape(48, 64).astype(kind)
    frame[5:15] = mark
    notes = sample_of(tmp_path / "a.npy", np.stack([frame, frame]), fov=57).notes
    assert any(f"many pixels hold {mark}" in note for note in notes) == told
    notes = sample_of(tmp_path / "a.npy", np.stack([frame, frame]), fov=57, far=30.0).notes
    assert not any("many pixels hold" in note for note in notes)


def test_folders_that_links_name_are_entered_but_those_above_are_not(tmp_path):
    for place in ("store/v", "raw/b"):
        (tmp_path / place).mkdir(parents=True)
        for k in range(2):
            np.save(tmp_path / place / f"{k}.npy", np.full((4, 5), 1000, "u2"))
    (tmp_path / "raw" / "a").symlink_to(tmp_path / "store")
    (tmp_path / "raw" / "up").symlink_to("..")
    (tmp_path / "store" / "again").symlink_to(tmp_path / "raw")
    assert [item.name for item in DepthVideos(inputs=(tmp_path / "raw",)).items()] == ["a/v", "b"]
    assert [item.name for item in CloudFolders(tmp_path / "raw").items()] == ["a/v", "b"]
    reasons = dict(unreadable_entries(tmp_path / "raw", []))
    assert set(reasons) == {tmp_path / "raw" / "up", tmp_path / "raw" / "a" / "again"}
