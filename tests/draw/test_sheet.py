"""Contact sheets, and pictures that are whole or not there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dpcli.draw.palette import DARK, LIGHT
from dpcli.draw.sheet import GAP, TITLE_HEIGHT, SheetRow, contact_sheet, save_picture, spread_evenly
from dpcli.errors import DataError


def cells(count: int, value: int) -> list[np.ndarray]:
    return [np.full((31, 40, 3), value + number, np.uint8) for number in range(count)]


@pytest.mark.parametrize("theme", [DARK, LIGHT])
def test_cells_stand_in_rows_under_their_titles(theme) -> None:
    rows = [SheetRow("front", ["", "", ""], cells(3, 100)), SheetRow("back", ["", ""], cells(2, 200))]
    page = np.asarray(contact_sheet(rows, theme))
    assert page.shape == (2 * (31 + TITLE_HEIGHT + GAP) + GAP, 3 * (40 + GAP) + GAP, 3)
    assert tuple(page[0, 0]) == theme.page
    for row, (_, _, own) in enumerate(rows):
        top = GAP + TITLE_HEIGHT + row * (31 + TITLE_HEIGHT + GAP)
        for column, cell in enumerate(own):
            left = GAP + column * (40 + GAP)
            np.testing.assert_array_equal(page[top : top + 31, left : left + 40], cell)


def test_a_long_title_stays_on_the_page() -> None:
    page = np.asarray(contact_sheet([SheetRow("a long title " * 30, [""], cells(1, 0))]))
    assert page.shape[1] == 40 + 2 * GAP and (page[GAP : GAP + TITLE_HEIGHT, -GAP:] == DARK.page).all()


def test_a_name_of_several_lines_is_drawn_in_one() -> None:
    pages = [np.asarray(contact_sheet([SheetRow(title, [""], cells(1, 0))])) for title in ("a\nb", "a\\nb")]
    np.testing.assert_array_equal(*pages)


def test_a_sheet_of_nothing_is_refused() -> None:
    for rows in ([], [SheetRow("empty", [], [])]):
        with pytest.raises(DataError, match="at least one picture"):
            contact_sheet(rows)


@pytest.mark.parametrize(("count", "most"), [(1, 8), (5, 5), (24, 8), (3, 7), (100, 2)])
def test_numbers_are_spread_to_both_ends(count: int, most: int) -> None:
    chosen = spread_evenly(count, most)
    assert chosen[0] == 0 and chosen[-1] == count - 1 and len(chosen) == min(count, most)
    assert np.ptp(np.diff(chosen)) <= 1 if len(chosen) > 2 else True


def test_a_picture_is_whole_or_not_there(tmp_path: Path) -> None:
    picture = cells(1, 9)[0]
    save_picture(picture, tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as image:
        np.testing.assert_array_equal(np.asarray(image), picture)
    for wrong in (tmp_path / "no" / "a.png", tmp_path / "a.what"):
        with pytest.raises(DataError, match="cannot be written"):
            save_picture(picture, wrong)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
