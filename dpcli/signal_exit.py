"""Signals that end the program while no command is ready to save anything: one sentence and an exit code, whatever is loading.

Commands that can keep what is done take the stop signals over while they work (`runtime.signals`). This imports nothing
but what Python has loaded anyway, so that it stands before anything else does. Python's handlers run between two lines of
Python: for a library that doesn't come back to them, or crashes, a watchdog process ends this one.
"""

from __future__ import annotations

import os
import signal
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:  # as in typing, whose import would take longer than all of this
    from types import FrameType, SimpleNamespace

STOPPED, INTERRUPTED = 75, 130  # as EX_TEMPFAIL, and as a shell reports SIGINT
_RETRY = 0.05  # seconds until it is looked again whether an import still runs
_AGAIN = 1.0  # seconds until it is looked whether the command is ending or a library dropped what should end it
# seconds after which a first, a second signal that Python didn't acknowledge ends the process
_GRACE, _SECOND_GRACE = (15, 2)
_ACKNOWLEDGED = b"\0"  # no signal's number
_OVERTAKEN = 0.1  # seconds in which the number of a signal that another thread got may come after the answer to it
STOP_NAMES = ("SIGTERM", "SIGUSR1", "SIGUSR2", "SIGHUP")  # sent by batch systems before they kill; by a closed terminal
_CODES = {"SIGINT": INTERRUPTED, **dict.fromkeys(STOP_NAMES, STOPPED)}


class Ended(KeyboardInterrupt):
    """Unwinds a command, raised in it by a signal. Not the plain one, for which Python kills itself by SIGINT as it ends."""


class _State:
    """Holds the name of the signal that came, whether there is work to be ended in order, and whose process this is."""

    name = ""
    working = False
    process = 0
    writing = -1  # end of the pipe to the watchdog
    temporary = ""  # a folder


_state = _State()


def watch_signals() -> None:
    """Makes Ctrl-C and stop signals end this process with a sentence; those that are ignored (nohup) stay so."""
    _state.process, sys.unraisablehook = os.getpid(), _reraise_dropped
    for name in _CODES:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _handle)


def start_watchdog() -> None:
    """Starts a process that kills this one when it doesn't acknowledge a signal, and reports when it crashed; not on Windows."""
    if not hasattr(os, "fork"):
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    os.register_at_fork(after_in_child=lambda: signal.set_wakeup_fd(-1))
    _state.writing = writing
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)  # what C gets at once, also where Python's handlers wait
    try:
        child = os.fork()
    except OSError:  # no more processes are allowed: the command works without
        return
    if child == 0:
        try:
            os.close(writing)
            _run_watchdog(reading, _state.process)
        finally:
            os._exit(0)
    os.close(reading)


def acknowledge_signal() -> None:
    """Tells the watchdog that a signal was received, or that the work is done."""
    if _state.writing >= 0 and _state.process == os.getpid():
        try:
            os.write(_state.writing, _ACKNOWLEDGED)
        except OSError:  # it was killed
            pass


def _run_watchdog(reading: int, process: int) -> None:
    import select
    import time

    for name in _CODES:  # they reach the whole group, and are the other one's to answer
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    for number in (0, 1):  # else a reader of our pipes would wait for the watchdog, too
        os.close(number)
    numbers = {getattr(signal, name): name for name in _CODES}
    pending, grace, acknowledged_at, ended_well = "", None, -1.0, False
    while True:
        ready, _, _ = select.select([reading], [], [], grace)
        if not ready:
            _say(f"stopped by {pending}; a library did not come back from its work; run the same command again")
            os.kill(process, signal.SIGKILL)
            return
        message = os.read(reading, 1)
        if not message:
            break
        if message == _ACKNOWLEDGED:
            pending, grace, acknowledged_at, ended_well = "", None, time.monotonic(), True
        elif message[0] in numbers and time.monotonic() > acknowledged_at + _OVERTAKEN:
            if pending and not shows_impatience(message[0]):
                continue
            grace = _SECOND_GRACE if pending else _GRACE
            pending, ended_well = numbers[message[0]], False
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
    _state.working = working


def signal_outcome() -> tuple[int, str] | None:
    """Returns the exit code and what to say when a signal has ended the command, else None."""
    if not _state.name:
        return None
    code = _CODES[_state.name]
    stopped = f"stopped by {_state.name}; run the same command again"
    return code, "interrupted" if code == INTERRUPTED else stopped


def remove_at_end(folder: str) -> None:
    """Has `end_at_once` remove a temporary folder, as nothing that Python runs at its end is run then."""
    _state.temporary = folder


def end_at_once(code: int) -> None:
    """Ends this process when a signal has unwound its command: no thread or library that the signal found at work is waited for.

    Else does nothing.
    """
    if not _state.name or _state.process != os.getpid():
        return
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):  # nothing reads it any more
            pass
    if _state.temporary:
        import shutil

        shutil.rmtree(_state.temporary, ignore_errors=True)
    acknowledge_signal()
    os._exit(code)


def shows_impatience(number: int) -> bool:
    """Returns whether a signal that follows another one asks to end at once.

    SIGHUP doesn't: where a terminal closes, its shell and the system send one each, and a login that ends adds one to SIGTERM.
    No signal does below torchrun, which passes on what a batch system has sent to every process, and kills after 30 seconds.
    """
    return signal.Signals(number).name != "SIGHUP" and "TORCHELASTIC_RUN_ID" not in os.environ


def let_end() -> None:
    """Ignores further signals: the work is done, and what it is worth is decided."""
    if _state.process == os.getpid():
        signal.setitimer(signal.ITIMER_REAL, 0)
        for name in (*_CODES, "SIGALRM"):
            if hasattr(signal, name):
                signal.signal(getattr(signal, name), signal.SIG_IGN)


def _handle(number: int, frame: FrameType | None) -> None:
    if os.getpid() != _state.process:  # a fork of it, which its parent ends
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        return
    acknowledge_signal()
    if _state.name and not shows_impatience(number):
        return
    first, _state.name = not _state.name, signal.Signals(number).name
    if _state.working and first:
        _unwind(number, frame)
        return
    code, said = signal_outcome() or (STOPPED, "stopped")
    _say(said)
    os._exit(code)


def _unwind(number: int, frame: FrameType | None) -> None:
    """Raises Ended, but not within an import: a library that is half there turns it into anything, an abort even.

    Nor while a pool starts a worker: one that it doesn't know of yet takes the word to end that another one waits for.
    It is raised again where a library's C code caught and dropped it, but not in what tidies up because of it.
    """
    if _is_unwinding():
        _unwind_in(_AGAIN)
    elif _must_be_whole(frame):
        _unwind_in(_RETRY)
    else:
        _unwind_in(_AGAIN)
        raise Ended


def _unwind_in(seconds: float) -> None:
    if not hasattr(signal, "setitimer"):  # Windows
        raise Ended
    signal.signal(signal.SIGALRM, _unwind)
    signal.setitimer(signal.ITIMER_REAL, seconds)


def _is_unwinding() -> bool:
    """Returns whether an exception is being handled that is Ended, or that was raised while Ended was handled."""
    error = sys.exc_info()[1]
    while error is not None and not isinstance(error, Ended):
        error = error.__context__
    return error is not None


def _reraise_dropped(dropped: SimpleNamespace) -> None:
    """Raises Ended again where Python drops errors, such as in what runs as an object goes; others only --debug shows."""
    if dropped.exc_type is Ended:
        _unwind_in(_RETRY)
    elif "--debug" in sys.argv:
        sys.__unraisablehook__(dropped)


def _must_be_whole(frame: FrameType | None) -> bool:
    while frame is not None:
        code = frame.f_code
        if code.co_filename.startswith("<frozen importlib"):
            return True
        if code.co_name == "submit" and "concurrent" in code.co_filename:
            return True
        frame = frame.f_back
    return False
