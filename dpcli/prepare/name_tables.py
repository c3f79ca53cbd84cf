"""Tables of samples' names that people write: a line for each, with its label or split, in any spreadsheet's dialect."""

from __future__ import annotations

import csv
import io
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from dpcli.errors import DataError
from dpcli.path_names import first_names
from dpcli.prepare.reader import SPLITS
from dpcli.runtime.progress import log
from dpcli.text_files import decode_text

COLUMNS = ("name", "label", "subject", "split")
_CALLED = {"file": "name", "filename": "name", "path": "name", "video": "name", "sample": "name"} | {
    "class": "label",
    "category": "label",
    "person": "subject",
    "subset": "split",
}
_PERHAPS = {  # where no column is called as above; the first two only together
    "name": "clip sequence recording id file_name video_id video_name sample_id sample_name sequence_id sequence_name",
    "label": "action gesture activity target class_name label_name class_label",
    "subject": "actor user performer participant signer subject_id person_id user_id",
    "split": "set partition",
}
_SUFFIX = re.compile(r"\.[A-Za-z]\w{0,7}$")  # of files; 1.5 in a name is a number
_DIVIDER_TOLD = re.compile(r"\s*\"?sep=(.)\"?\s*\n")  # a first line for spreadsheets
_NOTHING = {"nan", "null", "n/a", "#n/a"}  # as programs write a cell without a value


def read_rows(path: Path, needed: str) -> dict[str, dict[str, str]]:
    """Returns the cells of each line by column, and ``line``, its number, by the sample's name. needed: the column that each
    must fill beside ``name``, such as label; without a header these are the two.

    Commas, semicolons or tabs divide; the text may be of any usual encoding; lines that begin with # are comments; further columns
    are passed over with a warning. Raises DataError that names file and line.
    """
    numbered = _read_lines(path, needed)
    header = ["name", needed]
    if numbered and (names := _header(numbered[0][1], needed)):
        header = names
        if needed not in header or len(set(header)) < len(header):
            number, found = numbered[0]
            others = ", ".join(column for column in COLUMNS if column not in ("name", needed))
            raise DataError(f"{path}:{number}: columns {','.join(found)}; expected name,{needed} and perhaps {others}")
        numbered.pop(0)
        if others := [name for name in header if name and name not in COLUMNS]:
            log.warn(f"{path}: columns not read: {', '.join(others)}")
    records: dict[str, dict[str, str]] = {}
    for number, row in numbered:
        if row[0].startswith("#") and sum(map(bool, row)) < len(header):  # a comment in between
            continue
        record = dict(zip(header, row, strict=False))
        row = row[: len(header)] if not any(row[len(header) :]) else row  # a line may end with the divider
        lacking = not record.get(needed) or record[needed].lower() in _NOTHING
        if len(row) != len(header) or not record["name"] or lacking:
            unknown = f" (leave the line out where the {needed} isn't known)" if record["name"] and lacking else ""
            raise DataError(f"{path}:{number}: {','.join(row)[:80]!r}; expected {','.join(header)}{unknown}")
        if record["name"] in records:
            raise DataError(f"{path}:{number}: {record['name']!r} appears twice")
        records[record["name"]] = record | {"line": str(number)}
    if not records:
        raise DataError(f"{path}: no rows; expected {','.join(header)}")
    return records


def _read_lines(path: Path, needed: str) -> list[tuple[int, list[str]]]:
    """Returns the lines of a table that hold something, without comments above the header, with their numbers."""
    try:
        text = decode_text(path).lstrip("\ufeff")
        if told := _DIVIDER_TOLD.match(text):
            text = "\n" + text[told.end() :]  # lines keep their numbers
        first = next((line for line in text.split("\n") if line.strip() and line[0] != "#"), "")
        divider = told[1] if told else next((mark for mark in ",;\t" if mark in first), ",")
        rows = csv.reader(io.StringIO(text), delimiter=divider)  # `splitlines` would end lines at other signs, too
        lines = [(rows.line_num, [cell.strip() for cell in row]) for row in rows]
    except DataError as error:
        raise DataError(
            str(error).replace("expected numbers in columns", f"expected a CSV table of name,{needed}")
        ) from None
    except FileNotFoundError:
        raise DataError(f"{path}: no such file; expected a CSV table of name,{needed}") from None
    except OSError as error:
        raise DataError(
            f"{path}: can't be read ({(error.strerror or str(error)).lower()}); expected a CSV table"
        ) from None
    except csv.Error as error:
        raise DataError(f"{path}: cannot be read as a CSV table ({error})") from None
    numbered = [(number, row) for number, row in lines if any(row)]
    while numbered and numbered[0][1][0].startswith("#"):
        numbered.pop(0)
    return numbered


def _header(row: list[str], needed: str) -> list[str]:
    """Returns the columns that a first line names, those we know as we call them; [] when it is no header."""
    names = [_CALLED.get(cell.lower(), cell.lower()) for cell in row]
    while names and not names[-1]:
        names.pop()
    guessed = list(names)
    for field, words in _PERHAPS.items():
        places = [place for place, name in enumerate(names) if name in words.split()]
        if field not in names and len(places) == 1:
            guessed[places[0]] = field
    if "name" in guessed and needed in guessed:
        return guessed
    return names if "name" in names else []


def warn_of_splits(path: Path, splits: Iterable[str]) -> None:
    """Warns of splits that no command takes for training, validation or test, such as misspelled ones."""
    if strange := sorted({*splits} - {*SPLITS, ""}):
        log.warn(f"{path}: splits that are none of {', '.join(SPLITS)} stay as they are: {first_names(strange)}")


def places_of(path: Path, written: Iterable[str], names: Iterable[str]) -> dict[str, str]:
    """Returns the sample that each name in a table means, of those in ``names``. It may lack the suffix of the sample's, or have one
    more, and be spelled with other letters for the same (\\ for /, composed or not).

    Raises DataError when it means none, or two mean one.
    """
    known = list(names)
    found = _told_apart(known)
    places = {one: found.get(_plain(one)) or found.get(_stem(one)) for one in written}
    strangers = sorted(one for one, name in places.items() if not name)
    if strangers:
        listed, verb = first_names([repr(one) for one in strangers], 3), "is" if len(strangers) == 1 else "are"
        raise DataError(
            f"{path}: names {listed}, which {verb} not among the samples ({', '.join(known[:3])}, ...); spell"
            f" {'it' if verb == 'is' else 'them'} as these, or take {'its line' if verb == 'is' else 'their lines'} out"
        )
    twice = [name for name, count in Counter(places.values()).items() if count > 1]
    if twice:
        raise DataError(f"{path}: names {twice[0]!r} twice, with and without its suffix")
    return {one: name for one, name in places.items() if name}


def _plain(name: str) -> str:
    return unicodedata.normalize("NFC", name.replace("\\", "/").removeprefix("./").rstrip("/"))  # macOS splits letters


def _stem(name: str) -> str:
    return _SUFFIX.sub("", _plain(name))


def _told_apart(names: Iterable[str]) -> dict[str, str]:
    """Returns the names of samples by themselves, and by what they are without a suffix where that is one sample's."""
    names = list(names)
    stems = Counter(map(_stem, names))
    return {_stem(name): name for name in names if stems[_stem(name)] == 1} | {_plain(name): name for name in names}
