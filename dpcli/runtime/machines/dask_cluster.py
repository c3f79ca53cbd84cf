"""Work on many machines: Dask distributed as an Executor for `ordered_map`."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from dpcli.counted import counted
from dpcli.errors import DpcError, UsageError
from dpcli.runtime.progress import log

_CONNECT_SECONDS = 30
_TRIES = 3  # an item whose worker is lost is worked on again elsewhere; one that takes more workers down is lost


@contextmanager
def cluster_executor(address: str, jobs: int) -> Iterator[tuple[Executor, int]]:
    """Yields an executor on a Dask cluster and how many items it works on at a time.

    address: `local` starts `jobs` processes on this machine, anything else is a running scheduler, `tcp://host:8786`.
    Its workers need the same dpc and see the files that an item names under the same path; they write nothing. A worker
    that is lost costs only time. DpcError: no answer, or no worker.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
        from distributed.comm import CommClosedError
    except ImportError:
        raise UsageError("--dask needs Dask distributed: pip install 'dpc-toolkit[cluster]'") from None
    if address != "local" and "://" not in address:
        raise UsageError(f"--dask {address}: expected local or a scheduler's address, such as tcp://node1:8786")
    settings = {
        "distributed.scheduler.allowed-failures": _TRIES,
        "distributed.comm.timeouts.connect": f"{_CONNECT_SECONDS}s",
        "distributed.admin.large-graph-warning-threshold": "1GB",
    }
    with dask.config.set(settings):
        cluster = None
        try:
            if address == "local":
                cluster = LocalCluster(jobs, threads_per_worker=1, dashboard_address=None, silence_logs=50)
            with Client(cluster or address, timeout=_CONNECT_SECONDS, set_as_default=False) as client:
                yield client.get_executor(), _slots(client, address)
        except (CommClosedError, TimeoutError, OSError) as error:
            if isinstance(error, OSError) and not isinstance(error, (TimeoutError, ConnectionError)):
                raise
            raise DpcError(
                f"--dask {address}: the scheduler does not answer ({error}); run again to continue"
            ) from None
        finally:
            if cluster is not None:
                cluster.close()


def _slots(client: object, address: str) -> int:
    """Returns the threads of all workers, once there is one."""
    client.wait_for_workers(1, timeout=_CONNECT_SECONDS)  # type: ignore[attr-defined]
    threads = client.nthreads()  # type: ignore[attr-defined]
    slots = sum(threads.values())
    log.info(f"Dask {address}: {counted(len(threads), 'worker')}, {counted(slots, 'item')} at a time")
    return slots
