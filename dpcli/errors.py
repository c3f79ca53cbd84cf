"""The errors a user can meet. Each class fixes the exit code; the message says what, where, what was expected, what to do."""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager

_ADDRESS = re.compile(r"<([\w.]+) object at 0x[0-9a-fA-F]+>")


REORDER = "`dpc prepare merge FILE --labels map.toml -o NEW.h5` puts them in the order of `classes` in the map"


class DpcError(Exception):
    """The work failed (exit code 1).

    Memory addresses, which libraries put into their messages, are left out: they are of no use, and files that keep
    the message would differ from run to run.
    """

    exit_code = 1

    def __init__(self, *said: object) -> None:
        super().__init__(*(_ADDRESS.sub(r"\1", one) if isinstance(one, str) else one for one in said))


class UsageError(DpcError):
    """The command was used wrongly (exit code 2)."""

    exit_code = 2


class DataError(DpcError):
    """An input is not what it should be (exit code 3)."""

    exit_code = 3


class Stopped(DpcError):
    """A signal asked to stop; what is done is saved and running again continues (exit code 75, EX_TEMPFAIL)."""

    exit_code = 75


def first_line(error: BaseException) -> str:
    r"""Returns the first line of what a library's error says, or its type where it says nothing.

    >>> first_line(ValueError("no number\nat line 3")), first_line(KeyError())
    ('no number', 'KeyError')
    """
    return (str(error).strip() or type(error).__name__).splitlines()[0]


@contextmanager
def reading(where: object) -> Iterator[None]:
    """Turns whatever a library raises in the block into DataError that names `where`, the file or sample, and its type.

    Our own errors pass, as do those of the system that carry a number (no such file, no permission, no room), but not that
    of a place that no file has, to which damaged offsets lead.
    """
    try:
        yield
    except DpcError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL, errno.EOVERFLOW):
            raise
        said = (str(error).splitlines() or [""])[0][:200]
        what = f"{type(error).__name__}: {said}" if said else type(error).__name__
        if isinstance(error, MemoryError):  # of a large file, or of a count in a damaged one
            raise DataError(
                f"{where}: too large for the memory there is, or damaged ({what}); free memory, or copy it again"
            ) from error
        raise DataError(f"{where}: damaged, or of another format ({what}); make or copy it again") from error
