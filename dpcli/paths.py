"""Paths that are not UTF-8 (folders of an older system): how they are spelled in files, and which libraries can't open them."""

from __future__ import annotations

from pathlib import Path

from dpcli.errors import DataError


def as_utf8(text: str) -> str:
    r"""Text from a path as HDF5 can hold it: a byte that is not UTF-8 is spelled ``\xe9``."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def utf8_path(path: Path, library: str) -> str:
    """The path for a library that takes only UTF-8 (OpenCV's videos crash otherwise). DataError when it is none."""
    text = str(path)
    if as_utf8(text) != text:
        raise DataError(f"{as_utf8(text)}: the path holds bytes that are not UTF-8, and {library} can't open it; rename it")
    return text
