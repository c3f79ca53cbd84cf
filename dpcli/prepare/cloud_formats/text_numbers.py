"""Texts of numbers in columns, whoever wrote them: decimal commas, quotes, UTF-16, headers, comments, counts."""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.cloud import named_axes

_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_COMMENT = ("#", "//", "%")
_MISSING = frozenset(("", "nan", "-nan", "+nan", "na", "n/a", "null", "none", "nil", "-", "nan(ind)", "-nan(ind)"))
_NUMBER = r"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?"
_GROUPED = re.compile(r"[-+]?\d{1,3}([.,' \u00a0\u202f])\d{3}(\1\d{3})*([.,]\d+)?")
_LOOKED_AT = 30  # lines before the numbers, and rows that tell what the columns hold


@dataclass(frozen=True)
class TextTable:
    """Holds the rows of a text, not yet taken for numbers. names: of the columns, none where the file names none.

    lines: the rows; numbers: which line of the file each is, from 1. delimiter: None for blanks.
    """

    path: Path
    names: tuple[str, ...]
    lines: list[str]
    line_numbers: list[int]
    delimiter: str | None

    @cached_property
    def width(self) -> int:
        """Returns the number of columns."""
        return len(self.names) or len(_trimmed(self.cells(self.lines[0])))

    def cells(self, line: str) -> list[str]:
        """Returns the cells of a row, without quotes and blanks around them."""
        if self.delimiter is None:
            return [cell.strip('"') for cell in line.split()]
        if '"' in line or "'" in line:
            quote = '"' if '"' in line else "'"
            return [cell.strip() for cell in next(csv.reader([line], delimiter=self.delimiter, quotechar=quote))]
        return [cell.strip() for cell in line.split(self.delimiter)]

    def columns(self, places: Sequence[int]) -> np.ndarray:
        """Returns some columns as numbers f64 (N,k), NaN where a cell is empty. Raises DataError that names the line."""
        if not self.lines:
            return np.zeros((0, len(places)))
        fast = self._read_fast(list(places))
        return self._read_any(list(places)) if fast is None else fast

    def words(self, place: int) -> list[str]:
        """Returns the cells of a column as they are written."""
        return [self._row(line, number)[place] for line, number in zip(self.lines, self.line_numbers)]

    def _read_fast(self, places: list[int]) -> np.ndarray | None:
        """Returns what NumPy reads; None where the text is none that it reads right."""
        body = "\n".join(self.lines)
        if '"' in body or "'" in body or (self.delimiter != "," and "," in body and "." in body):
            return None
        if self.delimiter not in (None, ","):
            widths = {line.count(self.delimiter) + 1 for line in self.lines}
        elif self.delimiter == ",":
            widths = {line.count(",") + 1 for line in self.lines}
        else:
            widths = {self.width} if len(places) == self.width else {len(line.split()) for line in self.lines}
        if widths != {self.width}:
            return None
        lines = self.lines if self.delimiter == "," or "," not in body else body.replace(",", ".").split("\n")
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
        rows = [self._row(line, number) for line, number in zip(self.lines, self.line_numbers)]
        decimal = self._decimal(rows, places)
        values = np.empty((len(rows), len(places)))
        for k, (row, number) in enumerate(zip(rows, self.line_numbers)):
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
            return "."
        both = [cell for cell in commas if "." in cell]
        signs = {max(".,", key=cell.rfind) for cell in both}
        if not both:
            points = any("." in row[place] for row in rows for place in places)
            grouped = all(_GROUPED.fullmatch(cell) for cell in commas)
            signs = {"."} if points and grouped else {","} if not points else set()
        if len(signs) != 1:
            raise DataError(f"{self.path}: numbers such as {commas[0]} beside others with a point; expected one style")
        return signs.pop()


def _trimmed(cells: list[str], width: int = 0) -> list[str]:
    """Returns the cells without empty ones at the end, which trailing separators make."""
    end = len(cells)
    while end > width and not cells[end - 1]:
        end -= 1
    return cells[:end]


def _number(cell: str, decimal: str) -> float | None:
    """Returns the number in a cell, NaN of an empty one, None of other words."""
    if cell.lower() in _MISSING:
        return float("nan")
    grouped = _GROUPED.fullmatch(cell)
    if grouped and grouped[1] != decimal:
        cell = cell.replace(grouped[1], "")
    if decimal == ",":
        cell = cell.replace(",", ".")
    try:
        return float(cell)
    except ValueError:
        return None


def read_text_table(path: Path) -> TextTable:
    """Reads the rows of a text and what its header says. Raises DataError when it is no table of numbers."""
    numbered = [(k, line.strip("\r\n \x00")) for k, line in enumerate(decode_text(path).split("\n"), 1)]
    numbered = [(k, line) for k, line in numbered if line.strip()]
    if not numbered:
        raise DataError(f"{path}: no rows; expected numbers in columns")
    delimiter = None
    if re.fullmatch(r"sep=.", numbered[0][1], re.IGNORECASE):  # as Excel tells itself
        delimiter = numbered.pop(0)[1][-1]
    if "\t" in "".join(line for _, line in numbered[:2]):
        numbered = [(k, line) for k, line in numbered]
    header, names = _find_header(path, numbered, delimiter)
    rows = [(k, line) for k, line in numbered[header:] if not line.startswith(_COMMENT)]
    rows = _without_count(path, rows)
    if not rows:
        raise DataError(f"{path}: a header, but no rows; expected numbers in columns")
    delimiter = delimiter or _delimiter(rows[0][1])
    table = TextTable(path, tuple(names), [line for _, line in rows], [k for k, _ in rows], delimiter)
    return table if names else _checked_unnamed(table)


def decode_text(path: Path) -> str:
    """Returns the text of a file in UTF-8, or in UTF-16 or 32 by its mark or its zeros; else byte by byte (Latin-1)."""
    data = path.read_bytes()
    encoding = next((name for mark, name in _MARKS if data.startswith(mark)), "")
    if not encoding and b"\0" in data[:200]:
        zeros = [data[:200][k::2].count(0) for k in (0, 1)]
        if min(zeros) > 5 or max(zeros) < len(data[:200]) // 4:
            raise DataError(f"{path}: not text; expected numbers in columns")
        encoding = "utf-16-be" if zeros[0] > zeros[1] else "utf-16-le"
    try:
        return data.decode(encoding or "utf-8").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        if encoding:
            raise DataError(f"{path}: not readable as {encoding}, perhaps truncated; save it as UTF-8") from None
        return data.decode("latin-1").replace("\r\n", "\n").replace("\r", "\n")


def _find_header(path: Path, numbered: list[tuple[int, str]], delimiter: str | None) -> tuple[int, list[str]]:
    """Returns where the rows begin, and the names of their columns, [] without."""
    for place, (_, line) in enumerate(numbered[:_LOOKED_AT]):
        names = _names(line, delimiter)
        if names and named_axes(path, names) is not None:
            return place + 1, names
    place, (number, line) = next(
        ((place, one) for place, one in enumerate(numbered) if not one[1].startswith(_COMMENT)), (0, numbered[0])
    )
    if not all(
        re.fullmatch(_NUMBER, cell) or cell.lower() in _MISSING | {"inf", "-inf"} for cell in _rough_cells(line)
    ):
        words = ", ".join(_names(line, delimiter) or line.split())[:80]
        raise DataError(f"{path}:{number}: columns {words}; expected x, y and z among them, or numbers only")
    return place, []


def _names(line: str, delimiter: str | None) -> list[str]:
    """Returns the cells of a line as names, without the sign of a comment."""
    line = re.sub(r"^(#|//|%)+\s*", "", line)
    sign = delimiter or next((d for d in "\t;,|" if d in line), None)
    if sign is None:
        return [cell.strip("\"'") for cell in line.split()]
    cells = next(csv.reader([line], delimiter=sign, skipinitialspace=True))
    return [cell.strip().strip("'\"").strip() for cell in _trimmed([cell.strip() for cell in cells])]


def _rough_cells(line: str) -> list[str]:
    return [cell for cell in re.split(r"[\s;,|\"']+", line) if cell]


def _delimiter(line: str) -> str | None:
    """Returns what separates the cells of a row; None for blanks. Commas between blanks are decimal ones."""
    if sign := next((d for d in "\t;|" if d in line), None):
        return sign
    if "," not in line:
        return None
    words = line.split()
    decimal = len(words) >= 3 and all(re.fullmatch(_NUMBER, word) for word in words)
    return None if decimal else ","


def _without_count(path: Path, rows: list[tuple[int, str]]) -> list[tuple[int, str]]:
    """Returns the rows without a first one that counts them. Raises DataError when it counts others."""
    if len(rows) < 1 or not re.fullmatch(r"\d+", rows[0][1]) or (len(rows) > 1 and len(_rough_cells(rows[1][1])) < 3):
        return rows
    count, rest = int(rows[0][1]), rows[1:]
    if len(rest) != count:
        raise DataError(
            f"{path}: says {count} points in line {rows[0][0]}, holds {len(rest)}; truncated, or two clouds"
        )
    return rest


def _checked_unnamed(table: TextTable) -> TextTable:
    """Returns the table. Raises DataError when its numbers seem cut by their own decimal commas."""
    if table.delimiter == "," and not any('"' in line for line in table.lines[:_LOOKED_AT]):
        cells = [cell for line in table.lines[:_LOOKED_AT] for cell in table.cells(line)]
        whole = all(re.fullmatch(r"[-+]?\d+|", cell) for cell in cells)
        if whole and any(re.fullmatch(r"-0|0\d+", cell) for cell in cells):
            raise DataError(
                f"{table.path}:{table.line_numbers[0]}: decimal commas between commas can't be told apart; save it with"
                " decimal points, or with semicolons between the columns"
            )
    return table
