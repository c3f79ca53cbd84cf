"""Standard streams under odd conditions: closed, full, on a terminal that lacks letters, or with texts that would command it."""

from __future__ import annotations

import io
import os
import re
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from rich.console import Console

# Control characters, the halves of letters that broken UTF-8 leaves, and what turns the direction of the text around.
_UNSEEN = re.compile(
    "[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff\U000e0000-\U000e007f]"
)
_PIPE_WIDTH = 250  # columns where no terminal sets a limit


def ready_streams() -> None:
    """Makes what is printed to a closed stream go nowhere, and spells a letter that can't be shown; before anything is opened.

    A closed stdin stays None, so that its readers can tell. The number of a closed stream is occupied, else the next
    file to be opened would get it, and with it all that is printed. What stderr can't take is dropped: no message is worth
    the work that it tells of.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    if sys.stdout is None:
        sys.stdout = open(1, "w", closefd=False)
    else:
        sys.stdout.reconfigure(errors="backslashreplace")
    sys.stdout = PrintableStream(sys.stdout)
    sys.stderr = PrintableStream(_error_stream(2, closefd=False))


def quiet_libraries() -> None:
    """Lets what C libraries write to stderr, such as libpng about each damaged picture, go nowhere; Python's stderr stays.

    They write to number 2, which from now on is the null device, also in programs that this process starts.
    """
    before = sys.stderr
    sys.__stderr__ = kept = _error_stream(os.dup(2))
    sys.stderr = PrintableStream(kept) if isinstance(before, PrintableStream) else kept
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os.close(nowhere)


class _DroppingFile(io.FileIO):
    """Drops what can't be written: the disk of a log is full, a terminal is gone, nobody reads the pipe. Waits for a slow reader."""

    def write(self, data: Any) -> int:
        import select

        try:
            while (count := super().write(data)) is None:  # a terminal that another program set not to block
                select.select([], [self], [])
        except OSError:
            return len(data)
        return count


def _error_stream(number: int, closefd: bool = True) -> TextIO:
    """Returns a text stream for messages on an open descriptor, which never fails."""
    encoding = sys.__stderr__.encoding if sys.__stderr__ else "utf-8"
    file = io.BufferedWriter(_DroppingFile(number, "w", closefd=closefd))
    return io.TextIOWrapper(file, encoding=encoding, errors="backslashreplace", line_buffering=True)


@contextmanager
def loud_libraries() -> Iterator[None]:
    """Undoes `quiet_libraries` for the programs that the block starts."""
    quiet, number = os.dup(2), sys.__stderr__.fileno() if sys.__stderr__ else 2
    os.dup2(number, 2)
    try:
        yield
    finally:
        os.dup2(quiet, 2)
        os.close(quiet)


class PrintableStream:
    """Wraps a text stream so that no control sequence reaches a terminal; otherwise acts as that stream."""

    def __init__(self, stream: TextIO) -> None:
        self.unfiltered = stream

    def write(self, text: str) -> int:
        """Writes text in which control characters, but line breaks and tabs, are spelled."""
        return self.unfiltered.write(printable(text, kept="\n\t"))

    def writelines(self, lines: Iterable[str]) -> None:
        """Writes one line after the other."""
        for line in lines:
            self.write(line)

    @property
    def encoding(self) -> str:
        """Returns UTF-8: click writes past a stream of ASCII, but letters that can't be shown are spelled here."""
        return "utf-8"

    def __getattr__(self, name: str) -> Any:
        return getattr(self.unfiltered, name)


def rich_console(stream: TextIO) -> Console:
    """Returns rich's console on a stream, wide in a pipe. Its colors pass, so texts of files must be made `printable` before."""
    from rich.console import Console

    width = None if stream.isatty() else _PIPE_WIDTH
    file = getattr(stream, "unfiltered", stream)
    return Console(file=file, highlight=False, width=width, markup=False, emoji=False)


def hush_warnings() -> None:
    """Keeps Python's warnings, which libraries mean for programmers, off the screen, here and in workers, unless asked for."""
    if not sys.warnoptions and "PYTHONWARNINGS" not in os.environ:
        os.environ["PYTHONWARNINGS"] = "ignore"
        warnings.simplefilter("ignore")


def printable(text: str, kept: str = "") -> str:
    r"""Returns text from a file as a terminal may get it: a control character that is not `kept` is spelled, such as ``\x1b``."""
    return _UNSEEN.sub(lambda found: found[0] if found[0] in kept else found[0].encode("unicode_escape").decode(), text)
