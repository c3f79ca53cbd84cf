"""Names in the letters of other scripts: drawn where a font has them, told where none has."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from fontTools.fontBuilder import FontBuilder
from fontTools.pens.ttGlyphPen import TTGlyphPen
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

from dpcli.draw import fonts
from dpcli.draw.fonts import text_font
from dpcli.draw.sheet import SheetRow, contact_sheet, save_figure

RARE = "\U00013000"  # an Egyptian hieroglyph, which fonts of computers seldom have
NOWHERE = "\U0010fffd"  # for private use: a box


@pytest.fixture(autouse=True)
def nothing_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fonts, "_SAID", set())


@pytest.fixture
def made_font(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A font of one letter, RARE, a square, which is all that this computer has."""
    pen = TTGlyphPen(None)
    pen.moveTo((0, 0))
    for corner in ((0, 700), (700, 700), (700, 0)):
        pen.lineTo(corner)
    pen.closePath()
    builder = FontBuilder(1000, isTTF=True)
    builder.setupGlyphOrder([".notdef", "rare"])
    builder.setupCharacterMap({ord(RARE): "rare"})
    builder.setupGlyf({".notdef": TTGlyphPen(None).glyph(), "rare": pen.glyph()})
    builder.setupHorizontalMetrics({".notdef": (800, 0), "rare": (800, 0)})
    builder.setupHorizontalHeader(ascent=800, descent=-200)
    builder.setupNameTable({"familyName": "Made", "styleName": "Regular"})
    builder.setupOS2()
    builder.setupPost()
    builder.save(tmp_path / "Made.ttf")
    monkeypatch.setattr(font_manager, "findSystemFonts", lambda: [str(tmp_path / "Made.ttf")])
    return tmp_path / "Made.ttf"


def drawn(text: str) -> bytes:
    image = Image.new("L", (80, 40))
    ImageDraw.Draw(image).text((2, 2), text, fill=255, font=text_font(20, text))
    return image.tobytes()


@pytest.mark.parametrize("text", ["öffnen", "Łódź", "дверь", "πόρτα", "wave – ½"])
def test_letters_beyond_english_ones_are_drawn(text: str, capfd) -> None:
    contact_sheet([SheetRow(text, [text], [np.zeros((30, 200, 3), np.uint8)])])
    assert not capfd.readouterr().err
    assert all(drawn(letter) != drawn(NOWHERE) for letter in text if letter != " ")


def test_english_words_keep_their_font() -> None:
    assert text_font(13, "high arm wave").getname() == ImageFont.load_default(size=13).getname()


def test_a_font_of_this_computer_is_found(made_font: Path, capfd) -> None:
    assert text_font(13, RARE).getname()[0] == "Made"
    assert not capfd.readouterr().err


def test_letters_that_no_font_has_are_told_once(made_font: Path, capfd) -> None:
    for _ in range(2):
        text_font(13, f"wave {NOWHERE}")
    assert capfd.readouterr().err.count("no font of this computer has 1 letter") == 1


def test_figures_take_letters_of_other_fonts(made_font: Path, tmp_path: Path, capfd) -> None:
    pictures = []
    for title in (RARE, NOWHERE):
        figure, axes = plt.subplots(figsize=(2, 1))
        axes.set_title(title)
        save_figure(figure, tmp_path / "a.png")
        plt.close(figure)
        pictures.append((tmp_path / "a.png").read_bytes())
        assert ("no font" in capfd.readouterr().err) == (title != RARE)
    assert pictures[0] != pictures[1]
