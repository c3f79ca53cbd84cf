"""The interface of a reader of raw data: a cheap index of items, and one item read into a sample."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.regular_files import why_unreadable
from dpcli.store import CloudSequence

SPLITS = ("train", "validation", "test")
ON_ERROR = ("skip", "stop")  # what becomes of a bad sample, or frame
_SPLIT_WORDS = {
    **dict(zip(SPLITS, SPLITS)),
    "training": "train",
    "val": "validation",
    "valid": "validation",
    "testing": "test",
}
_AFFIX = re.compile(r"^(?:split|set|data|subset)[ _.-]+|[ _.-]*(?:split|set|data|subset|videos|clips|samples)$")


@dataclass(frozen=True)
class Item:
    """Holds one sample of the index: what is known about it before its data are opened.

    A non-empty ``problem`` marks an entry that can't be read at all (a list line naming a missing file,
    a label out of range); the pipeline reports it like a failed read and never calls the reader. ``extra``: what `read`
    needs; ``files`` in it are those that it is read from, where ``path`` is not one of them or doesn't hold them itself.
    """

    name: str
    path: Path
    split: str = ""
    label: int = -1
    subject: int = -1
    camera: int = -1
    extra: dict[str, Any] = field(default_factory=dict)
    problem: str = ""


@dataclass
class Sample:
    """Holds one sequence, and counts of what its reader left out, such as ``{"frames without depth dropped": 2}``; what counts
    0 isn't kept.
    """

    sequence: CloudSequence
    notes: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.notes = {what: count for what, count in self.notes.items() if count}

    def note(self, counts: Mapping[str, int]) -> None:
        """Adds further counts."""
        self.notes |= {what: count for what, count in counts.items() if count}


def published_found(items: Sequence[Item], published: Mapping[str, int], kind: str) -> list[str]:
    """Returns a line for each published split: how many of its samples, `kind` in the plural, the index holds."""
    found = Counter(item.split for item in items if not item.problem)
    return [f"{split}: {found[split]} of the {count} published {kind} found" for split, count in published.items()]


def split_called(word: str) -> str:
    """Returns the split that people call by this word, in any case, as a folder or in a table; "" when it is none.

    >>> [split_called(word) for word in ("Train", "val", "test_set", "wave")]
    ['train', 'validation', 'test', '']
    """
    return _SPLIT_WORDS.get(_AFFIX.sub("", word.strip().lower()), "")


class Reader(Protocol):
    """Reads a raw format. Implementations derive from it and are frozen dataclasses of their options, so they pickle into worker
    processes, without what `items` found: what `read` needs of that is in the item's ``extra``. What they list may be called
    ``inputs``; workers have none.

    What an option decides is a property, what is always the same a ClassVar. What is said here of a method isn't said again where
    one implements it.
    """

    @property
    def class_names(self) -> Sequence[str]:
        """Returns the class names in the order of their labels, none where no sample has one."""
        return ()

    @property
    @abstractmethod
    def length_unit(self) -> str:
        """Returns the name of the output's unit of length."""

    @property
    @abstractmethod
    def fields(self) -> tuple[str, ...]:
        """Returns the optional fields that every sample has, such as ``time``."""

    @property
    def config(self) -> dict[str, Any]:
        """Returns the options that decide the content, for the provenance: all that don't say where the raw data are."""
        return {name: value for name, value in asdict(self).items() if name not in ("raw", "inputs")}  # type: ignore[call-overload]

    @property
    def history(self) -> Sequence[dict[str, Any]]:
        """Returns the provenance of what is read, which raw data don't have."""
        return ()

    @abstractmethod
    def items(self) -> list[Item]:
        """Returns the index in its final order. Raises DataError when the raw data are not what they should be."""

    @abstractmethod
    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        """Returns one sample, in a worker process. Raises DataError on a bad one. ``rng`` belongs to this item alone."""

    @abstractmethod
    def summary(self, items: list[Item]) -> list[str]:
        """Returns lines for the log about what the index holds and lacks."""


def require_least(options: object, **least: int) -> None:
    """Raises UsageError that names the first of some options, by the names of their fields, whose number is below the least."""
    for name, number in least.items():
        if getattr(options, name) < number:
            raise UsageError(f"{_typed(options, name)}: expected {number} or more")


def require_known(options: object, **known: Collection[object]) -> None:
    """Raises UsageError that names the first of some options whose value is none of the known ones."""
    for name, values in known.items():
        if getattr(options, name) not in values:
            raise UsageError(f"{_typed(options, name)}: expected {' or '.join(map(str, values))}")


def _typed(options: object, name: str) -> str:
    return f"--{name.replace('_', '-')} {getattr(options, name)}"


def describe(item: Item) -> dict[str, Any]:
    """Returns the fields of a CloudSequence that the index already knows."""
    return {"split": item.split, "label": item.label, "subject": item.subject, "camera": item.camera}


def natural_key(path: Path | str) -> list[tuple[int, int, str]]:
    """Returns sort key under which ``frame2`` comes before ``frame10``; equal numbers fall back to the spelling.

    >>> sorted(["frame10.png", "frame2.png", "frame1.png"], key=natural_key)
    ['frame1.png', 'frame2.png', 'frame10.png']
    """
    text = path.name if isinstance(path, Path) else path
    parts = re.split(r"(\d+)", text)
    return [(0, int(p), p) if p.isdecimal() and p.isascii() else (1, 0, p) for p in parts if p]


def require_folder(path: Path, expected: str) -> Path:
    """Returns ``path`` when it is a folder. Raises DataError that says what was looked for in it otherwise."""
    if path.is_dir():
        return path
    odd = why_unreadable(path).partition(", expected")
    if odd[1]:
        raise DataError(
            f"{path}: {odd[0]}; raw data come from files and folders, not through a pipe: save them, and name these"
        )
    found = odd[0] or ("is a file" if path.exists() else "does not exist")
    raise DataError(f"{path}: {found}; expected a folder with {expected}")


def drop_empty_frames(name: str, counts: np.ndarray) -> tuple[np.ndarray, dict[str, int]]:
    """Returns which frames to keep, i64 (T'), of ``counts`` i64 (T) points per frame, and notes.

    A frame without a single valid point carries no geometry and would break samplers later, so it is
    dropped and counted; a sequence of nothing but such frames is a bad sample (DataError).
    """
    kept = np.flatnonzero(counts)
    if len(counts) == 0:
        raise DataError(f"{name}: holds no frames; expected at least 1")
    if len(kept) == 0:
        raise DataError(f"{name}: none of its frames ({len(counts)}) has a valid depth pixel or point")
    return kept, {"frames without points dropped": len(counts) - len(kept)}


def sample_of_frames(
    item: Item,
    points: np.ndarray,
    counts: np.ndarray,
    notes: Mapping[str, int],
    *,
    time: np.ndarray | None = None,
    where: Path | None = None,
    **fields: Any,
) -> Sample:
    """Returns the sample of an item's points f32 (P,3), of which each frame has ``counts`` i64 (T), without empty frames.

    notes: what else was left out. time: of every frame, f64 (T), or None. where: the item's place in messages, if not its
    path. fields: those of a CloudSequence, of its points. Raises DataError where no frame has points.
    """
    kept, dropped = drop_empty_frames(str(where or item.path), counts)
    time = None if time is None else time[kept]
    sequence = CloudSequence(item.name, points, offsets(counts[kept]), time=time, **fields, **describe(item))
    return Sample(sequence, {**notes, **dropped})


def offsets(counts: np.ndarray) -> np.ndarray:
    """Returns offsets i64 (T+1) that start with 0, of counts i64 (T).

    >>> offsets(np.array([2, 0, 3])).tolist()
    [0, 2, 2, 5]
    """
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(counts, dtype=np.int64)])
