"""The two list files of SHREC'17: which gesture is whose, its labels and its split."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from dpcli.errors import DataError
from dpcli.prepare.reader import require_folder

GESTURES = (
    "grab",
    "tap",
    "expand",
    "pinch",
    "rotation clockwise",
    "rotation counter-clockwise",
    "swipe right",
    "swipe left",
    "swipe up",
    "swipe down",
    "swipe X",
    "swipe +",
    "swipe V",
    "shake",
)
FINGERS = ("one finger", "whole hand")
IMAGE_UNIT = "pixel (row, column), mm (depth)"
PUBLISHED = {"train": 1960, "test": 840}
_COLUMNS = {"gesture": 14, "finger": 2, "subject": 28, "trial": 0, "label14": 14, "label28": 28, "frames": 0}


@dataclass(frozen=True)
class Entry:
    """Holds one line: all count from 1; ``frames`` is the length of the sequence."""

    gesture: int
    finger: int
    subject: int
    trial: int
    label14: int
    label28: int
    frames: int

    @property
    def folder(self) -> str:
        """Returns the sequence's folder, relative to the lists."""
        return f"gesture_{self.gesture}/finger_{self.finger}/subject_{self.subject}/essai_{self.trial}"

    def label(self, labels: int) -> int:
        """Returns the label among 14 or 28, from 0."""
        return (self.label14 if labels == 14 else self.label28) - 1


def parse_line(line: str) -> Entry:
    """Returns the parts of a line such as ``1 1 2 1 1 1 67``. Raises ValueError, which says what is wrong."""
    words = line.split()
    if len(words) != len(_COLUMNS) or not all(word.isascii() and word.isdigit() for word in words):
        raise ValueError("expected 7 whole numbers: gesture finger subject trial label14 label28 frames")
    for (what, most), word in zip(_COLUMNS.items(), words, strict=True):
        if int(word) < 1 or (most and int(word) > most):
            raise ValueError(f"{what} {int(word)} is out of range; expected 1 to {most or 'more'}")
    return Entry(*(int(word) for word in words))


@dataclass(frozen=True)
class ListFile:
    """Holds a list file and its lines (number from 1, text), blank ones left out."""

    path: Path
    split: str
    lines: tuple[tuple[int, str], ...]


def find_lists(raw: Path) -> list[ListFile]:
    """Finds train_gestures.txt and test_gestures.txt in ``raw`` or a folder directly in it.

    Raises DataError unless both are there.
    """
    expected = "train_gestures.txt, test_gestures.txt and gesture_1/ ... gesture_14/"
    folder = require_folder(raw, expected)
    homes = [home for home in (folder, *sorted(folder.iterdir())) if (home / "train_gestures.txt").is_file()]
    home = homes[0] if homes else folder
    lists = []
    for split in PUBLISHED:
        path = home / f"{split}_gestures.txt"
        if not path.is_file():
            raise DataError(f"{path}: not found; expected {expected}")
        text = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
        lists.append(ListFile(path, split, tuple((n, t) for n, t in enumerate(text, start=1) if t.strip())))
    if not any(entry.lines for entry in lists):
        raise DataError(f"{home}: both list files are empty; expected one line per gesture")
    return lists


def entries(lists: Sequence[ListFile]) -> Iterator[tuple[str, str, Entry | str]]:
    """Yields (split, FILE:LINE, entry or what is wrong with the line), each sequence once."""
    seen: dict[str, str] = {}
    meaning: dict[tuple[str, int], tuple[tuple[int, ...], str]] = {}
    for file in lists:
        for number, text in file.lines:
            where = f"{file.path.name}:{number}"
            try:
                entry = parse_line(text)
                _once(entry, where, seen)
                _agrees("label14", entry.label14, (entry.gesture,), where, meaning)
                _agrees("label28", entry.label28, (entry.gesture, entry.finger), where, meaning)
            except ValueError as error:
                yield file.split, where, f"{file.path}:{number}: {error}; found {text.strip()[:60]!r}"
            else:
                yield file.split, where, entry


def _once(entry: Entry, where: str, seen: dict[str, str]) -> None:
    if entry.folder in seen:
        raise ValueError(f"{entry.folder} is listed already, in {seen[entry.folder]}")
    seen[entry.folder] = where


def _agrees(
    what: str, label: int, gesture: tuple[int, ...], where: str, meaning: dict[tuple[str, int], tuple]
) -> None:  # of two lines that differ the first is believed
    first, line = meaning.setdefault((what, label), (gesture, where))
    if first != gesture:
        raise ValueError(f"{what} {label} stands for {_words(gesture)} here and for {_words(first)} in {line}")


def _words(gesture: Sequence[int]) -> str:
    return ", ".join([GESTURES[gesture[0] - 1], *(FINGERS[finger - 1] for finger in gesture[1:])])


def gesture_names(lists: Sequence[ListFile], labels: int) -> list[str]:
    """Returns the names of the 14 or 28 classes in label order, as the lists pair labels with gestures and fingers.

    A class that no line has is called ``class N``, N from 1.
    """
    names = [f"class {number}" for number in range(1, labels + 1)]
    for _, _, entry in entries(lists):
        if isinstance(entry, Entry):
            gesture = (entry.gesture,) if labels == 14 else (entry.gesture, entry.finger)
            names[entry.label(labels)] = _words(gesture)
    return names
