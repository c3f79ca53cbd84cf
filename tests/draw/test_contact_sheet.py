"""The contact sheet: which samples, which way up, who hides whom; against a z-buffer written as loops."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.draw import contact_sheet as sheet_module
from dpcli.draw.contact_sheet import Raster, contact_sheet, default_view, draw_frame, parse_view, spread_samples
from dpcli.errors import DataError, UsageError
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter

RED, GREEN = (255, 0, 0), (0, 255, 0)


def loop_z_buffer(points: np.ndarray, colors: np.ndarray, raster: Raster, size: int) -> np.ndarray:
    """Every pixel of every square, one after the other; the nearest wins, of equally near ones the later point."""
    image = np.full((raster.height, raster.width, 3), sheet_module._BACKGROUND, np.uint8)
    depth = np.full((raster.height, raster.width), np.inf)
    for (x, y, z), color in zip(points, colors, strict=True):
        column = int(np.floor((x - raster.center[0]) * raster.scale + raster.width / 2))
        row = int(np.floor((y - raster.center[1]) * raster.scale + raster.height / 2))
        for dy in range(size):
            for dx in range(size):
                r, c = row + dy - size // 2, column + dx - size // 2
                if 0 <= r < raster.height and 0 <= c < raster.width and z <= depth[r, c]:
                    depth[r, c], image[r, c] = z, color
    return image


def random_cloud(seed: int, count: int) -> tuple[np.ndarray, np.ndarray, Raster]:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.3, 1.3, (count, 3)).astype(np.float32)
    points[:, 2] = np.round(points[:, 2] * 4) / 4  # ties in depth
    return points, rng.integers(0, 256, (count, 3)).astype(np.uint8), Raster(24, 18, np.zeros(2), 8.0)


def assert_draws_the_nearest(draw, seed: int, count: int, size: int) -> None:
    points, colors, raster = random_cloud(seed, count)
    expected = loop_z_buffer(points, colors, raster, size)
    np.testing.assert_array_equal(draw(points, colors, raster), expected)


@pytest.fixture
def flat(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without shading and closing gaps, so that colors can be compared."""
    monkeypatch.setattr(sheet_module, "_fill_gaps", lambda image, depth: (image, depth))
    monkeypatch.setattr(sheet_module, "_relief", lambda image, depth: image)


@pytest.mark.parametrize("size", [1, 2, 3, 4])
@pytest.mark.parametrize("count", [0, 1, 300])
def test_drawing_equals_a_loop(flat: None, monkeypatch: pytest.MonkeyPatch, size: int, count: int) -> None:
    monkeypatch.setattr(sheet_module, "_dot_size", lambda pixels: size)
    assert_draws_the_nearest(draw_frame, size, count, size)


def test_the_loop_rejects_a_drawing_in_which_the_far_hides_the_near(
    flat: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sheet_module, "_dot_size", lambda pixels: 2)
    with pytest.raises(AssertionError):
        assert_draws_the_nearest(lambda p, c, r: draw_frame(p * [1, 1, -1], c, r), 5, 300, 2)
    with pytest.raises(AssertionError):
        assert_draws_the_nearest(lambda p, c, r: draw_frame(p * [1, -1, 1], c, r), 5, 300, 2)


def test_y_points_down_and_x_right() -> None:
    points = np.array([[0.5, 0, 1], [0, 0.5, 1]], np.float32)
    image = draw_frame(points, np.array([RED, GREEN], np.uint8), Raster(20, 20, np.zeros(2), 10.0))
    red, green = ((image == color).all(-1) for color in (RED, GREEN))
    assert np.argwhere(red).mean(0)[1] > 12 and np.argwhere(green).mean(0)[0] > 12


def test_only_gaps_of_one_pixel_are_closed() -> None:
    depth = np.where(np.array([[1, 0, 1, 0, 0, 1], [0, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 1]], bool), 5, np.inf)
    image = np.where(np.isfinite(depth)[..., None], 200, 0).astype(np.uint8).repeat(3, axis=2)
    filled, deep = sheet_module._fill_gaps(image, depth.astype(np.float32))
    expected = np.array([[1, 1, 1, 0, 0, 1], [1, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 1]], bool)
    np.testing.assert_array_equal(filled[..., 0] == 200, expected)
    np.testing.assert_array_equal(np.isfinite(deep), expected)


def test_relief_darkens_only_what_lies_behind_its_neighbor() -> None:
    image = np.full((5, 6, 3), 200, np.uint8)
    depth = np.full((5, 6), 10, np.float32)
    depth[:, 3:] = 14
    shaded = sheet_module._relief(image, depth)
    assert (shaded[:, 3] < 200).all() and (shaded[:, [0, 1, 2, 4, 5]] == 200).all()


@pytest.mark.parametrize(
    ("text", "right", "down", "away"),
    [
        ("xyz", (1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ("x-zy", (1, 0, 0), (0, 0, -1), (0, 1, 0)),
        ("yx-z", (0, 1, 0), (1, 0, 0), (0, 0, -1)),
        ("-yzx", (0, -1, 0), (0, 0, 1), (1, 0, 0)),
    ],
)
def test_view(text: str, right: tuple, down: tuple, away: tuple) -> None:
    assert parse_view(text).tolist() == [list(right), list(down), list(away)]


@pytest.mark.parametrize("text", ["", "xy", "xxz", "xyzz", "x y z", "--xyz", "xyz-", "front"])
def test_a_view_that_is_none(text: str) -> None:
    with pytest.raises(UsageError, match="such as xyz"):
        parse_view(text)


def test_image_coordinates_are_turned_upright() -> None:
    assert default_view("pixel (row, column), gray level") == "yx-z" and default_view("m") == "xyz"


@settings(max_examples=60, deadline=None)
@given(labels=st.lists(st.integers(-1, 6), min_size=1, max_size=40), count=st.integers(1, 12))
def test_samples_are_spread_over_the_classes(labels: list[int], count: int) -> None:
    chosen = spread_samples(np.array(labels), count)
    assert len(set(chosen)) == len(chosen) == min(count, len(labels))
    shown = [labels[i] for i in chosen]
    assert shown == sorted(shown)
    assert len(set(shown)) == min(count, len(set(labels)))
    if count >= len(set(labels)):  # no class gets two more than another that still had samples
        for label in set(labels):
            if shown.count(label) < labels.count(label):
                assert max(shown.count(other) for other in shown) <= shown.count(label) + 1


@pytest.mark.parametrize("field", ["none", "color", "part"])
def test_the_sheet_shows_the_colors_of_the_file(tmp_path: Path, field: str) -> None:
    from PIL import Image

    rng = np.random.default_rng(0)
    path = tmp_path / "c.h5"
    with CloudsWriter(path, class_names=["wave", "push"], fields=() if field == "none" else (field,)) as writer:
        for index in range(3):
            frames = [rng.uniform(0, 1, (200, 3)) for _ in range(5)] + [np.zeros((0, 3))]
            extra = {
                "color": {"color": [np.tile(np.array([RED], np.uint8), (len(f), 1)) for f in frames]},
                "part": {"part": [np.arange(len(f), dtype=np.int16) % 3 for f in frames]},
            }.get(field, {})
            writer.write(CloudSequence.from_frames(f"s{index}", frames, label=index % 2, **extra))
    picture = tmp_path / "sheet.png"
    with CloudsReader(path) as reader:
        contact_sheet(reader, picture, samples=2, frames=4)
    with Image.open(picture) as image:
        pixels = np.asarray(image).reshape(-1, 3).astype(int)
    red = ((pixels[:, 0] > 120) & (pixels[:, 1] < 40) & (pixels[:, 2] < 40)).sum()
    colored = (pixels.max(1) - pixels.min(1) > 60).sum()
    assert colored > 500
    assert (red > 0.9 * colored) == (field == "color")


def test_a_picture_into_nowhere(tmp_path: Path) -> None:
    path = tmp_path / "c.h5"
    with CloudsWriter(path) as writer:
        writer.write(CloudSequence.from_frames("s", [np.zeros((1, 3))]))
    with CloudsReader(path) as reader, pytest.raises(DataError, match="cannot be written"):
        contact_sheet(reader, tmp_path / "none" / "x.png")
