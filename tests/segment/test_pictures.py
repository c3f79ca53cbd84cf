"""Pictures and PLY files of parts: who hides whom, which color means what, and files that other programs read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from dpcli.draw.palette import PALETTE
from dpcli.draw.ply import write_ply, write_ply_frames
from dpcli.errors import DataError, UsageError
from dpcli.segment.pictures import Look, _legend, parts_picture, there_and_back, turntable, usual_look
from dpcli.store import CloudSequence

WHITE = (255, 255, 255)


@pytest.fixture
def sequence() -> CloudSequence:
    rng = np.random.default_rng(0)
    frames = [rng.uniform(-1, 1, (90 + 10 * t, 3)) for t in range(5)]
    return CloudSequence.from_frames("toy", frames, part=[(frame[:, 0] > 0).astype(int) for frame in frames])


def test_sheet_shows_parts_by_color(sequence: CloudSequence, tmp_path: Path) -> None:
    swapped = replace(sequence, part=1 - sequence.part)
    look = Look(cell=100)
    parts_picture(tmp_path / "a.png", [sequence, swapped, sequence], frames=3, look=look)
    image = np.asarray(Image.open(tmp_path / "a.png"))
    rows = [image[8 + 122 * row + 22 : 8 + 122 * (row + 1), 8:-8] for row in range(3)]
    assert image.shape == (3 * 122 + 16, 3 * 100 + 16, 3)
    np.testing.assert_array_equal(rows[0], rows[2])
    assert not np.array_equal(rows[0], rows[1])
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


@pytest.mark.parametrize(
    ("command", "axis"),
    [
        ("dpc prepare depth my_videos --fov 60", 1),
        ("dpc prepare msraction3d RAW", 1),
        ("dpc generate4d export s.h5 --as clouds", 1),
        ("dpc prepare kitti-sf RAW --coordinates camera", 1),
        ("dpc prepare synthetic articulated --view single", 2),
        ("dpc prepare clouds scans/depth", 2),
        ("dpc prepare kitti-det RAW", -1),
    ],
)
def test_what_stands_is_drawn_standing_with_its_head_up(command: str, axis: int, tmp_path: Path) -> None:
    """The head, part 0, lies at y = -1 in camera axes (1), at y = 1 in KITTI's (-1), and at z = 1 in those of rooms (2)."""
    body = np.random.default_rng(0).uniform(-0.2, 0.2, (400, 3))
    body[:, abs(axis)] = np.linspace(-1, 1, 400)
    head = body[:, abs(axis)] * (-1 if axis == 1 else 1) > 0
    body = CloudSequence.from_frames("who", [body], part=[np.where(head, 0, 1)])
    parts_picture(
        tmp_path / "a.png", [body], look=usual_look([{"command": command}, {"command": "dpc segment predict"}])
    )
    cell = np.asarray(Image.open(tmp_path / "a.png"))[30:230, 8:208].astype(int)
    rows, columns = np.nonzero((cell < 240).any(-1))
    assert np.ptp(rows) > 2 * np.ptp(columns)
    blue, orange = (np.nonzero(cell[..., 2] - cell[..., 0] > 40)[0], np.nonzero(cell[..., 0] - cell[..., 2] > 40)[0])
    assert blue.mean() < orange.mean() - 40


def test_odd_sequences_are_drawn(tmp_path: Path) -> None:
    point = CloudSequence.from_frames("point" * 40, [np.zeros((1, 3))], part=[np.array([0])])
    gap = CloudSequence.from_frames("gap", [np.zeros((0, 3)), np.ones((9, 3))], part=[np.zeros(0), np.arange(9) - 1])
    many = CloudSequence.from_frames(
        "many", [np.random.default_rng(0).normal(size=(5000, 3))], part=[np.arange(5000) % 40]
    )
    parts_picture(tmp_path / "a.png", [point, gap, many])
    image = np.asarray(Image.open(tmp_path / "a.png"))
    assert tuple(image[0, 0]) == WHITE


def test_the_legend_names_what_stands_and_what_has_few_points() -> None:
    told: list[str] = []
    draw = SimpleNamespace(
        textlength=lambda text, font: 6 * len(text),
        ellipse=lambda box, fill: None,
        text=lambda place, text, **_look: told.append(text),
    )
    _legend(draw, 0, 800, np.repeat([-1, 1, 2], [700, 298, 2]), "0, stands")
    _legend(draw, 0, 800, np.repeat([0, 1], [999, 1]), "?")
    assert told == ["2: <1 %", "1: 30 %", "0, stands: 70 %", "1: <1 %", "0: >99 %"]


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
    cases: list[tuple[type, str, Callable]] = [
        (DataError, "no parts to draw", lambda: parts_picture(tmp_path / "a.png", [bare])),
        (DataError, "no sequences", lambda: parts_picture(tmp_path / "a.png", [])),
        (DataError, "cannot be written", lambda: parts_picture(tmp_path / "no" / "a.png", [sequence])),
        (DataError, "cannot be written", lambda: parts_picture(tmp_path / "a.what", [sequence])),
        (UsageError, "expected .gif", lambda: turntable(tmp_path / "a.mp4", sequence)),
        (UsageError, "up axis 'w'", lambda: Look(up="w")),
        (DataError, "no parts to write", lambda: write_ply_frames(tmp_path / "ply", bare)),
        (DataError, "don't fit", lambda: write_ply(tmp_path / "a.ply", np.zeros((2, 3)), np.zeros(3, int))),
        (
            DataError,
            "does not exist; create it first",
            lambda: write_ply(tmp_path / "no" / "a.ply", np.zeros((1, 3)), np.zeros(1, int)),
        ),
    ]
    for kind, message, call in cases:
        with pytest.raises(kind, match=message):
            call()
