"""Points as dots and as balls: which way up, and who hides whom; against a z-buffer written as loops."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.draw import points as points_module
from dpcli.draw.palette import DARK
from dpcli.draw.points import FINE, Raster, _lit_ball, draw_balls, draw_dots

RED, GREEN, WHITE = (255, 0, 0), (0, 255, 0), (255, 255, 255)


def loop_z_buffer(points: np.ndarray, colors: np.ndarray, raster: Raster, size: int) -> np.ndarray:
    """Every pixel of every square, one after the other; the nearest wins, of equally near ones the later point."""
    image = np.full((raster.height, raster.width, 3), DARK.background, np.uint8)
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
    monkeypatch.setattr(points_module, "_fill_gaps", lambda image, depth: (image, depth))
    monkeypatch.setattr(points_module, "_shade_relief", lambda image, depth: image)


@pytest.mark.parametrize("size", [1, 2, 3, 4])
@pytest.mark.parametrize("count", [0, 1, 300])
def test_drawing_equals_a_loop(flat: None, monkeypatch: pytest.MonkeyPatch, size: int, count: int) -> None:
    monkeypatch.setattr(points_module, "_dot_side", lambda pixels: size)
    assert_draws_the_nearest(draw_dots, size, count, size)


def test_the_loop_rejects_a_drawing_in_which_the_far_hides_the_near(
    flat: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(points_module, "_dot_side", lambda pixels: 2)
    with pytest.raises(AssertionError):
        assert_draws_the_nearest(lambda p, c, r: draw_dots(p * [1, 1, -1], c, r), 5, 300, 2)
    with pytest.raises(AssertionError):
        assert_draws_the_nearest(lambda p, c, r: draw_dots(p * [1, -1, 1], c, r), 5, 300, 2)


def test_y_points_down_and_x_right() -> None:
    points = np.array([[0.5, 0, 1], [0, 0.5, 1]], np.float32)
    image = draw_dots(points, np.array([RED, GREEN], np.uint8), Raster(20, 20, np.zeros(2), 10.0))
    red, green = ((image == color).all(-1) for color in (RED, GREEN))
    assert np.argwhere(red).mean(0)[1] > 12 and np.argwhere(green).mean(0)[0] > 12


def test_only_gaps_of_one_pixel_are_closed() -> None:
    depth = np.where(np.array([[1, 0, 1, 0, 0, 1], [0, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 1]], bool), 5, np.inf)
    image = np.where(np.isfinite(depth)[..., None], 200, 0).astype(np.uint8).repeat(3, axis=2)
    filled, deep = points_module._fill_gaps(image, depth.astype(np.float32))
    expected = np.array([[1, 1, 1, 0, 0, 1], [1, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 1]], bool)
    np.testing.assert_array_equal(filled[..., 0] == 200, expected)
    np.testing.assert_array_equal(np.isfinite(deep), expected)


def test_shade_relief_darkens_only_what_lies_behind_its_neighbor() -> None:
    image = np.full((5, 6, 3), 200, np.uint8)
    depth = np.full((5, 6), 10, np.float32)
    depth[:, 3:] = 14
    shaded = points_module._shade_relief(image, depth)
    assert (shaded[:, 3] < 200).all() and (shaded[:, [0, 1, 2, 4, 5]] == 200).all()


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


def test_a_side_and_no_relief_paint_plain_squares() -> None:
    points, colors = np.array([[0.0, 0, 1], [0, 0, 2]], np.float32), np.array([RED, GREEN], np.uint8)
    image = draw_dots(points, colors, Raster(9, 9, np.zeros(2), 1.0), side=3, relief=False, background=WHITE)
    red = (image == RED).all(-1)
    assert red.sum() == 9 and red[3:6, 3:6].all() and (image[~red] == 255).all()
