"""Texts of numbers in columns, whoever wrote them: decimal commas, quotes, UTF-16, headers, comments, counts."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.cloud import named_axes
from dpcli.prepare.cloud_formats.column_names import (
    ROWS_ARE_FRAMES,
    Table,
    find_trios,
    seconds_in_brackets,
    unit_of,
    unit_of_comments,
    words_of,
)
from dpcli.prepare.cloud_formats.plain_numbers import parse_plain
from dpcli.text_files import decode_text

COMMENTS = ("#", "//", "%")
_SHEET_ERRORS = ("#n/a", "#na", "#value!", "#div/0!", "#num!", "#ref!", "#null!", "#name?")  # of spreadsheets
_MISSING = frozenset(
    ("", "nan", "-nan", "+nan", "na", "n/a", "null", "none", "nil", "-", "nan(ind)", "-nan(ind)", *_SHEET_ERRORS)
)
_NOT_A_NUMBER = re.compile(r"[-+]?1[.,]#(qnan|snan|ind|inf)\w*", re.IGNORECASE)  # as Windows writes it
_NUMBER = r"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?"
_GROUPED = re.compile(r"[-+]?\d{1,3}([.,'\u2019 \u00a0\u202f])\d{3}(\1\d{3})*([.,]\d+)?")
_FRACTION = re.compile(r"[-+]?\d+\.\d+")
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+")
_SPACED_COMMAS = re.compile(r"[-+]?\d+,\d+(, +[-+]?\d+,\d+)+")
_POINTED = re.compile(r"[-+]?[1-9]\d{0,2}(\.\d{3})+")
_BELOW_THOUSAND = re.compile(r"[-+]?[1-9]\d{0,2}")  # which groups of thousands leave as they are
CUT = "frames of texts with numbers such as 5.41123e+06, whose last digits are missing; write more of them"
_DIGITS = "|".join(rf"\d{{{n}}}e\+?0*(?:[{n + 1}-9]|[1-9]\d)" for n in range(3, 9))  # fewer than the exponent asks for
_CUT = re.compile(rf"(?<![\d.])\d[.,](?:{_DIGITS})(?!\d)", re.IGNORECASE)
_SHOWN = 1 << 16  # characters at both ends of a text that tell how it writes numbers
_EDGES = " \r\n\x00"  # no tabs: they may stand for empty cells
_HEAD = 200  # lines among which the header is looked for
_LOOKED_AT = 30  # lines before the numbers, and rows that tell what the columns hold


@dataclass(frozen=True)
class TextTable(Table):
    """Holds the rows of a text, not yet taken for numbers.

    body: the text from the first row on; first_line: which line of the file that is, from 1. delimiter: None for blanks.
    limit: rows that count, None for all. header: the line of the names, which files that were joined hold several times.
    unit: as comments before the rows tell it. seconds: (column, seconds of its unit) where a row below the header tells that
    a column is in a unit of time.
    """

    path: Path
    names: tuple[str, ...]
    body: str
    first_line: int = 1
    delimiter: str | None = None
    limit: int | None = None
    header: str = ""
    unit: str = ""
    seconds: tuple[tuple[str, float], ...] = ()

    @cached_property
    def numbered(self) -> list[tuple[int, str]]:
        """Returns the rows with the number of their line; no empty ones, no comments, no header that comes again."""
        lines, blank = enumerate(self.body.split("\n"), self.first_line), f" {self.delimiter or ''}"
        rows = ((k, line.strip(_EDGES)) for k, line in lines if line.strip(blank).strip() and not _is_comment(line))
        return list(islice((row for row in rows if row[1] != self.header or not self.header), self.limit))

    @property
    def rows(self) -> int:
        """Returns the number of rows of the whole text, those beyond ``limit`` too."""
        lines = self.body.count("\n") + (not self.body.endswith("\n"))
        return lines if lines == self.limit else len(replace(self, limit=None).numbered)

    @property
    def empty_rows(self) -> int:
        """Returns how many rows hold nothing between their delimiters, as pandas writes points of NaN; `numbered` lacks them."""
        sign = self.delimiter or "\n"
        return sum(sign in line and not line.strip(f" {sign}").strip() for line in self.body.split("\n"))

    @property
    def cut(self) -> dict[str, int]:
        """Returns a note where numbers lack their last digits, as C++, MATLAB and spreadsheets write large ones; {} where none do."""
        ends = self.body[:_SHOWN], self.body[-_SHOWN:]
        return {CUT: 1} if any("e" in end.lower() and _CUT.search(end) for end in ends) else {}

    @cached_property
    def width(self) -> int:
        """Returns the number of columns."""
        return len(self.names) or len(_trimmed(self.cells(self.first_rows(1)[0][1])))

    def first_rows(self, count: int) -> list[tuple[int, str]]:
        """Returns the first rows with the numbers of their lines, without looking at the others."""
        head = replace(self, body="\n".join(self.body.split("\n", 4 * count + 100)[: 4 * count + 100]))
        return head.numbered[:count]

    def cells(self, line: str) -> list[str]:
        """Returns the cells of a row, without quotes and blanks around them."""
        if self.delimiter is None:
            return [cell.strip('"') for cell in line.split()]
        if '"' in line or "'" in line:
            quote = '"' if '"' in line else "'"
            return [cell.strip() for cell in next(csv.reader([line], delimiter=self.delimiter, quotechar=quote))]
        return [cell.strip() for cell in line.split(self.delimiter)]

    def columns(self, places: Sequence[int]) -> np.ndarray:
        signs = {",": "", ";": ",.", "\t": ",."}.get(self.delimiter or "", ",")  # that may divide thousands
        doubtful = bool(signs) and _may_be_thousands(self.body, signs)
        sure = self.width and not doubtful
        plain = parse_plain(self.body, self.width, self.delimiter, self.limit) if sure else None
        if plain is not None:
            return plain[:, list(places)]
        fast = None if doubtful else self._read_fast(list(places))
        return self._read_any(list(places)) if fast is None else fast

    def words(self, place: int) -> list[str]:
        return [self._row(line, number)[place] for number, line in self.numbered]

    def moments(self, place: int) -> np.ndarray | None:
        unit = dict(self.seconds).get(self.names[place]) if self.names else None
        if unit is None:
            return None
        try:
            values = self.columns([place])[:, 0]
        except DataError:  # such as times of day
            return None
        known = values[np.isfinite(values)]
        return (values - known[0]) * unit if len(known) else None

    def _read_fast(self, places: list[int]) -> np.ndarray | None:
        """Returns what NumPy reads where some columns hold words; None where the text is none that it reads right."""
        lines = [line for _, line in self.numbered]
        body = "\n".join(lines)
        if '"' in body or "'" in body or (self.delimiter != "," and "," in body and "." in body):
            return None
        widths = {len(line.split(self.delimiter)) for line in lines}
        if widths != {self.width}:
            return None
        if self.delimiter != "," and "," in body:
            lines = body.replace(",", ".").split("\n")
        try:
            return np.loadtxt(lines, delimiter=self.delimiter, usecols=places, ndmin=2, comments=None)
        except ValueError:
            return None

    def _row(self, line: str, number: int) -> list[str]:
        cells = self.cells(line)
        if len(cells) > self.width:
            cells = _trimmed(cells, self.width)
        if len(cells) != self.width:
            doubled = self.delimiter == "," and len(cells) == 2 * self.width
            raise DataError(
                f"{self.path}:{number}: {len(cells)} values; expected numbers in columns, {self.width} as in the"
                f" {'header' if self.names else 'first row'}"
                + ("; are these decimal commas between commas? Save it with points or semicolons" if doubled else "")
            )
        return cells

    def _read_any(self, places: list[int]) -> np.ndarray:
        rows = [self._row(line, number) for number, line in self.numbered]
        decimal = self._decimal(rows, places)
        values = np.empty((len(rows), len(places)))
        for k, (row, (number, _)) in enumerate(zip(rows, self.numbered)):
            for column, place in enumerate(places):
                value = _number(row[place], decimal)
                if value is None:
                    name = f"column {self.names[place]!r}" if self.names else f"column {place + 1}"
                    raise DataError(
                        f"{self.path}:{number}: {name} holds {row[place]!r:.60}; expected numbers in columns"
                    )
                values[k, column] = value
        return values

    def _decimal(self, rows: list[list[str]], places: list[int]) -> str:
        """Returns the decimal sign of the cells. Raises DataError where points and commas contradict one another."""
        commas = [row[place] for row in rows for place in places if "," in row[place]]
        if not commas:
            return self._decimal_of_points(rows, places)
        both = [cell for cell in commas if "." in cell]
        signs = {max(".,", key=cell.rfind) for cell in both}
        if not both:
            others = [row[place] for row in rows for place in places if "," not in row[place]]
            points = any("." in cell for cell in others)
            grouped = all(_THOUSANDS.fullmatch(cell) for cell in commas)
            whole = [cell for cell in others if _BELOW_THOUSAND.fullmatch(cell)]
            if grouped and whole and not points and self.delimiter != ",":
                raise DataError(
                    f"{self.path}: {commas[0]} beside {whole[0]} may be {commas[0].replace(',', '')} or"
                    f" {commas[0].replace(',', '.')}; expected numbers without groups of thousands"
                )
            english = self.delimiter == "," and any(_FRACTION.fullmatch(cell) for row in rows for cell in row)
            signs = {"."} if grouped and (points or whole or english) else {","} if not points else set()
        if len(signs) != 1:
            raise DataError(f"{self.path}: numbers such as {commas[0]} beside others with a point; expected one style")
        return signs.pop()

    def _decimal_of_points(self, rows: list[list[str]], places: list[int]) -> str:
        """Returns the decimal sign of cells without commas. Raises DataError where a column of points in groups of three digits
        holds whole numbers, too, as where they divide thousands.
        """
        columns = [[row[place] for row in rows] for place in places]
        pointed = [cell for column in columns for cell in column if "." in cell]
        grouped = next((cell for cell in pointed if cell.count(".") > 1 and _POINTED.fullmatch(cell)), "")
        if grouped and (other := next((cell for cell in pointed if not _POINTED.fullmatch(cell)), "")):
            raise DataError(f"{self.path}: numbers such as {grouped} beside {other}; expected one style")
        if grouped:
            return ","
        for column in columns if self.delimiter in (";", "\t") else []:
            own = [cell for cell in column if "." in cell]
            whole = [cell for cell in column if _BELOW_THOUSAND.fullmatch(cell)]
            if own and whole and all(map(_POINTED.fullmatch, own)):
                raise DataError(
                    f"{self.path}: {own[0]} beside {whole[0]} may be {own[0].replace('.', '')} or {own[0]};"
                    " expected numbers without groups of thousands"
                )
        return "."


def _may_be_thousands(body: str, signs: str) -> bool:
    """Returns whether all of a text's commas, or all its points, may divide thousands, such as 1,500: no other number tells
    decimals. signs: which of the two may.
    """
    found = [sign for sign in ",." if sign in body]
    if len(found) != 1 or found[0] not in signs:
        return False
    sign = f"[{found[0]}]"
    return re.search(rf"{sign}(?!\d{{3}}(?!\d))|(?<!\d)0{sign}|\d{{4}}{sign}|(?<!\d){sign}", body) is None


def _is_comment(line: str) -> bool:
    """Returns whether a line says something about the rows; one that begins with a spreadsheet's error is a row."""
    start = line.lstrip()
    return start.startswith(COMMENTS) and not start.lower().startswith(_SHEET_ERRORS)


def _trimmed(cells: list[str], width: int = 0) -> list[str]:
    """Returns the cells without empty ones at the end, which trailing separators make."""
    end = len(cells)
    while end > width and not cells[end - 1]:
        end -= 1
    return cells[:end]


def _number(cell: str, decimal: str) -> float | None:
    """Returns the number in a cell, NaN of an empty one, None of other words."""
    if cell.lower() in _MISSING or _NOT_A_NUMBER.fullmatch(cell):
        return float("nan")
    grouped = _GROUPED.fullmatch(cell)
    if grouped and grouped[1] != decimal:
        cell = cell.replace(grouped[1], "")
    if decimal == ",":
        cell = cell.replace(",", ".")
    if "_" in cell:  # which Python would pass over
        return None
    try:
        return float(cell)
    except ValueError:
        return None


def read_text_table(path: Path, *, may_be_empty: bool = False) -> TextTable:
    """Reads the rows of a text and what its header says. Raises DataError when it is no table of numbers, or has no rows.

    may_be_empty: names without rows are a table, too, such as of a moment in which a radar saw nothing.
    """
    text = decode_text(path)
    if not text.isascii():
        text = text.replace("\u2212", "-")  # the minus of typographers, as some languages' numbers have it
    head = list(enumerate(text.split("\n", _HEAD)[:_HEAD], 1))
    head = [(k, line.strip(_EDGES)) for k, line in head if line.strip()]
    if not head:
        raise DataError(f"{path}: no rows; expected numbers in columns")
    delimiter = None
    if re.fullmatch(r"sep=.", head[0][1], re.IGNORECASE):  # as Excel tells itself
        delimiter = head.pop(0)[1][-1]
    first, names = _find_header(path, head, delimiter)
    body = text.split("\n", first - 1)[-1] if first > 1 else text
    header = next((line for k, line in head if k == first - 1), "") if names else ""
    unit = unit_of_comments([line for k, line in head if k < first and line.startswith(COMMENTS)])
    table = _with_units(TextTable(path, tuple(names), body, first, delimiter, header=header, unit=unit))
    rows = table.first_rows(2)
    if not rows and names and may_be_empty:
        return table
    if not rows:
        raise DataError(f"{path}: a header, but no rows; expected numbers in columns")
    if re.fullmatch(r"\d+", rows[0][1]) and (len(rows) == 1 or len(_rough_cells(rows[1][1])) > 2):
        table = _without_count(table, *rows[0])
        rows = rows[1:] or rows
    table = _with_row_names(replace(table, delimiter=delimiter or delimiter_of(rows[0][1])), rows)
    return table if names else _checked_unnamed(_with_counted_header(table))


def _with_units(table: TextTable) -> TextTable:
    """Returns the table without a first row that tells the units of its columns, which stand in their names then."""
    row = re.match(r"\s*(.+)\n", table.body) if table.names else None
    axes = named_axes(table.path, table.names) if row else None
    if not row or not axes:
        return table
    units = names_in(row[1].strip(_EDGES), table.delimiter or delimiter_of(row[1]))
    told = {unit_of(f"x {units[place] if place < len(units) else ''}") for place in axes[0]}
    if len(told) != 1 or not (unit := told.pop()):
        return table
    names = tuple(f"{name} [{unit}]" if place in axes[0] else name for place, name in enumerate(table.names))
    return replace(
        table,
        names=names,
        body=table.body[row.end() :],
        first_line=table.first_line + row[0].count("\n"),
        seconds=seconds_by_name(names, units),
    )


def seconds_by_name(names: Sequence[str], units: Sequence[str]) -> tuple[tuple[str, float], ...]:
    """Returns the columns of which a row of units tells one of time, with the seconds of that.

    >>> seconds_by_name(["frame", "time", "x", "dwell"], ["-", "[ms]", "mm"])
    (('time', 0.001),)
    """
    found = ((name, seconds_in_brackets(" ".join(words_of(unit)))) for name, unit in zip(names, units))
    return tuple((name, seconds) for name, seconds in found if seconds)


def _with_row_names(table: TextTable, rows: list[tuple[int, str]]) -> TextTable:
    """Returns the table, its first column taken for the names of rows where the header has none for it, as R writes it, and
    pandas between blanks: they count the rows, or are quoted, unlike numbers behind them, and differ (those of a part of a
    table count in the whole).
    """
    if table.names and rows and len(table.cells(rows[0][1])) == len(table.names) + 1 and table.delimiter is None:
        some = [table.cells(row)[0] for _, row in table.first_rows(_LOOKED_AT)]  # 0 and 1 alone may be x of a grid
        if len(some) > 2 and some == [str(k) for k in range(len(some))]:
            return replace(table, names=("", *table.names))
    unnamed = [cells[0] for _, row in rows if len(cells := _trimmed(table.cells(row))) == len(table.names) + 1]
    quoted = all(row.startswith('"') and row.count('"') <= 2 * len(table.names) for _, row in rows)
    quoted = quoted and len(set(unnamed)) == len(rows)
    if not table.names or len(unnamed) != len(rows) or not (quoted or unnamed == ["1", "2"][: len(rows)]):
        return table
    return replace(table, names=("", *table.names))


def _with_counted_header(table: TextTable) -> TextTable:
    """Returns the table, its first row taken for names where that only counts the columns, as pandas writes ``0,1,2`` above
    columns without names, perhaps behind an empty cell above the index.
    """
    (number, first), *rows = table.first_rows(_LOOKED_AT) or [(0, "")]
    cells = table.cells(first)
    index = cells[:1] == [""]
    counted = cells[index:] == [str(k) for k in range(len(cells) - index)] and len(cells) - index >= len("xyz")
    if not counted or not any(re.search(r"[.,]\d|\de", cell) for _, row in rows for cell in table.cells(row)[index:]):
        return table
    names = ("", "x", "y", "z")[not index :] + tuple(cells[3 + index :])
    body = table.body.split("\n", number - table.first_line + 1)[-1]
    return replace(table, names=names, body=body, first_line=number + 1)


def _find_header(path: Path, head: list[tuple[int, str]], delimiter: str | None) -> tuple[int, list[str]]:
    """Returns the line where the rows begin, from 1, and the names of their columns, [] without."""
    for number, line in head[:_LOOKED_AT]:
        names = names_in(line, delimiter)
        if names and named_axes(path, names) is not None:
            return number + 1, names
    number, line = next((one for one in head if not one[1].startswith(COMMENTS)), head[0])
    if not all(
        re.fullmatch(_NUMBER, cell) or cell.lower() in _MISSING | {"inf", "-inf"} for cell in _rough_cells(line)
    ):
        words = names_in(line, delimiter) or line.split()
        raise DataError(
            f"{path}:{number}: columns {', '.join(words)[:80]}; expected x, y and z among them, or numbers only{_advice(words)}"
        )
    return number, []


def _advice(words: list[str]) -> str:
    """Returns what to do where columns tell angles instead of lengths, or several points, or lines are no rows; "" elsewhere."""
    known = {word.lower()[:3] for word in words}
    if words[0].endswith(":"):
        return "; of messages as `rostopic echo` prints them make a table (echo -p, or columns frame, x, y, z): a row for each point"
    if {"lat", "lon"} <= known:
        return "; project latitudes and longitudes to meters first"
    if len(find_trios(words)) > 1:
        return f"; a row holds one point: write a row for each of them, or, {ROWS_ARE_FRAMES}"
    angles = known & {"azi", "ele", "the", "phi", "ang"}
    return (
        "; compute x, y and z of the angles and distances first"
        if angles and known & {"ran", "dis", "r", "rho", "dep"}
        else ""
    )


def names_in(line: str, delimiter: str | None) -> list[str]:
    """Returns the cells of a line as names, without the sign of a comment."""
    line = re.sub(r"^(#|//|%)+\s*", "", line)
    sign = delimiter or next((d for d in "\t;,|" if d in line), None)
    if sign is None:
        return [cell.strip("\"'") for cell in line.split()]
    cells = next(csv.reader([line], delimiter=sign, skipinitialspace=True))
    return [cell.strip().strip("'\"").strip() for cell in _trimmed([cell.strip() for cell in cells])]


def _rough_cells(line: str) -> list[str]:
    return [cell for cell in re.split(r"[\s;,|\"']+", line) if cell]


def delimiter_of(line: str) -> str | None:
    """Returns what separates the cells of a row; None for blanks. Commas between blanks are decimal ones, but for those behind
    all cells but the last.
    """
    if sign := next((d for d in "\t;|" if d in line), None):
        return sign
    if "," not in line:
        return None
    *words, last = re.sub(r'(?<!\S)"[^"]*"(?!\S)', "0", line).split()  # the names of rows, and other texts
    decimal = len(words) >= 2 and all(re.fullmatch(_NUMBER, word) for word in (*words, last))
    return None if decimal and not all(word.endswith(",") for word in words) else ","


def _without_count(table: TextTable, number: int, text: str) -> TextTable:
    """Returns the table without a first row ``text``, in line ``number``, that counts the others. Raises DataError when it
    counts wrong.
    """
    body = table.body.split("\n", number - table.first_line + 1)[-1]
    rest = replace(table, body=body, first_line=number + 1)
    found = len(rest.numbered) if "\n" in table.body else 0
    if found != int(text):
        raise DataError(
            f"{table.path}: says {text} points in line {number}, holds {found}; truncated, or two clouds in one file"
        )
    return rest


def _checked_unnamed(table: TextTable) -> TextTable:
    """Returns the table. Raises DataError when its numbers seem cut by their own decimal commas."""
    rows = table.first_rows(_LOOKED_AT)
    if rows and table.delimiter == "," and not any('"' in line for _, line in rows):
        cells = [cell for _, line in rows for cell in table.cells(line)]
        whole = all(re.fullmatch(r"[-+]?\d+|", cell) for cell in cells)
        spaced = all(_SPACED_COMMAS.fullmatch(line) for _, line in rows)
        if whole and (spaced or any(re.fullmatch(r"-0|0\d+", cell) for cell in cells)):
            raise DataError(
                f"{table.path}:{rows[0][0]}: decimal commas between commas can't be told apart; save it with"
                " decimal points, or with semicolons between the columns"
            )
    return table
