"""Spreading independent items over processes, results in input order, with a bounded number in flight."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import forkserver
from multiprocessing.connection import wait
from typing import Any

from dpcli.errors import DpcError
from dpcli.runtime import handover
from dpcli.runtime.memory import keep_freed_memory

# One process per core is the parallelism: libraries inside a worker must not start threads of their own.
_SINGLE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


_STOPPING = [getattr(signal, name) for name in ("SIGTERM", "SIGUSR1", "SIGUSR2") if hasattr(signal, name)]


def _start_worker() -> None:
    """The parent decides when to stop: Ctrl-C and stop signals reach the whole process group, workers ignore them."""
    for number in (signal.SIGINT, *_STOPPING):
        signal.signal(number, signal.SIG_IGN)
    os.environ.update({name: "1" for name in _SINGLE_THREAD})
    threading.Thread(target=_end_with_parent, daemon=True).start()
    keep_freed_memory()  # one item takes what the one before gave back


def _end_with_parent() -> None:
    """A killed parent can't tell its workers to end, and they would wait for work for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def start_early(modules: Sequence[str]) -> None:
    """Start the server that worker processes are forked from, with `modules` imported: once for all, while this goes on.

    For what every worker needs and what takes long to import; a module that fails to import is left to the workers.
    Without effect where the server runs already. The modules must start no threads: a fork would lose them.
    """
    multiprocessing.get_context("forkserver").set_forkserver_preload(list(modules))
    _ensure_server()


def _ensure_server() -> None:
    """The server ignores stop signals: if one killed it, its workers would be left behind for ever."""
    before = {name: os.environ.get(name) for name in _SINGLE_THREAD}
    os.environ.update({name: "1" for name in _SINGLE_THREAD})  # read by libraries as the server imports them
    main = threading.current_thread() is threading.main_thread()
    previous = [signal.signal(number, signal.SIG_IGN) for number in _STOPPING] if main else []
    try:
        forkserver.ensure_running()
    finally:
        for number, handler in zip(_STOPPING, previous):
            signal.signal(number, handler)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _new_pool(jobs: int) -> ProcessPoolExecutor:
    _ensure_server()
    return ProcessPoolExecutor(jobs, multiprocessing.get_context("forkserver"), initializer=_start_worker)


def _guarded(function: Callable[[Any], Any], item: Any) -> Any:
    try:
        return function(item)
    except Exception as error:  # an item's failure is a result, so that the caller can skip it
        return error


def ordered_map(
    function: Callable[[Any], Any], items: Iterable[Any], jobs: int, executor: Executor | None = None
) -> Iterator[tuple[Any, Any]]:
    """Yield `(item, function(item) or the exception it raised)` in input order.

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
    work = partial(handover.packed, guarded) if own and handover.POSSIBLE else guarded
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
