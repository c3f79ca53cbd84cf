"""The words that say from which side points are drawn."""

from __future__ import annotations

import pytest

from dpcli.draw.view import default_view, parse_view
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
