"""A cache of what was read from files, which reads a file again when it changed."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable
from functools import lru_cache, wraps
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Content = TypeVar("Content")
Read = Callable[Concatenate[Path, Arguments], Content]


def file_state(path: Path) -> tuple[int, int, int] | None:
    """Returns what changes when another file takes a path, or its bytes change; None where none can be found there."""
    try:
        found = os.stat(path)
    except (OSError, ValueError):  # the second of a name with NUL
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns


def cached_by_file(maxsize: int) -> Callable[[Read[Arguments, Content]], Read[Arguments, Content]]:
    """Decorates a function of a path, and perhaps of further arguments that can be hashed: its latest ``maxsize`` results are
    kept, each for as long as the file stays as it was. What it raises isn't kept.
    """

    def decorate(read: Read[Arguments, Content]) -> Read[Arguments, Content]:
        @lru_cache(maxsize)
        def kept(state: Hashable, path: Path, *arguments: Arguments.args, **named: Arguments.kwargs) -> Content:
            return read(path, *arguments, **named)

        @wraps(read)
        def cached(path: Path, *arguments: Arguments.args, **named: Arguments.kwargs) -> Content:
            return kept(file_state(path), path, *arguments, **named)

        return cached

    return decorate
