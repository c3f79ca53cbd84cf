"""What is no measurement is dropped and counted; shifts are kept; what can't be in meters is doubted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dpcli.prepare.closing_line import closing_lines
from dpcli.prepare.cloud_formats.cloud import Cloud
from dpcli.prepare.commands.merge import merge
from dpcli.prepare.pipeline import Conversion, convert
from dpcli.prepare.reader import Item
from dpcli.prepare.scans.assembling import COARSE, Lengths, assemble
from dpcli.prepare.scans.cleaning import AT_ORIGIN, CROWDED, IMPOSSIBLE, LONE, NOT_FINITE, clean
from dpcli.prepare.scans.clouds import CloudFolders
from dpcli.runtime.machines.shards import Shard
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter

POINTS = np.random.default_rng(1).uniform(0.5, 2, (20, 3))


def frames_of(folder, *frames):
    folder.mkdir(parents=True, exist_ok=True)
    for t, frame in enumerate(frames):
        np.save(folder / f"{t}.npy", frame)
    return folder


def convert_folder(folder, path, **options):
    return convert(CloudFolders(folder, **options), path, Conversion(jobs=1))


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ([0.0, 0, 0], AT_ORIGIN),
        ([-0.0, 0, 0], AT_ORIGIN),
        ([1e-9, -1e-9, 0], AT_ORIGIN),  # what turning leaves of 0
        ([1.17549435e-38] * 3, AT_ORIGIN),
        ([1e30, 1, 1], IMPOSSIBLE),
        ([-3.4e38, 0, 0], IMPOSSIBLE),
        ([-9999.0] * 3, IMPOSSIBLE),
        ([65535.0] * 3, IMPOSSIBLE),
        ([-(2.0**31)] * 3, IMPOSSIBLE),
        ([np.float32(2**31 - 1)] * 3, IMPOSSIBLE),
        ([np.nan, 1, 1], NOT_FINITE),
        ([-np.inf, 1, 1], NOT_FINITE),
    ],
)
def test_points_that_nobody_measured(bad, reason):
    cloud = Cloud(np.vstack([POINTS[:5], [bad] * 3, POINTS[5:]]), extra={"v": np.arange(23, dtype=np.float32)})
    assert clean([cloud]) == {reason: 3}
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.extra["v"].tolist() == [*range(5), *range(8, 23)]


def test_many_points_at_one_place_are_told():
    place = [[0.0, 0.0, 1.73]] * 10  # where the sensor of a vehicle stands
    for points, told in ((np.vstack([POINTS, place]), True), (np.vstack([POINTS, place[:5]]), False)):
        flat = np.column_stack([np.repeat(POINTS[:, 0], 20), np.arange(400), np.arange(400)])  # one x, not one place
        clouds = [Cloud(points), Cloud(np.vstack([flat, points]))]
        assert (CROWDED in assemble(Item("a", Path("a")), clouds, Lengths()).notes) == told


@pytest.mark.parametrize("fullest", range(5))
def test_padding_is_told_whichever_frame_has_none(fullest):
    """Points that fill frames up to one size, such as -1: the fullest frame has none of them."""
    frames = [np.concatenate([POINTS, np.full((12, 3), -1.0)]) for _ in range(5)]
    frames[fullest] = np.concatenate([POINTS, POINTS[:12] + 0.01])
    sample = assemble(Item("a", Path("a")), [Cloud(frame) for frame in frames], Lengths(1, "m"))
    assert sample.notes.get(CROWDED) == 1


def test_one_corner_at_the_origin_is_kept_unless_another_frame_tells():
    corner = np.vstack([np.zeros((1, 3)), POINTS])
    assert clean([Cloud(corner), Cloud(corner)]) == {}
    assert clean([Cloud(corner), Cloud(np.vstack([corner, np.zeros((1, 3))]))]) == {AT_ORIGIN: 3}
    for place in ([448_000, 5_411_000, 300], [-448_000, -5_411_000, 0]):
        assert clean([Cloud(np.vstack([np.zeros((1, 3)), POINTS + place]))]) == {AT_ORIGIN: 1}


@pytest.mark.parametrize("jump", [True, False])
def test_a_followed_point_that_jumps_to_the_origin_was_not_seen(jump):
    """As the tables of motion capture have hidden markers; one that begins or rests there, or passes by, was seen."""
    frames = [POINTS + 0.02 * t for t in range(6)]
    if jump:
        frames[2][3] = frames[4][7] = 0
    else:
        frames = [frame - POINTS[5] - 0.06 for frame in frames]  # the sixth point passes the origin in the fourth frame
        frames = [np.concatenate([frame, [[0, 0, 0]]]) for frame in frames[:3]] + [np.float64(frames[3])]
    clouds = [Cloud(frame.copy(), track=np.arange(len(frame))) for frame in frames]
    assert clean(clouds) == ({AT_ORIGIN: 2} if jump else {})
    lost = {2: [3], 4: [7]} if jump else {}
    assert [c.track.tolist() for c in clouds] == [
        np.delete(np.arange(len(frame)), lost.get(t, [])).tolist() for t, frame in enumerate(frames)
    ]
    clouds = [Cloud(frame.copy()) for frame in frames]  # without identities nothing tells
    assert not clean(clouds)
    frames[1][0] += 1  # where another point goes as far, one that comes from the origin may, too
    assert not clean([Cloud(frame.copy(), track=np.arange(len(frame))) for frame in frames])


def test_frames_of_one_row_that_stands_for_nothing():
    nothing = np.zeros((1, 3))
    assert clean([Cloud(POINTS), Cloud(nothing), Cloud(nothing)]) == {AT_ORIGIN: 2}
    assert clean([Cloud(nothing), Cloud(POINTS[:1])]) == {}  # one point is followed
    seen = [Cloud(POINTS), Cloud(nothing - 1), Cloud(nothing - 1), Cloud(nothing - 5), Cloud(POINTS[:1])]
    assert clean(seen) == {LONE.format("(-1, -1, -1)"): 2} and [len(one.points) for one in seen] == [20, 1, 1, 1, 1]
    assert clean([Cloud(POINTS[:1]), Cloud(nothing - 1), Cloud(nothing - 1)]) == {}


def test_ordinary_points_on_diagonals_and_axes_stay():
    points = np.array([[1.0, 1, 1], [0, 0, 1], [5, 0, 0], [-9999, 1, 2]])
    assert clean([Cloud(points)]) == {}


def test_the_shift_is_kept_told_and_undone(tmp_path):
    base = np.array([448_000.0, 5_411_000, 300])
    frames_of(tmp_path / "in" / "map", POINTS + base, POINTS + base + 1)
    frames_of(tmp_path / "in" / "near", POINTS)
    report = convert_folder(tmp_path / "in", tmp_path / "a.h5")
    with CloudsReader(tmp_path / "a.h5") as reader:
        far, near = reader.read(0), reader.read(1)
    np.testing.assert_allclose(far.frame(1) + far.shift, POINTS + base + 1, atol=1e-6)
    assert near.shift is None and far.shift.tolist() == np.floor((POINTS + base).min(0)).tolist()
    np.testing.assert_allclose(near.frame(0), POINTS, atol=1e-6)
    assert report.closing[1] == "map: (448000, 5411000, 300) was taken off its coordinates; the file keeps it as shift"


@pytest.mark.parametrize(
    ("unit", "scale", "first"),
    [("m", None, 1.5), ("cm", None, 150), ("mm", None, 1500), ("m", 500.0, 3), ("cm", 10.0, 150), ("span", None, 1500)],
)
def test_units_that_files_declare_become_those_of_the_output(unit, scale, first):
    cloud = Cloud(np.array([[1500.0, 20, 30], [1600, 20, 30]]), unit="mm")
    sample = assemble(Item("a", Path("a")), [cloud], Lengths(scale, unit))
    assert sample.sequence.points[0, 0] == first
    assert any(f"from mm to {unit}," in note for note in sample.notes) is (scale is None and unit in ("m", "cm"))


@pytest.mark.parametrize(("kind", "rounded"), [("f4", True), ("f8", False)])
def test_map_coordinates_that_float32_rounded_are_told(tmp_path, kind, rounded):
    reader = CloudFolders(frames_of(tmp_path, (POINTS + [448_000, 5_411_000, 300]).astype(kind)))
    assert (COARSE in reader.read(reader.items()[0], np.random.default_rng(0)).notes) is rounded


@pytest.mark.parametrize("unit", ["m", "mm", "span"])
@pytest.mark.parametrize("size", [0.003, 0.05, 1.0, 40.0])
@pytest.mark.parametrize("away", [0.0, 30, 900, 9000, 2e5])
@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_float32_rounds_no_small_object_without_a_word(unit, size, away, kind):
    exact = POINTS / np.ptp(POINTS) * size + away * np.array([1, -0.9, 0.8])
    stored = exact.astype(kind)
    sample = assemble(Item("a", Path("a")), [Cloud(stored)] * 2, Lengths(None, unit))
    found, shift = sample.sequence.frame(0), sample.sequence.shift
    off = np.abs(found + (0 if shift is None else shift) - exact).max() / size
    assert off < 1e-4 or (kind == "f4" and (off < 0.01 or {COARSE, CROWDED} & set(sample.notes)))
    assert shift is None or away >= 30


def test_shards_and_merges_keep_shifts(tmp_path):
    for k in range(3):
        frames_of(tmp_path / "in" / f"s{k}", POINTS + 1e6 * k)
    convert_folder(tmp_path / "in", tmp_path / "whole.h5")
    reader = CloudFolders(tmp_path / "in")
    for index in range(2):
        convert(reader, tmp_path / f"{index}.h5", Conversion(shard=Shard(index, 2)))
    merge([tmp_path / "0.h5", tmp_path / "1.h5"], tmp_path / "merged.h5")
    assert (tmp_path / "merged.h5").read_bytes() == (tmp_path / "whole.h5").read_bytes()
    merge([tmp_path / "whole.h5"], tmp_path / "again.h5", prefix=True)
    with CloudsReader(tmp_path / "again.h5") as file:
        assert file.shifts[:, 0].tolist() == [0, 1e6, 2e6]


@pytest.mark.parametrize(
    ("points", "doubt"),
    [
        (POINTS * 1.6e7, "more than 100 km wide"),
        ((POINTS - 1) * 4000, "if these are millimeters, give --scale 1000"),
        ((POINTS + 1) * 1000, "if these are millimeters, give --scale 1000"),
        ((POINTS * 100).round(), "whole numbers, hardly meters; if they are millimeters, give --scale 1000"),
        (POINTS * (1e-3, 1e-3, 9) + (8.4, 49, 115), "are these degrees?"),
        (POINTS * (1e-3, 1e-3, 9), ""),  # a pole around which the axes stand
        (POINTS.round(), ""),
        (POINTS * 1000 + 448_000, ""),
        (POINTS * 100 - 80, ""),
    ],
)
def test_lengths_that_no_sensor_sees(tmp_path, points, doubt):
    reader = CloudFolders(frames_of(tmp_path / "in", points))
    notes = reader.read(reader.items()[0], np.random.default_rng(0)).notes
    assert any(doubt in note for note in notes) if doubt else not any("wide" in n or "around" in n for n in notes)
    reader = CloudFolders(tmp_path / "in", unit="mm")
    assert not any("--scale" in note for note in reader.read(reader.items()[0], np.random.default_rng(0)).notes)


@pytest.mark.parametrize(
    ("rates", "said"),
    [
        ([15, 30], "at 15 to 30 fps, 0.0333 to 0.0667 s apart"),
        ([25, 24, 30, 30], "at 24 to 30 fps"),
        ([30, 30.3], "at 30.1 fps"),
        ([20], "at 20 fps"),
    ],
)
def test_the_closing_line_names_no_rate_that_no_sequence_has(tmp_path, rates, said):
    with CloudsWriter(tmp_path / "a.h5", class_names=[], fields=["time"]) as writer:
        for number, rate in enumerate(rates):
            frames = [np.ones((4, 3))] * 5
            writer.write(CloudSequence.from_frames(str(number), frames, time=np.arange(5) / rate))
        writer.write(CloudSequence.from_frames("one frame", [np.ones((4, 3))], time=np.zeros(1)))
    assert closing_lines(CloudsReader(tmp_path / "a.h5"), {})[0].endswith(said)


def test_the_closing_line_is_what_a_person_can_check(tmp_path):
    box = np.array([[1.0, 0, 0], [3, 1, 0.5], [2, 0.5, 0.25], [0, 0, 0], [0, 0, 0], [np.nan, 0, 0]])
    frames_of(tmp_path / "in", box, box, box)
    report = convert_folder(tmp_path / "in", tmp_path / "a.h5", fps=30)
    assert report.closing == [
        "median distance 2.08 m, extent 2 x 1 x 0.5 m, 3 frames at 30 fps, 6 points at (0,0,0) dropped,"
        " 3 points with NaN or infinity dropped"
    ]
    (tmp_path / "in" / "2.npy").rename(tmp_path / "in" / "7.npy")
    assert (
        "3 frames at 2.86 fps, 0.1 to 0.6 s apart,"
        in convert_folder(tmp_path / "in", tmp_path / "d.h5", fps=10).closing[0]
    )
    frames_of(tmp_path / "many" / "a", box)
    frames_of(tmp_path / "many" / "b", box, box)
    one = convert(CloudFolders(tmp_path / "many"), tmp_path / "b.h5", Conversion(jobs=1)).closing
    two = convert(CloudFolders(tmp_path / "many"), tmp_path / "c.h5", Conversion(jobs=2)).closing
    assert one == two and "2 sequences of 1 to 2 frames without times, 6 points at (0,0,0) dropped" in one[0]
    with CloudsReader(tmp_path / "b.h5") as reader:
        assert closing_lines(reader, {})[0] in one[0]
        dropped = {"frames without points dropped": 1, "points at (0,0,0) dropped": 2}
        told = closing_lines(reader, dropped)[0]
        assert told.endswith(", 1 frame without points dropped, 2 points at (0,0,0) dropped")
