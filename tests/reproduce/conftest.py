"""What the programs of tables are tried with: their `dpc` commands run in this process, which saves a start for each."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from dpcli.runtime.run_folder import RunFolder


@pytest.fixture(autouse=True, scope="module")
def no_learning_curves():
    """No table shows them; a picture takes longer than these trainings."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunFolder, "_draw_rest", lambda folder: None)
        yield


@pytest.fixture
def dpc_told(dpc_here) -> Callable[..., str]:
    """As `runs.dpc`: what a command, which must succeed, says on stdout."""

    def run(*words: object, threads: int | None = None) -> str:
        # toy data would only wait for the start of worker processes
        alone = ("--jobs", 1) if words[0] == "prepare" and "--jobs" not in words else ()
        done = dpc_here(*words, *alone)
        assert done.returncode == 0, done.stderr
        return done.stdout.decode()

    return run
