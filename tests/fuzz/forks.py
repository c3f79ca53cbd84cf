"""Commands in forks of this process, which has the libraries loaded already: no start-up for each of thousands of runs."""

from __future__ import annotations

import os
import resource
import select
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

_MORE = 300  # seconds at most that a run which computes may take beyond its time on the clock
UNEXPECTED = 99  # the exit code of work that raised


@dataclass(frozen=True)
class Limits:
    """Bounds on one run: seconds on the clock, seconds of CPU (0: none), bytes of address space beyond this process's, bytes of a file."""

    seconds: float = 60
    cpu: int = 0
    memory: int = 14 << 30
    file: int = 300 << 20


@dataclass(frozen=True)
class Ended:
    """What a run left: exit code (a signal's number negative), stderr, stdout, seconds, bytes of memory at its peak.

    quiet: seconds between its last word on stderr and its end.
    """

    code: int
    said: str
    printed: str
    seconds: float
    memory: int
    quiet: float = 0.0


def forked(work: Callable[[], int], limits: Limits, folder: Path | None = None) -> Ended:
    """Runs the work in a fork of this process, in the folder; the fork and all that it started are gone afterwards.

    This process must have no threads of its own. A run over its time on the clock ends by SIGALRM, over its CPU time by
    SIGXCPU.
    """
    began = time.monotonic()
    with tempfile.TemporaryFile() as printed, tempfile.TemporaryFile() as said:
        child = os.fork()
        if child == 0:
            os._exit(_in_child(work, limits, folder, printed.fileno(), said.fileno()))
        timed_out = not _waited(child, limits.seconds)
        _kill_group(child)
        _, status, used = os.wait4(child, 0)
        code = -signal.SIGALRM if timed_out else os.waitstatus_to_exitcode(status)
        texts = [os.pread(one.fileno(), 1 << 20, 0).decode(errors="backslashreplace") for one in (said, printed)]
        quiet = time.time() - os.fstat(said.fileno()).st_mtime
    return Ended(code, *texts, time.monotonic() - began, used.ru_maxrss << 10, quiet)


def _waited(child: int, seconds: float) -> bool:
    """Waits until the child ends, or the time is over and nothing of it asks for a processor; says whether it ended."""
    ended = os.pidfd_open(child)
    try:
        for wait in (seconds, *[1.0] * _MORE):
            if select.select([ended], [], [], wait)[0]:
                return True
            if not _runs(child):
                return False
        return False
    finally:
        os.close(ended)


def _runs(session: int) -> bool:
    """Says whether a process of the session computes or reads from a disk: on a busy machine it only came too short."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            state, _, _, its_session = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
        except OSError:  # it ended meanwhile
            continue
        if int(its_session) == session and state in "RD":
            return True
    return False


def _kill_group(child: int) -> None:
    try:
        os.killpg(child, signal.SIGKILL)
    except ProcessLookupError:
        os.kill(child, signal.SIGKILL)  # it has not become a group yet; a child not waited for can always be asked


def _in_child(work: Callable[[], int], limits: Limits, folder: Path | None, printed: int, said: int) -> int:
    try:
        os.setsid()
        nothing = os.open(os.devnull, os.O_RDONLY)
        for number, target in ((0, nothing), (1, printed), (2, said)):
            os.dup2(target, number)
        streams = [open(number, "w", buffering=1, closefd=False, errors="backslashreplace") for number in (1, 2)]
        sys.stdout, sys.stderr = streams
        _limit(limits)
        os.chdir(folder or ".")
        return work() or 0
    except BaseException:
        traceback.print_exc()
        return UNEXPECTED
    finally:
        sys.stdout.flush()
        sys.stderr.flush()


def _limit(limits: Limits) -> None:
    space = limits.memory + int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (space, space))
    resource.setrlimit(resource.RLIMIT_FSIZE, (limits.file, limits.file))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    if limits.cpu:
        resource.setrlimit(resource.RLIMIT_CPU, (limits.cpu, limits.cpu + 5))
