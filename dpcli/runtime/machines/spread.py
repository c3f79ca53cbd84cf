"""The choice of who works on the items of a command: processes of this machine, a Dask cluster, and which shard of them."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass

from dpcli.runtime.device import cpu_count
from dpcli.runtime.machines.dask_cluster import cluster_executor
from dpcli.runtime.machines.shards import Shard


@dataclass(frozen=True)
class Workers:
    """Holds how many items are worked on at a time, and where: `executor`, or processes of this machine for None.

    apart: even one at a time is worked on in a process of its own, which may die.
    """

    slots: int = 1
    executor: Executor | None = None
    apart: bool = False


@dataclass(frozen=True)
class Spread:
    """Says who works on which items; the bytes of the whole result depend on none of it.

    jobs: processes, None for as many as are worthwhile. shard: only its items, None for all. dask: the address of a cluster's
    scheduler, `local` for a cluster on this machine, "" for processes.
    """

    jobs: int | None = None
    shard: Shard | None = None
    dask: str = ""

    @contextmanager
    def workers(self, jobs: int = 1) -> Iterator[Workers]:
        """Yields the workers; `jobs`: how many processes are worthwhile, where the user gave no number.

        Raises UsageError and DpcError as `cluster_executor`.
        """
        if not self.dask:
            yield Workers(self.jobs or jobs)
            return
        with cluster_executor(self.dask, self.jobs or cpu_count()) as (executor, slots):
            yield Workers(slots, executor)


ALONE = Spread()
