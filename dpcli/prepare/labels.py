"""Labels of samples that don't tell them: from a CSV table, with subject and split, or from the folders they lie in."""

from __future__ import annotations

import re
import unicodedata
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from dpcli.errors import DataError
from dpcli.path_names import first_names
from dpcli.prepare.name_tables import places_of, read_rows, warn_of_splits
from dpcli.prepare.reader import Item, split_called
from dpcli.runtime.progress import log

_WHOLE = re.compile(r"^(-?\d+)[.,]0+$")  # as programs write a column of numbers that has a gap
_NUMBERED = re.compile(r"([^\W\d]+[ _.-]?)(\d{1,9})")  # such as s01
_BETWEEN = re.compile(r"[\s_-]+")
_UNKNOWN = {"nan", "null", "n/a", "#n/a", "none", "unknown", "?", "-"}  # who is seen
_MOST_PEOPLE = 10**9  # numbers that names lead to: two of a hundred people share one in 1 of 200,000 tables


@dataclass(frozen=True)
class Row:
    """Holds what one line says about one sample; ``label`` indexes the table's class names."""

    label: int
    subject: int
    split: str


@dataclass(frozen=True)
class LabelTable:
    """Holds rows by sample name, and the class names that their labels index; without rows it says nothing."""

    path: Path = Path()
    rows: dict[str, Row] = field(default_factory=dict)
    class_names: list[str] = field(default_factory=list)

    def apply(self, items: list[Item]) -> list[Item]:
        """Returns items with the table's fields; one it doesn't name keeps label -1.

        Names may lack the suffix of a sample's, or have one more. Raises DataError when it names a stranger.
        """
        places = places_of(self.path, self.rows, [item.name for item in items])
        own = {places[written]: row for written, row in self.rows.items()}
        rows = ((item, own.get(item.name)) for item in items)
        return [replace(i, label=r.label, subject=r.subject, split=r.split) if r else i for i, r in rows]

    def unnamed(self, items: list[Item]) -> list[str]:
        """Returns a line for the log about the samples that the table doesn't name; none when it names all."""
        names = [item.name for item in items if item.label < 0 and not item.problem] if self.rows else []
        return [f"{len(names)} without a label in {self.path}: {first_names(names)}"] if names else []


def read_labels(path: Path) -> LabelTable:
    """Reads columns ``name,label[,subject][,split]`` with a header line, or the first two without one, as `read_rows` does.

    Labels are whole numbers from 0, or words; words are numbered in alphabetical order. DataError names file and line.
    """
    return _number_labels(path, read_rows(path, "label"))


def labels_of_folders(root: Path, names: Sequence[str], layout: str) -> LabelTable:
    """Takes each name's first folder for its class; where all begin with train, val(idation) or test, that is the split
    and the next one the class, and where these come second in all, they are the splits. Classes are numbered in
    alphabetical order.

    names: relative to `root`, parts with `/`. layout: what a name holds at least, such as `CLASS/VIDEO`. Raises
    DataError when one holds less, or when most lie in folders of splits and some do not: those splits would silently
    become classes.
    """
    least = len(layout.split("/"))
    parts = {name: _one_text(name).split("/") for name in names}
    short = [name for name, own in parts.items() if len(own) < least]
    if short:
        raise DataError(
            f"{root}: {short[0]!r} is in no folder of its class; --label-from-folder expects {layout}, or"
            f" train/{layout} and test/{layout}, below what is given"
        )
    deep = [name for name, own in parts.items() if split_called(own[0]) and len(own) > least]
    divided = len(deep) == len(parts)
    meant = len({parts[name][0] for name in deep}) > 1 or all(split_called(own[0]) for own in parts.values())
    if deep and meant and not divided:  # else `train` may be a class among others
        divides = set(deep)
        misplaced = [repr(name) for name in parts if name not in divides]
        raise DataError(
            f"{root}: {first_names(misplaced)}: not SPLIT/{layout}, as {deep[0]!r} and"
            f" {len(deep)} in all are; move away what makes a sample of it, such as a stray picture"
        )
    classes = {name: own[1 if divided else 0] for name, own in parts.items()}
    class_names = sorted(set(classes.values()))
    _warn_of_classes(root, class_names, {0})
    _warn_of_levels(root, [own[divided:] for own in parts.values()])
    splits = {name: split_called(own[0]) if divided else "" for name, own in parts.items()}
    if not divided and all(len(own) > least for own in parts.values()):
        second = {name: split_called(own[1]) for name, own in parts.items()}
        splits = second if all(second.values()) and len({*second.values()}) > 1 else splits
    places = {name: place for place, name in enumerate(class_names)}
    rows = {name: Row(places[own], -1, splits[name]) for name, own in classes.items()}
    return LabelTable(root, rows, class_names)


def _warn_of_levels(root: Path, parts: list[list[str]]) -> None:
    """Warns where folders of another level may be the classes: all samples lie below one folder, or the folders below each
    are the same. parts: of every name, from its class on.
    """
    given, top = root, parts[0][0] if parts else ""
    while len({*map(tuple, (own[:2] for own in parts))}) == 1 and all(len(own) > 2 for own in parts):
        given, parts = given / parts[0][0], [own[1:] for own in parts]  # a folder that holds nothing but a folder
    if len({own[0] for own in parts}) == 1 and all(len(own) > 3 and split_called(own[1]) for own in parts):
        parts = [[own[0], *own[2:]] for own in parts]  # the classes may lie below the splits
    below: dict[str, set[str]] = {}
    people = all(re.fullmatch(r"\D*\d+", own[0]) for own in parts)  # s1/wave, s2/wave
    for own in parts:
        inner = len(own) > 2 or people and not re.search(r"\d", "".join(own[1:2]))
        below.setdefault(own[0], set()).update(own[1:2] if inner else ())
    alike = {frozenset(names) for names in below.values()}
    same = next(iter(alike), frozenset())
    if len(alike) != 1 or len(same) < 2 or all(map(split_called, same)):
        return
    listed = first_names(sorted(same))
    if len(below) == 1:
        (only,) = below
        advice = f"give {given / only}" if (given / only).is_dir() else f"move them up, out of {only!r}"
        whose = "its folders" if only == top else f"the folders in {only!r}"
        log.warn(f"{root}: all samples are of one class, {top!r}; if {whose} are the classes ({listed}), {advice}")
    else:
        log.warn(
            f"{root}: the classes are {first_names(sorted(below))}; the folders below are the same in each ({listed}): if those"
            " are the classes, give them in a table (--labels)"
        )


def _number_labels(path: Path, records: dict[str, dict[str, str]]) -> LabelTable:
    for record in records.values():
        record["label"] = _WHOLE.sub(r"\1", _one_text(record["label"]))
    words = {record["label"] for record in records.values()}
    labels = {0}
    if all(map(_is_number, words)):
        class_names = [str(k) for k in range(_plausible(path, records) + 1)]
        labels = {int(word) for word in words}
        _warn_of_one_number(path, words)
    elif any(map(_is_number, words)):
        raise DataError(f"{path}: some labels are numbers and some are words; use one kind")
    else:
        class_names = sorted(words)
    _warn_of_classes(path, class_names, labels)
    places = {name: place for place, name in enumerate(class_names)}
    rows, people = {}, _people(path, (record.get("subject", "") for record in records.values()))
    for name, record in records.items():
        where = f"{path}:{record['line']}"
        label = int(record["label"]) if _is_number(record["label"]) else places[record["label"]]
        if label < 0:
            raise DataError(f"{where}: label {label} is out of range; labels count from 0")
        subject = people[record.get("subject", "")] or "-1"
        if not _is_number(subject) or len(subject) > 10 or int(subject) >= 1 << 31:
            raise DataError(
                f"{where}: subject {subject[:30]!r}; expected a whole number below 2^31: number the people, alike in all tables"
            )
        split = record.get("split", "")
        rows[name] = Row(label, int(subject), split_called(split) or split)
    warn_of_splits(path, (row.split for row in rows.values()))
    return LabelTable(path, rows, class_names)


def _warn_of_one_number(path: Path, words: Iterable[str]) -> None:
    """Warns where labels are spelled differently but are one number, such as 1 and 01, which folders of classes tell apart."""
    spellings: dict[int, list[str]] = {}
    for word in sorted(words):
        spellings.setdefault(int(word), []).append(word)
    for number, alike in sorted(spellings.items()):
        if len(alike) > 1:
            log.warn(
                f"{path}: labels {' and '.join(map(repr, alike))} are one number, so one class, {number}; if they are different classes,"
                " write words"
            )


def _people(path: Path, subjects: Iterable[str]) -> dict[str, str]:
    """Returns the numbers of subjects that are all spelled alike, such as s01 and s12, or 1.0, or that are all names without
    digits, whose numbers are the same in every table; the subjects themselves where they are neither.
    """
    whole = {subject: _WHOLE.sub(r"\1", subject) for subject in subjects}
    whole = {subject: "" if own.lower() in _UNKNOWN else own for subject, own in whole.items()}
    known = {own for own in whole.values() if own}
    found = {own: match for own in known if (match := _NUMBERED.fullmatch(own))}
    numbers = {}
    if len(found) == len(known) and len({match[1] for match in found.values()}) == 1:
        numbers = {own: str(int(match[2])) for own, match in found.items()}
    elif known and all(re.search(r"[^\W\d_]", own) and not re.search(r"\d", own) for own in known):
        numbers = {own: str(zlib.crc32(_one_spelling(own).encode()) % _MOST_PEOPLE) for own in sorted(known)}
        if len({*numbers.values()}) < len({*map(_one_spelling, known)}):
            raise DataError(f"{path}: two names of subjects lead to one number; number the people, alike in all tables")
        log.info(
            f"{path}: people are known by numbers that follow from their names, alike in all tables:"
            f" {first_names([f'{own} {number}' for own, number in numbers.items()], 8)}"
        )
    return {subject: numbers.get(own, own) for subject, own in whole.items()}


def _one_text(name: str) -> str:
    """Returns a name with its letters and their accents together: macOS and its archives take them apart."""
    return unicodedata.normalize("NFC", name)


def _one_spelling(name: str) -> str:
    return _one_text(name).casefold()


def _warn_of_classes(path: Path, class_names: list[str], labels: set[int]) -> None:
    """Warns of numbers that leave the first class empty, and of classes whose names differ in capitals, in spaces and the like, or in
    the width of letters.
    """
    if 0 not in labels:
        log.warn(f"{path}: no sample has label 0; labels count from 0, so that the first class stays empty")
    spellings: dict[str, list[str]] = {}
    for name in class_names:
        spellings.setdefault(_folded(name), []).append(name if name == name.strip() else repr(name))
    for names in spellings.values():
        if len(names) > 1:
            log.warn(f"{path}: {' and '.join(names)} are different classes")


def _folded(name: str) -> str:
    return _BETWEEN.sub(" ", unicodedata.normalize("NFKC", name).casefold()).strip()


def _plausible(path: Path, records: dict[str, dict[str, str]]) -> int:
    """Returns the largest label, which makes as many class names. Raises DataError when so few lines can't mean it."""
    longest = max(
        records.values(), key=lambda record: (len(record["label"].lstrip("-0")), record["label"].lstrip("-0"))
    )
    word, at_most = longest["label"], 10_000 + 100 * len(records)
    if len(word.lstrip("-0")) > 18 or int(word) > at_most:
        raise DataError(
            f"{path}:{longest['line']}: label {word[:30]} claims more classes than a table of {len(records)} lines can mean,"
            f" expected at most {at_most}; give words, or number the classes from 0"
        )
    return max(int(record["label"]) for record in records.values())


def _is_number(word: str) -> bool:
    return word.isascii() and word.removeprefix("-").isdigit()
