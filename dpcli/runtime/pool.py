"""Spreading independent items over processes, results in input order, with a bounded number in flight."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures import TimeoutError as NotYet  # its own class before Python 3.11
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import wait
from multiprocessing.context import ForkServerContext, ForkServerProcess
from typing import Any

from dpcli.errors import DataError, DpcError
from dpcli.regular_files import regular_files_only
from dpcli.runtime import shared_memory as handover
from dpcli.runtime.progress import log
from dpcli.runtime.tuning import fast_transport, keep_freed_memory
from dpcli.runtime.worker_server import SINGLE_THREAD, STOPPING, ensure_server
from dpcli.standard_streams import quiet_libraries

_LOOK = 1.0  # seconds between looks whether a process died while it wrote a result
_MOST = 1024  # processes; with far more, the counters of a pool's queue overflow


_worker = threading.local()  # `apart` where this process is a worker, which may be ended


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Ends this process, a worker of `ordered_map`, when the block takes more seconds of its processor; elsewhere does nothing.

    So a C library that loops forever costs one item. Time that others take on a busy machine does not count.
    """
    if not getattr(_worker, "apart", False) or not hasattr(signal, "setitimer"):
        yield
        return
    signal.setitimer(signal.ITIMER_PROF, seconds)  # what SIGPROF does by default needs no help of Python's
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _start_worker(debug: bool, level: int) -> None:
    """Leaves it to the parent when to stop: Ctrl-C and stop signals reach the whole process group, workers ignore them."""
    _worker.apart, log.level = True, level
    if not debug:
        quiet_libraries()
    os.dup2(2, 1)  # nothing that a library prints is a result
    for number in (signal.SIGINT, *STOPPING):
        signal.signal(number, signal.SIG_IGN)
    os.environ.update({name: "1" for name in SINGLE_THREAD})
    threading.Thread(target=_end_with_parent, daemon=True).start()
    keep_freed_memory()  # one item takes what the one before gave back


def _end_with_parent() -> None:
    """Ends this worker when its parent was killed and can't tell it to; it would wait for work forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


class Worker(ForkServerProcess):
    """Ends when its executor says so, although it ignores SIGTERM, which a batch system sends to all processes."""

    def terminate(self) -> None:
        """Ends the process. From Python 3.12 on a broken executor holds a lock until its processes ended."""
        self.kill()


class _Workers(ForkServerContext):
    Process = Worker


def _new_pool(jobs: int, without: str) -> ProcessPoolExecutor:
    """Raises DpcError where the machine has no place for what processes share, as some containers without /dev/shm.

    without: the options that do without processes.
    """
    ensure_server()
    try:
        return ProcessPoolExecutor(min(jobs, _MOST), _Workers(), _start_worker, (log.debug, log.level))
    except ConnectionError as error:
        raise _no_server(error, without) from None
    except (OSError, ImportError) as error:
        said = error.strerror if isinstance(error, OSError) else error
        raise DpcError(
            f"processes can't share locks on this machine, which needs /dev/shm for them ({said}); {without} needs none"
        ) from None


def _submitted(executor: Executor, without: str, work: Callable[[Any], Any], *item: Any) -> Future:
    """Raises DpcError where the server that starts processes has ended. without: as `_new_pool`; "" for a caller's executor."""
    try:
        return executor.submit(work, *item)
    except (ConnectionError, EOFError) as error:
        if not without:
            raise
        raise _no_server(error, without) from None


def _no_server(error: ConnectionError | EOFError, without: str) -> DpcError:
    said = getattr(error, "strerror", None) or "it ended without a word"
    return DpcError(f"the server that starts worker processes can't run on this machine ({said}); {without} needs none")


def _guarded(function: Callable[[Any], Any], item: Any) -> Any:
    try:
        with regular_files_only():  # in whatever process: a FIFO would hold it forever
            return function(item)
    except Exception as error:  # an item's failure is a result, so that the caller can skip it
        return error


class LostWorker(DataError):
    """The process that worked on an item died, and so did the one that tried it again: the item is passed over."""


def _was_lost(error: Exception) -> bool:
    """Returns whether an executor says that the worker of an item died; Dask's class is recognized by its name, as Dask may be absent."""
    return isinstance(error, BrokenProcessPool) or type(error).__name__ == "KilledWorker"


class _Pool:
    """Holds processes of this machine, or an executor of the caller's, and replaces processes that died."""

    def __init__(self, function: Callable[[Any], Any], jobs: int, executor: Executor | None, apart: bool) -> None:
        self._guarded = partial(_guarded, function)
        packed = executor is None and handover.POSSIBLE and fast_transport()
        self._work = partial(handover.packed, self._guarded) if packed else self._guarded
        self._jobs, self._given = jobs, executor
        self._without = "" if executor else "--jobs 1 --item-seconds 0" if apart else "--jobs 1"
        self._open()

    def _open(self) -> None:
        self._strangers = set(multiprocessing.active_children())
        self._executor = self._given or _new_pool(self._jobs, self._without)
        self._children: set = set()

    def submit(self, item: Any) -> Future:
        """Has an item worked on, by new processes where the old ones broke."""
        try:
            future = _submitted(self._executor, self._without, self._work, item)
        except BrokenProcessPool:
            self._end_broken()
            self._open()
            future = _submitted(self._executor, self._without, self._work, item)
        # now: later it forgets those that ended
        self._children |= set(multiprocessing.active_children()) - self._strangers
        return future

    def result(self, item: Any, future: Future) -> Any:
        """Returns an item's result, or LostWorker as one. What was on its way as a process died is tried again, alone, as
        it is unknown which item took it down."""
        try:
            return self._unpacked(item, _awaited(future, self._given or self._executor, self._children))
        except Exception as error:
            if not _was_lost(error):
                raise
        return self._try_alone(item) if self._given is None else _lost()

    def _unpacked(self, item: Any, result: Any) -> Any:
        if not isinstance(result, handover.Parcel):
            return result
        try:
            return handover.unpacked(result)
        except OSError:  # not allowed here, or that worker is gone
            return self._try_alone(item)

    def _try_alone(self, item: Any) -> Any:
        alone, children = _new_pool(1, self._without), []
        try:
            tried = _submitted(alone, self._without, self._guarded, item)
            children = list(alone._processes.values())  # type: ignore[attr-defined]  # the public way asks how they ended
            return _awaited(tried, alone, set(children))
        except BrokenProcessPool:
            _end(children)
            alone.shutdown()  # waits for its thread, which asks how they ended: of two that ask, the second learns nothing
            return _lost(_signal_of(children))
        finally:
            alone.shutdown()

    def _end_broken(self) -> None:
        _end(set(multiprocessing.active_children()) - self._strangers)
        self._executor.shutdown(wait=True, cancel_futures=True)

    def close(self) -> None:
        """Ends the processes; an executor of the caller's stays."""
        if self._given is None:
            try:
                # the one public way to learn that processes died since the last item
                _submitted(self._executor, self._without, int)
            except BrokenProcessPool:
                _end(set(multiprocessing.active_children()) - self._strangers)
            self._executor.shutdown(wait=True, cancel_futures=True)


def _awaited(future: Future, executor: Executor, children: set) -> Any:
    """Returns a future's result; ends a pool whose process died while it wrote a result, so that the future breaks.

    The thread of such a pool reads on, and would wait for the rest forever: `executor` itself has the pipe open, too.
    """
    dead_before = False
    while True:
        try:
            return future.result(_LOOK if children else None)
        except NotYet:
            dead = bool(wait([child.sentinel for child in children], 0))  # doesn't ask how one ended
            if dead and dead_before and not future.done():
                _end(children)
                executor._result_queue._writer.close()  # type: ignore[attr-defined]  # nothing public ends that thread
                children = set()
            dead_before = dead


def _end(children: Iterable) -> None:
    """Ends the processes of a broken executor, which sends them SIGTERM, which they ignore, and would wait for them forever."""
    for child in children:
        child.kill()


def _signal_of(children: list) -> str:
    """Returns the name of the signal that ended one of some processes, "" where none did or it is unknown."""
    codes = [child.exitcode for child in children]
    return next((signal.Signals(-code).name for code in codes if code and code < 0), "")


def _lost(how: str = "") -> LostWorker:
    if how == "SIGPROF":
        return LostWorker("it took more of the processor's time than --item-seconds allows, a second time too")
    why = f"by {how}" if how else "killed, or out of memory"
    return LostWorker(f"the process that worked on it died ({why}), and so did the one that tried it again")


def on_second(work: Callable[[Any], Any], pair: tuple[Any, Any]) -> Any:
    """Returns ``work`` of a pair's second: for items that travel with their number. A worker loads this module anyway."""
    return work(pair[1])


def ordered_map(
    function: Callable[[Any], Any],
    items: Iterable[Any],
    jobs: int,
    executor: Executor | None = None,
    apart: bool = False,
) -> Iterator[tuple[Any, Any]]:
    """Yields `(item, function(item) or the exception it raised)` in input order.

    At most `2 * jobs` results exist at a time, so memory doesn't grow with the number of items. `jobs <= 1` without an
    executor runs in this process unless `apart`, for what may take its process down; else `executor`, or `jobs` processes
    started by `forkserver` (safe beside threads).
    A worker that dies (out of memory, killed) costs time: what was on its way is worked on again. An item that takes
    down a second one has LostWorker for its result.
    """
    if executor is None and jobs <= 1 and not apart:
        for item in items:
            yield item, _guarded(function, item)
        return
    pool, waiting = _Pool(function, max(jobs, 1), executor, apart), deque()
    try:
        for item in items:
            waiting.append((item, pool.submit(item)))
            if len(waiting) >= 2 * max(jobs, 1):
                done, future = waiting.popleft()
                yield done, pool.result(done, future)
        while waiting:
            done, future = waiting.popleft()
            yield done, pool.result(done, future)
    finally:
        for _, future in waiting:
            future.cancel()
        pool.close()
