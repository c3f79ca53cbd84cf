"""Which frames and points a network sees: published clip counts, fairness of the draw, coordinates."""

from __future__ import annotations

import re
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from dpcli.classify.data.augment import NONE, PEERS, Augmentation
from dpcli.classify.data.clips import (
    Clip,
    ClipSource,
    clip_frames,
    clip_starts,
    normalize,
    sample_points,
    uniform_frames,
)
from dpcli.classify.data.validation_split import (
    about_absent_classes,
    about_frequent_class,
    about_people,
    about_tested_people,
    carve_validation,
    default_rule,
    folds,
    lasting_rule,
)
from dpcli.classify.data.videos import report_short
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.settings import training_settings
from dpcli.errors import DataError, UsageError
from dpcli.runtime.seeds import generator
from dpcli.runtime.settings.catalog import Given
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter

CONFIG = KinetConfig(
    num_classes=2, num_frames=4, points_per_frame=16, centroids=(8, 4), neighbors=4, widths=((8, 8), (8, 8), (8, 8))
)


@pytest.fixture
def reader(tmp_path) -> CloudsReader:
    with CloudsWriter(tmp_path / "c.h5", class_names=["a", "b"]) as writer:
        for i, length in enumerate((2, 4, 7, 10, 9, 8)):
            # frame t holds the value t in its first coordinate: a clip tells which frames it has
            frames = [np.full((5 + 7 * t, 3), [t, i, 0], np.float32) for t in range(length)]
            writer.write(
                CloudSequence.from_frames(f"v{i}", frames, label=i % 2, split="train" if i < 5 else "test", subject=i)
            )
    return CloudsReader(tmp_path / "c.h5")


def test_frames_without_points_are_told_where_clips_show_them(tmp_path, capsys):
    some, none = np.ones((5, 3), np.float32), np.zeros((0, 3), np.float32)
    with CloudsWriter(tmp_path / "e.h5", class_names=["a"]) as writer:
        for name, frames in (
            ("whole", [some] * 5),
            ("gaps", [none, some, some, none, some]),
            ("other", [none, some] * 3),
        ):
            writer.write(CloudSequence.from_frames(name, frames, label=0))
    empty = CloudsReader(tmp_path / "e.h5")
    report_short(ClipSource(empty, [0, 1], CONFIG))
    assert "2 frames without points in 1 video taken as points at the origin: gaps" in capsys.readouterr().err
    report_short(ClipSource(empty, [0], CONFIG))
    report_short(ClipSource(empty, [0, 1], CONFIG.changed(scales=(1.0,)), timing="slots"))
    assert capsys.readouterr().err == ""


def test_every_start_and_spread_clips():
    assert clip_starts(7, 4, None) == [0, 1, 2, 3] and clip_starts(4, 4, None) == [0] and clip_starts(2, 4, None) == [0]
    assert clip_starts(24, 4, 3) == [0, 10, 20] and clip_starts(24, 4, 1) == [10] and clip_starts(5, 4, 9) == [0, 1]
    assert clip_frames(3, 5, 0) == (0, 1, 2, 2, 2)
    assert uniform_frames(80, 8) == tuple(int(j * 80 / 8) for j in range(8)) and uniform_frames(3, 6) == (
        0,
        0,
        1,
        1,
        2,
        2,
    )


def test_published_clip_counts(shared_data):
    """Facts 4.1 for the videos at hand: every start with stride 1, counted from the real files' lengths."""
    lengths = {}
    for path in sorted((shared_data / "msraction3d").glob("*.mat")):
        subject = int(re.search(r"_s(\d+)_", path.name).group(1))
        with open(
            path, "rb"
        ) as file:  # the sizes of a MATLAB 5 file's first array; scipy's whosmat takes 20 ms for them
            head = zlib.decompressobj().decompress(file.read(1024)[136:], 64)
        lengths[path.name] = (int(np.frombuffer(head, "<i4", 3, 32)[2]), subject <= 5)
    missing = 270 - sum(train for _, train in lengths.values())
    for frames, clips, dropped in ((4, 9825, 0), (8, 8745, 0), (12, 7665, 0), (16, 6587, 2), (24, 4478, 13)):
        ours = sum(len(clip_starts(n, frames, None)) for n, train in lengths.values() if train and n >= frames)
        short = sum(train and n < frames for n, train in lengths.values())
        assert short <= dropped <= short + missing
        assert 0 <= clips - ours <= missing * 60  # the four absent videos: at most 60 frames each


def test_short_videos_are_padded_or_dropped_and_named(reader):
    padded = ClipSource(reader, [0, 1, 2], CONFIG)
    assert padded.padded == ["v0"] and padded.dropped == [] and len(padded.clips(None)) == 1 + 1 + 4
    dropped = ClipSource(reader, [0, 1, 2], CONFIG, drop_short=True)
    assert dropped.dropped == ["v0"] and dropped.sequences == [1, 2]
    with pytest.raises(DataError, match="no video has 4 frames"):
        ClipSource(reader, [0], CONFIG, drop_short=True)


@pytest.mark.parametrize(
    "timing, shown, told", [("clips", (0, 1, 1, 1), "padded by holding"), ("uniform", (0, 0, 1, 1), "each")]
)
def test_what_becomes_of_a_short_video_is_told_as_it_is(reader, timing, shown, told, capsys):
    source = ClipSource(reader, [0], CONFIG, timing=timing)
    assert source.clips(1)[0].frames == shown
    report_short(source)
    assert f"1 video of fewer than 4 frames, {told}" in " ".join(capsys.readouterr().err.split())


def test_a_clip_holds_its_frames_in_order(reader):
    source = ClipSource(reader, [2], CONFIG)
    points = source.load(source.clips(None)[2], 0)
    assert points.shape == (4, 16, 3) and points[..., 0].tolist() == [[t] * 16 for t in (2, 3, 4, 5)]


def test_the_draw_depends_on_the_key_alone(reader):
    source = ClipSource(reader, [2, 3], CONFIG, augmentation=Augmentation(), seed=5)
    clip = source.epoch(3, 1)[0]
    assert source.epoch(3, 1) == ClipSource(reader, [2, 3], CONFIG, seed=5).epoch(3, 1)
    assert np.array_equal(source.load(clip, 3, 0), source.load(clip, 3, 0))
    assert not np.array_equal(source.load(clip, 3, 0), source.load(clip, 3, 1))
    # every start occurs
    assert len({tuple(c.frames) for n in range(60) for c in source.epoch(n, 1) if c.sequence == 3}) == 7


@pytest.mark.parametrize("timing", ["clips", "uniform"])
def test_clips_of_a_video_that_stay_together_come_from_all_its_parts(reader, timing):
    source = ClipSource(reader, [2, 3], CONFIG, timing=timing, seed=5)
    for number in range(40):
        clips = source.epoch(number, 3, together=True)
        assert [clip.sequence for clip in clips] in ([2, 2, 2, 3, 3, 3], [3, 3, 3, 2, 2, 2])
        starts = [clip.frames for clip in clips if clip.sequence == 3]  # of ten frames: seven starts
        assert starts == sorted(starts)
        if timing == "clips":
            assert all(first in part for (first, *_), part in zip(starts, ((0, 1), (2, 3), (4, 5, 6))))
    if timing == "clips":  # of four frames there is one start, whatever the part
        one = [ClipSource(reader, [1], CONFIG, seed=5).epoch(number, 3, together=True) for number in range(20)]
        assert {clip.frames for clips in one for clip in clips} == {(0, 1, 2, 3)}
    seen = {clip.frames for number in range(60) for clip in source.epoch(number, 3, together=True)}
    assert seen >= {clip.frames for clip in source.clips(None) if timing == "clips"}


def test_points_are_drawn_without_replacement_or_in_whole_copies():
    rng = np.random.default_rng(0)
    frame = np.arange(30, dtype=np.float32).reshape(10, 3)
    few = sample_points(frame, 6, rng)
    assert len(np.unique(few, axis=0)) == 6
    many = sample_points(frame, 25, rng)
    counts = np.unique(many[:, 0], return_counts=True)[1]
    assert len(counts) == 10 and sorted(set(counts)) == [2, 3]
    assert sample_points(frame[:0], 4, rng).tolist() == [[0, 0, 0]] * 4


def test_normalizations():
    points = np.random.default_rng(0).normal(3, 2, (4, 50, 3)).astype(np.float32)
    assert np.allclose(normalize(points, "center").mean((0, 1)), 0, atol=1e-5)
    unit = normalize(points, "unit")
    assert np.isclose(np.linalg.norm(unit, axis=-1).max(), 1)
    image = normalize(points, "image")
    for axis, size in ((0, 120), (1, 160)):
        assert np.allclose(image[..., axis], (points[..., axis] - points[..., axis].mean()) / size, atol=1e-5)
    assert np.isclose(image[..., 2].std(), 1, atol=1e-4) and normalize(points, "none") is points
    flat = points.copy()
    flat[..., 2] = 5
    assert np.isfinite(normalize(flat, "image")).all() and not normalize(np.ones_like(flat), "unit").any()


def _body(tall: float, frames: int = 6) -> np.ndarray:
    """A clip (T,200,3) of one shape, `tall` times its size, that crouches in its last frame and stands off center."""
    shape = np.random.default_rng(0).normal(0, (0.1, 0.3, 0.1), (200, 3))
    clip = np.tile(shape, (frames, 1, 1))
    clip[-1, :, 1] *= 0.5
    return (clip * tall + [1, -2, 3]).astype(np.float32)


def test_equal_height_makes_bodies_of_any_size_and_unit_the_same_clip():
    child, adult, millimeters = (normalize(_body(tall), "height") for tall in (0.8, 1.2, 1200))
    assert np.allclose(child, adult, atol=1e-5) and np.allclose(millimeters, adult, atol=1e-4)
    assert not np.allclose(normalize(_body(0.8), "center"), normalize(_body(1.2), "center"), atol=1e-2)
    deviations = adult[..., 1].std(1)
    assert np.allclose(deviations[:-1], 0.27, atol=1e-5)
    assert np.isclose(deviations[-1], 0.135, atol=1e-4)  # a factor for each frame would hide the crouching
    assert adult.dtype == np.float32 and np.allclose(adult.mean((0, 1)), 0, atol=1e-5)


def test_equal_height_of_clips_with_empty_frames_or_without_height():
    clip = _body(1.2)
    clip[:4] = 0  # what `sample_points` makes of empty frames: most of the clip
    # median of whole and half
    assert np.isclose(normalize(clip, "height")[4:, :, 1].std(1).max(), 0.27 * 4 / 3, atol=1e-4)
    flat = _body(1.2)
    flat[..., 1] = 5
    for points in (flat, np.zeros_like(flat)):
        assert np.allclose(normalize(points, "height"), points - points.mean((0, 1)), atol=1e-5)


def test_augmentation_is_one_rigid_draw_a_clip():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3, 40, 3)).astype(np.float32)
    turned = Augmentation(0, False, 0.5, 0.1, 0, 0, 0, 0)(points, rng)
    before, after = (
        np.linalg.norm(p.reshape(-1, 3)[:, None] - p.reshape(-1, 3)[None], axis=-1) for p in (points, turned)
    )
    assert np.allclose(before, after, atol=1e-4) and not np.allclose(points, turned, atol=1e-2)
    for where, axes in ((0, PEERS), (points.mean((0, 1)), replace(PEERS, origin=False))):
        scaled = axes(points, rng)
        ratio = (scaled - where) / (points - where)
        assert np.allclose(ratio, ratio[0, 0], rtol=1e-2) and len(np.unique(ratio[0, 0].round(4))) == 3
        assert np.all((ratio[0, 0] > 0.89) & (ratio[0, 0] < 1.11))
    # a body before the camera comes nearer and goes, as in the published loaders
    far = points + np.float32([0, 0, 3.5])
    depths = [PEERS(far, np.random.default_rng(seed))[..., 2].mean() for seed in range(50)]
    assert 0.15 < np.std(depths) < 0.25
    thinned = Augmentation(0, False, 0, 0, 0, 0, 0.9, 0)(points, np.random.default_rng(3))
    assert len(np.unique(thinned[0], axis=0)) < 40 and np.isin(thinned[..., 0].round(4), points[..., 0].round(4)).all()
    assert NONE == Augmentation(0, False, 0, 0, 0, 0, 0, 0)


def linear_maps(points: np.ndarray, change: Augmentation, draws: int) -> np.ndarray:
    """The matrices A (draws,3,3) with which x - mean becomes A (x - mean) in as many draws, found by least squares."""
    around = (points - points.mean((0, 1))).reshape(-1, 3)
    made = [change(points, np.random.default_rng(seed)).reshape(-1, 3) for seed in range(draws)]
    return np.array([np.linalg.lstsq(around, one - one.mean(0), rcond=None)[0].T for one in made])


def test_each_change_of_an_augmentation_is_the_one_that_it_names():
    points = np.random.default_rng(0).normal(2, 1, (2, 4, 3)).astype(np.float32)
    turns = linear_maps(points, replace(NONE, turn=0.5), 100)
    assert np.allclose(turns[:, 1], [0, 1, 0], atol=1e-5) and np.allclose(turns[:, :, 1], [0, 1, 0], atol=1e-5)
    angles = np.arctan2(turns[:, 0, 2], turns[:, 0, 0])
    assert -0.5 <= angles.min() < -0.47 and 0.47 < angles.max() <= 0.5 and np.allclose(np.linalg.det(turns), 1)
    tilts = linear_maps(points, replace(NONE, tilt=0.1), 600)  # Rz Ry Rx, whose angles its entries tell
    about_x, about_z = np.arctan2(tilts[:, [2, 1], [1, 0]], tilts[:, [2, 0], [2, 0]]).T
    angles = np.stack([about_x, -np.arcsin(tilts[:, 2, 0]), about_z], axis=1)
    assert np.allclose(angles.std(0), 0.1, rtol=0.15) and 0.28 < np.abs(angles).max() < 0.3001
    sizes = linear_maps(points, replace(NONE, scale=0.2), 100)
    assert np.allclose(sizes, sizes[:, :1, :1] * np.eye(3), atol=1e-5) and 1.18 < sizes.max() < 1.2001
    assert 0.7999 < sizes[:, 0, 0].min() < 0.82
    both = linear_maps(points, replace(NONE, scale=0.2, per_axis=True, turn=0.5), 20)  # the body's axes, then turned
    squares = both.transpose(0, 2, 1) @ both
    assert np.allclose(squares, squares * np.eye(3), atol=1e-5) and np.ptp(squares[0].diagonal()) > 0.01
    shifts = np.array([replace(NONE, shift=0.1)(points, np.random.default_rng(s)) - points for s in range(100)])
    assert np.allclose(shifts, shifts[:, :1, :1], atol=1e-6) and (abs(np.abs(shifts).max((0, 1, 2)) - 0.1) < 0.01).all()
    jitter = replace(NONE, jitter=0.05)(np.zeros((2, 5000, 3), np.float32), np.random.default_rng(0))
    assert np.allclose(jitter.std(1), 0.05, rtol=0.05) and 0.14 < np.abs(jitter).max() < 0.1501
    many = np.arange(6000, dtype=np.float32).reshape(2, 1000, 3)
    thin = np.array([replace(NONE, dropout=0.6)(many, np.random.default_rng(s)) for s in range(50)])
    own = (thin == many).all(-1)
    assert own[:, :, 0].all() and (own[..., 1:] | (thin[:, :, 1:] == thin[:, :, :-1]).all(-1)).all()
    lost = 1 - own.mean(2)
    assert lost.min() < 0.05 and 0.5 < lost.max() < 0.65 and np.abs(np.diff(lost)).max() < 0.1  # one share a clip


def test_a_warp_bends_space_alike_at_all_times_and_keeps_neighbors_near():
    points = np.random.default_rng(0).normal(0, 0.3, (1, 400, 3)).astype(np.float32)
    clip = np.concatenate([points, points[:, ::-1]])  # the same places in another order at another time
    warped = replace(NONE, warp=0.2)(clip, np.random.default_rng(5))
    assert np.allclose(warped[0], warped[1, ::-1], atol=1e-5)
    moved = np.linalg.norm(warped - clip, axis=-1)
    assert 0.01 < moved.mean() < 0.2 and moved.std() > 0.005  # neither nothing nor a shift
    near = cKDTree(clip[0]).query(clip[0], 2)[1][:, 1]
    before, after = (np.linalg.norm(x[0] - x[0, near], axis=-1) for x in (clip, warped))
    assert 0.4 < (after / before).min() and (after / before).max() < 2


def test_validation_comes_from_training_subjects_only(reader):
    assert default_rule(reader) == "subject"
    train, held = carve_validation(reader, "subject", 0)
    assert held == [4] and train == [0, 1, 2, 3]
    train, held = carve_validation(reader, "subjects:1,2", 0)
    assert held == [1, 2]
    train, held = carve_validation(reader, "0.4", 0)
    assert sorted(train + held) == [0, 1, 2, 3, 4] and 5 not in train + held and len(held) == 2
    assert carve_validation(reader, "none", 0) == ([0, 1, 2, 3, 4], [])
    with pytest.raises(DataError, match="no labeled sample of split 'validation'; the file has 'test', 'train'"):
        carve_validation(reader, "split", 0)
    for bad in ("subjects:9", "subjects:0,1,2,3,4", "1.5", "some", "subjects:x"):
        with pytest.raises(UsageError):
            carve_validation(reader, bad, 0)


@pytest.mark.parametrize(
    "subjects, told",
    [
        ((0, 1, 2, 3), ""),
        ((0, 1, 1, 0), "2 people train and validate: people never seen come out lower"),
        ((0, 1, 2, 1), "1 person trains and validates"),
        ((0, 1, -1, 1), "the file doesn't say who is seen in 1 of 4 videos;"),
    ],
)
def test_people_who_train_and_validate_are_told(tmp_path, make_sequence, subjects, told):
    with CloudsWriter(tmp_path / "own.h5", class_names=["a"]) as writer:
        for k, subject in enumerate(subjects):
            writer.write(make_sequence(f"v{k}", label=0, split="train", subject=subject))
    said = about_people(CloudsReader(tmp_path / "own.h5"), [0, 1], [2, 3])
    assert said.startswith(told) and bool(said) == bool(told)
    assert about_people(CloudsReader(tmp_path / "own.h5"), [0, 1], []) == ""


@pytest.mark.parametrize(
    "subjects, told",
    [
        ((0, 1, 2, 3), ""),
        ((-1, -1, -1, -1), ""),
        ((0, 1, 1, 3), "1 of 2 people in the split 'test' is learned from, too: people never seen come out lower"),
        ((0, 0, 0, 0), "1 of 1 person in the split 'test' is"),
        ((0, 1, 1, 0), "2 of 2 people in the split 'test' are"),
    ],
)
def test_people_who_train_and_test_are_told(tmp_path, make_sequence, subjects, told):
    with CloudsWriter(tmp_path / "own.h5", class_names=["a"]) as writer:
        for k, subject in enumerate(subjects):
            writer.write(make_sequence(f"v{k}", label=0, split="train" if k < 2 else "test", subject=subject))
    said = about_tested_people(CloudsReader(tmp_path / "own.h5"), [0, 1], [2, 3])
    assert said.startswith(told) and bool(said) == bool(told)


def test_what_was_held_out_is_named_so_that_it_holds_for_other_files(tmp_path, make_sequence):
    with CloudsWriter(tmp_path / "own.h5", class_names=["a", "b", "c"]) as writer:
        for k, (label, subject) in enumerate([(0, 1), (1, 1), (2, 1), (0, 4), (1, 4)]):
            writer.write(make_sequence(f"v{k}", label=label, split="train", subject=subject))
    reader = CloudsReader(tmp_path / "own.h5")
    training, held = carve_validation(reader, "subject", 0)
    assert (
        lasting_rule(reader, "subject", held) == "subjects:4" and lasting_rule(reader, "fold:0/2", held) == "fold:0/2"
    )
    # of classes of two videos: nothing
    assert lasting_rule(reader, "0.1", carve_validation(reader, "0.1", 0)[1]) == "none"
    assert about_absent_classes(reader, training, held).startswith(
        "none of them is of 1 of the 3 classes that were learned: c;"
    )
    assert about_absent_classes(reader, training, training) == about_absent_classes(reader, training, []) == ""


@pytest.mark.parametrize(
    ("counts", "share"),
    [
        ((8, 1, 1), "80.0"),
        ((1, 3), "75.0"),
        ((5, 5), ""),
        ((7, 4), ""),
        ((4, 3, 3), ""),
        ((5, 3, 2), "50.0"),
        ((9,), ""),
    ],
)
def test_a_class_that_most_videos_show_is_told(tmp_path, make_sequence, counts, share):
    with CloudsWriter(tmp_path / "own.h5", class_names=["a", "b", "c"]) as writer:
        for label, count in enumerate(counts):
            for k in range(count):
                writer.write(make_sequence(f"{label}/{k}", label=label, split="train"))
    reader = CloudsReader(tmp_path / "own.h5")
    said = about_frequent_class(reader, range(len(reader)))
    assert about_frequent_class(reader, []) == "" and bool(said) is bool(share)
    assert not share or f"{max(counts)} of these videos are of class" in said and f"has {share} % right" in said


def test_the_files_own_validation_videos_validate(tmp_path, make_sequence):
    with CloudsWriter(tmp_path / "own.h5", class_names=["a", "b"]) as writer:
        for k, (split, label) in enumerate(
            [("train", 0), ("validation", 1), ("test", 0), ("validation", -1), ("train", 1)]
        ):
            writer.write(make_sequence(f"v{k}", label=label, split=split, subject=k))
    reader = CloudsReader(tmp_path / "own.h5")
    assert default_rule(reader) == "split" and carve_validation(reader, "split", 0) == ([0, 4], [1])
    assert carve_validation(reader, "subject", 0) == ([0], [4])  # other rules leave them out


@pytest.mark.parametrize(
    ("labels", "splits", "message"),
    [
        ((-1, -1), ("train", "train"), "none has a label: prepare them with --labels TABLE or, .* --label-from-folder"),
        (
            (0, 1),
            ("", ""),
            "none has a split: `dpc prepare split .*own.h5 -o own-split.h5 --fractions 0.8,0,0.2` divides them",
        ),
        ((0, 1), ("val", "test"), "the file has 'test', 'val'$"),
    ],
)
def test_a_file_without_training_videos_says_how_to_make_them(tmp_path, make_sequence, labels, splits, message):
    with CloudsWriter(tmp_path / "own.h5", class_names=["a", "b"]) as writer:
        for k in (0, 1):
            writer.write(make_sequence(f"v{k}", label=labels[k], split=splits[k]))
    with pytest.raises(DataError, match=rf"own.h5: no labeled sample of split 'train'; {message}"):
        carve_validation(CloudsReader(tmp_path / "own.h5"), "none", 0)


def test_a_fold_is_held_out_of_the_training_videos(reader):
    held = [carve_validation(reader, f"fold:{k}/5", 0) for k in range(5)]
    assert sorted(i for _, part in held for i in part) == [0, 1, 2, 3, 4]  # never the test video
    assert all(sorted(train + part) == [0, 1, 2, 3, 4] and len(part) == 1 for train, part in held)
    for bad in ("fold:5/5", "fold:-1/5", "fold:0/1", "fold:0/6", "fold:1", "fold:a/b", "folds"):
        with pytest.raises(UsageError, match="fold"):
            carve_validation(reader, bad, 0)


@settings(max_examples=40, deadline=None)
@given(data=st.data(), videos=st.integers(2, 60), seed=st.integers(0, 5))
def test_folds_are_disjoint_complete_and_fair(data, videos, seed):
    """Every video is in one fold; classes and folds are spread evenly, or subjects stay whole where there are enough."""
    draw = st.lists(st.integers(0, 3), min_size=videos, max_size=videos)
    labels, subjects = (np.array(data.draw(draw), np.int32) for _ in range(2))
    subjects -= data.draw(st.integers(0, 1))  # -1: unknown
    count = data.draw(st.integers(2, videos))
    found = folds(labels, subjects, count, seed)
    assert np.array_equal(found, folds(labels, subjects, count, seed))
    sizes = np.bincount(found, minlength=count)
    assert len(sizes) == count and sizes.sum() == videos and sizes.min() >= 1
    if subjects.min() >= 0 and len(set(subjects)) >= count:
        assert all(len(set(found[subjects == one])) == 1 for one in set(subjects))
        return
    assert sizes.max() - sizes.min() <= 1
    for label in set(labels):
        share = np.bincount(found[labels == label], minlength=count)
        assert share.max() - share.min() <= 1


def test_without_a_training_split_the_splits_are_named(tmp_path, make_sequence):
    with CloudsWriter(tmp_path / "x.h5") as writer:
        writer.write(make_sequence("a", split="valid", label=0))
    with pytest.raises(DataError, match="'valid'"):
        carve_validation(CloudsReader(tmp_path / "x.h5"), "none", 0)


def test_a_uniform_training_clip_spans_most_of_the_video_in_order(reader):
    source = ClipSource(reader, [3], CONFIG, timing="uniform", augmentation=Augmentation(crop=0.5))
    seen = [source.epoch(n, 1)[0].frames for n in range(200)]
    assert all(list(f) == sorted(f) and 0 <= f[0] and f[-1] < 10 for f in seen)
    assert min(f[-1] - f[0] for f in seen) >= 2 and {f[0] for f in seen} >= {0, 1, 2} and len(set(seen)) > 20
    assert all(max(np.diff(f)) - min(np.diff(f)) <= 1 for f in seen)  # even steps: speeds must mean something
    assert source.clips(None)[0].frames == uniform_frames(10, 4) and len(source.clips(3)) == 3


def test_a_clip_at_another_speed_leaves_out_or_repeats_frames(reader):
    source = ClipSource(reader, [3], CONFIG, augmentation=Augmentation(speed=0.8))
    seen = [np.array(source.epoch(n, 1)[0].frames) for n in range(400)]
    steps = [np.diff(f) for f in seen]
    assert all(f[0] >= 0 and f[-1] < 10 and (step >= 0).all() for f, step in zip(seen, steps))
    assert all(step.max() - step.min() <= 1 for step in steps)  # a speed is one for the clip
    spans = np.array([f[-1] - f[0] for f in seen])
    assert set(spans) == {1, 2, 3, 4, 5, 6}  # 3 frames at 1/1.8 to 1.8 of the speed
    # 3 times the mean of a log-uniform factor
    assert abs(spans.mean() - 3 * (1.8 - 1 / 1.8) / (2 * np.log(1.8))) < 0.25
    assert {int(f[-1]) for f in seen} >= {8, 9} and {int(f[0]) for f in seen} >= {0, 1, 6}


def test_without_a_speed_clips_are_drawn_as_ever(reader):
    still = ClipSource(reader, [2, 3], CONFIG, augmentation=Augmentation(), seed=5)
    assert still.epoch(3, 2) == ClipSource(reader, [2, 3], CONFIG, seed=5).epoch(3, 2)
    rng, lengths = generator(5, 1, 3), reader.frame_counts
    starts = [(s, int(rng.integers(max(int(lengths[s]) - 4, 0) + 1))) for s in (2, 3) for _ in range(2)]
    # one number a clip, then the order
    drawn = [Clip(s, clip_frames(int(lengths[s]), 4, start)) for s, start in starts]
    assert still.epoch(3, 2) == [drawn[i] for i in rng.permutation(4)]
    assert all((np.diff(clip.frames) == 1).all() for clip in still.epoch(3, 2) if clip.sequence == 3)


@pytest.mark.parametrize("timing,per_video", [("clips", None), ("clips", 4), ("uniform", 4)])
@pytest.mark.parametrize("together", [False, True])
def test_some_clips_hold_a_frame_and_are_of_no_class(reader, timing, per_video, together):
    source = ClipSource(reader, [1, 2, 3], CONFIG, timing=timing, augmentation=Augmentation(still=0.3), seed=5)
    drawn = [source.epoch(number, per_video, together) for number in range(60)]
    held = [clip for clips in drawn for clip in clips if clip.held]
    assert all(len(set(clip.frames)) == 1 for clip in held)
    assert 0.24 < len(held) / sum(map(len, drawn)) < 0.36
    assert {clip.sequence for clip in held} == {1, 2, 3}
    assert {clip.frames[0] for clip in held if clip.sequence == 3} == set(range(10))  # any frame of the video
    for clip in drawn[0]:
        assert source.target(clip) == (-1 if clip in held else reader.labels[clip.sequence])
    if together and per_video:  # the clips of a video are judged together: all or none of them
        kinds = [[len(set(clip.frames)) == 1 for clip in clips] for clips in drawn]
        assert all(len(set(some[i : i + 4])) == 1 for some in kinds for i in (0, 4, 8))


def test_a_video_of_one_frame_has_its_class(tmp_path):
    with CloudsWriter(tmp_path / "c.h5", class_names=["a", "b"]) as writer:
        writer.write(CloudSequence.from_frames("v", [np.zeros((5, 3), np.float32)], label=1, split="train"))
    source = ClipSource(CloudsReader(tmp_path / "c.h5"), [0], CONFIG, augmentation=Augmentation(still=0.5))
    assert {source.target(clip) for number in range(20) for clip in source.epoch(number, 1)} == {1}


def test_a_slow_clip_of_one_frame_keeps_its_class(reader):
    config, slow = replace(CONFIG, num_frames=2), Augmentation(speed=3.0)
    source = ClipSource(reader, [3], config, augmentation=slow)
    drawn = [clip for number in range(40) for clip in source.epoch(number, 1)]
    assert any(len(set(clip.frames)) == 1 for clip in drawn)
    assert {source.target(clip) for clip in drawn} == {reader.labels[3]}


def test_an_augmentation_is_one_by_name_and_changes():
    """The name sets all ranges, and each may then be changed; the preset's holds where nothing is said."""

    def said(preset: str, **values) -> Augmentation:
        return training_settings(Given(preset, sets=values)).augmentation

    assert said("quick", augment="none") == NONE and said("quick") == said("thesis", augment="ours") == Augmentation()
    changed = said("quick", augment="peers", augment_turn=0.4, augment_speed=0.3, augment_per_axis=False)
    assert changed == Augmentation(0.1, False, 0.4, 0, 0, 0, 0, 0, 0.3, True)
    assert said("thesis", augment_turn=0.2) == Augmentation(0.1, True, 0.2, 0, 0, 0, 0, 0, 0, True)
    for field, bad in (("turn", -1), ("turn", float("nan")), ("dropout", 1.0), ("speed", 10.0)):
        with pytest.raises(UsageError, match=f"augment_{field} = "):
            Augmentation(**{field: bad})
