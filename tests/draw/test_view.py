"""The words that say from which side points are drawn."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.draw.view import default_view, parse_view, turntable_view
from dpcli.errors import UsageError


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


def test_view_is_a_rotation_with_up_upwards() -> None:
    for up, axis in (("z", (0, 0, 1)), ("-y", (0, -1, 0)), ("x", (1, 0, 0))):
        for azimuth in np.linspace(-3, 3, 7):
            view = turntable_view(azimuth, 0.4, up)
            np.testing.assert_allclose(view @ view.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(view) == pytest.approx(1)
            right, down, away = view @ np.array(axis)
            assert abs(right) < 1e-12 and down < 0 and away < 0  # seen from above, upright tips toward the viewer
    np.testing.assert_allclose(turntable_view(np.pi / 2, 0, "z"), [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)
