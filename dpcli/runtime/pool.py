"""Spreading independent items over processes, results in input order, with a bounded number in flight."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing.connection import wait
from typing import Any

from dpcli.errors import DataError, DpcError
from dpcli.runtime import shared_memory as handover
from dpcli.runtime.tuning import fast_transport, keep_freed_memory
from dpcli.runtime.worker_server import SINGLE_THREAD, STOPPING, ensure_server

_MOST = 1024  # processes; with far more, the counters of a pool's queue overflow

_PATIENCE = 10.0  # seconds for the exit code of a process that has ended
_DIED = "a worker process died (killed, or out of memory); run again, perhaps with a smaller --jobs"


def _start_worker() -> None:
    """Leaves it to the parent when to stop: Ctrl-C and stop signals reach the whole process group, workers ignore them."""
    for number in (signal.SIGINT, *STOPPING):
        signal.signal(number, signal.SIG_IGN)
    os.environ.update({name: "1" for name in SINGLE_THREAD})
    threading.Thread(target=_end_with_parent, daemon=True).start()
    keep_freed_memory()  # one item takes what the one before gave back


def _end_with_parent() -> None:
    """Ends this worker when its parent was killed and can't tell it to; it would wait for work for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _new_pool(jobs: int) -> ProcessPoolExecutor:
    ensure_server()
    return ProcessPoolExecutor(min(jobs, _MOST), multiprocessing.get_context("forkserver"), initializer=_start_worker)


def _guarded(function: Callable[[Any], Any], item: Any) -> Any:
    try:
        return function(item)
    except Exception as error:  # an item's failure is a result, so that the caller can skip it
        return error


def ordered_map(
    function: Callable[[Any], Any], items: Iterable[Any], jobs: int, executor: Executor | None = None
) -> Iterator[tuple[Any, Any]]:
    """Yields `(item, function(item) or the exception it raised)` in input order.

    At most `2 * jobs` results exist at a time, so memory doesn't grow with the number of items. `jobs <= 1` without an
    executor runs in this process; else `executor`, or `jobs` processes started by `forkserver` (safe beside threads).
    When a worker dies, the items in hand are done again, each in a process of its own: one that crashes it (by SIGSEGV,
    say) has a DataError for its result, and the others go on. A process that is killed there, too (out of memory), ends
    the iteration with a DpcError, as does a worker of an `executor` that dies.
    """
    if executor is None and jobs <= 1:
        for item in items:
            yield item, _guarded(function, item)
        return
    rest = iter(items)
    while lost := (yield from _in_pool(function, rest, jobs, executor)):
        if executor is not None:
            raise DpcError(_DIED)
        yield from _one_by_one(function, lost)


def _in_pool(
    function: Callable[[Any], Any], items: Iterator[Any], jobs: int, executor: Executor | None
) -> Generator[tuple[Any, Any], None, list[Any]]:
    """Yields as `ordered_map`; returns the items in hand when a worker died, none at the end of all."""
    own = executor is None
    strangers = set(multiprocessing.active_children())
    pool = executor or _new_pool(jobs)
    guarded = partial(_guarded, function)
    work = partial(handover.packed, guarded) if own and handover.POSSIBLE and fast_transport() else guarded
    waiting: deque = deque()

    def first() -> tuple[Any, Any]:
        item, future = waiting[0]
        result = future.result()
        if isinstance(result, handover.Parcel):
            try:
                result = handover.unpacked(result)
            except OSError:  # not allowed here, or that worker is gone: then this finds the pool broken
                result = pool.submit(guarded, item).result()
        waiting.popleft()
        return item, result

    try:
        for item in items:
            waiting.append((item, None))  # first, so that it is in hand when the pool turns out to be broken
            waiting[-1] = (item, pool.submit(work, item))
            if len(waiting) >= 2 * max(jobs, 1):
                yield first()
        while waiting:
            yield first()
        return []
    except BrokenProcessPool:
        # the executor ends the other workers by SIGTERM, which they ignore, and would wait for them for ever
        for child in set(multiprocessing.active_children()) - strangers if own else ():
            child.kill()
        return [item for item, _ in waiting]
    finally:
        for _, future in waiting:
            if future is not None:
                future.cancel()
        if own:
            pool.shutdown(wait=True, cancel_futures=True)


def _one_by_one(function: Callable[[Any], Any], items: list[Any]) -> Iterator[tuple[Any, Any]]:
    """Yields as `ordered_map`, with one item at a time in one other process; one that crashes it has a DataError."""
    pool: ProcessPoolExecutor | None = None
    mine: set[Any] = set()
    try:
        for item in items:
            if pool is None:
                strangers, pool = set(multiprocessing.active_children()), _new_pool(1)
            try:
                future = pool.submit(partial(_guarded, function), item)
                mine = mine or set(multiprocessing.active_children()) - strangers
                result = future.result()
            except BrokenProcessPool:
                result = _crash(mine)
                pool.shutdown()
                pool, mine = None, set()
            yield item, result
    finally:
        if pool is not None:
            pool.shutdown(cancel_futures=True)


def _crash(processes: set[Any]) -> DataError:
    """Returns what to say of an item at which its process ended. DpcError when somebody killed it."""
    codes = [process.exitcode for process in processes if process.join(_PATIENCE) is None]
    code = next((code for code in codes if code), -signal.SIGKILL)
    if code == -signal.SIGKILL:
        raise DpcError(_DIED)
    how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return DataError(f"the process that read it crashed ({how}), though it had this alone to do; its data are damaged")
