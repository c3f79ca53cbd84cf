"""Contact sheets: rows of a title and equal cells; the one font of all sheets; pictures written whole."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dpcli.draw.fonts import families_with, tell_lacking, text_font
from dpcli.draw.palette import DARK, RGB, Theme
from dpcli.errors import DataError
from dpcli.runtime.whole_file import whole_file
from dpcli.standard_streams import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GAP = 4  # pixels between cells
TITLE_HEIGHT = 18  # pixels of a title's line
_NO_LETTER = re.compile(r"Glyph (\d+) .*missing from")  # as matplotlib warns


class SheetRow(NamedTuple):
    """Holds a row of a sheet: its title, and its cells u8 (H,W,3) with a mark for each, such as the frame's number."""

    title: str
    marks: Sequence[str]
    cells: Sequence[np.ndarray]


def contact_sheet(rows: Sequence[SheetRow], theme: Theme = DARK) -> Any:
    """Returns a PIL image of rows of cells, all of one size, each row under its title.

    Raises DataError when there is no cell to draw.
    """
    from PIL import Image, ImageDraw

    columns = max((len(row.cells) for row in rows), default=0)
    if not columns:
        raise DataError("a contact sheet needs at least one picture")
    height, width = next(row.cells[0].shape[:2] for row in rows if len(row.cells))
    size = (columns * (width + GAP) + GAP, len(rows) * (height + TITLE_HEIGHT + GAP) + GAP)
    sheet = Image.new("RGB", size, theme.page)
    draw = ImageDraw.Draw(sheet)
    for place, row in enumerate(rows):
        top = GAP + place * (height + TITLE_HEIGHT + GAP)
        write_line(draw, (GAP + 2, top + 1), row.title, size[0] - 2 * GAP, theme.ink)
        for column, (mark, cell) in enumerate(zip(row.marks, row.cells, strict=True)):
            left = GAP + column * (width + GAP)
            sheet.paste(Image.fromarray(cell), (left, top + TITLE_HEIGHT))
            draw.text((left + 4, top + TITLE_HEIGHT + 2), mark, fill=theme.faint, font=text_font(10, mark))
    return sheet


def spread_evenly(count: int, most: int) -> list[int]:
    """Returns at most `most` of the numbers 0 to count - 1, evenly spread, the first and the last among them.

    >>> spread_evenly(9, 3), spread_evenly(2, 5), spread_evenly(0, 4)
    ([0, 4, 8], [0, 1], [])
    """
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int)).tolist()


def shortened(text: str, most: int) -> str:
    """Returns a text on one line, of at most `most` characters, the last of them "…" where some are left out.

    >>> shortened("high arm wave", 8), shortened("bend", 8)
    ('high ar…', 'bend')
    """
    text = printable(text)
    return text if len(text) <= most else text[: most - 1] + "…"


def write_line(draw: Any, place: tuple[int, int], text: str, room: int, ink: RGB) -> None:
    """Writes a text in one line on a PIL drawing, shortened to the width (pixels) there is; names may hold ends of lines."""
    text = printable(text)
    font = text_font(13, text)
    while draw.textlength(text, font=font) > room and len(text) > 2:
        text = text[:-2] + "…"
    draw.text(place, text, fill=ink, font=font)


def save_picture(image: Any, path: Path) -> None:
    """Writes a PIL image, or an array u8 (H,W,3), whole or not at all. Raises DataError when it can't be written."""
    import imageio.v3 as imageio

    try:
        with whole_file(path) as part:
            imageio.imwrite(part, np.asarray(image), extension=path.suffix)
    except (ValueError, OSError) as error:
        raise _not_written(path, error) from None


def _not_written(path: Path, error: Exception) -> DataError:
    why = getattr(error, "strerror", None) or error
    return DataError(f"{path}: the picture cannot be written ({why}); name a .png in an existing folder")


def new_figure(width: float, height: float) -> Figure:
    """Returns an empty matplotlib figure, inches wide and high, by matplotlib's own defaults: a person's matplotlibrc, which may
    ask for TeX or other sizes of letters, is for that person's own figures.
    """
    import matplotlib
    from matplotlib.figure import Figure

    matplotlib.rcdefaults()
    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, path: Path, dpi: int = 150) -> None:
    """Writes a matplotlib figure, whole or not at all, with letters that its font lacks from others of this computer; warns of
    those that none has. Raises DataError when it can't be written.
    """
    try:
        with whole_file(path) as part:
            if lacking := _save(figure, part, dpi):
                names, lacking = families_with(lacking)
                _add_families(figure, names)
                _save(figure, part, dpi)
    except (ValueError, OSError) as error:
        raise _not_written(path, error) from None
    tell_lacking(lacking)


def _save(figure: Figure, path: Path, dpi: int) -> set[int]:
    """Writes a figure and returns the letters (numbers in Unicode) that its fonts lack."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        figure.savefig(path, dpi=dpi)
    return {int(found[1]) for one in told if (found := _NO_LETTER.search(str(one.message)))}


def _add_families(figure: Figure, names: list[str]) -> None:
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_fontfamily([*text.get_fontfamily(), *names])
