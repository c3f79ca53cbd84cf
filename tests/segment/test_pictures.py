"""Pictures and PLY files of parts: who hides whom, which color means what, and files that other programs read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dpcli.draw.palette import PALETTE, UNKNOWN, part_colors
from dpcli.draw.ply import write_ply, write_ply_frames
from dpcli.draw.points import FINE, Raster, _lit_ball, draw_balls
from dpcli.draw.view import turntable_view
from dpcli.errors import DataError, UsageError
from dpcli.prepare.decode.open3d_import import load_open3d
from dpcli.segment.pictures import Look, matched_ids, parts_picture, there_and_back, turntable
from dpcli.store import CloudSequence

WHITE = (255, 255, 255)


@pytest.fixture
def sequence() -> CloudSequence:
    rng = np.random.default_rng(0)
    frames = [rng.uniform(-1, 1, (90 + 10 * t, 3)) for t in range(5)]
    return CloudSequence.from_frames("toy", frames, part=[(frame[:, 0] > 0).astype(int) for frame in frames])


def test_view_is_a_rotation_with_up_upwards() -> None:
    for up, axis in (("z", (0, 0, 1)), ("-y", (0, -1, 0)), ("x", (1, 0, 0))):
        for azimuth in np.linspace(-3, 3, 7):
            view = turntable_view(azimuth, 0.4, up)
            np.testing.assert_allclose(view @ view.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(view) == pytest.approx(1)
            right, down, away = view @ np.array(axis)
            assert abs(right) < 1e-12 and down < 0 and away < 0  # seen from above, upright tips toward the viewer
    np.testing.assert_allclose(turntable_view(np.pi / 2, 0, "z"), [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)


def test_the_nearest_ball_wins_whatever_the_order() -> None:
    """Against a loop over pixels: the color of the nearest ball that covers it, as told by its strongest channel."""
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(-1, 1, (40, 2)), rng.permutation(40)[:, None]], 1)
    colors = np.eye(3)[rng.integers(0, 3, 40)] * 255
    picture = [
        draw_balls(points[o], colors[o], Raster(60, 50, np.zeros(2), 22), WHITE)
        for o in (slice(None), slice(39, None, -1))
    ]
    np.testing.assert_array_equal(*picture)
    drawn = picture[0].astype(int)
    place = points[:, :2] * 22 * FINE + np.array([60, 50]) * FINE / 2
    low, high = np.percentile(place, [2, 98], axis=0)
    radius = min(0.65 * np.sqrt(np.prod(high - low) / 40), 0.03 * 50 * FINE)
    checked = 0
    for row in range(50):
        for column in range(60):
            fine = FINE * np.array([column, row]) + np.stack(np.meshgrid(np.arange(FINE), np.arange(FINE)), -1).reshape(
                -1, 2
            )
            covers = ((fine[:, None] - np.floor(place)) ** 2).sum(-1) <= radius**2
            winners = {int(np.argmin(np.where(own, points[:, 2], 99))) if own.any() else -1 for own in covers}
            if len(winners) == 1:  # no edge inside the pixel
                checked += 1
                (winner,) = winners
                expected = (255,) * 3 if winner < 0 else colors[winner]
                assert drawn[row, column].argmax() == np.argmax(expected)
                assert (drawn[row, column] == 255).all() == (winner < 0)
    assert checked > 1500


def test_the_far_fades_and_the_light_comes_from_above() -> None:
    points, colors = np.array([[-1, 0, 0], [1, 0, 5.0]]), np.zeros((2, 3))
    image = draw_balls(points, colors, Raster(80, 40, np.zeros(2), 15), WHITE)
    assert image[:, :40].min() == 0 and image[:, 40:].min() > 50
    offsets, light = _lit_ball(9.0)
    assert len(light) == pytest.approx(np.pi * 81, rel=0.05) and 0.5 <= light.min() < 0.6 < 0.95 < light.max() <= 1
    assert light[offsets[:, 1] < 0].mean() > light[offsets[:, 1] > 0].mean() + 0.1
    assert (draw_balls(points[:0], colors[:0], Raster(8, 6, np.zeros(2), 1), WHITE) == 255).all()


def test_colors_are_apart_also_for_the_color_blind() -> None:
    """The first eight in the LMS space of Vienot et al. 1999: no two the same without red or without green cones."""
    to_lms = np.array([[17.8824, 43.5161, 4.11935], [3.45565, 27.1554, 3.86714], [0.0299566, 0.184309, 1.46709]])
    protan, deutan = np.eye(3), np.eye(3)
    protan[0], deutan[1] = [0, 2.02344, -2.52581], [0.494207, 0, 1.24827]
    linear = (PALETTE[:8] / 255) ** 2.2
    for sight in (np.eye(3), protan, deutan):
        seen = np.clip(linear @ (np.linalg.inv(to_lms) @ sight @ to_lms).T, 0, 1) ** (1 / 2.2)
        apart = np.linalg.norm(seen[:, None] - seen, axis=-1) + 9 * np.eye(8)
        assert apart.min() > 0.1
    assert len(np.unique(PALETTE, axis=0)) == len(PALETTE)


def test_part_colors() -> None:
    colors = part_colors(np.array([0, 3, -1, len(PALETTE)], np.int16))
    np.testing.assert_array_equal(colors, [PALETTE[0], PALETTE[3], UNKNOWN, PALETTE[0]])
    assert tuple(PALETTE[0]) == (0, 114, 178)


def test_matched_ids_follow_the_truth() -> None:
    truth = np.array([0, 0, 0, 0, 1, 1, 1, 2, 2, -1])
    found = np.array([5, 5, 5, 2, 2, 2, 2, 0, 9, -1])
    renamed = matched_ids(found, truth)
    np.testing.assert_array_equal(renamed[[0, 1, 2, 4, 5, 6, 9]], [0, 0, 0, 1, 1, 1, -1])
    assert renamed[3] == 1 and {renamed[7], renamed[8]} == {2, 3}  # one of two halves is the part, the other is new
    np.testing.assert_array_equal(matched_ids(np.array([4, 4, 1]), np.array([-1, -1, -1])) >= 0, True)


def test_sheet_shows_parts_and_truth_in_the_same_colors(sequence: CloudSequence, tmp_path: Path) -> None:
    swapped = replace(sequence, part=1 - sequence.part)
    look = Look(cell=100)
    parts_picture(tmp_path / "a.png", [swapped, sequence], truth=[sequence, None], frames=3, look=look)
    image = np.asarray(Image.open(tmp_path / "a.png"))
    rows = [image[8 + 122 * row + 22 : 8 + 122 * (row + 1), 8:-8] for row in range(3)]
    assert image.shape == (3 * 122 + 16, 3 * 100 + 16, 3)
    np.testing.assert_array_equal(rows[0], rows[1])  # the prediction has other ids, but the truth's colors
    np.testing.assert_array_equal(rows[0], rows[2])
    parts_picture(tmp_path / "b.png", [swapped], frames=3, look=look)
    assert not np.array_equal(np.asarray(Image.open(tmp_path / "b.png"))[30:130, 8:-8], rows[0])
    for column in range(3):  # every cell shows something
        assert (rows[0][:, 100 * column : 100 * (column + 1)] < 250).any()


def test_one_part_has_its_color(sequence: CloudSequence, tmp_path: Path) -> None:
    for part in (0, 1, 5):
        one = replace(sequence, part=np.full_like(sequence.part, part))
        parts_picture(tmp_path / "a.png", [one], look=Look(elevation=0.0))
        cell = np.asarray(Image.open(tmp_path / "a.png"))[30:230, 8:208].astype(float)
        painted = (cell < 250).any(-1)
        left = [color_left(cell[painted].mean(0), PALETTE[k]) for k in (0, 1, 5)]
        assert [0, 1, 5][int(np.argmin(left))] == part


def color_left(mean: np.ndarray, color: np.ndarray) -> float:
    """What of a mean color is no mixture of the color (in any light) and white."""
    return float(np.linalg.lstsq(np.stack([color / 255, np.ones(3)], 1), mean, rcond=None)[1][0])


@pytest.mark.parametrize("dark", [False, True])
def test_odd_sequences_are_drawn(dark: bool, tmp_path: Path) -> None:
    point = CloudSequence.from_frames("point" * 40, [np.zeros((1, 3))], part=[np.array([0])])
    gap = CloudSequence.from_frames("gap", [np.zeros((0, 3)), np.ones((9, 3))], part=[np.zeros(0), np.arange(9) - 1])
    many = CloudSequence.from_frames(
        "many", [np.random.default_rng(0).normal(size=(5000, 3))], part=[np.arange(5000) % 40]
    )
    parts_picture(tmp_path / "a.png", [point, gap, many], look=Look(dark=dark))
    image = np.asarray(Image.open(tmp_path / "a.png"))
    assert tuple(image[0, 0]) == ((17, 20, 26) if dark else WHITE)


def test_turntable(sequence: CloudSequence, tmp_path: Path) -> None:
    assert there_and_back(1, 3) == [0, 0, 0]
    order = there_and_back(4, 60)
    assert order[0] == 0 and max(order) == 3 and order[1:] == order[:0:-1] and set(np.abs(np.diff(order))) == {0, 1}
    turntable(tmp_path / "a.gif", sequence, seconds=0.8, look=Look(cell=64))
    with Image.open(tmp_path / "a.gif") as animation:
        assert animation.n_frames == 12 and animation.size == (64, 64) and animation.info["loop"] == 0
        pictures = []
        for k in (0, 3, 6):
            animation.seek(k)
            pictures.append(np.asarray(animation.convert("RGB")).astype(int))
    assert all((picture[0, 0] > 250).all() for picture in pictures)
    assert np.abs(pictures[0] - pictures[1]).mean() > 5


def test_pictures_say_what_is_wrong(sequence: CloudSequence, tmp_path: Path) -> None:
    bare = replace(sequence, part=None)
    short = CloudSequence.from_frames("short", [np.zeros((2, 3))], part=[np.zeros(2)])
    cases: list[tuple[type, str, Callable]] = [
        (DataError, "no parts to draw", lambda: parts_picture(tmp_path / "a.png", [bare])),
        (DataError, "550 points, its truth 2", lambda: parts_picture(tmp_path / "a.png", [sequence], truth=[short])),
        (DataError, "no sequences", lambda: parts_picture(tmp_path / "a.png", [])),
        (DataError, "cannot be written", lambda: parts_picture(tmp_path / "no" / "a.png", [sequence])),
        (DataError, "cannot be written", lambda: parts_picture(tmp_path / "a.what", [sequence])),
        (UsageError, "expected .gif", lambda: turntable(tmp_path / "a.mp4", sequence)),
        (UsageError, "up axis 'w'", lambda: Look(up="w")),
        (DataError, "no parts to write", lambda: write_ply_frames(tmp_path / "ply", bare)),
        (DataError, "don't fit", lambda: write_ply(tmp_path / "a.ply", np.zeros((2, 3)), None, np.zeros(3, int))),
        (
            DataError,
            "existing folder",
            lambda: write_ply(tmp_path / "no" / "a.ply", np.zeros((1, 3)), None, np.zeros(1, int)),
        ),
    ]
    for kind, message, call in cases:
        with pytest.raises(kind, match=message):
            call()


def test_ply_is_what_open3d_reads(sequence: CloudSequence, tmp_path: Path) -> None:
    paths = write_ply_frames(tmp_path / "toy", sequence)
    assert [path.name for path in paths] == [f"{t:04d}.ply" for t in range(5)]
    open3d = load_open3d()
    for t, path in enumerate(paths):
        cloud = open3d.t.io.read_point_cloud(str(path)).point
        span = slice(*sequence.frame_offsets[t : t + 2])
        np.testing.assert_array_equal(cloud.positions.numpy(), sequence.points[span])
        np.testing.assert_array_equal(cloud.colors.numpy(), part_colors(sequence.part[span]))
        np.testing.assert_array_equal(cloud["part"].numpy()[:, 0], sequence.part[span])


def test_ply_keeps_given_colors_and_unknown_parts(tmp_path: Path) -> None:
    points, colors = np.eye(3, dtype=np.float32), np.arange(9, dtype=np.uint8).reshape(3, 3)
    write_ply(tmp_path / "a.ply", points, colors, np.array([-1, 0, 300]))
    raw = (tmp_path / "a.ply").read_bytes()
    header, _, body = raw.partition(b"end_header\n")
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n") and len(body) == 3 * 19
    assert np.frombuffer(body[-4:], "<i4")[0] == 300 and np.frombuffer(body[15:19], "<i4")[0] == -1
    assert list(body[12:15]) == [0, 1, 2]
