"""Spreading independent items over processes, results in input order, with a bounded number in flight."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing.connection import wait
from typing import Any

from dpcli.errors import DpcError
from dpcli.runtime import shared_memory as handover
from dpcli.runtime.tuning import fast_transport, keep_freed_memory
from dpcli.runtime.worker_server import SINGLE_THREAD, STOPPING, ensure_server

_MOST = 1024  # processes; with far more, the counters of a pool's queue overflow


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
    A worker that dies (out of memory, killed) ends the iteration with a DpcError.
    """
    if executor is None and jobs <= 1:
        for item in items:
            yield item, _guarded(function, item)
        return
    own = executor is None
    strangers = set(multiprocessing.active_children())
    pool = executor or _new_pool(jobs)
    guarded = partial(_guarded, function)
    work = partial(handover.packed, guarded) if own and handover.POSSIBLE and fast_transport() else guarded
    waiting: deque = deque()

    def first() -> tuple[Any, Any]:
        done, future = waiting.popleft()
        result = future.result()
        if isinstance(result, handover.Parcel):
            try:
                return done, handover.unpacked(result)
            except OSError:  # not allowed here, or that worker is gone: then this finds the pool broken
                return done, pool.submit(guarded, done).result()
        return done, result

    try:
        for item in items:
            waiting.append((item, pool.submit(work, item)))
            if len(waiting) >= 2 * max(jobs, 1):
                yield first()
        while waiting:
            yield first()
    except BrokenProcessPool:
        # the executor ends the other workers by SIGTERM, which they ignore, and would wait for them for ever
        for child in set(multiprocessing.active_children()) - strangers if own else ():
            child.kill()
        raise DpcError(
            "a worker process died (killed, or out of memory); run again, perhaps with a smaller --jobs"
        ) from None
    finally:
        for _, future in waiting:
            future.cancel()
        if own:
            pool.shutdown(wait=True, cancel_futures=True)
