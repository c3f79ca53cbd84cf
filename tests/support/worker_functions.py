"""Work for processes of `ordered_map`; these import this module, so that it imports nothing that takes long."""

from __future__ import annotations

import os
import signal
import struct
import sys
import time
from pathlib import Path


def square(x: int) -> int:
    if x == 3:
        raise ValueError("three")
    time.sleep(0.02 * (x % 3))  # later items finish first
    return x * x


def die_at_three(x: int) -> int:
    if x == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return x


def die_writing_at_three(item):
    """Writes the first bytes of a result's length as `multiprocessing` does, and dies; the second time it returns."""
    number, folder = item
    if number == 3 and not any(Path(folder).iterdir()):
        (Path(folder) / "died").touch()
        frame = sys._getframe()
        while "result_queue" not in frame.f_locals:
            frame = frame.f_back
        queue = frame.f_locals["result_queue"]
        queue._wlock.acquire()
        os.write(queue._writer.fileno(), struct.pack("!i", 99_999) + b"half of it")
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die_once_at_three(item: tuple[int, str]) -> int:
    x, folder = item
    if x == 3 and not Path(folder, "died").exists():
        Path(folder, "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return x
