"""Fonts that have the letters of a name: Pillow's own, which has little but English ones, matplotlib's, or one of this computer."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

from dpcli.counted import counted
from dpcli.runtime.progress import log

_SAID: set[str] = set()
# Words in the names of fonts that are asked last.
_SLANTED = "bold black heavy thin light italic oblique condensed mono serif".split()
# Fonts that draw boxes, nothing, or no letters for what they claim.
_WITHOUT_LETTERS = ("lastresort", "blank", "emoji", "symbol")


def text_font(size: int, text: str = "") -> Any:
    """Returns the font of sheets, letters `size` pixels high: Pillow's, where it has the letters of `text`, else one that has them.

    Where none has all of them, the log tells of those that will be boxes.
    """
    from PIL import ImageFont

    letters = _letters_of(text)
    if text.isascii() or letters <= _of_pillow():
        return ImageFont.load_default(size=size)
    best, lacking = _of_matplotlib(), letters - _of_file(_of_matplotlib())
    for path in _other_fonts() if lacking else ():
        without = letters - _of_file(path)
        if len(without) < len(lacking) and _opens(path, size):
            best, lacking = path, without
        if not lacking:
            break
    tell_lacking(lacking)
    return ImageFont.truetype(best, size)


def families_with(letters: Iterable[int]) -> tuple[list[str], set[int]]:
    """Returns font families, by matplotlib's names, that together have as many of these letters (numbers in Unicode) as this
    computer has, and the letters that none has.
    """
    from matplotlib import font_manager

    names, lacking = [], set(letters)
    for path in _other_fonts():
        if not lacking:
            break
        if (own := _of_file(path) & lacking) and (name := _registered(font_manager, path)):
            names.append(name)
            lacking -= own
    return names, lacking


def tell_lacking(letters: set[int]) -> None:
    """Says in the log which letters are boxes in a picture, once for each."""
    new = {letter for letter in letters if chr(letter) not in _SAID}
    _SAID.update(map(chr, new))
    if new:
        shown = " ".join(sorted(map(chr, new))[:8])
        log.warn(
            f"no font of this computer has {counted(len(new), 'letter')} of the names ({shown}), which are boxes in pictures; "
            "install a font that has them, such as Noto"
        )


def _letters_of(text: str) -> frozenset[int]:
    return frozenset(ord(letter) for letter in text if not letter.isspace())


@cache
def _of_pillow() -> frozenset[int]:
    from PIL import ImageFont

    return _charted(BytesIO(ImageFont.load_default(size=10).font_bytes))


@cache
def _of_file(path: str) -> frozenset[int]:
    """Returns the letters of a font file; none where it can't be read."""
    try:
        return _charted(path)
    except (OSError, RuntimeError, ValueError):
        return frozenset()


def _charted(font: str | BytesIO) -> frozenset[int]:
    from matplotlib.ft2font import FT2Font

    return frozenset(FT2Font(font).get_charmap())


@cache
def _of_matplotlib() -> str:
    import matplotlib

    return str(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf"))


def _other_fonts() -> Iterator[str]:
    """Yields the fonts of this computer, upright ones of usual width first."""
    from matplotlib import font_manager

    def rank(path: str) -> tuple[int, str]:
        stem = Path(path).stem.lower()
        return sum(word in stem for word in _SLANTED), path

    found = sorted(map(str, font_manager.findSystemFonts()), key=rank)
    return (path for path in found if not any(word in Path(path).stem.lower() for word in _WITHOUT_LETTERS))


def _opens(path: str, size: int) -> bool:
    from PIL import ImageFont

    try:
        ImageFont.truetype(path, size)
    except OSError:
        return False
    return True


def _registered(font_manager: Any, path: str) -> str:
    """Returns the family of a font file, which matplotlib knows from now on; "" where it can't use it."""
    try:
        font_manager.fontManager.addfont(path)
        return font_manager.FontProperties(fname=path).get_name()
    except (OSError, RuntimeError, ValueError):
        return ""
