"""Signals that end the program while no command is ready to save anything: one sentence and an exit code, whatever is loading.

Commands that can keep what is done take the stop signals over while they work (`runtime.signals`). This imports nothing
but what Python has loaded anyway, so that it stands before anything else does.
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
_CODES = {"SIGINT": INTERRUPTED, "SIGTERM": STOPPED, "SIGUSR1": STOPPED, "SIGUSR2": STOPPED}


class Ended(KeyboardInterrupt):
    """Unwinds a command, raised in it by a signal. Not the plain one, for which Python kills itself by SIGINT as it ends."""


class _Watch:
    """Holds the name of the signal that came, whether there is work to be ended in order, and whose process this is."""

    name = ""
    working = False
    process = 0


_watch = _Watch()


def watch_signals() -> None:
    """Makes Ctrl-C and stop signals end this process with a sentence; those that are ignored (nohup) stay so."""
    _watch.process, sys.unraisablehook = os.getpid(), _lost
    for name in _CODES:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _handle)


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
    first, _watch.name = not _watch.name, signal.Signals(number).name
    if _watch.working and first:
        _unwind(number, frame)
        return
    code, said = signal_outcome() or (STOPPED, "stopped")
    try:
        stderr = sys.__stderr__.fileno() if sys.__stderr__ else 2
        shown = "\x1b[?25h" if os.isatty(stderr) else ""  # a bar hides the cursor
        os.write(stderr, f"{shown}dpc: error: {said}\n".encode())
    except (OSError, ValueError):  # closed
        pass
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
