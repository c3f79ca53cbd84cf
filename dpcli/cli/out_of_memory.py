"""Tells where memory ends which numbers of the user's asked for so much, or what to take less of."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from dpcli.errors import UsageError

_MUCH = 8  # times a default: such a number is named as what asked for the memory
_MANY = 10_000  # the same where there is no default


def out_of_memory(error: BaseException) -> bool:
    """Returns whether memory ended: numpy raises MemoryError, torch RuntimeError, on a GPU a kind of its own, on a CPU a plain one."""
    text = str(error)
    said = type(error).__name__ == "OutOfMemoryError" or "can't allocate memory" in text
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and said)


def memory_sentence(error: BaseException) -> str:
    """Returns the message for a command that ran out of memory though no number given to it is large."""
    return (
        f"not enough memory on {_machine(error)}{_asked_for(error)}; take less at a time: --batch, or --set accumulate=2 in"
        " `classify train`, --points, --frames, --size, --jobs"
    )


@contextmanager
def naming_large(given: Mapping[str, tuple[Any, Any]]) -> Iterator[None]:
    """Raises UsageError where memory ends in the block and numbers in `given`, words -> (value, default), are far above defaults."""
    try:
        yield
    except Exception as error:
        large = [words for words, (value, default) in given.items() if _is_large(value, default)]
        if not large or not out_of_memory(error):
            raise
        raise UsageError(
            f"{', '.join(large)}: more memory would be needed than {_machine(error)} has{_asked_for(error)}; take less"
        ) from error


def _is_large(value: Any, default: Any) -> bool:
    usual = max(map(abs, _numbers(default)), default=0)
    return any(number >= (_MUCH * usual or _MANY) for number in _numbers(value))


def _numbers(value: Any) -> Iterator[float]:
    """Yields the numbers in a value, which may be a tuple of tuples; truth values are none."""
    if isinstance(value, (list, tuple)):
        for one in value:
            yield from _numbers(one)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield value


def _machine(error: BaseException) -> str:
    return "the GPU" if "CUDA" in str(error) else "this machine"


def _asked_for(error: BaseException) -> str:
    found = re.search(r"allocate ([\d.]+) ?(\w+)", str(error))
    if found is None:
        return ""
    from rich.filesize import decimal

    return f" ({decimal(int(found[1])) if found[2] == 'bytes' else ' '.join(found.groups())} more were asked for)"
