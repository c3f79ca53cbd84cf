"""Labels of samples that don't tell them: from a CSV table, with subject and split, or from the folders they lie in."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dpcli.errors import DataError
from dpcli.prepare.reader import SPLIT_FOLDERS, Item

_COLUMNS = ("name", "label", "subject", "split")


@dataclass(frozen=True)
class Row:
    """Holds what one line says about one sample; ``label`` indexes the table's class names."""

    label: int
    subject: int
    split: str


@dataclass(frozen=True)
class LabelTable:
    """Holds rows by sample name, and the class names that their labels index."""

    path: Path
    rows: dict[str, Row]
    class_names: list[str]

    def apply(self, items: list[Item]) -> list[Item]:
        """Returns items with the table's fields; one it doesn't name keeps label -1.

        Raises DataError when it names a stranger.
        """
        strangers = sorted(self.rows.keys() - {item.name for item in items})
        if strangers:
            known = ", ".join(item.name for item in items[:3])
            raise DataError(f"{self.path}: names {strangers[0]!r}, which is not among the samples ({known}, ...)")
        rows = ((item, self.rows.get(item.name)) for item in items)
        return [replace(i, label=r.label, subject=r.subject, split=r.split) if r else i for i, r in rows]


def read_labels(path: Path) -> LabelTable:
    """Reads columns ``name,label[,subject][,split]`` with a header line, or the first two without one.

    Labels are whole numbers from 0, or words; words are numbered in alphabetical order. DataError names file and line.
    """
    try:
        lines = [
            [cell.strip() for cell in row] for row in csv.reader(path.read_text(encoding="utf-8-sig").splitlines())
        ]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path}: cannot be read as a CSV table ({error})") from None
    numbered = [(number, row) for number, row in enumerate(lines, start=1) if any(row)]
    header = list(_COLUMNS[:2])
    if numbered and "name" in numbered[0][1]:
        header = numbered.pop(0)[1]
        if "label" not in header or set(header) - set(_COLUMNS):
            raise DataError(f"{path}:1: columns {','.join(header)}; expected name,label and perhaps subject, split")
    records: dict[str, dict[str, str]] = {}
    for number, row in numbered:
        record = dict(zip(header, row, strict=False))
        if len(row) != len(header) or not record["name"] or not record["label"]:
            raise DataError(f"{path}:{number}: {','.join(row)!r}; expected {','.join(header)}")
        if record["name"] in records:
            raise DataError(f"{path}:{number}: {record['name']!r} appears twice")
        records[record["name"]] = record | {"line": str(number)}
    if not records:
        raise DataError(f"{path}: no rows; expected {','.join(header)}")
    return _number_labels(path, records)


def labels_of_folders(root: Path, names: Sequence[str], layout: str) -> LabelTable:
    """Takes each name's first folder for its class; where all begin with train, val(idation) or test, that is the split
    and the next one the class. Classes are numbered in alphabetical order.

    names: relative to `root`, parts with `/`. layout: what a name holds at least, such as `CLASS/VIDEO`. Raises
    DataError when one holds less, or when most lie in folders of splits and some do not: those splits would silently
    become classes.
    """
    least = len(layout.split("/"))
    parts = {name: name.split("/") for name in names}
    short = [name for name, own in parts.items() if len(own) < least]
    if short:
        raise DataError(
            f"{root}: {short[0]!r} lies in no folder of its class; --label-from-folder expects {layout}, or"
            f" train/{layout} and test/{layout}, below what is given"
        )
    deep = [name for name, own in parts.items() if own[0] in SPLIT_FOLDERS and len(own) > least]
    divided = len(deep) == len(parts)
    meant = len({parts[name][0] for name in deep}) > 1 or all(own[0] in SPLIT_FOLDERS for own in parts.values())
    if deep and meant and not divided:  # else `train` may be a class among others
        odd = [name for name in parts if name not in set(deep)]
        raise DataError(
            f"{root}: {', '.join(map(repr, odd[:5]))}{' ...' if odd[5:] else ''}: not SPLIT/{layout}, as {deep[0]!r} and"
            f" {len(deep)} in all are; move away what makes a sample of it, such as a stray picture"
        )
    classes = {name: own[1 if divided else 0] for name, own in parts.items()}
    class_names = sorted(set(classes.values()))
    splits = {name: SPLIT_FOLDERS[own[0]] if divided else "" for name, own in parts.items()}
    rows = {name: Row(class_names.index(own), -1, splits[name]) for name, own in classes.items()}
    return LabelTable(root, rows, class_names)


def _number_labels(path: Path, records: dict[str, dict[str, str]]) -> LabelTable:
    words = [record["label"] for record in records.values()]
    if all(_is_number(word) for word in words):
        class_names = [str(k) for k in range(_plausible(path, records) + 1)]
    elif any(_is_number(word) for word in words):
        raise DataError(f"{path}: some labels are numbers and some are words; use one kind")
    else:
        class_names = sorted(set(words))
    rows = {}
    for name, record in records.items():
        where = f"{path}:{record['line']}"
        label = int(record["label"]) if _is_number(record["label"]) else class_names.index(record["label"])
        if label < 0:
            raise DataError(f"{where}: label {label} is out of range; labels count from 0")
        subject = record.get("subject", "") or "-1"
        if not _is_number(subject) or len(subject) > 10 or int(subject) >= 1 << 31:
            raise DataError(f"{where}: subject {subject[:30]!r}; expected a whole number below 2^31")
        split = record.get("split", "")
        rows[name] = Row(label, int(subject), SPLIT_FOLDERS.get(split, split))
    return LabelTable(path, rows, class_names)


def _plausible(path: Path, records: dict[str, dict[str, str]]) -> int:
    """Returns the largest label, which makes as many class names; DataError when no table of that many lines could mean it."""
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
