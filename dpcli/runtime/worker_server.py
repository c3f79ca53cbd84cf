"""The server that worker processes are forked from. It imports no library but those that it is told of."""

from __future__ import annotations

import os
import signal
import tempfile
from multiprocessing import forkserver, resource_tracker
from multiprocessing.util import get_temp_dir

from dpcli.signal_exit import STOP_NAMES, remove_at_end
from dpcli.standard_streams import loud_libraries

# One process per core is the parallelism: libraries inside a worker must not start threads of their own.
SINGLE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

_LONGEST = 70  # bytes of TMPDIR: a socket's path has 107 at most, and the folder in it and the socket take 33 of them

STOPPING = [getattr(signal, name) for name in STOP_NAMES if hasattr(signal, name)]


def ensure_server(preload: str = "") -> None:
    """Starts the server unless it runs. Stop signals and Ctrl-C never reach it.

    preload: a module that the server imports, once for all of its workers and while its caller does other things.

    A signal that ended the server would leave its workers running without a parent, and while it imports libraries it
    would print a trace of them.
    """
    before = {name: os.environ.get(name) for name in SINGLE_THREAD}
    os.environ.update({name: "1" for name in SINGLE_THREAD})  # read by libraries as the server imports them
    # blocked, not ignored: one that comes now is this process's, a moment later
    let_through = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, *STOPPING])
    try:
        resource_tracker.ensure_running()  # the server's start would start it; it lets some signals through
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, *STOPPING])
        remove_at_end(choose_socket_folder())  # Python removes it only where it ends in its own way
        with loud_libraries():  # each worker decides for itself
            forkserver.set_forkserver_preload([preload] if preload else [])
            forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, let_through)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def choose_socket_folder() -> str:
    """Returns the folder of the sockets of this process and of its workers: in TMPDIR or, where that path is too long, in /tmp."""
    place = tempfile.gettempdir()
    try:
        tempfile.tempdir = place if len(os.fsencode(place)) <= _LONGEST else "/tmp"
        return get_temp_dir()
    finally:
        tempfile.tempdir = place
