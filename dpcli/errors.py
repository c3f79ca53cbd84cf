"""The errors a user can meet. Each class fixes the exit code; the message says what, where, what was expected, what to do."""

from __future__ import annotations


class DpcError(Exception):
    """The work failed (exit code 1)."""

    exit_code = 1


class UsageError(DpcError):
    """The command was used wrongly (exit code 2)."""

    exit_code = 2


class DataError(DpcError):
    """An input is not what it should be (exit code 3)."""

    exit_code = 3


class Stopped(DpcError):
    """A signal asked to stop; what is done is saved and running again continues (exit code 75, EX_TEMPFAIL)."""

    exit_code = 75
