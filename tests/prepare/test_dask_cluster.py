"""Reading on a cluster: the same bytes, whoever reads, and a worker that is lost costs only time."""

from __future__ import annotations

import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from dpcli.errors import UsageError
from dpcli.prepare.pipeline import Conversion, convert
from dpcli.prepare.reader import Item, Sample
from dpcli.runtime.provenance import file_digest
from dpcli.store.writing.item_pass import ItemPass
from tests.support.prepare_helpers import ToyReader, dpc


@dataclass(frozen=True)
class SlowReader(ToyReader):
    """Says which processes read, and takes its time; `deadly` kills whoever reads that item."""

    folder: str = ""
    deadly: int = -1

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        Path(self.folder, f"{os.getpid()}.pid").touch()
        time.sleep(0.05)
        if item.extra["k"] == self.deadly:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().read(item, rng)

    @property
    def config(self) -> dict:
        return {}


def test_any_executor_gives_the_same_bytes_with_few_in_flight(tmp_path, monkeypatch):
    whole = convert(ToyReader(count=20, bad=(3,)), tmp_path / "whole.h5")
    waiting, most = [0], [0]

    class Counting(ThreadPoolExecutor):
        def submit(self, *given, **more):
            waiting[0] += 1
            most[0] = max(most[0], waiting[0])
            return super().submit(*given, **more)

    take = ItemPass._take
    monkeypatch.setattr(ItemPass, "_take", lambda *given: (waiting.__setitem__(0, waiting[0] - 1), take(*given)))
    with Counting(3) as executor:
        report = convert(ToyReader(count=20, bad=(3,)), tmp_path / "a.h5", slots=3, executor=executor)
    assert file_digest(tmp_path / "a.h5") == file_digest(tmp_path / "whole.h5") and report.skipped == whole.skipped
    assert most[0] <= 6


@pytest.fixture(scope="module")
def cluster():
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    from distributed import LocalCluster

    with LocalCluster(2, threads_per_worker=1, dashboard_address=None, silence_logs=50) as made:
        yield made


def test_a_lost_worker_costs_only_time(cluster, tmp_path):
    from dpcli.runtime.machines.dask_cluster import cluster_executor

    reader = SlowReader(count=40, folder=str(tmp_path))
    convert(SlowReader(count=40, folder=str(tmp_path)), tmp_path / "whole.h5")
    own = {str(os.getpid())}
    [path.unlink() for path in tmp_path.glob("*.pid")]
    lost = []

    def kill_one() -> None:
        deadline = time.monotonic() + 90
        while not lost and time.monotonic() < deadline:
            busy = [path.stem for path in tmp_path.glob("*.pid") if path.stem not in own]
            if len(busy) == 2:
                time.sleep(0.2)
                os.kill(int(busy[0]), signal.SIGKILL)
                lost.append(busy[0])
            time.sleep(0.01)

    thread = threading.Thread(target=kill_one)
    thread.start()
    with cluster_executor(cluster.scheduler_address, 2) as (executor, slots):
        assert slots == 2
        report = convert(reader, tmp_path / "a.h5", slots=slots, executor=executor)
    thread.join()
    assert lost and report.written == 40
    assert file_digest(tmp_path / "a.h5") == file_digest(tmp_path / "whole.h5")
    readers = {path.stem for path in tmp_path.glob("*.pid")}
    assert len(readers - own) >= 2 and own.isdisjoint(readers)


def test_a_sample_that_kills_every_worker_is_passed_over_by_name(cluster, tmp_path):
    from dpcli.runtime.machines.dask_cluster import cluster_executor

    reader = SlowReader(count=6, folder=str(tmp_path), deadly=4)
    with cluster_executor(cluster.scheduler_address, 2) as (executor, n):
        report = convert(reader, tmp_path / "a.h5", slots=n, executor=executor)
    ((name, reason),) = report.skipped
    assert report.written == 5 and name == "toy004" and "the process that worked on it died" in reason
    convert(reader, tmp_path / "b.h5", Conversion(jobs=2))
    assert file_digest(tmp_path / "a.h5") == file_digest(tmp_path / "b.h5")


def test_the_command_on_a_local_cluster(tmp_path):
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    words = ("prepare", "synthetic", "gestures", "--frames", "4", "--size", "48", "--videos-per-class", "1")
    done = dpc(*words, "-o", tmp_path / "a.h5", "--dask", "local", "--jobs", "2")
    assert done.returncode == 0 and "2 workers" in done.stderr and "Traceback" not in done.stderr, done.stderr
    assert dpc(*words, "-o", tmp_path / "b.h5", "--jobs", "1").returncode == 0
    assert file_digest(tmp_path / "a.h5") == file_digest(tmp_path / "b.h5")


def test_addresses_that_are_none():
    from dpcli.runtime.machines.dask_cluster import cluster_executor

    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    with pytest.raises(UsageError, match="--dask node1:8786: expected local"), cluster_executor("node1:8786", 2):
        pass
