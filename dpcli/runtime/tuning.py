"""Everything that is done to the process as a whole to make it faster: environment, allocator, BLAS, thread counts."""

from __future__ import annotations

import ctypes
import functools
import importlib
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # glibc's mallopt parameters
_SIDE = 256  # of the product that is tried
_CLOSE = 1e-5  # relative error of float32 sums of that length; of bfloat16 it is 2.4e-3
_SCIPY_BLAS = "scipy.linalg.cython_blas"


def tune_environment() -> None:
    """Sets what torch and numba read as they load, where the user has not: call it before either is imported.

    Threads that wait by spinning keep the other library's threads off the cores: waiting passively, a static step of
    `classify train --preset quick` (8 clips) took 0.62 s instead of 1.5 s, best of 24 on two cores that others used, too.
    A large tensor in pages of 4 kB takes longer to get from the system than to fill: large pages made static training of
    large clips 1.5 times as fast (docs/experiments/speed.md); twelve small clips gain nothing by them.

    Numba doesn't import where it is given no thread, by which people mean as many as there are CPUs.
    """
    if re.fullmatch(r"\s*(-\d+|0+)\s*", os.environ.get("NUMBA_NUM_THREADS", "")):
        del os.environ["NUMBA_NUM_THREADS"]
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")


def keep_freed_memory() -> None:
    """Lets the C library keep freed blocks for the next training step instead of returning them to the system.

    A step frees and takes the same hundreds of megabytes again; without this every page is faulted in and zeroed again.
    A static step of twelve clips took 1.04 times the processor time without it (DGCNN quick 1.00, PointNet++ thesis 1.05).
    Does nothing where the C library is not glibc.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(_MMAP_THRESHOLD, 1 << 30)
        libc.mallopt(_TRIM_THRESHOLD, (1 << 31) - 1)
    except (OSError, AttributeError):
        pass


def fast_transport() -> bool:
    """Returns whether large arrays take the fast ways: DPC_TRANSPORT=plain in the environment says no.

    The fast ways are whole chunks written past HDF5's cache, a journal that points to them (`store.writing`), and arrays of
    worker processes handed over in shared memory (`runtime.shared_memory`). The plain ones, for odd file systems and to
    compare with, leave the same bytes. `dpc prepare msraction3d --jobs 2` took 41 to 53 s the fast way, 49 to 61 s the
    plain one (three runs each in turn, a busy machine); writing 144 MB alone 0.26 s and 0.84 s.
    """
    return os.environ.get("DPC_TRANSPORT", "") != "plain"


@functools.cache
def choose_products() -> bool:
    """Lets oneDNN multiply float32 matrices where that is faster than torch's choice, as exactly; True where it does.

    torch asks MKL, which on AMD's processors uses half of the vector width (AVX2), where oneDNN uses all of it
    (AVX-512): 2.3 times as fast on Zen 5; Zen 4, whose units are half as wide, should gain little. torch's only way
    to oneDNN is its leave to round factors to bfloat16, which oneDNN makes use of where the processor has AMX. So a
    product is tried, and where its error isn't that of float32, MKL stays. The setting is the whole process's, and
    would concern a GPU, too: where there is one, nothing is changed. On a virtual AMD EPYC with AVX-512 a static step takes
    1.04 to 1.09 times the processor time without it.
    """
    import torch

    if torch.cuda.is_available() or not _wide_amd():
        return False
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    if _error() < _CLOSE:
        return True
    torch.set_float32_matmul_precision(before)
    return False


def _wide_amd() -> bool:
    import torch

    try:
        amd = "AuthenticAMD" in Path("/proc/cpuinfo").read_text().partition("flags")[0]
    except OSError:  # not Linux
        return False
    return amd and torch.backends.cpu.get_cpu_capability() == "AVX512"


def _error() -> float:
    """Returns the relative error of a product of float32 matrices, as this process computes it."""
    import torch

    left, right = torch.randn(2, _SIDE, _SIDE, generator=torch.Generator().manual_seed(0))
    exact = left.double() @ right.double()
    return float(((left @ right) - exact).norm() / exact.norm())


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Gives torch `count` threads for the length of a block, and as many as before at its end.

    One thread for many small operations: two gain nothing by them, and wait for one another on a busy machine.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def numba_threads_as_torch() -> None:
    """Gives numba's own threads the number that torch uses, and torch its number back, which numba changes with its own.

    Where NUMBA_THREADING_LAYER asks for threads of a library that isn't there, as TBB's, numba chooses others.
    """
    import numba
    import torch

    threads = torch.get_num_threads()
    count = max(1, min(threads, numba.config.NUMBA_NUM_THREADS))
    try:
        numba.set_num_threads(count)
    except ValueError:
        os.environ.pop("NUMBA_THREADING_LAYER", None)
        numba.config.THREADING_LAYER = "default"
        numba.set_num_threads(count)
    if torch.get_num_threads() != threads:  # starting its own threads, numba gives OpenMP, and so torch, as many
        torch.set_num_threads(threads)


def load_numba_without_blas() -> None:
    """Imports numba's array functions, as its first kernel would, without their look for scipy's BLAS.

    What needs it looks again (np.dot), but for numba's np.cov and np.corrcoef, which no kernel here uses. A process that
    only samples farthest points, as the workers of `dpc prepare --sampling fps`, then has its first kernel after 3.1 s
    instead of 4.1 s (best of three, a busy machine).
    """
    if _SCIPY_BLAS in sys.modules or "numba.np.arraymath" in sys.modules:
        return
    sys.modules[_SCIPY_BLAS] = None  # type: ignore[assignment]  # an import of it fails at once
    try:
        importlib.import_module("numba.np.arraymath")
    finally:
        del sys.modules[_SCIPY_BLAS]
