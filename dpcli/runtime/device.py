"""Choosing the device and the number of threads."""

from __future__ import annotations

import os
import sys

from dpcli.counted import counted
from dpcli.errors import UsageError
from dpcli.runtime.tuning import choose_products


def cpu_count() -> int:
    """Counts the CPUs this process may use: the affinity mask, narrowed by SLURM_CPUS_PER_TASK when a batch system sets it."""
    try:
        cpus = len(os.sched_getaffinity(0))
    except AttributeError:  # not Linux
        cpus = os.cpu_count() or 1
    granted = os.environ.get("SLURM_CPUS_PER_TASK", "")
    return min(cpus, int(granted)) if granted.isdigit() and int(granted) > 0 else cpus


def choose_device(name: str = "auto"):
    """Turns `auto | cpu | cuda | cuda:n` into a torch.device; UsageError for any other, and when a CUDA device is asked for and absent.

    For a CPU it also chooses the library that multiplies matrices (`tuning.choose_products`).
    """
    import torch

    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    if device is None or device.type not in ("cpu", "cuda"):  # torch knows more, of which none was tried
        raise UsageError(f"--device {name}: unknown device; use auto, cpu, cuda or cuda:N")
    visible = torch.cuda.device_count() if device.type == "cuda" else 0
    if device.type == "cuda" and (not torch.cuda.is_available() or (device.index or 0) >= visible):
        one = "--device cuda or cpu" if torch.cuda.is_available() else "--device cpu"
        raise UsageError(f"--device {name}: {counted(visible, 'CUDA device')} visible; use {one}")
    if device.type == "cpu":
        choose_products()
    return device


def peak_memory() -> int:
    """Returns the peak resident memory of this process so far, in bytes."""
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
