"""Signals at any moment of any command: one sentence, the exit code of the table, and nothing left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.runtime.pool import ordered_map
from dpcli.runtime.signals import stop_requested
from dpcli.signal_exit import shows_impatience
from dpcli.store import ScoresWriter
from tests.support.prepare_helpers import ROOT

CODES = {signal.SIGINT: 130, signal.SIGTERM: 75, signal.SIGUSR1: 75, signal.SIGHUP: 75}
SAID = {
    signal.SIGINT: "dpc: error: interrupted",
    signal.SIGTERM: "stopped by SIGTERM",
    signal.SIGUSR1: "stopped by SIGUSR1",
    signal.SIGHUP: "stopped by SIGHUP",
}
COMMANDS = {
    "info": ["info", "s.h5"],
    "evaluate": ["evaluate", "classification", "s.h5", "--split", "all"],
    "profile": ["classify", "profile", "--model", "msraction3d-16"],
    "prepare": ["prepare", "synthetic", "gestures", "--videos-per-class", "400", "-o", "o.h5", "--jobs", "1"],
}
# Python's own start is over and the command's has just begun: what a test can wait for
STARTED = """
import os, sys
import dpcli.signal_exit as signals
from dpcli.__main__ import main
watch = signals.watch_signals
def told():
    watch()
    os.write(1, b"x")
signals.watch_signals, sys.argv = told, ["dpc", *sys.argv[1:]]
main()
"""


@pytest.fixture
def folder(tmp_path) -> Path:
    with ScoresWriter(tmp_path / "s.h5", class_names=["a", "b"]) as writer:
        for n in range(40):
            writer.write(f"v{n}", np.eye(2)[n % 2], label=n // 20, split="test")
    return tmp_path


def start(folder: Path, words: list[str], **options: object) -> subprocess.Popen:
    process = subprocess.Popen(
        [sys.executable, "-c", STARTED, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONFAULTHANDLER": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        **options,
    )
    assert process.stdout.read(1) == b"x"
    return process


def what_it_said(process: subprocess.Popen) -> str:
    """Returns the errors of a process that ends; of one that doesn't, where its threads stand fails the test."""
    try:
        return process.communicate(timeout=120)[1].decode()
    except subprocess.TimeoutExpired:
        state = Path(f"/proc/{process.pid}/stat")
        seen = state.read_text() if state.exists() else "no /proc"
        process.send_signal(signal.SIGABRT)  # Python's fault handler writes the threads' stacks
        try:
            said = process.communicate(timeout=10)[1].decode()
        except subprocess.TimeoutExpired as other:
            said = f"another process holds its pipes: {(other.stderr or b'').decode()}"
        pytest.fail(f"it did not end: {seen}\n{said}")


@pytest.mark.parametrize(
    ("command", "number"),
    [
        (command, number)
        for command in COMMANDS
        for number in CODES
        if command == "info" or number in (signal.SIGINT, signal.SIGTERM)
    ],
)
def test_a_signal_at_any_moment_is_a_sentence(folder, command, number):
    """From the first line on, while libraries load, at work, at the end."""
    ended = 0
    for wait in (0, 0.02, 0.1, 0.4, 1.0):
        process = start(folder, COMMANDS[command])
        time.sleep(wait)
        process.send_signal(number)
        said = what_it_said(process)
        assert "Traceback" not in said and "Exception" not in said and "a bug" not in said, said
        if process.returncode == 0:
            continue  # it was done before
        ended += 1
        assert process.returncode == CODES[number], (wait, said)
        assert SAID[number] in said and said.count("dpc: error:") == 1, (wait, said)
        assert not (folder / "o.h5").exists()
    assert ended >= 2


AT_A_LINE = """
import io, os, signal, sys
import dpcli.__main__, dpcli.cli.app as app

def run(at):  # in a fork: the command, with SIGTERM before the line of that number in what frames its work
    seen = 0
    def each(frame, event, argument):
        nonlocal seen
        if event == "line":
            seen += 1
            if seen == at + 1:
                os.kill(os.getpid(), signal.SIGTERM)
        return each
    codes = {dpcli.__main__.main.__code__, app.main.__code__, app._run.__code__}
    os.dup2(said.fileno(), 1), os.dup2(said.fileno(), 2)
    sys.argv = ["dpc", *sys.argv[1:]]
    sys.settrace(lambda frame, event, argument: each if frame.f_code in codes else None)
    try:
        dpcli.__main__.main()
    except SystemExit as ended:
        sys.settrace(None)
        sys.stdout.flush()
        os._exit(ended.code if seen > at else 9)

for at in range(1000):
    said = open("said", "w+b")
    child = os.fork()
    if child == 0:
        run(at)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    said.seek(0)
    print(at, code, said.read())
    if code == 9:
        break
"""


def test_a_signal_at_any_line_around_the_work_is_a_sentence(folder):
    """In what frames a command, where few moments of a clock fall: each line is taken in turn."""
    words, env = [sys.executable, "-c", AT_A_LINE, *COMMANDS["info"]], {**os.environ, "PYTHONPATH": str(ROOT)}
    told = subprocess.run(words, cwd=folder, env=env, capture_output=True, timeout=240, check=True).stdout.decode()
    *lines, last = [line.split(" ", 2) for line in told.splitlines()]
    assert last[1] == "9" and len(lines) >= 20, told
    watched = next(n for n, (_, code, _) in enumerate(lines) if code != str(-signal.SIGTERM))
    assert watched < 8  # imports, one a line, and the call itself
    for at, code, said in lines[watched:]:
        assert (
            code == "75" and said.count("dpc: error: stopped by SIGTERM") == 1 or code == "0" and "dpc:" not in said
        ), (at, said)


def test_a_stopped_command_waits_for_no_thread(folder):
    """Nor for a library's, which may never come back from what the signal broke off."""
    code = """
import os, signal, threading, time
import dpcli.cli.app as app
from dpcli.__main__ import main
threading.Thread(target=time.sleep, args=(90,)).start()
set_working = app.set_working
def stopped(working):
    set_working(working)
    os.kill(os.getpid(), signal.SIGTERM)
app.set_working = stopped
main()
"""
    words, env = [sys.executable, "-c", code, *COMMANDS["info"]], {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, cwd=folder, env=env, capture_output=True, timeout=60)
    assert done.returncode == 75 and b"stopped by SIGTERM" in done.stderr


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_what_a_command_keeps_in_tmpdir_goes_with_it(folder, number):
    (folder / "tmp").mkdir()
    words = ["prepare", "synthetic", "gestures", "--videos-per-class", "400", "-o", "-", "--jobs", "1"]
    for wait in (0.05, 1.5):
        process = subprocess.Popen(
            [sys.executable, "-m", "dpcli", *words],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(folder / "tmp")},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        time.sleep(wait)
        process.send_signal(number)
        process.communicate(timeout=120)
        assert list((folder / "tmp").iterdir()) == []


def test_a_signal_that_is_ignored_stays_ignored(folder):
    """As under nohup, or in the background of a script."""
    process = start(folder, COMMANDS["info"], preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN))
    process.send_signal(signal.SIGINT)
    told, _ = process.communicate(timeout=60)
    assert process.returncode == 0 and b"scores" in told


def ignoring(number: signal.Signals, words: list[str], cwd: Path) -> subprocess.CompletedProcess:
    """Runs Python with a signal that is ignored from its start."""
    code = (
        f"import os, signal, sys; signal.signal({int(number)}, signal.SIG_IGN); os.execv(sys.executable, sys.argv[1:])"
    )
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", code, sys.executable, *words]
    return subprocess.run(words, cwd=cwd, env=env, capture_output=True, timeout=120, start_new_session=True)


SIGNAL_TO_ALL = """
import os, signal, sys
import dpcli.store.writing.item_pass as item_pass
from dpcli.__main__ import main
take = item_pass.ItemPass._take
def signaled(*given):  # the command, the server of its workers and the workers
    os.killpg(0, signal.{name})
    take(*given)
item_pass.ItemPass._take = signaled
main()
"""


@pytest.mark.parametrize("name", ["SIGHUP", "SIGTERM", "SIGINT"])
def test_a_signal_that_is_ignored_stays_ignored_at_work_and_in_workers(name, tmp_path):
    words = "prepare synthetic gestures --videos-per-class 1 --frames 8 --size 32 --jobs 2 -o a.h5".split()
    done = ignoring(getattr(signal, name), ["-c", SIGNAL_TO_ALL.format(name=name), *words], tmp_path)
    assert done.returncode == 0 and (tmp_path / "a.h5").exists(), done.stderr


def test_a_terminal_that_closes_sends_two_signals_which_stop_once(tmp_path):
    """The shell sends one to its jobs, the system another as the shell ends."""
    words = "prepare synthetic gestures --videos-per-class 1 --frames 8 --size 32 --jobs 2 -o a.h5".split()
    program = [
        "-c",
        SIGNAL_TO_ALL.format(name="SIGHUP").replace("\n    take", "\n    os.killpg(0, 1)\n    take"),
        *words,
    ]
    done = ignoring(signal.SIGUSR2, program, tmp_path)
    assert done.returncode == 75 and b"stopped by SIGHUP; 1 of 10 samples are kept" in done.stderr, done.stderr
    again = ignoring(signal.SIGUSR2, ["-m", "dpcli", *words], tmp_path)
    assert again.returncode == 0 and b"1 of 10" in again.stderr, again.stderr


def test_one_signal_ends_a_wait_for_a_pipe(folder):
    """Nobody writes into it."""
    reading, writing = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-m", "dpcli", "info", "-"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=reading,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    time.sleep(1.5)
    process.terminate()
    _, told = process.communicate(timeout=120)
    os.close(reading), os.close(writing)
    assert process.returncode == 75 and b"stopped by SIGTERM" in told


@pytest.mark.parametrize("words", ["classify train s.h5 -o m --config pipe", "evaluate classification pipe"])
def test_no_command_waits_for_a_pipe_given_as_a_file(words, folder, monkeypatch, dpc_here):
    """Nobody writes into it; only streams come by one."""
    monkeypatch.chdir(folder)
    os.mkfifo("pipe")
    done = dpc_here(*words.split())
    assert done.returncode in (2, 3) and b"pipe" in done.stderr and b"expected a" in done.stderr


def test_a_worker_does_not_wait_for_a_pipe(folder):
    os.mkfifo(folder / "pipe")
    ((_, error),) = ordered_map(Path.read_bytes, [folder / "pipe"], 1, apart=True)
    assert isinstance(error, DataError) and "pipe: a FIFO, expected a regular file" in str(error)


def test_a_second_signal_ends_it_at_once(folder):
    code = (
        "import time, sys, os\nfrom dpcli import signal_exit as s\ns.watch_signals(); s.set_working(True)\n"
        "try:\n os.write(1, b'x'); time.sleep(60)\nexcept KeyboardInterrupt:\n os.write(1, b'y'); time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    for letter in (b"x", b"y"):
        assert process.stdout.read(1) == letter
        process.terminate()
    _, told = process.communicate(timeout=120)
    assert process.returncode == 75 and told == b"dpc: error: stopped by SIGTERM; run the same command again\n"


def test_what_torchrun_passes_on_is_no_second_signal(monkeypatch):
    """Slurm sends SIGTERM to every process of a step, and torchrun to its own again: they ended before anything was saved."""
    monkeypatch.delenv("TORCHELASTIC_RUN_ID", raising=False)
    assert shows_impatience(signal.SIGTERM)
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    monkeypatch.setattr("dpcli.runtime.signals.os._exit", lambda code: pytest.fail(f"ended with {code}"))
    with stop_requested() as stop:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGTERM)
    assert stop.name == "SIGTERM"


def test_a_second_hangup_leaves_the_first_its_time_to_tidy_up():
    code = (
        "import time, os\nfrom dpcli import signal_exit as s\ns.watch_signals(); s.set_working(True)\n"
        "try:\n os.write(1, b'x'); time.sleep(60)\n"
        "except KeyboardInterrupt:\n os.write(1, b'y'); time.sleep(1); os.write(1, b'tidied')"
    )
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    for letter in (b"x", b"y"):
        assert process.stdout.read(1) == letter
        process.send_signal(signal.SIGHUP)
    assert process.communicate(timeout=120)[0] == b"tidied"


DEAF = """
import itertools, os, signal, sys
from dpcli import signal_exit as s
if sys.argv[1] == "loops":
    s._GRACE = 0.3
s.watch_signals()
s.start_watchdog()
s.set_working(True)
os.write(1, b"x")
if sys.argv[1] == "loops":
    sum(itertools.repeat(0))  # holds the interpreter, as C code may: no handler of Python's runs
if sys.argv[1] == "crashes":
    os.abort()
if sys.argv[1] == "waits":
    signal.pause()
s.acknowledge_signal()
"""


@pytest.mark.parametrize(
    ("how", "number", "code", "words"),
    [
        ("loops", signal.SIGTERM, -signal.SIGKILL, "stopped by SIGTERM; a library did not come back"),
        ("loops", signal.SIGINT, -signal.SIGKILL, "stopped by SIGINT; a library did not come back"),
        ("loops", signal.SIGHUP, -signal.SIGKILL, "stopped by SIGHUP; a library did not come back"),
        ("crashes", None, -signal.SIGABRT, "dpc: error: killed, or ended by a crash in a library"),
        ("waits", signal.SIGKILL, -signal.SIGKILL, "dpc: error: killed, or ended by a crash in a library"),
        ("waits", signal.SIGUSR1, 1, "Ended"),  # what a command answers itself
        ("is done", None, 0, ""),
    ],
)
def test_a_library_that_never_comes_back_or_crashes_ends_with_a_sentence(how, number, code, words):
    process = subprocess.Popen(
        [sys.executable, "-c", DEAF, how], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    try:
        assert process.stdout.read(1) == b"x"
        if number is not None:
            time.sleep(0.5)  # it is in the loop by then
            process.send_signal(number)
        _, told = process.communicate(timeout=120)
    finally:
        process.kill()  # a loop that nothing ends would take a core from all other tests
    assert process.returncode == code, told
    assert words in told.decode() and told.count(b"dpc: error:") == (code < 0)


def test_who_reads_a_pipe_does_not_wait_for_the_one_that_stands_by():
    code = DEAF + "\nos.close(1)\nsys.stdin.read()"
    process = subprocess.Popen(
        [sys.executable, "-c", code, "is done"],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stdout.read() == b"x"  # the end of it
    assert process.poll() is None
    process.communicate(timeout=120)
    assert process.returncode == 0


DROPPED = """
import os, signal, time
from dpcli import signal_exit as s
s._AGAIN = 0.5
s.watch_signals()
s.set_working(True)
try:
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.1)
    except BaseException:  # as C code that takes any exception for "it is not there"
        pass
    time.sleep(50)
finally:
    for _ in range(20):
        time.sleep(0.1)
    os.write(1, b"tidied")
"""


def test_what_ends_a_command_is_raised_again_where_a_library_drops_it_but_not_while_it_tidies_up():
    done = subprocess.run([sys.executable, "-c", DROPPED], cwd=ROOT, capture_output=True, timeout=120)
    assert done.stdout == b"tidied" and done.stderr.count(b"signal_exit.Ended") == 1, done.stderr


AS_A_WORKER_STARTS = """
import os, signal, sys
from multiprocessing.process import BaseProcess
start, started = BaseProcess.start, []
def start_and_stop(self):
    start(self)
    started.append(self)
    if len(started) == 1:
        os.kill(os.getpid(), signal.{name})
BaseProcess.start = start_and_stop
from dpcli.__main__ import main
sys.argv = ["dpc", *sys.argv[1:]]
main()
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_as_a_worker_starts_ends_the_command(name, tmp_path):
    """The pool didn't know of that worker, which took the word to end that another one waited for: forever."""
    words = "prepare synthetic gestures --videos-per-class 1 --frames 8 --size 32 --jobs 2 -o".split()
    done = subprocess.run(
        [sys.executable, "-c", AS_A_WORKER_STARTS.format(name=name), *words, tmp_path / "a.h5"],
        capture_output=True,
        timeout=60,
        cwd=ROOT,
    )
    assert done.returncode == CODES[getattr(signal, name)], done.stderr
