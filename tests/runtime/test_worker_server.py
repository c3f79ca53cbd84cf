"""The server of worker processes: it starts early, and neither Ctrl-C nor a stop signal is its business."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
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


STOPPED_AT_WORK = """
import os, signal, sys
import dpcli.store.writing.item_pass as item_pass
from dpcli.__main__ import main
take = item_pass.ItemPass._take
def interrupted(*given):
    os.kill(os.getpid(), signal.SIGINT)
    take(*given)
item_pass.ItemPass._take = interrupted
main()
"""


MADE = "prepare synthetic gestures --videos-per-class 1 --frames 8 --size 32 --jobs 2 -o a.h5".split()


def run_with_workers(
    start: list[str], folder: Path, temporary: Path, words: list[str] = MADE
) -> subprocess.CompletedProcess:
    temporary.mkdir(exist_ok=True)
    return subprocess.run(
        [sys.executable, *start, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2]), "TMPDIR": str(temporary)},
        capture_output=True,
        timeout=120,
    )


def test_ctrl_c_leaves_no_folder_of_the_server_in_tmpdir(tmp_path: Path) -> None:
    with tempfile.TemporaryDirectory(dir="/tmp") as short:  # longer ones have none
        done = run_with_workers(["-c", STOPPED_AT_WORK], tmp_path, temporary := Path(short, "tmp"))
        assert done.returncode == 130 and list(temporary.iterdir()) == [], done.stderr


def test_a_server_that_can_t_run_is_a_sentence(tmp_path: Path) -> None:
    """As where nobody may run the program of this very Python again."""
    start = (
        "import multiprocessing; multiprocessing.set_executable('/bin/false'); from dpcli.__main__ import main; main()"
    )
    done = run_with_workers(["-c", start], tmp_path, tmp_path / "tmp")
    said = b"dpc: error: the server that starts worker processes can't run on this machine ("
    assert done.returncode == 1 and said in done.stderr and b"; --jobs 1 needs none\n" in done.stderr, done.stderr
    assert b"Traceback" not in done.stderr


@pytest.mark.parametrize("letters", [70, 71, 120])
def test_workers_start_where_the_path_of_tmpdir_is_too_long_for_a_socket(tmp_path: Path, letters: int) -> None:
    """And where somebody's own socket.py lies in the current folder, which is no folder of modules of the script `dpc`."""
    if sys.version_info >= (3, 11):  # before, Python can't be told so
        (tmp_path / "socket.py").write_text("raise SystemExit('was run')\n")
    with tempfile.TemporaryDirectory(dir="/tmp") as short:
        temporary, script = Path(short, "x" * (letters - 1 - len(short))), Path(short, "dpc")
        script.write_text('from dpcli.__main__ import main\n\nif __name__ == "__main__":\n    main()\n')
        done = run_with_workers([str(script)], tmp_path, temporary)
        assert done.returncode == 0 and list(temporary.iterdir()) == [], done.stderr


def test_training_loads_clips_in_workers_where_the_path_of_tmpdir_is_too_long_for_a_socket(tmp_path: Path) -> None:
    words = "classify train a.h5 -o run --preset tiny --epochs 1 --set epochs_dynamic=0 --set workers=1".split()
    with tempfile.TemporaryDirectory(dir="/tmp") as short:
        temporary = Path(short, "x" * 100)
        for one in (MADE, words):
            done = run_with_workers(["-m", "dpcli"], tmp_path, temporary, one)
            assert done.returncode == 0, done.stderr
