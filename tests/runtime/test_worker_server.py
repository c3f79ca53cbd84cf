"""The server of worker processes: it starts early, and neither Ctrl-C nor a stop signal is its business."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

# A module that takes long to import says so first; the pool must work all the same, whatever came meanwhile.
SLOW = "import pathlib, time\npathlib.Path('importing').touch()\ntime.sleep(1.5)\n"
PROGRAM = """
import signal, sys, time
from dpcli.runtime.pool import ordered_map
from dpcli.runtime.worker_server import ensure_server

if __name__ == "__main__":
    seen = []
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP):
        signal.signal(number, lambda number, frame: seen.append(number))
    ensure_server("slow_import")
    while not seen:
        time.sleep(0.01)
    print([result for _, result in ordered_map(abs, [-1, 2], 2)], *map(int, seen))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP])
def test_a_signal_to_all_while_it_imports_reaches_the_command_only(tmp_path: Path, number: int) -> None:
    (tmp_path / "slow_import.py").write_text(SLOW)
    (tmp_path / "program.py").write_text(PROGRAM)
    paths = os.pathsep.join([str(tmp_path), str(Path(__file__).resolve().parents[2])])
    process = subprocess.Popen(
        [sys.executable, "program.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": paths},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    waited = time.monotonic() + 60
    while not (tmp_path / "importing").exists() and time.monotonic() < waited:
        time.sleep(0.01)
    assert (tmp_path / "importing").exists()
    os.killpg(process.pid, number)
    said, problems = process.communicate(timeout=60)
    assert said.split("\n")[0] == f"[1, 2] {int(number)}"
    assert problems == ""


def test_ctrl_c_while_libraries_load_is_a_sentence() -> None:
    code = (
        "import dpcli.__main__, dpcli.standard_streams as first\n"
        "def interrupted(): raise KeyboardInterrupt\n"
        "first.ready_streams = interrupted\n"
        "dpcli.__main__.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "dpc: error: interrupted\n")
