"""Stopping politely: SIGTERM, SIGUSR1 and SIGUSR2 set a flag, the running item is finished and saved, exit code 75."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from dpcli.errors import Stopped
from dpcli.signal_exit import acknowledge_signal

_NAMES = ("SIGTERM", "SIGUSR1", "SIGUSR2")  # batch systems send one of these before they kill


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
def stop_requested() -> Iterator[StopRequest]:
    """Installs the handlers for the length of a block. The first signal sets the flag, a second one exits at once (75)."""
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return

    def handle(number: int, frame: object) -> None:
        acknowledge_signal()
        if request.requested:
            os._exit(Stopped.exit_code)
        request.requested, request.name = True, signal.Signals(number).name

    numbers = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
    previous = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield request
    finally:
        for number, old in previous.items():
            signal.signal(number, old)
