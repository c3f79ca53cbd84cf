"""`dpc prepare NAME --check RAW`: what a data set's folder lacks, told before hours are spent.

What a recipe (data_recipes/NAME.toml) may say of the raw files, one table per kind of file, all of it optional:

    [[raw]]
    path = "sequences/{00..10}/velodyne/*.bin"   # below RAW; * and ? in a name, ** any depth, {00..10} or {a,b}: each
                                                 # of them must be there. A list of paths: one of them suffices.
    what = "scans of the sequences 00-10"        # in words, for the message
    count = 567                                  # so many files in all of path together; [low, high]: at least, at most
    each = [4541, 1101, ...]                     # files of each of the {...}, in their order; one number: of every one
    bytes = 307212                               # size of every file; [low, high]; default: not empty
    optional = true                              # missing is told, but is no error
    instead_of = "other what"                    # one of the two rows suffices (zips instead of folders)

Without count and each, at least one file per path. Everything else in a recipe is for people.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.prepare.decode.folder_listing import walk_folders
from dpcli.prepare.reader import require_folder
from dpcli.prepare.series import is_hidden
from dpcli.runtime.progress import log
from dpcli.text_files import read_toml

RECIPES = Path(__file__).resolve().parents[1] / "data_recipes"  # a link to the top folder; in a package a copy
_KEYS = {"path", "what", "count", "each", "bytes", "optional", "instead_of"}
_OWN = ("clouds", "depth")  # commands for a user's own files
_MADE = ("gestures", "articulated", "streets")
_SHOWN = 10


@dataclass(frozen=True)
class Row:
    """Holds one `[[raw]]` table of a recipe."""

    paths: tuple[str, ...]
    what: str
    count: tuple[float, float] | None
    each: tuple[int, ...] | None
    bytes: tuple[float, float]
    optional: bool
    instead_of: str


def read_recipe(name: str) -> tuple[dict[str, Any], list[Row]]:
    """Reads a recipe and its rows.

    Raises DataError when there is none, or when it says something that is not understood.
    """
    path = RECIPES / f"{name}.toml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in RECIPES.glob("*.toml")))
        raise DataError(f"there is no recipe for {name}; there are {known}")
    recipe = read_toml(path)
    return recipe, [_row(table, path) for table in recipe.get("raw", [])]


def _row(table: dict[str, Any], path: Path) -> Row:
    unknown = table.keys() - _KEYS
    if unknown or "path" not in table:
        raise DataError(
            f"{path}: a [[raw]] table has {sorted(unknown) or 'no path'}; expected {', '.join(sorted(_KEYS))}"
        )
    paths = tuple(table["path"]) if isinstance(table["path"], list) else (table["path"],)
    each = table.get("each")
    if each is not None:
        wanted = len(expand_braces(paths[0]))
        each = tuple(each) if isinstance(each, list) else (each,) * wanted
        if len(each) != wanted:
            raise DataError(f"{path}: each has {len(each)} numbers, but {paths[0]} names {wanted} paths")
    count = _bounds(table["count"]) if "count" in table else None
    size = _bounds(table["bytes"]) if "bytes" in table else (1, float("inf"))
    optional, instead_of = bool(table.get("optional", False)), table.get("instead_of", "")
    return Row(paths, table.get("what", paths[0]), count, each, size, optional, instead_of)


def _bounds(value: int | list[int]) -> tuple[float, float]:
    return (value[0], value[1]) if isinstance(value, list) else (value, value)


def expand_braces(pattern: str) -> list[str]:
    """Returns `a{00..02}/{x,y}` as a00/x, a00/y, a01/x, ...; without braces the pattern itself.

    >>> expand_braces("s{08..10}/{a,b}")
    ['s08/a', 's08/b', 's09/a', 's09/b', 's10/a', 's10/b']
    """
    match = re.search(r"\{([^{}]*)\}", pattern)
    if not match:
        return [pattern]
    numbers = re.fullmatch(r"(\d+)\.\.(\d+)", match[1])
    if numbers:
        width = len(numbers[1])
        words = [f"{n:0{width}}" for n in range(int(numbers[1]), int(numbers[2]) + 1)]
    else:
        words = match[1].split(",")
    return [one for word in words for one in expand_braces(pattern[: match.start()] + word + pattern[match.end() :])]


class Tree:
    """Lists the files below a folder (or one file) once: path -> size, -1 for links to nowhere."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @cached_property
    def files(self) -> dict[str, int]:
        """Returns the size of every file by its path."""
        if self.folder.is_file():
            return {self.folder.name: self.folder.stat().st_size}
        return dict(_sizes_below(self.folder))

    def find(self, pattern: str) -> list[str]:
        """Returns files that fit a pattern: * and ? within a name, ** over folders (none, too)."""
        if not any(sign in pattern for sign in "*?"):
            return [pattern] if pattern in self.files else []
        fits = re.compile(_pattern_to_regex(pattern)).fullmatch
        return sorted(name for name in self.files if fits(name))


def _sizes_below(root: Path) -> Iterator[tuple[str, int]]:
    """Yields path and size of every file below a folder that isn't hidden, -1 of links to nowhere."""
    for folder, _, names in walk_folders(root):
        above = "" if folder == str(root) else f"{os.path.relpath(folder, root)}/"
        for name in (name for name in names if not is_hidden(name)):
            try:
                yield above + name, os.stat(os.path.join(folder, name)).st_size
            except OSError:
                yield above + name, -1


def _pattern_to_regex(pattern: str) -> str:
    pieces = []
    for piece in pattern.split("/"):
        if piece == "**":
            pieces.append("(?:[^/]+/)*")
        else:
            signs = {"*": "[^/]*", "?": "[^/]"}
            pieces.append("".join(signs.get(sign, re.escape(sign)) for sign in piece) + "/")
    return "".join(pieces).removesuffix("/")


def check_row(row: Row, tree: Tree) -> tuple[list[str], str, int]:
    """Returns (what is missing or wrong, what was found, how many files) of one row; of several paths the best of those
    there.
    """
    return min((_check_path(row, pattern, tree) for pattern in row.paths), key=lambda one: (one[2] == 0, len(one[0])))


def _check_path(row: Row, pattern: str, tree: Tree) -> tuple[list[str], str, int]:
    faults, total, wrong = [], 0, []
    paths = expand_braces(pattern)
    for number, path in enumerate(paths):
        names = tree.find(path)
        total += len(names)
        wrong += [name for name in names if not row.bytes[0] <= tree.files[name] <= row.bytes[1]]
        if row.each is not None and len(names) != row.each[number]:
            faults.append(f"{path}: {len(names)} files, expected {row.each[number]}")
        elif not names and row.count is None:
            faults.append(f"{path}: missing")
    if row.count is not None and not row.count[0] <= total <= row.count[1]:
        faults.append(f"{pattern}: {total} files, expected {_bounds_in_words(row.count)}")
    for name in wrong:
        size = "a link to nowhere" if tree.files[name] < 0 else f"{tree.files[name]} bytes"
        faults.append(f"{name}: {size}, expected {_bounds_in_words(row.bytes)} bytes")
    return faults, f"{total} files {pattern}", total


def _bounds_in_words(span: tuple[float, float]) -> str:
    low, high = span
    if low == high:
        return f"{low:.0f}"
    return f"at least {low:.0f}" if high == float("inf") else f"{low:.0f} to {high:.0f}"


def check_rows(rows: list[Row], tree: Tree) -> tuple[list[str], list[str]]:
    """Returns (lines for the user, faults that are errors) of all rows."""
    results = {row.what: (row, *check_row(row, tree)) for row in rows}
    replaced = {_name_of_less_useful(results[row.instead_of], results[row.what]) for row in rows if row.instead_of}
    lines, errors = [], []
    for what, (row, faults, found, _) in results.items():
        if not faults:
            lines.append(f"ok       {what}: {found}")
            continue
        if what in replaced:
            continue
        lines.append(f"{'optional' if row.optional else 'MISSING '} {what}:")
        lines += [f"           {fault}" for fault in faults[:_SHOWN]]
        if len(faults) > _SHOWN:
            lines.append(f"           ... and {len(faults) - _SHOWN} more")
        errors += [] if row.optional else faults
    return lines, errors


def _name_of_less_useful(one: tuple[Row, list[str], str, int], other: tuple[Row, list[str], str, int]) -> str:
    """Returns the which of two rows need not be told, as the other suffices or is nearer to what is there."""
    return max(other, one, key=lambda it: (bool(it[1]), it[3] == 0, len(it[1])))[0].what


def check_folder(name: str, raw: Path | None, make_reader: Callable[[], Any], *, file: bool = False) -> Iterator[str]:
    """Yields lines that say what of recipe `name` is in `raw` and what is not, then what the reader's own index finds.

    make_reader: anything with the `items` and `summary` of a Reader. file: `raw` may be a single file. People's own files
    have no recipe; the index alone tells what of them can be read.

    DataError, after the last line, when something is missing. Raises DataError at once when there is no recipe or no
    folder.
    """
    if raw is None and name in _MADE:
        raise DataError(f"--check: prepare synthetic {name} reads no files, so none can be missing")
    recipe, rows = ({"title": "your own files"}, []) if name in _OWN else read_recipe(name)
    if raw is None:
        raise DataError(
            f"--check: name the folder of {recipe.get('title', name)}, as dpc prepare {name} FOLDER --check"
        )
    if name not in _OWN and not (file and raw.is_file()):
        require_folder(raw, f"what data_recipes/{name}.toml shows")
    yield f"{recipe.get('title', name)}, {raw}"
    lines, errors = check_rows(rows, Tree(raw))
    yield from lines
    try:
        yield from _index_lines(make_reader(), errors)
    except DataError as error:
        yield f"MISSING  {error}"
        errors.append(str(error))
    if errors:
        where = recipe.get("get", {}).get("ask", "")
        raise DataError(
            f"{raw}: {counted(len(errors), 'thing')} missing or wrong{'; where to get it: ' + where if where else ''}"
        )


def _index_lines(reader: Any, errors: list[str]) -> Iterator[str]:
    """Yields what the index finds without opening data: list lines without a file, strange names, labels out of range,
    links to nowhere.
    """
    from dpcli.prepare.pipeline import all_items

    items, unread = all_items(reader)
    bad = [item for item in items if item.problem]
    for line in reader.summary(items):
        log.info(line)
    good, bad = len(items) - len(bad), bad + unread
    yield f"{'MISSING ' if bad else 'ok      '} index: {counted(good, 'sample')} to convert, {len(bad)} that cannot be"
    for item in bad[:_SHOWN]:
        yield f"           {item.name}: {item.problem}"
    if len(bad) > _SHOWN:
        yield f"           ... and {len(bad) - _SHOWN} more"
    errors.extend(item.problem for item in bad)
