"""Clouds in texts: columns with names, or x y z first; and the vertices of meshes in texts."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.cloud import (
    MOST_UNNAMED,
    Cloud,
    cloud_of_columns,
    counts_rows,
    named_axes,
    refuse_frames,
    refuse_times,
    require_columns,
    require_names,
    unnamed_columns,
    unread_columns,
    without,
)
from dpcli.prepare.cloud_formats.column_names import Table, find_colors, find_frame_column
from dpcli.prepare.cloud_formats.text_numbers import COMMENTS, TextTable, read_text_table
from dpcli.text_files import decode_text

_MARK = re.compile(
    r"\b(frame|scan|sweep|step|cloud|time|time_?stamp|t)\b[\s_.:=#]*(id|no|number|index)?[\s:=#]*\d", re.IGNORECASE
)
EMPTY = "rows with nothing between their delimiters dropped"
BLOCKS = "texts whose rows stand in blocks between empty lines, each read as one cloud"
COUNTED = (
    "texts whose column {0!r} counts up, as numbers of frames do; if each text is a recording, give --frame-column {0}"
)
UNCOLORED = "colors of vertices left out, since other vertices of the same file have none"
_COLORED = (6, 7)  # numbers of a vertex in an OBJ: x y z red green blue, and alpha
_TELLING = 10  # rows that tell what columns without names hold
_COUNTING = 256  # rows in which a column counts frames: scans sorted by ring have more points in each
_IMPLIED = {  # (suffix, columns) -> what they hold, in formats without a header
    (".pts", 4): "x y z intensity",
    (".pts", 6): "x y z red green blue",
    (".pts", 7): "x y z intensity red green blue",
    (".xyzrgb", 6): "x y z red green blue",
    (".xyzn", 6): "x y z nx ny nz",
    (".xyzi", 4): "x y z intensity",
}


def read_text(path: Path, keep: Sequence[str] = ()) -> Cloud:
    """Reads one cloud from a text. Raises DataError when it holds several frames, or is no table of numbers."""
    table = read_text_table(path, may_be_empty=True)
    if not table.first_rows(1):  # a count of 0, or names alone
        return _counted(cloud_of_columns(path, {name: np.empty(0) for name in table.names or "xyz"}, keep), table)
    if not table.names:
        names = _IMPLIED.get((path.suffix.lower(), table.width), "")
        table = replace(table, names=tuple(names.split()))
    refuse_frames_of_table(table)
    _refuse_marked_frames(table)
    cloud = cloud_of_table(table, keep)
    counting = _counting_column(table, cloud.unread)
    cloud = replace(cloud, dropped=cloud.dropped | {COUNTED.format(counting): 1}) if counting else cloud
    return _counted(cloud, table)


def read_vertices(path: Path, keep: Sequence[str] = ()) -> Cloud:
    """Returns the vertices of an OBJ or OFF file as a cloud, in the order in which they stand there, whatever its faces do with
    them; with the colors that stand behind the places in an OBJ. Raises DataError where they can't be read.
    """
    if keep:
        raise DataError(f"{path}: --keep-fields {keep[0]}: the numbers of its vertices have no names")
    lines = (line.partition("#")[0].split() for line in decode_text(path).split("\n"))
    found = [words for words in lines if words]
    is_obj = path.suffix.lower() == ".obj"
    rows = [words[1:] for words in found if words[0] == "v"] if is_obj else _rows_of_off(path, found)
    if is_obj and not rows:
        raise DataError(f"{path}: no vertices (lines such as v 0.1 0.2 0.3)")
    colors = sum(len(row) in _COLORED for row in rows) if is_obj else 0
    places = sum(len(row) == len("xyz") for row in rows)
    cut = places == 1 and len(rows[-1]) == len("xyz") and found[-1][0] == "v"
    mixed = 0 < colors < len(rows) == colors + places and not cut  # of several objects, as Blender writes them
    rows = [row[: len("xyz")] for row in rows] if mixed else rows
    try:
        values = np.array(rows, np.float64).reshape(len(rows), len(rows[0]) if rows else len("xyz"))
    except ValueError:
        raise DataError(
            f"{path}: its vertices are no rows of as many numbers each; truncated, or with decimal commas?"
        ) from None
    require_columns(path, *values.shape)
    colored = is_obj and values.shape[1] in _COLORED
    unread = unnamed_columns(7 if colored else 4, values.shape[1])
    lost = {UNCOLORED: colors} if mixed else {}
    return Cloud(values[:, :3], values[:, 3:6] if colored else None, unread=unread, dropped=lost)


def _rows_of_off(path: Path, found: list[list[str]]) -> list[list[str]]:
    """Returns the words of the vertices' rows of an OFF file. Raises DataError where it holds other counts than it says."""
    first, *rows = found or [[""]]
    counts, rows = (first[1:], rows) if len(first) > 1 else (rows[0] if rows else [], rows[1:])
    if not re.fullmatch(r"(ST)?(C?N?|NC)OFF", first[0]) or len(counts) < 2 or not all(map(str.isdecimal, counts[:2])):
        raise DataError(f"{path}: no OFF file in text; expected OFF, the numbers of vertices and faces, and their rows")
    vertices, faces = map(int, counts[:2])
    if len(rows) != vertices + faces:
        raise DataError(
            f"{path}: truncated or damaged: its header counts {vertices + faces} vertices and faces, it holds {len(rows)};"
            " copy it again"
        )
    return rows[:vertices]


def _counted(cloud: Cloud, table: TextTable) -> Cloud:
    """Returns the cloud of a table with what lies between its points."""
    if table.body.rstrip("\n").count("\n") < len(cloud.points):  # no more lines: looking at them takes longer
        return cloud
    told = {BLOCKS: int("\n\n\n" in table.body.rstrip()), EMPTY: table.empty_rows}
    return replace(cloud, dropped=cloud.dropped | {what: count for what, count in told.items() if count})


def cloud_of_table(table: TextTable, keep: Sequence[str] = ()) -> Cloud:
    """Returns the points of all rows of a table, with colors where it has them."""
    if not table.names:
        if keep:
            raise DataError(f"{table.path}: column {keep[0]}: its columns have no names")
        if not 3 <= table.width <= MOST_UNNAMED:
            require_columns(table.path, len(table.numbered), table.width)
        values = table.columns(range(table.width))  # all of them: a word in any is an error in the file
        refuse_times(table.path, values)
        first = _first_axis(table, values)
        unread = unread_columns(first, table.width)
        return Cloud(values[:, first : first + 3], unit=table.unit, unread=unread, dropped=table.cut)
    axes = named_axes(table.path, table.names)
    if axes is None:
        raise DataError(f"{table.path}: columns {', '.join(table.names)[:80]}; expected x, y and z among them")
    require_names(table.path, table.names, keep)
    places = list(dict.fromkeys([*axes[0], *find_colors(table.names), *map(table.names.index, keep)]))
    values = table.columns(places)
    cloud = cloud_of_columns(table.path, {table.names[p]: values[:, k] for k, p in enumerate(places)}, keep)
    unread = without([name for name in table.names if name], cloud.columns, keep)
    return replace(cloud, unread=unread, unit=cloud.unit or table.unit, dropped=table.cut)


def _first_axis(table: TextTable, values: np.ndarray) -> int:
    """Returns which column without a name is x: 0, or 1 behind one that counts the rows.

    Raises DataError where whole numbers lie before three columns of fractions, such as the row and column of a scanner's
    ray: which three are x, y and z?
    """
    rows = [table.cells(line) for _, line in table.first_rows(_TELLING)]
    fractions = [any(not cell.lstrip("-+").isdecimal() for cell in column) for column in zip(*rows)]
    whole = fractions.index(True) if True in fractions else len(fractions)
    if not 0 < whole <= table.width - 3 or not all(fractions[whole : whole + 3]):
        return 0
    ids = values[:, :whole]
    if (ids < 0).any() or (ids != np.floor(ids)).any():
        return 0
    if whole == 1 and counts_rows(ids[:, 0]):
        return 1
    if len(ids) < (_TELLING if whole == 1 else 3):
        return 0
    raise DataError(
        f"{table.path}: its first {f'{whole} columns hold' if whole > 1 else 'column holds'} whole numbers, the three behind"
        " fractions; which are x, y and z? Write a line of names above, such as: row column x y z intensity"
    )


def _refuse_marked_frames(table: TextTable) -> None:
    """Raises DataError where comments between the rows number frames, which one cloud would mix up."""
    if not any(sign[0] in table.body for sign in COMMENTS):  # a single letter is found far faster
        return
    rows = table.body.rstrip().split("\n")
    marks = [row.strip() for row in rows[:-1] if row.lstrip().startswith(COMMENTS) and _MARK.search(row)]
    if marks:
        raise DataError(
            f"{table.path}: comments such as {marks[0]!r:.60} divide its rows into frames; save each as its own file, or"
            " write the number into a column called frame"
        )


def _counting_column(table: TextTable, unread: Sequence[str]) -> str:
    """Returns the first column of those that were not read whose whole numbers go up one by one, some for several rows: it may
    number frames in a word that isn't known. "" without one.
    """
    rows = [table.cells(line) for _, line in table.first_rows(_COUNTING)] if table.names else []
    for name in unread if len(rows) > 2 else ():
        cells = [row[table.names.index(name)].removesuffix(".0") for row in rows if len(row) == table.width]
        if not all(cell.isascii() and cell.isdecimal() for cell in cells):
            continue
        steps = np.diff(np.array(cells, np.float64))
        ones = np.count_nonzero(steps == 1)
        if (steps >= 0).all() and ones > 1 and 2 * ones > np.count_nonzero(steps) and (steps == 0).any():
            return name
    return ""


def refuse_frames_of_table(table: Table) -> None:
    """Raises DataError when a column numbers several frames; one of words, such as the names of pictures, doesn't."""
    if name := find_frame_column(table.names):
        try:
            values = table.columns([table.names.index(name)])
        except DataError:
            return
        refuse_frames(table.path, name, values)
