"""The decorators of the CPU kernels: numba, cached on disk."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numba
from numba.core import event
from numba.core.caching import FunctionCache
from numba.core.sigutils import normalize_signature

from dpcli.runtime.progress import log
from dpcli.runtime.tuning import load_numba_without_blas

load_numba_without_blas()
# Meant for a user's own code: vector instructions have no form in plain Python. Numba reads the variable again at any time.
os.environ.pop("NUMBA_DISABLE_JIT", None)
numba.config.DISABLE_JIT = False

_FOLDER = Path(__file__).parent
_SPLATTING = _FOLDER.parent / "splatting"
_SHARED = (Path(__file__), _FOLDER / "simd.py", _SPLATTING / "cpu_simd.py", _SPLATTING / "cpu_tile_lists.py")
# A digest of what is compiled into kernels of other files, functions and constants: an edit there makes their cached code stale.
SHARED_CODE = hashlib.sha256(b"".join(path.read_bytes() for path in _SHARED)).hexdigest()

# No NaN ever enters (callers check), and a zero's sign never matters: this lets minima vectorize. Nothing that changes
# a value is allowed, neither reassociation nor fused multiply-add: indices must equal the reference's, ties included.
_FLAGS = {"nnan", "nsz"}
_ARITHMETIC = {"contract", "nsz", "arcp", "reassoc"}

_PATIENCE = 1.5  # seconds of compiling before a user is told


class _Announcement(event.Listener):
    """Tells the user, once and only when it takes long, that the process compiles kernels instead of working."""

    def __init__(self) -> None:
        self.kept = True  # until a kernel finds no place on disk
        self._said, self._depth, self._since, self._spent = False, 0, 0.0, 0.0

    def on_start(self, event: event.Event) -> None:
        """Hears that a kernel, or a helper of the one in work, is compiled; numba's lock lets in one thread at a time."""
        now = time.monotonic()
        if self._depth == 0:
            self._since = now
        self._depth += 1
        if not self._said and self._spent + now - self._since >= _PATIENCE:
            self._said = True
            self._say()

    def on_end(self, event: event.Event) -> None:
        """Hears that one is done."""
        self._depth -= 1
        if self._depth == 0:
            self._spent += time.monotonic() - self._since

    def _say(self) -> None:
        worker = multiprocessing.parent_process() is not None
        if worker and not multiprocessing.current_process().name.endswith("-1"):
            return  # all workers compile the same at the same time; the first speaks for them
        if self.kept:
            log.info("compiling fast code for this machine, once; this may take half a minute")
        else:
            log.info(
                "compiling fast code, which may take half a minute, in every run, because no folder could keep it;"
                " NUMBA_CACHE_DIR=FOLDER names one that can"
            )


_announcement = _Announcement()
event.register("numba:compile", _announcement)


class _KernelCache(FunctionCache):
    """Keeps compiled kernels on disk. A full disk, a damaged file or one of another user costs time, never the command."""

    def __init__(self, function: Callable) -> None:
        super().__init__(function)
        file = self._cache_file
        file._source_stamp = (file._source_stamp, SHARED_CODE)  # numba's own stamp is of the kernel's file alone

    def load_overload(self, sig: object, target_context: object) -> object:
        """Returns the compiled kernel, or None where there is none, it can't be read, or it is one for other types.

        Processes that compile one kernel for different types at the same time may each give its file the same name.
        """
        try:
            found = super().load_overload(sig, target_context)
        except Exception:  # a pickle's bytes decide what is raised
            return None
        return found if found is None or found.signature.args == normalize_signature(sig)[0] else None

    def save_overload(self, sig: object, data: object) -> None:
        """Writes the compiled kernel; a second time over an index that can't be read; or not at all."""
        for _ in range(2):
            try:
                return super().save_overload(sig, data)
            except Exception:
                with suppress(Exception):
                    self.flush()
        _announcement.kept = False


def kernel(function: Callable) -> Callable:
    """Compiles a search, whose indices and distances must equal the reference's, on its first call.

    Serial by design: callers spread work over plain threads (`backend.run_in_threads`), which unlike numba's parallel
    mode survives a fork. Where no cache folder is writable the kernel is compiled anew in each process. Helpers belong
    in the file of the kernel that calls them: the cache looks for changes in that file and in those of `_SHARED` only.
    A slice takes single numbers, arrays are copied by a loop: numba's check of shapes is compiled for five seconds.
    """
    return _compiled(function, nogil=True, fastmath=_FLAGS, error_model="numpy")


def inlined(function: Callable) -> Callable:
    """Compiles a helper of a `kernel` whose text goes into the caller: for what is called once a microsecond."""
    return _compiled(function, nogil=True, fastmath=_FLAGS, error_model="numpy", inline="always")


def arithmetic_kernel(function: Callable) -> Callable:
    """Compiles as `kernel`, but infinities and NaN pass through as IEEE 754 has them: for values that were not checked."""
    return _compiled(function, nogil=True, error_model="numpy")


def _compiled(function: Callable, **options: object) -> Callable:
    kernel = numba.njit(**options)(function)
    try:
        kernel._cache = _KernelCache(function)
    except RuntimeError:  # no folder for the cache
        _announcement.kept = False
    return kernel


def parallel_kernel(function: Callable) -> Callable:
    """Compiles floating-point work for numba's own threads: contraction and reordering allowed, results to rounding only.

    Must not run in a process that forks afterwards; `parallel.parallel_kernels` loads modules that use it.
    """
    return _compiled(function, parallel=True, fastmath=_ARITHMETIC, error_model="numpy")


def piece_kernel(function: Callable) -> Callable:
    """Compiles as `parallel_kernel`, but serial and without the GIL: for work that plain threads share among them."""
    return _compiled(function, nogil=True, fastmath=_ARITHMETIC, error_model="numpy")


def inlined_piece(function: Callable) -> Callable:
    """Compiles a helper of other kernels as `piece_kernel`, into each of its callers.

    Called instead, it would be compiled by itself and with each caller, and reordered in two ways: the process that compiles
    runs the one, those that find the caller in the cache the other, whose sums differ in their last bits.
    """
    return _compiled(function, forceinline=True, nogil=True, fastmath=_ARITHMETIC, error_model="numpy")
