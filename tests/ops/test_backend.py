"""Choosing a backend, and the promises around it: no torch for fps_numpy, bounded memory, threads and forks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import dpcli.ops
from dpcli.errors import UsageError
from dpcli.ops import chosen_backend, fps, fps_reference, space_time_ball_query
from dpcli.ops.backend import key_distances, key_indices, ordered_keys, row_blocks, run_in_threads
from tests.support.ops_helpers import backend


def python(code: str, **environment: str) -> str:
    """Output of a fresh interpreter."""
    import os

    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env={**os.environ, **environment})
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_every_name_resolves() -> None:
    for name in dpcli.ops.__all__:
        assert callable(getattr(dpcli.ops, name))
    with pytest.raises(AttributeError):
        dpcli.ops.nothing  # noqa: B018


def test_backend_follows_device_and_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DPC_BACKEND", raising=False)
    assert chosen_backend("cpu") == "numba" and chosen_backend("cuda") == "torch"
    with backend("torch"):
        assert chosen_backend("cpu") == "torch"
    with backend("numba"):
        assert chosen_backend("cuda") == "torch"
    with backend("triton"), pytest.raises(UsageError, match="triton"):
        chosen_backend("cpu")


def test_fps_numpy_imports_no_torch() -> None:
    code = (
        "import sys, numpy as np; from dpcli.ops import fps_numpy; "
        "print(fps_numpy(np.eye(3), 2).tolist(), 'torch' in sys.modules)"
    )
    assert python(code) == "[0, 1] False"


def test_missing_numba_falls_back_with_one_warning() -> None:
    code = (
        "import sys; sys.modules['numba'] = None\n"
        "import torch, numpy as np; from dpcli.ops import fps, fps_numpy\n"
        "sys.stderr = sys.stdout\n"
        "p = torch.eye(3)[None]\n"
        "print(fps(p, 2).tolist(), fps(p, 2).tolist(), fps_numpy(np.eye(3), 2).tolist())"
    )
    warning, result = python(code).splitlines()
    assert "numba does not import" in warning
    assert result == "[[0, 1]] [[0, 1]] [0, 1]"


def test_kernels_survive_a_fork_after_use() -> None:
    """Plain threads, made per call: numba's own parallel mode would kill the child here."""
    code = (
        "import multiprocessing as mp, torch; from dpcli.ops import fps\n"
        "import dpcli.ops.backend as b; b._THREAD_NS = 1.0; torch.set_num_threads(2)\n"
        "p = torch.randn(8, 500, 3, generator=torch.Generator().manual_seed(0))\n"
        "fps(p, 50)\n"
        "def child(q): torch.set_num_threads(1); q.put(fps(p, 50).sum().item())\n"
        "c = mp.get_context('fork'); q = c.Queue(); w = c.Process(target=child, args=(q,)); w.start()\n"
        "print(q.get(timeout=60) == fps(p, 50).sum().item()); w.join()"
    )
    assert python(code) == "True"


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_thread_count_changes_nothing(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dpcli.ops.backend._THREAD_NS", 1.0)
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(3, 700, 3, generator=generator)
    times = torch.arange(7).repeat_interleave(100).expand(3, -1)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        assert torch.equal(fps(points, 60), fps_reference(points, 60))
        got = space_time_ball_query(points[:1], times[:1], points[:1], times[:1], [0.3, 0.3], 9, order="nearest")
    finally:
        torch.set_num_threads(before)
    want = space_time_ball_query(points[:1], times[:1], points[:1], times[:1], [0.3, 0.3], 9, order="nearest")
    assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))


def test_an_error_in_a_thread_reaches_the_caller() -> None:
    def fail_late(first: int, last: int) -> None:
        if last == 10:
            raise RuntimeError(f"window {first}")

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with pytest.raises(RuntimeError, match="window 6"):
            run_in_threads(fail_late, (), 10, 1e9)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize(
    ("total", "milliseconds", "most"), [(0, 9, 1), (1, 9, 1), (4, 9, 4), (11, 9, 11), (11, 1, 2), (11, 0.1, 1)]
)
def test_windows_cover_all_items_once(threads: int, total: int, milliseconds: float, most: int) -> None:
    """At most `most` windows: one per item, and none of less than 4 ms."""
    windows = []
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        run_in_threads(lambda name, *window: windows.append(window), ("x",), total, milliseconds * 1e6)
    finally:
        torch.set_num_threads(before)
    assert sorted(item for first, last in windows for item in range(first, last)) == list(range(total))
    assert len(windows) == min(threads, most)


def test_reference_memory_is_bounded() -> None:
    """Blocks of a 16 x 2048 clip hold at most 2^20 pairs, and at least one row however long."""
    blocks = row_blocks(1024, 32768, torch.device("cpu"))
    assert all((block.stop - block.start) * 32768 <= 1 << 20 for block in blocks)
    assert [block.stop - block.start for block in row_blocks(2, 1 << 30, torch.device("cpu"))] == [1, 1]


def test_keys_sort_as_distance_then_index() -> None:
    distances = torch.tensor([0.5, 0.0, float("inf"), 0.5, 1e-45, 3e38])
    order = ordered_keys(distances).sort().values
    assert key_indices(order).tolist() == [1, 4, 0, 3, 5, 2]
    assert torch.equal(key_distances(order), distances[key_indices(order)])
    assert np.isinf(key_distances(order)[-1].item())


def test_no_module_hides_a_function_of_the_package():
    """A submodule of the same name would take the function's place as soon as anything imports it."""
    modules = {path.stem for path in Path(dpcli.ops.__file__).parent.iterdir()}
    assert not modules & set(dpcli.ops.__all__)
