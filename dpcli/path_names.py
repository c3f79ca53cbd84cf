"""Names taken from paths: short ones that tell files apart, and what becomes of paths that are not UTF-8."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dpcli.errors import DataError


def as_utf8(text: str) -> str:
    r"""Returns text from a path as HDF5 can hold it: a byte that is not UTF-8 is spelled ``\xe9``."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def utf8_path(path: Path, library: str) -> str:
    """Returns the path for a library that takes only UTF-8 (OpenCV's videos crash otherwise). DataError when it is none."""
    text = str(path)
    if as_utf8(text) != text:
        raise DataError(
            f"{as_utf8(text)}: the path holds bytes that are not UTF-8, and {library} can't open it; rename it"
        )
    return text


def short_names(paths: Sequence[str | Path]) -> list[str]:
    """Returns a name for each file: its stem; where several share one, their folder's (`seed0/scores.h5`: seed0). May still repeat."""
    stems = [as_utf8(Path(path).stem) for path in paths]
    folders = [as_utf8(Path(path).resolve().parent.name) for path in paths]
    return [folder or stem if stems.count(stem) > 1 else stem for stem, folder in zip(stems, folders)]
