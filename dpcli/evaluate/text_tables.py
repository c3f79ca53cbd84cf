"""Tables of text, and numbers as they stand in them: for a terminal, or as markdown for a document."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.evaluate.bootstrap import FEW, TOO_FEW, Interval, Resampling
from dpcli.evaluate.markdown import as_markdown, markdown_table
from dpcli.standard_streams import printable

UNDEFINED = "-"


@dataclass
class TextTable:
    """Holds a title, a header and rows of text; the first column is aligned to the left, the others to the right."""

    title: str
    header: list[str]
    rows: list[list[str]]

    def __post_init__(self) -> None:  # names of classes and files are among them
        self.title = printable(self.title)
        self.header = [printable(cell) for cell in self.header]
        self.rows = [[printable(cell) for cell in row] for row in self.rows]

    @property
    def width(self) -> int:
        """Returns how many columns of text the table takes in a terminal."""
        cells = zip(self.header, *self.rows, strict=True)
        return sum(max(len(cell) for cell in column) + 2 for column in cells)


def percent(share: float | None) -> str:
    """Returns a share as a percentage, `-` for an undefined one.

    >>> percent(0.8512), percent(None)
    ('85.1 %', '-')
    """
    return UNDEFINED if share is None or np.isnan(share) else f"{100 * share:.1f} %"


def percent_ends(own: Interval | None) -> str:
    """Returns the ends of an interval of shares; `-` where there is no interval or an undefined one.

    >>> percent_ends(Interval(0.831, 0.87))
    '83.1 - 87.0 %'
    """
    return f"{100 * own.low:.1f} - {percent(own.high)}" if own is not None and own.defined else UNDEFINED


def four_digits(value: float) -> str:
    """Returns a number to four significant digits, `-` for NaN.

    >>> four_digits(0.0123456), four_digits(float("nan"))
    ('0.01235', '-')
    """
    return UNDEFINED if np.isnan(value) else f"{value:.4g}"


def four_digit_ends(own: Interval | None) -> str:
    """Returns the ends of an interval to four significant digits; `-` where there is none or an undefined one."""
    return f"{own.low:.4g} - {own.high:.4g}" if own is not None and own.defined else UNDEFINED


def number_text(value: float | None, unit: str = "", *, signed: bool = False) -> str:
    """Returns a number as tables of several metrics have it: `85.1` for a fraction of 0.8512, other units to four digits."""
    if value is None or np.isnan(value):
        return UNDEFINED
    sign = "+" if signed else ""
    return f"{100 * value:{sign}.1f}" if unit == "fraction" else f"{value:{sign}.4g}"


def number_ends(own: Interval, unit: str, *, signed: bool = False) -> str:
    """Returns the ends of an interval in the form of `number_text`: `83.1 - 87.0`, of a difference `-1.2 to +3.4`."""
    if not own.defined:
        return UNDEFINED
    return (" to " if signed else " - ").join(number_text(end, unit, signed=signed) for end in (own.low, own.high))


def p_value_text(value: float | None) -> str:
    """Returns a p value to three digits, never as certain as 0; `-` for an undefined one."""
    if value is None or np.isnan(value):
        return UNDEFINED
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def resampling_note(resampling: Resampling, of: str, number: int) -> list[str]:
    """Returns how the intervals were found, and that they are too narrow where they are of few, or nothing without intervals.

    of: what was resampled, in words. number: how many of them there are.
    """
    if not resampling.resamples:
        return []
    if number < 2:
        return [f"Intervals: undefined; there is one of these {of} only, and nothing says how another would differ."]
    return [
        f"Intervals: {100 * resampling.confidence:.4g} %, bootstrap (BCa, {resampling.resamples} resamples of the "
        f"{number} {of}, seed {resampling.seed}): what other {of} of this kind would give, not another training.",
        *([f"They are too narrow: {number} {of} are few for a bootstrap. {TOO_FEW}"] if number < FEW else []),
    ]


def markdown_tables(tables: list[TextTable], notes: list[str]) -> str:
    """Returns the tables, then the notes, as markdown for a document."""
    made = [
        f"**{as_markdown(table.title)}**\n\n{markdown_table(table.header, table.rows, [True] * len(table.header))}"
        for table in tables
    ]
    return "\n\n".join([*made, *map(as_markdown, notes)])
