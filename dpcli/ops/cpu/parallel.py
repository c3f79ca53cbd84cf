"""Loading kernel modules that use numba's own threads.

Never call such a kernel before a fork: libgomp then ends the child. Worker processes here come from a forkserver.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType


def parallel_kernels(module: str) -> ModuleType:
    """The kernel module of that full name, its threads set to as many threads as torch uses."""
    import numba
    import torch

    threads = torch.get_num_threads()
    numba.set_num_threads(max(1, min(threads, numba.config.NUMBA_NUM_THREADS)))
    if torch.get_num_threads() != threads:  # starting its own threads, numba gives OpenMP, and so torch, as many
        torch.set_num_threads(threads)
    return import_module(module)
