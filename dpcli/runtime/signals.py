"""Stopping politely: SIGTERM, SIGUSR1, SIGUSR2 and SIGHUP set a flag, the running item is finished and saved, exit code 75."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from dpcli.errors import Stopped
from dpcli.signal_exit import STOP_NAMES, acknowledge_signal, shows_impatience


@dataclass
class StopRequest:
    """Tells whether a stop was asked for: `requested` turns True at the first stop signal; `name` says which."""

    requested: bool = False
    name: str = ""

    def check(self, what: str, again: str = "to continue") -> None:
        """Raises Stopped when a stop was asked for; `what` says what is already safe, `again` what for to run once more."""
        if self.requested:
            raise Stopped(f"stopped by {self.name}; {what}; run the same command again {again}")


@contextmanager
def answering(numbers: Iterable[int], handle: Callable[[int], object]) -> Iterator[None]:
    """Has `handle` answer signals for the length of a block, in the main thread. Those that are ignored (nohup) stay so."""

    def answer(number: int, frame: object) -> None:
        acknowledge_signal()
        handle(number)

    previous = {}
    if threading.current_thread() is threading.main_thread():  # elsewhere Python allows no handlers
        heard = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
        previous = {number: signal.signal(number, answer) for number in heard}
    try:
        yield
    finally:
        for number, old in previous.items():
            signal.signal(number, old)


@contextmanager
def stop_requested() -> Iterator[StopRequest]:
    """Installs the handlers for the length of a block. The first signal sets the flag, a second one exits at once (75)."""
    request = StopRequest()

    def handle(number: int) -> None:
        if not request.requested:
            request.requested, request.name = True, signal.Signals(number).name
        elif shows_impatience(number):
            os._exit(Stopped.exit_code)

    with answering([getattr(signal, name) for name in STOP_NAMES if hasattr(signal, name)], handle):
        yield request
