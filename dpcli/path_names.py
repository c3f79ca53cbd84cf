"""Names and paths: short ones that tell files apart, those that are not UTF-8, those that a file names inside itself."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from dpcli.errors import DataError

_ABSOLUTE = re.compile(r"\s*(/|[A-Za-z]:|file:|[A-Za-z][A-Za-z0-9+.-]*://)", re.IGNORECASE)
_UNUSUAL = re.compile(r"[^\w.-]+")
_LONGEST = 4095  # bytes of a path and, below, 255 of a name: Linux takes no more


def as_utf8(text: str) -> str:
    r"""Returns text from a path as HDF5 can hold it: a byte that is not UTF-8 is spelled ``\xe9``."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def utf8_path(path: Path, library: str) -> str:
    """Returns a path for a library that takes only UTF-8 (OpenCV's videos crash). Raises DataError when it isn't UTF-8."""
    text = str(path)
    if as_utf8(text) != text:
        raise DataError(
            f"{as_utf8(text)}: the path holds bytes that are not UTF-8, and {library} can't open it; rename it"
        )
    return text


def first_names(names: Sequence[str], most: int = 5) -> str:
    """Returns the first names with commas between, and how many more there are.

    >>> first_names(["a", "b"]), first_names(["a", "b", "c", "d"], 2)
    ('a, b', 'a, b and 2 more')
    """
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def short_names(paths: Sequence[str | Path]) -> list[str]:
    """Returns a name for each file: its stem; where several share one, their folder's (`seed0/scores.h5`: seed0). May still repeat."""
    stems = [as_utf8(Path(path).stem) for path in paths]
    folders = [as_utf8(Path(path).resolve().parent.name) for path in paths]
    counts = Counter(stems)
    return [folder or stem if counts[stem] > 1 else stem for stem, folder in zip(stems, folders)]


def frame_names(numbers: range, suffix: str, before: str = "") -> list[str]:
    """Returns a file name for each number of a frame, with so many digits that their order as text is that of the frames.

    >>> frame_names(range(2), ".png"), frame_names(range(1, 10_001), ".ply", "frame")[::9999]
    (['0000.png', '0001.png'], ['frame00001.ply', 'frame10000.ply'])
    """
    digits = max(4, len(str(numbers.stop - 1)))
    return [f"{before}{number:0{digits}d}{suffix}" for number in numbers]


def file_names(names: Sequence[str], otherwise: str = "object") -> list[str]:
    """Returns a different name of a file or folder, without its suffix, for each of some names that stand in a file.

    What is no letter, digit, `-`, `_` or `.` becomes `_`. Names that are the same then, also where capitals don't count,
    get their number. otherwise: what one without any letter is called.

    >>> file_names(["a/b", "a b", "..", "c"])
    ['a_b_0', 'a_b_1', 'object', 'c']
    """
    plain = [_UNUSUAL.sub("_", name).strip("_.")[:60] or otherwise for name in names]
    counts = Counter(name.lower() for name in plain)
    taken = {name for name, count in counts.items() if count == 1}
    for index, name in enumerate(plain):
        if counts[name.lower()] > 1:
            name = f"{name}_{index}"
            while name.lower() in taken:
                name += "_"
            taken.add(name.lower())
            plain[index] = name
    return plain


def path_inside(root: Path | None, folder: Path, name: str) -> Path:
    """Returns where ``name``, which stands in a file, lies below ``folder``; nothing is opened.

    A backslash is a slash, as in names written on Windows. Raises DataError when it leaves ``root``: by ``..``, as an
    absolute path, with a drive or as an address (``file://``), or through a link. root None: it may.
    """
    plain = name.replace("\\", "/")
    if not _can_be(str(folder / plain)):
        raise DataError(f"the name {name[:80]!r} cannot be a file's; expected a path below {as_utf8(str(folder))}")
    if root is None:
        return folder / plain.removeprefix("file://")
    place = folder / plain
    try:
        inside = not _ABSOLUTE.match(plain) and place.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError):  # a circle of links
        inside = False
    if not inside:
        raise DataError(
            f"{name[:80]!r} is outside the folder {as_utf8(str(root))}, or isn't named from within it; only files in it"
            " are opened"
        )
    return place


def _can_be(path: str) -> bool:
    """Returns whether a system could have a file of this path: no NUL, no half letters, not too long."""
    try:
        raw = os.fsencode(path)
    except UnicodeEncodeError:
        return False
    return b"\0" not in raw and len(raw) <= _LONGEST and all(len(part) <= 255 for part in raw.split(b"/"))
