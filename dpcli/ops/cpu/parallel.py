"""Loading kernel modules that use numba's own threads.

Never call such a kernel before a fork: libgomp then ends the child. Worker processes here come from a forkserver.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from dpcli.runtime.tuning import numba_threads_as_torch


def parallel_kernels(module: str) -> ModuleType:
    """Returns the kernel module of that full name, its threads set to as many threads as torch uses."""
    numba_threads_as_torch()
    return import_module(module)
