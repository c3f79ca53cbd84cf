"""The processes that share one training run, as torchrun starts them; a run without torchrun is one process."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist

from dpcli.errors import DpcError, UsageError, first_line
from dpcli.runtime.progress import log

_LOST = ("Connection closed", "Connection reset", "Broken pipe", "peer", "NCCL", "Timed out", "timed out")


@dataclass(frozen=True)
class Processes:
    """Tells this process's number among `count`; only the first one writes files and messages."""

    rank: int = 0
    count: int = 1
    local_rank: int = 0  # among those of this machine: which GPU is whose

    @property
    def first(self) -> bool:
        """Tells whether this is the process that writes files and messages."""
        return self.rank == 0

    def place(self, device: torch.device) -> torch.device:
        """Returns the device of this process: each has its own GPU."""
        return torch.device("cuda", self.local_rank) if device.type == "cuda" and self.count > 1 else device

    def sums(self, values: Sequence[float], device: torch.device) -> list[float]:
        """Returns element-wise sums over all processes (collective: every process must call it)."""
        if self.count == 1:
            return list(values)
        # gloo sums float64; so does nccl, on the GPU
        totals = torch.tensor(values, dtype=torch.float64, device=device)
        dist.all_reduce(totals)
        return totals.tolist()

    def wait(self) -> None:
        """Waits until every process has come here."""
        if self.count > 1:
            dist.barrier()


def from_environment() -> Processes:
    """Returns what torchrun says in RANK, WORLD_SIZE and LOCAL_RANK. Raises UsageError when they are no numbers."""
    try:
        named = {"rank": "RANK", "count": "WORLD_SIZE", "local_rank": "LOCAL_RANK"}
        return Processes(**{key: int(os.environ[name]) for key, name in named.items() if name in os.environ})
    except ValueError:
        raise UsageError("RANK, WORLD_SIZE or LOCAL_RANK is not a number; start with torchrun, or unset them") from None


def refuse_several(command: str) -> None:
    """Raises UsageError where torchrun started several processes of a command that trains in one."""
    count = from_environment().count
    if count > 1:
        raise UsageError(f"{command} trains in one process, but torchrun started {count}; run it without torchrun")


@contextmanager
def process_group(device: torch.device) -> Iterator[Processes]:
    """Joins the other processes for the length of a block: NCCL between GPUs, gloo between CPUs."""
    processes = from_environment()
    if processes.count == 1:
        yield processes
        return
    if not processes.first:
        log.level = 0
    if device.type == "cuda":
        torch.cuda.set_device(processes.local_rank)
    kind = "nccl" if device.type == "cuda" else "gloo"
    try:
        dist.init_process_group(kind)
    except (RuntimeError, ValueError) as error:
        raise DpcError(
            f"process {processes.rank} of {processes.count} could not reach the others: {first_line(error)};"
            f" start them with torchrun, and name the network to use in {kind.upper()}_SOCKET_IFNAME if there are several"
        ) from None
    try:
        yield processes
    except RuntimeError as error:
        if not any(word in str(error) for word in _LOST):
            raise
        raise DpcError(
            f"process {processes.rank} of {processes.count} lost the others ({first_line(error)});"
            " run again to continue from the last epoch that was saved"
        ) from None
    finally:
        dist.destroy_process_group()
