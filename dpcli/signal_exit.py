"""Signals that end the program while no command is ready to save anything: one sentence and an exit code, whatever is loading.

Commands that can keep what is done take the stop signals over while they work (`runtime.signals`). This imports nothing
but what Python has loaded anyway, so that it stands before anything else does. Python's handlers run between two lines of
Python: for a library that doesn't come back to them, or crashes, a second process stands by, which does nothing else.
"""

from __future__ import annotations

import os
import signal
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:  # as in typing, whose import would take longer than all of this
    from types import FrameType, SimpleNamespace

STOPPED, INTERRUPTED = 75, 130  # as EX_TEMPFAIL, and as a shell reports SIGINT
_PATIENCE = 0.05  # seconds after which one looks again whether libraries still load
_DEAF, _DEAF_TWICE = 15, 2  # seconds after which a signal, a second signal, that nobody heard ends the process
_HEARD = b"\0"  # no signal's number
_OVERTAKEN = 0.1  # seconds in which the number of a signal that another thread got may come after the answer to it
_CODES = {"SIGINT": INTERRUPTED, "SIGTERM": STOPPED, "SIGUSR1": STOPPED, "SIGUSR2": STOPPED}


class Ended(KeyboardInterrupt):
    """Unwinds a command, raised in it by a signal. Not the plain one, for which Python kills itself by SIGINT as it ends."""


class _Watch:
    """Holds the name of the signal that came, whether there is work to be ended in order, and whose process this is."""

    name = ""
    working = False
    process = 0
    writing = -1  # to the process that stands by


_watch = _Watch()


def watch_signals() -> None:
    """Makes Ctrl-C and stop signals end this process with a sentence; those that are ignored (nohup) stay so."""
    _watch.process, sys.unraisablehook = os.getpid(), _lost
    for name in _CODES:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _handle)


def stand_by() -> None:
    """Starts a process that ends this one when it hears no signal, and says so when it ends without a word; not on Windows."""
    if not hasattr(os, "fork"):
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    os.register_at_fork(after_in_child=lambda: signal.set_wakeup_fd(-1))
    _watch.writing = writing
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)  # what C gets at once, also where Python's handlers wait
    try:
        child = os.fork()
    except OSError:  # no more processes are allowed: the command works without
        return
    if child == 0:
        try:
            os.close(writing)
            _stand_by(reading, _watch.process)
        finally:
            os._exit(0)
    os.close(reading)


def heard() -> None:
    """Tells the process that stands by that a signal was heard, or that the work is done."""
    if _watch.writing >= 0 and _watch.process == os.getpid():
        try:
            os.write(_watch.writing, _HEARD)
        except OSError:  # it was killed
            pass


def _stand_by(reading: int, process: int) -> None:
    import select
    import time

    for name in ("SIGHUP", *_CODES):  # they reach the whole group, and are the other one's to answer
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    for number in (0, 1):  # whoever waits for the end of a pipe waits for the command alone
        os.close(number)
    numbers = {getattr(signal, name): name for name in _CODES}
    unheard, patience, heard_at, ended_well = "", None, -1.0, False
    while True:
        ready, _, _ = select.select([reading], [], [], patience)
        if not ready:
            _say(f"stopped by {unheard}; a library did not come back from its work; run the same command again")
            os.kill(process, signal.SIGKILL)
            return
        told = os.read(reading, 1)
        if not told:
            break
        if told == _HEARD:
            unheard, patience, heard_at, ended_well = "", None, time.monotonic(), True
        elif told[0] in numbers and time.monotonic() > heard_at + _OVERTAKEN:
            patience = _DEAF_TWICE if unheard else _DEAF
            unheard, ended_well = numbers[told[0]], False
    if not ended_well:
        _say("killed, or ended by a crash in a library: too little memory, perhaps, or a damaged input")


def _say(sentence: str) -> None:
    """Writes an error past all of Python's streams; a bar has hidden the cursor."""
    try:
        stderr = sys.__stderr__.fileno() if sys.__stderr__ else 2
        shown = "\x1b[?25h" if os.isatty(stderr) else ""
        os.write(stderr, f"{shown}dpc: error: {sentence}\n".encode())
    except (OSError, ValueError):  # closed
        pass


def set_working(working: bool) -> None:
    """Says whether a signal has to unwind a command, which tidies up, or ends the process at once. The second one always does."""
    _watch.working = working


def signal_outcome() -> tuple[int, str] | None:
    """Returns the exit code and what to say when a signal has ended the command, else None."""
    if not _watch.name:
        return None
    code = _CODES[_watch.name]
    stopped = f"stopped by {_watch.name}; run the same command again"
    return code, "interrupted" if code == INTERRUPTED else stopped


def let_end() -> None:
    """Ignores further signals: the work is done, and what it is worth is decided."""
    if _watch.process == os.getpid():
        signal.setitimer(signal.ITIMER_REAL, 0)
        for name in (*_CODES, "SIGALRM"):
            if hasattr(signal, name):
                signal.signal(getattr(signal, name), signal.SIG_IGN)


def _handle(number: int, frame: FrameType | None) -> None:
    if os.getpid() != _watch.process:  # a fork of it, which its parent ends
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        return
    heard()
    first, _watch.name = not _watch.name, signal.Signals(number).name
    if _watch.working and first:
        _unwind(number, frame)
        return
    code, said = signal_outcome() or (STOPPED, "stopped")
    _say(said)
    os._exit(code)


def _unwind(number: int, frame: FrameType | None) -> None:
    """Raises Ended, but not within an import: a library that is half there turns it into anything, an abort even."""
    if not _imports(frame):
        raise Ended
    _again()


def _again() -> None:
    signal.signal(signal.SIGALRM, _unwind)
    signal.setitimer(signal.ITIMER_REAL, _PATIENCE)


def _lost(told: SimpleNamespace) -> None:
    """Raises Ended again where Python drops errors, such as in what runs as an object goes; others only --debug shows."""
    if told.exc_type is Ended:
        _again()
    elif "--debug" in sys.argv:
        sys.__unraisablehook__(told)


def _imports(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False
