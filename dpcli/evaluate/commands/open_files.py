"""Opening the several files of one command, of which one may come from a pipe."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from dpcli.errors import UsageError
from dpcli.store import input_file


def open_files(stack: ExitStack, arguments: Sequence[str]) -> list[Path]:
    """Returns a readable path for each argument, `-` for a pipe, until `stack` closes. Raises UsageError for two pipes."""
    if list(arguments).count("-") > 1:
        raise UsageError("-: a pipe holds one file; name the others")
    return [stack.enter_context(input_file(argument)) for argument in arguments]
