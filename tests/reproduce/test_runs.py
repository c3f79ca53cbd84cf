"""Commands of the tables' programs that run beside one another."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from functools import partial

import pytest

from dpcli.reproduce import runs


def test_rows_keep_their_order_and_calls_run_beside_one_another() -> None:
    both = threading.Barrier(2)

    def work(number: int) -> dict:
        both.wait(30)
        return {"number": number}

    found = runs.side_by_side({"a": [partial(work, k) for k in range(3)], "b": [partial(work, 3)]}, 2)
    assert found == {"a": [{"number": k} for k in range(3)], "b": [{"number": 3}]}


def test_after_one_that_fails_no_other_begins() -> None:
    begun = []

    def work(number: int) -> dict:
        begun.append(number)
        if number == 1:
            sys.exit(3)
        return {}

    with pytest.raises(SystemExit, match="3"):
        runs.side_by_side({"row": [partial(work, k) for k in range(9)]}, 1)
    assert begun == [0, 1]


def test_a_signal_reaches_the_commands_of_threads(monkeypatch) -> None:
    """Each sleeps for a minute unless it hears the signal; of those that wait for their turn none begins."""
    begun = []
    monkeypatch.setattr(runs, "_command", [sys.executable, "-c", "import time; print(flush=True); time.sleep(60)"])

    def work(number: int) -> dict:
        begun.append(number)
        runs.dpc()
        return {}

    def stop() -> None:
        while len(runs._running) < 2:
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGTERM)

    started = time.monotonic()
    threading.Thread(target=stop).start()
    with pytest.raises(SystemExit, match="143"):
        runs.side_by_side({"row": [partial(work, k) for k in range(6)]}, 2)
    assert sorted(begun) == [0, 1] and time.monotonic() - started < 30 and not runs._running
