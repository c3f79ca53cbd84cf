"""The blocks of a report: tables whose cells know how they sort, figures, and sections that hold them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

MISSING = "-"
_DIGITS = {"dB": 2, "degree": 2, "percent": 2}


@dataclass(frozen=True)
class Cell:
    """Holds a table's cell. sort: number it sorts by, None = by its text, or last when that is "-"; share: bar in 0..1."""

    text: str
    sort: float | None = None
    share: float | None = None
    link: str = ""
    mark: str = ""  # "ours" | "thesis"


@dataclass(frozen=True)
class Table:
    """Holds rows under a header, the first cell of each its name; key: what the table is, for code that looks for it."""

    title: str
    header: tuple[str, ...]
    rows: list[list[Cell]]
    note: str = ""
    key: str = ""


@dataclass(frozen=True)
class Figure:
    """Holds markup that only a page can show, made here, with all text from files escaped."""

    title: str
    html: str
    note: str = ""


@dataclass(frozen=True)
class Headline:
    """Holds the one number a result is known by: metric, value and interval as text."""

    metric: str
    value: Cell
    interval: str = ""


@dataclass
class Section:
    """Holds one result: its headline, tables and figures, and all that its numbers depend on."""

    anchor: str
    title: str
    task: str
    data: str
    headline: Headline
    blocks: list[Table | Figure] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    details: list[tuple[str, list[tuple[str, str]]]] = field(default_factory=list)  # (heading, term and words)
    commands: list[str] = field(default_factory=list)


@dataclass
class Report:
    """Holds all of the page. beside: tables with the thesis's rows; left_out: what was given but isn't shown."""

    title: str
    summary: Table
    sections: list[Section]
    beside: list[Table]
    left_out: list[str]
    version: str


def is_number(value: Any) -> bool:
    """Returns whether a value is a number, and not a truth value."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def text_of(value: Any, unit: str = "") -> str:
    """Returns a value as text: a fraction in percent, two decimals for dB, degrees and percent, else four digits.

    >>> text_of(0.9351, "fraction"), text_of(25.0, "dB"), text_of(0.0123456)
    ('93.5 %', '25.00', '0.01235')
    """
    if value is None:
        return MISSING
    if not is_number(value):
        return str(value)
    if unit == "fraction":
        return f"{100 * value:.1f} %"
    if isinstance(value, int):
        return str(value)
    return f"{value:.{_DIGITS[unit]}f}" if unit in _DIGITS else f"{value:.4g}"


def cell(value: Any, unit: str = "", *, bar: bool = False, mark: str = "") -> Cell:
    """Returns a cell of a value that is a number, a text, or missing (None)."""
    if not is_number(value):
        return Cell(text_of(value), mark=mark)
    share = min(max(float(value), 0.0), 1.0) if bar else None
    return Cell(text_of(value, unit), float(value), share, mark=mark)


def interval_of(found: Any) -> tuple[float, float] | None:
    """Returns low and high of an interval, however it is written; None when it is none."""
    if isinstance(found, dict):
        found = found.get("interval", [found.get("low"), found.get("high")])
    if isinstance(found, (list, tuple)) and len(found) == 2 and all(is_number(end) for end in found):
        return float(found[0]), float(found[1])
    return None


def interval_text(found: Any, unit: str = "") -> str:
    """Returns an interval in words, "" without one.

    >>> interval_text([0.896, 0.96], "fraction")
    '89.6 to 96.0 %'
    """
    ends = interval_of(found)
    if ends is None:
        return ""
    low, high = (text_of(end, unit) for end in ends)
    return f"{low.removesuffix(' %')} to {high}" if low.endswith(" %") else f"{low} to {high}"


def sort_key(text: str) -> float | None:
    """Returns the number a text begins with; None for other texts.

    >>> sort_key("93.5 %"), sort_key("1,024"), sort_key("-")
    (93.5, 1024.0, None)
    """
    head = text.strip().replace(",", "").replace("\u2212", "-").split(" ")[0].rstrip("%\u00b0")
    try:
        value = float(head)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def table(
    title: str, header: Sequence[str], rows: Sequence[Sequence[Cell | str]], note: str = "", key: str = ""
) -> Table:
    """Returns a table of cells and plain texts, which sort by the number they begin with, if any."""
    made = [[own if isinstance(own, Cell) else Cell(own, sort_key(own)) for own in row] for row in rows]
    return Table(title, tuple(header), made, note, key)
