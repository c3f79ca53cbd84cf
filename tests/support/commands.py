"""A `dpc` command in this process: for tests about what it says or makes, not about processes. Saves the start."""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
from unittest import mock

from dpcli.cli.app import main


def exit_code(*words: object) -> int:
    """Run it; what it would have left to the shell."""
    try:
        main(list(map(str, words)))
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


def typed(*words: object) -> int:
    """As `exit_code`, and files tell of this command line: what a process of its own would write, to the byte."""
    with mock.patch.object(sys, "argv", ["dpc", *map(str, words)]):
        return exit_code(*words)


def told(*words: object) -> subprocess.CompletedProcess[str]:
    """As `typed`; what it said on stdout and stderr stands in the result, as text."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = typed(*words)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def piped(*words: object, stdin: bytes = b"") -> subprocess.CompletedProcess[bytes]:
    """As `typed`, in the middle of a pipe: it reads these bytes, and the result holds the bytes of its stdout and stderr."""
    out, err = (io.TextIOWrapper(io.BytesIO(), write_through=True) for _ in range(2))
    reading = mock.patch.object(sys, "stdin", io.TextIOWrapper(io.BytesIO(stdin)))
    with reading, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = typed(*words)
    return subprocess.CompletedProcess(words, code, out.buffer.getvalue(), err.buffer.getvalue())
