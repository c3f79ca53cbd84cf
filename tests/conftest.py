"""Fixtures shared by all tests."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import hypothesis
import numpy as np
import pytest

from dpcli.store import CloudSequence
from tests.support.commands import exit_code

ROOT = Path(__file__).resolve().parents[1]
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell's background jobs; what tests start would inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # as under nohup: these tests go on, what they start hears it
    signal.signal(signal.SIGHUP, lambda number, frame: None)
if "PYTEST_XDIST_WORKER" in os.environ:  # the workers take the cores: more threads in each would wait for one another
    os.environ.setdefault("OMP_NUM_THREADS", "1")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Runs the kernels' own tests first: each kernel is compiled once, and then lies on disk for all workers."""
    items.sort(key=lambda item: "ops" not in item.path.parts)
    gc.freeze()  # thousands of tests and their libraries are no garbage to look for


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real data sets beside the project; tests that need them are skipped where they are absent."""
    path = Path(os.environ.get("DPC_TEST_DATA", ROOT.parent / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"no real data at {path}; DPC_TEST_DATA names another folder")
    return path


@pytest.fixture(scope="session")
def golden_file(shared_data: Path) -> Callable[[str], dict[str, np.ndarray]]:
    """The arrays of a file of independent golden values, which lie beside the real data; skipped where those are not."""
    folder = shared_data.parent / "golden"
    if not folder.is_dir():
        pytest.skip(f"no golden values at {folder}")

    def load(name: str) -> dict[str, np.ndarray]:
        with np.load(folder / name) as arrays:
            return dict(arrays)

    return load


@pytest.fixture(scope="module")
def one_thread():
    """Small tensors: on a busy machine torch's threads wait for each other a hundred times longer than they work."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def dpc() -> Callable[..., subprocess.CompletedProcess]:
    """Run `dpc` as a process of its own; stdout and stderr come back as bytes."""

    def run(*words: object, stdin: bytes | None = None, cwd: Path | None = None, timeout: float = 300, **env: str):
        command = [sys.executable, "-m", "dpcli", *map(str, words)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), **env}
        given = {"input": stdin} if stdin is not None else {"stdin": subprocess.DEVNULL}
        return subprocess.run(command, capture_output=True, cwd=cwd, env=environment, timeout=timeout, **given)

    return run


@pytest.fixture
def dpc_here(capfd) -> Callable[..., subprocess.CompletedProcess]:
    """As `dpc`, in this process (see commands.py)."""

    def run(*words: object) -> subprocess.CompletedProcess:
        capfd.readouterr()
        code = exit_code(*words)
        said = capfd.readouterr()
        return subprocess.CompletedProcess(words, code, said.out.encode(), said.err.encode())

    return run


@pytest.fixture
def make_sequence() -> Callable[..., CloudSequence]:
    """A random sequence; frames have different sizes, so that offsets matter."""

    def make(name: str, seed: int = 0, frames: int = 5, **fields: object) -> CloudSequence:
        rng = np.random.default_rng(seed)
        clouds = [rng.normal(size=(20 + seed + 3 * t, 3)).astype(np.float32) for t in range(frames)]
        return CloudSequence.from_frames(name, clouds, **fields)

    return make


# the same examples in every run (--hypothesis-profile default draws others): a suite that fails by the draw tells its reader nothing
hypothesis.settings.register_profile("suite", derandomize=True, deadline=None)
hypothesis.settings.load_profile("suite")
