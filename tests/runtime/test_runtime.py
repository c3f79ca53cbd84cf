"""Signals, processes, progress, provenance, devices."""

from __future__ import annotations

import errno
import io
import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from dpcli.errors import DataError, DpcError, Stopped, UsageError
from dpcli.runtime import device, pool, progress, provenance
from dpcli.runtime.pool import LostWorker, ordered_map
from dpcli.runtime.seeds import generator
from dpcli.runtime.signals import stop_requested
from dpcli.runtime.weights import load_weights, save_weights
from tests.support.worker_functions import die_at_three, die_once_at_three, die_writing_at_three, square


@pytest.mark.parametrize(("apart", "works"), [(False, "--jobs 1"), (True, "--jobs 1 --item-seconds 0")])
def test_a_machine_whose_processes_share_nothing_is_told_what_works(apart, works, monkeypatch):
    """What was run with --jobs 1 and has a limit on an item's time needs a process all the same."""

    def no_place(*_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(pool, "ProcessPoolExecutor", no_place)
    with pytest.raises(DpcError, match=rf"/dev/shm for them \(Read-only file system\); {works} needs none"):
        next(ordered_map(square, range(2), 1 if apart else 2, apart=apart))


@pytest.mark.parametrize("jobs", [1, 3])
def test_results_come_in_order_and_failures_as_results(jobs):
    rows = list(ordered_map(square, range(8), jobs))
    assert [item for item, _ in rows] == list(range(8))
    assert isinstance(rows[3][1], ValueError) and [r for i, r in rows if i != 3] == [i * i for i in range(8) if i != 3]


def test_more_jobs_than_a_pool_can_count_are_no_error():
    assert [done for _, done in ordered_map(square, [1, 2], 10**12)] == [1, 4]


def test_any_executor_serves_and_few_items_are_in_flight():
    taken = []

    def items():
        for i in range(50):
            taken.append(i)
            yield i

    with ThreadPoolExecutor(2) as executor:
        rows = ordered_map(square, items(), 2, executor)
        next(rows)
        assert len(taken) <= 4
        assert len(list(rows)) == 49


def test_an_item_that_kills_whoever_works_on_it_costs_itself_alone():
    rows = dict(ordered_map(die_at_three, range(9), 2))
    assert isinstance(rows.pop(3), LostWorker) and rows == {x: x for x in range(9) if x != 3}


def test_a_worker_that_is_killed_once_costs_nothing(tmp_path):
    items = [(x, str(tmp_path)) for x in range(9)]
    assert [done for _, done in ordered_map(die_once_at_three, items, 2)] == list(range(9))
    assert list(tmp_path.iterdir())


def test_a_worker_that_is_killed_while_it_writes_a_result_costs_nothing(tmp_path):
    """Its pool waits for the rest of the result, and other workers for their turn to write."""
    items = [(x, str(tmp_path)) for x in range(5)]
    assert [done for _, done in ordered_map(die_writing_at_three, items, 2)] == list(range(5))
    assert list(tmp_path.iterdir())


def test_a_stop_signal_sets_the_flag_and_old_handlers_return():
    before = signal.getsignal(signal.SIGTERM)
    with stop_requested() as stop:
        stop.check("nothing")
        os.kill(os.getpid(), signal.SIGUSR1)
        assert stop.requested and stop.name == "SIGUSR1"
        with pytest.raises(Stopped, match="3 items are kept"):
            stop.check("3 items are kept")
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_second_signal_exits_at_once():
    code = """
import time
from dpcli.runtime.signals import stop_requested
with stop_requested() as stop:
    print("ready", flush=True)
    while not stop.requested:
        time.sleep(0.01)
    print("stopped", flush=True)
    time.sleep(60)
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    for _ in range(2):
        process.stdout.readline()
        process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=60) == 75


def test_a_batch_log_gets_plain_lines(monkeypatch):
    monkeypatch.setattr(progress, "_PLAIN_INTERVAL", 0.0)
    stream = io.StringIO()
    with progress.Progress("prepare x", 4, "video", stream) as bar:
        bar.skip(2)
        bar.advance(1, frames=10)
        bar.advance(1, frames=10)
    lines = stream.getvalue().splitlines()
    assert lines[0].startswith("dpc: prepare x 3/4 75% ") and "eta" in lines[0] and "frames/s" in lines[0]
    assert (
        lines[-1].startswith("dpc: prepare x 4/4 100% ") and "eta" not in lines[-1] and "\x1b" not in stream.getvalue()
    )


def test_a_log_s_last_line_is_not_there_twice_and_slow_rates_are_no_zeros(monkeypatch):
    monkeypatch.setattr(progress, "_PLAIN_INTERVAL", 0.0)
    stream = io.StringIO()
    with progress.Progress("predict", 1, "sequence", stream) as bar:
        bar.started -= 10
        bar.advance(1, frames=4)
    assert stream.getvalue().splitlines() == ["dpc: predict 1/1 100% 0.1 sequence/s 0.4 frames/s"]


def test_durations():
    assert [progress.duration(s) for s in (5.9, 75, 3725)] == ["5s", "1m15s", "1h02m"]


def test_weights_are_written_by_one_name_and_what_hinders_that_is_said(tmp_path, monkeypatch):
    """A folder that was removed meanwhile; a kill in the middle, after which the next run tidies up."""
    tensors, header = {"a": torch.arange(6.0).reshape(2, 3)}, {"format": "toy"}
    with pytest.raises(DataError, match=r"gone/w.safetensors: the folder .*gone does not exist; create it first"):
        save_weights(tmp_path / "gone" / "w.safetensors", tensors, header)

    def killed(part, path):
        names.extend(os.listdir(tmp_path))
        raise KeyboardInterrupt

    names: list[str] = []
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("dpcli.runtime.whole_file.put_in_place", killed)
        save_weights(tmp_path / "w.safetensors", tensors, header)
    assert len(names) == 1 and names[0].startswith(".w.safetensors.") and not os.listdir(tmp_path)
    save_weights(tmp_path / "w.safetensors", tensors, header)
    loaded, said = load_weights(tmp_path / "w.safetensors", "toy", "nobody")
    assert torch.equal(loaded["a"], tensors["a"]) and said["format"] == "toy"


def test_equal_weights_are_equal_bytes(tmp_path):
    """A file's digest tells whether a network is another one, however often it was written."""
    tensors = {"b": torch.arange(6.0).view(2, 3), "a": torch.ones(3, dtype=torch.float16)}
    header = {"format": "f", "notes": json.dumps({"of": "gl\u00e4\n"}), "maker": "m", "config": "{}", "more": "\u001b"}
    found = set()
    for _ in range(12):  # the library's own order is another one nearly each time
        save_weights(tmp_path / "w.safetensors", tensors, header)
        found.add((tmp_path / "w.safetensors").read_bytes())
    assert len(found) == 1
    loaded, told = load_weights(tmp_path / "w.safetensors", "f", "m")
    assert header.items() <= told.items() and all(torch.equal(loaded[key], value) for key, value in tensors.items())


def test_the_recorded_command_leaves_out_what_doesn_t_change_the_result():
    words = ["prepare", "depth", "my video", "-o", "x.h5", "--jobs", "4", "--seed", "0", "-q", "--output=y", "--force"]
    assert provenance.command_line(words) == "dpc prepare depth 'my video' --seed 0"
    joined = ["-qv", "prepare", "depth", "-oa.h5", "--output=b.h5", "--scale", "-1"]
    assert provenance.command_line(joined) == "dpc prepare depth --scale -1"


def test_generators_depend_on_every_key():
    draws = {tuple(generator(*key).integers(1 << 30, size=3)) for key in ((0,), (0, 0), (0, 1), (1, 0), (0, 1, 0))}
    assert len(draws) == 5
    assert np.array_equal(generator(4, 2).random(3), generator(4, 2).random(3))


def test_devices(monkeypatch):
    assert device.choose_device("cpu").type == "cpu"
    for name in ("gpu", "", "cuda:x", "mps", "meta"):  # torch knows the last two; nothing here was tried there
        with pytest.raises(UsageError, match="unknown device"):
            device.choose_device(name)
    for count, said in (
        (0, "0 CUDA devices visible; use --device cpu"),
        (1, "1 CUDA device visible; use --device cuda or"),
    ):
        monkeypatch.setattr(torch.cuda, "device_count", lambda count=count: count)
        monkeypatch.setattr(torch.cuda, "is_available", lambda count=count: count > 0)
        with pytest.raises(UsageError, match=f"--device cuda:77: {said}"):
            device.choose_device("cuda:77")
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "1")
    assert device.cpu_count() == 1


def test_a_killed_parent_leaves_no_workers_behind(tmp_path):
    code = """
import sys, time
from dpcli.runtime.pool import ordered_map
if __name__ == "__main__":
    for item, _ in ordered_map(time.sleep, [0.01] * 4 + [1] * 100, 2):
        print(item, flush=True)
"""
    script = tmp_path / "spread.py"
    script.write_text(code)
    environment = {**os.environ, "PYTHONPATH": os.getcwd()}
    process = subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment
    )
    process.stdout.readline()
    process.kill()
    process.communicate(timeout=60)  # returns when the last process holding the pipes is gone
