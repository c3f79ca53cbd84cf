"""The folder of a training run: what --force may delete and when, who may write, a full disk, a run that is over."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dpcli.classify.training.trainer import Trainer
from dpcli.errors import DpcError, Stopped, UsageError
from dpcli.runtime import run_folder
from dpcli.runtime.run_folder import RunFolder
from dpcli.store import ScoresReader
from dpcli.store.file import open_store
from tests.classify.commands.test_train_predict import gestures
from tests.support.commands import exit_code

ROOT = Path(__file__).resolve().parents[2]
TRAIN = ("--preset", "tiny", "--frames", "4", "--points", "64", "--batch", "4", "--seed", "3", "--validation", "none")
SHORT = (*TRAIN, "--epochs", "1", "--set", "epochs_dynamic=0")

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return gestures(tmp_path_factory.mktemp("data") / "clouds.h5", videos=8)


@pytest.fixture(scope="module")
def trained(data) -> Path:
    """A folder with a trained model, which no test changes."""
    assert exit_code("classify", "train", data, "-o", data.parent / "trained", *SHORT) == 0
    return data.parent / "trained"


@pytest.fixture
def finished(trained, tmp_path) -> Path:
    """A copy of it, of a test's own."""
    return shutil.copytree(trained, tmp_path / "run")


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@contextlib.contextmanager
def file_size_limit(limit: int) -> Iterator[None]:
    """A block in which no file of this process may get more bytes, as on a full disk; Python ignores SIGXFSZ by itself."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def start(*words: object) -> subprocess.Popen:
    """`dpc` as a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-m", "dpcli", *map(str, words)],
        cwd=ROOT,
        text=True,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def wait_for(come: Callable[[], bool], process: subprocess.Popen) -> None:
    deadline = time.monotonic() + 240
    while not come() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    assert come() and process.poll() is None, process.communicate()


def test_a_command_that_fails_deletes_no_model(data, finished, tmp_path, dpc_here):
    """--force empties the folder only once everything else is there, checked and read."""
    other = tmp_path / "other"
    other.mkdir()
    (other / "best.safetensors").write_bytes(b"no weights")
    (tmp_path / "link.safetensors").symlink_to(finished / "best.safetensors")
    before = contents(finished)
    assert ".lock" not in before and "best.safetensors" in before
    for more, code, said in (
        (("--init", finished), 2, f"--init {finished}/best.safetensors: is in the folder of -o"),
        (("--set", f"static_from={finished / 'best.safetensors'}"), 2, "static_from = "),
        (("--init", tmp_path / "link.safetensors"), 2, "is in the folder of -o"),
        (("--init", "nosuch"), 3, "--init nosuch: no such file"),
        (("--set", "static_from=nosuch"), 3, "static_from = nosuch: no such file"),
        (("--set", f"static_from={other}"), 3, "not a complete safetensors file"),
        (("--set", "backbone=nosuch:Cls"), 2, "nosuch"),
        (("--set", "accumulate=99"), 2, "accumulate = 99"),
        (("--seed", 2**64), 2, "--seed"),
    ):
        done = dpc_here("classify", "train", data, "-o", finished, *SHORT, "--force", *more)
        assert done.returncode == code and said in done.stderr.decode(), (more, done.stderr)
        assert b"--model" not in done.stderr and b"Traceback" not in done.stderr
        assert contents(finished) == before, more


def test_weights_without_a_configuration_are_not_overwritten(data, finished, dpc_here):
    (finished / "config.json").unlink()
    before = contents(finished)
    words = ("classify", "train", data, "-o", finished, *SHORT)
    refused = dpc_here(*words)
    assert refused.returncode == 2 and contents(finished) == before
    assert b"best.safetensors" in refused.stderr and b"config.json" in refused.stderr and b"--force" in refused.stderr
    assert dpc_here(*words, "--force").returncode == 0 and (finished / "config.json").exists()


def test_a_second_training_into_a_folder_is_refused(data, tmp_path, dpc_here):
    """With --force, too. Until the first one ends, however: a kill leaves no lock that holds, and the run continues."""
    folder = tmp_path / "run"
    words = ("classify", "train", data, "-o", folder, *TRAIN, "--epochs", 3000, "--set", "epochs_dynamic=0")
    first = start(*words)
    try:
        wait_for((folder / "state.pt").exists, first)
        for more in ((), ("--force",)):
            second = dpc_here(*words, *more)
            said = f"{folder}: cannot write (another dpc is writing it)".encode()
            assert second.returncode == 1 and said in second.stderr
        assert first.poll() is None and (folder / "state.pt").exists() and (folder / "config.json").exists()
    finally:
        first.kill()
        first.communicate()
    saved = (folder / "state.pt").stat().st_mtime_ns
    third = start(*words)
    wait_for(lambda: (folder / "state.pt").stat().st_mtime_ns > saved, third)
    third.send_signal(signal.SIGTERM)
    said = third.communicate(timeout=240)[1]
    assert third.returncode == 75 and "continuing" in said and not (folder / ".lock").exists()


@pytest.mark.parametrize(("limit", "name"), [(30_000, "last.safetensors"), (700_000, "state.pt")])
def test_a_full_disk_ends_with_a_sentence_and_the_run_goes_on(data, finished, tmp_path, dpc_here, limit, name):
    weights, state = ((finished / file).stat().st_size for file in ("last.safetensors", "state.pt"))
    assert 30_000 < weights < 700_000 < state, "the limits no longer fall between the sizes of the files"
    folder = tmp_path / "full"
    words = ("classify", "train", data, "-o", folder, *SHORT)
    with file_size_limit(limit):
        full = dpc_here(*words)
    said = full.stderr.decode()
    assert full.returncode == 1 and f"{folder / name}: the file size limit is reached; make room" in said, said
    assert "bug" not in said and "Traceback" not in said and "last saved state" not in said
    assert not [path.name for path in folder.iterdir() if path.name.startswith(".")]
    assert dpc_here(*words).returncode == 0 and (folder / "best.safetensors").exists()


def test_a_disk_that_fills_up_keeps_the_last_state(data, tmp_path, dpc_here, monkeypatch):
    folder = tmp_path / "run"
    words = ("classify", "train", data, "-o", folder, *TRAIN, "--epochs", 3, "--set", "epochs_dynamic=0")
    take = Trainer._take

    def stopping(self, *batch):
        if (folder / "state.pt").exists():
            os.kill(os.getpid(), signal.SIGTERM)
        return take(self, *batch)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_take", stopping)
        first = dpc_here(*words)
    assert first.returncode == 75, first.stderr
    before = (folder / "state.pt").read_bytes()
    with file_size_limit(700_000):
        full = dpc_here(*words)
    said = full.stderr.decode()
    assert full.returncode == 1 and "run the same command again: it continues from the last saved state" in said, said
    assert (folder / "state.pt").read_bytes() == before
    again = dpc_here(*words)
    assert again.returncode == 0 and b"continuing" in again.stderr
    assert [row["epoch"] for row in json.loads((folder / "log.json").read_text())] == [1, 2, 3]


def test_a_model_of_a_run_without_weights_yet(data, finished, tmp_path, dpc_here):
    words = ("classify", "predict", data, "--model", finished, "-o", tmp_path / "s.h5")
    (finished / "best.safetensors").unlink()
    early = dpc_here(*words).stderr.decode()
    assert (
        "no best.safetensors yet" in early and f"{finished}/last.safetensors" in early and "no such file" not in early
    )
    (finished / "last.safetensors").unlink()
    none = dpc_here(*words)
    assert none.returncode == 3 and b"no best.safetensors yet" in none.stderr and b"to continue it" in none.stderr


def test_a_finished_training_says_so(data, finished, dpc_here):
    before = contents(finished)
    again = dpc_here("classify", "train", data, "-o", finished, *SHORT)
    assert again.returncode == 0 and b"best.safetensors" in again.stdout and contents(finished) == before
    assert b"is finished already" in again.stderr and b"--force" in again.stderr and b"continuing" not in again.stderr


@pytest.mark.parametrize("rows, told", [(2, True), (1, False)])
def test_weights_whose_state_is_gone_are_not_trained_over(rows, told, tmp_path):
    """As of a copied folder that lacks the largest file; a kill leaves one row without a state, and then it starts over."""

    def run(force: bool = False) -> RunFolder:
        return RunFolder(tmp_path / "run", {"seed": 0}, force, columns=["epoch"])

    with run() as folder:
        for epoch in range(rows):
            folder.log({"epoch": epoch})
        folder.file("last.safetensors").write_bytes(b"weights")
    for force in (False, True):
        with run(force) as folder:
            if told and not force:
                with pytest.raises(UsageError, match=r"state\.pt: is gone, and without it .* --force to start over"):
                    folder.load_state()
            else:
                assert folder.load_state() is None
            assert folder.file("last.safetensors").exists() != force


def test_the_largest_seed_trains_and_is_kept_in_files(data, tmp_path, dpc_here):
    largest, run = 2**63 - 1, tmp_path / "run"
    assert dpc_here("classify", "train", data, "-o", run, *SHORT, "--seed", largest).returncode == 0
    done = dpc_here("classify", "predict", data, "--model", run, "-o", tmp_path / "s.h5", "--seed", largest)
    assert done.returncode == 0 and ScoresReader(tmp_path / "s.h5").provenance[-1]["seed"] == largest, done.stderr
    with open_store(tmp_path / "s.h5") as file:
        assert int(file.attrs["seed"]) == largest
    above = dpc_here("classify", "predict", data, "--model", run, "-o", tmp_path / "t.h5", "--seed", largest + 1)
    assert above.returncode == 2 and b"--seed" in above.stderr and str(largest).encode() in above.stderr


@pytest.mark.parametrize("first", [0, 10])
@pytest.mark.parametrize("error", [None, Stopped("saved"), OSError(28, "No space left on device")])
def test_curves_take_little_of_the_time_and_show_all_rows_in_the_end(tmp_path, monkeypatch, error, first):
    """A run that is over before the time of its first picture draws one, at its end."""
    monkeypatch.setattr(run_folder, "_FIRST_PICTURE", first)
    drawn: list[int] = []

    def curves(rows: list[dict], path: Path) -> None:
        time.sleep(0.05)
        drawn.append(len(rows))

    with pytest.raises(DpcError) if error else contextlib.nullcontext():
        with RunFolder(tmp_path / "run", {}, columns=["step"], curves=curves) as folder:
            for step in range(10):
                folder.log({"step": step})
                folder.draw_curves()
            if error:
                raise error
    if first:
        assert drawn == ([] if isinstance(error, OSError) else [10])
    else:
        assert drawn[0] == 1 and len(drawn) <= 5
        assert drawn[-1] == 10 or isinstance(error, OSError)
