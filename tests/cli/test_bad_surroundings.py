"""Real processes in bad surroundings: a disk that is full, signals in the middle, pipes of three commands."""

from __future__ import annotations

import hashlib
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
from matplotlib.rcsetup import validate_backend

from dpcli.interpreter import settle_interpreter
from dpcli.segment.training.flow_store import FlowStore
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, ScoresWriter
from dpcli.store.file import read_skipped, write_skipped
from tests.support.commands import typed
from tests.support.prepare_helpers import ROOT, write_msr
from tests.support.sessions import members

DPC = [sys.executable, "-m", "dpcli"]
NAMES = [f"a{1 + n % 20:02}_s{1 + n % 8:02}_e{1 + n // 20:02}" for n in range(40)]


@pytest.fixture(scope="module")
def raw(tmp_path_factory) -> Path:
    """Forty videos of MSR-Action3D's format: 160 x 120, 12 frames, half of the pixels valid; 11 MB of points."""
    return write_msr(tmp_path_factory.mktemp("robust") / "raw", NAMES, frames=12, height=120, width=160)


def leftovers(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def namespace(script: str, **env: str) -> subprocess.CompletedProcess:
    """A shell script as root of a user and mount namespace of its own."""
    return subprocess.run(
        ["unshare", "-rm", "sh", "-ec", script],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, **env},
    )


@pytest.fixture
def mounting(tmp_path) -> None:
    """For tests that mount a small file system of their own, as root of a namespace; not every machine lets people."""
    script = 'mount -t tmpfs -o size=1m none "$D" && touch "$D/x"'
    if shutil.which("unshare") is None or namespace(script, D=str(tmp_path)).returncode != 0:
        pytest.skip("this machine lets nobody mount a file system of their own (unshare -rm)")


@pytest.fixture(scope="module")
def undisturbed(raw) -> Callable[[str], str]:
    """The digest of a run that nothing stopped, with such options; each is made once."""

    @cache
    def digest(more: str) -> str:
        path = raw.with_name(f"whole{more}.h5")
        assert typed("prepare", "msraction3d", raw, "-o", path, "--jobs", "1", *more.split()) == 0
        return hashlib.sha256(path.read_bytes()).hexdigest()

    return digest


@pytest.mark.parametrize(
    "jobs, more", [("1", ""), ("2", ""), ("2", "--compression gzip"), ("1", "--points 900 --sampling fps")]
)
def test_a_full_disk_keeps_what_is_done_and_the_same_command_continues(
    raw, tmp_path, undisturbed, jobs, more, mounting
):
    """A file system of 2 MiB for 11 MB of points, then of room enough; the bytes are those of a run that nothing stopped."""
    command = f'"{sys.executable}" -m dpcli prepare msraction3d "$RAW" -o "$D/out.h5" --jobs {jobs} {more}'
    size = {"": "2m", "--compression gzip": "6m"}.get(more, "1m")
    script = (
        f'mount -t tmpfs -o size={size} none "$D"; set +e\n{command}\necho "code $?"; ls -A "$D"\n'
        f'{command}\necho "code $?"\nmount -o remount,size=200m "$D"\n{command}\necho "code $?"; ls -A "$D"; sha256sum "$D/out.h5"'
    )
    (tmp_path / "full").mkdir()
    done = namespace(script, D=str(tmp_path / "full"), RAW=str(raw))
    said, told = done.stdout.split("\n"), done.stderr
    assert said[:4] == ["code 1", ".out.h5.new", ".out.h5.part", "code 1"] and said[5:7] == ["code 0", "out.h5"], said
    sizes = r"about \d+\.\d MB needed, \d+(\.\d)? \w+ of \d\.\d MB free in .*/full"
    assert re.search(
        rf"out.h5: no space left on the device \({sizes}\); what is done, [1-9]\d* samples?, is kept. Make room", told
    ), told
    assert "continuing: " in told and "Traceback" not in told
    assert said[7].split()[0] == undisturbed(more)


@pytest.mark.parametrize(
    "words", ["prepare merge c.h5 -o {}/o.h5", "info c.h5 --picture {}/p.png", "info c.h5 --page {}/p.html"]
)
def test_a_disk_without_one_free_byte_is_told_in_the_same_words(words, tmp_path, mounting):
    """Not even an empty file of HDF5 fits; no library adds what it thinks of that."""
    with CloudsWriter(tmp_path / "c.h5") as writer:
        writer.write(CloudSequence.from_frames("a", [np.ones((4, 3), np.float32)] * 2))
    (tmp_path / "full").mkdir()
    script = (
        'mount -t tmpfs -o size=64k none "$D/full"; set +e; head -c 65536 /dev/zero > "$D/full/fill"; cd "$D"\n'
        f'"{sys.executable}" -m dpcli -q {words.format("full")}; echo "code $?"'
    )
    done = namespace(script, D=str(tmp_path), PYTHONPATH=str(ROOT))
    assert done.stdout.endswith("code 1\n"), done.stderr
    told = r"dpc: error: full/\S+: no space left on the device \(0 bytes of 65.5 kB free in \S+/full\); .*\n"
    assert re.fullmatch(told, done.stderr), done.stderr


def test_a_full_disk_below_the_pipe(raw, tmp_path, mounting):
    """`-o -` spools beside nothing the user named: the message still says what was full."""
    script = (
        'mount -t tmpfs -o size=2m none "$TMPDIR"; set +e\n'
        f'"{sys.executable}" -m dpcli prepare msraction3d "$RAW" -o - --jobs 1 | wc -c; ls -A "$TMPDIR"'
    )
    done = namespace(script, TMPDIR=str(tmp_path), RAW=str(raw))
    assert done.stdout.split() == ["0"], done.stdout + done.stderr
    assert "no space left on the device" in done.stderr and "Traceback" not in done.stderr


def test_flows_that_the_disk_has_no_room_for_are_told_before_a_training_begins(tmp_path, mounting):
    """Mapped files get their room when they are made: a page without room, later, would end the process by SIGBUS."""
    code = """
import os, sys
from pathlib import Path
from dpcli.errors import DpcError
from dpcli.segment.training.flow_store import FlowStore
for size in sys.argv[1:]:
    assert os.system(f'mount -t tmpfs -o size={size} none "$D"') == 0
    try:
        store = FlowStore(Path(os.environ["D"]), 40, 2048, fresh=True)  # two files of 1.9 MiB
        store._first[:] = store._now[:] = 1
        print("written")
    except DpcError as error:
        print(error)
"""
    done = namespace('"$PYTHON" -c "$CODE" 1m 3m 9m', D=str(tmp_path), CODE=code, PYTHON=sys.executable)
    told = done.stdout.splitlines()
    assert len(told) == 3 and "flows_first.npy: no space left" in told[0] and told[2] == "written", done
    assert "flows.npy: no space left on the device (about 2.0 MB needed, " in told[1]


def test_flows_have_their_room_on_the_disk_from_the_start(tmp_path):
    """What keeps the process above from a bus error, on any machine: the files are not sparse."""
    FlowStore(tmp_path, 40, 2048, fresh=True)
    for name in ("flows_first.npy", "flows.npy", "flows_known.npy"):
        found = (tmp_path / name).stat()
        assert found.st_blocks * 512 >= found.st_size > 0


WRITES = """
import resource, signal, sys
from pathlib import Path
import numpy as np
from dpcli.classify.commands.explain_pac import write_clouds
from dpcli.classify.explain.point_activation_cloud import ActivationCloud
from dpcli.errors import DpcError
from dpcli.store import CloudSequence, ScoresWriter
from dpcli.store.embedding import StreamEmbedding, write_embedding

rng, folder = np.random.default_rng(0), Path(sys.argv[1])
rows = rng.random((40, 30), np.float32)
names = [f"v{k}" for k in range(40)]

def scores(path):
    with ScoresWriter(path, class_names=[f"c{k}" for k in range(30)], streams=["a", "b"]) as writer:
        for name, row in zip(names, rows):
            writer.write(name, row, streams={"a": row, "b": row})

def embedding(path):
    said = StreamEmbedding(np.repeat(rows, 8, 1), rows[:, :2], {"perplexity": 5.0})
    write_embedding(path, names, np.zeros(40, np.int32), [""] * 40, {"static": said, "dynamic": said}, class_names=["a"])

def activations(path):
    cloud = CloudSequence("v", rng.random((3000, 3), np.float32), np.array([0, 1500, 3000]))
    own = {s: rng.random(3000, np.float32) for s in ("static", "dynamic")}
    write_clouds(path, [ActivationCloud(cloud, (0, 1), own, 0, 0, 1.0)], rule="activation", class_names=["a"])

for work in (scores, embedding, activations):
    work(folder / "whole.h5")
    size = (folder / "whole.h5").stat().st_size
    (folder / "whole.h5").unlink()
    for limit in np.linspace(1, size - 1, 23).astype(int).tolist():
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        try:
            work(folder / "out.h5")
        except DpcError as error:
            if "file size limit is reached" not in str(error) and "cannot write" not in str(error):
                print(work.__name__, limit, error)
        else:
            print(work.__name__, limit, "was taken for written")
        left = [path.name for path in folder.iterdir()]
        if left:
            print(work.__name__, limit, "left", left)
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
print("done")
"""


def test_wherever_a_write_fails_it_is_told_once_and_leaves_nothing(tmp_path):
    """HDF5 buffers a data set's last bytes until nobody holds it, where h5py prints a trace instead of raising, then crashes."""
    (tmp_path / "work").mkdir()
    done = subprocess.run(
        [sys.executable, "-c", WRITES, tmp_path / "work"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\n", "")


def test_a_file_size_limit_is_told_like_a_full_disk(raw, tmp_path, dpc):
    """Where nobody may mount: the shell's limit on a file's size stops the same write."""

    def limited() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (2 << 20, 2 << 20))

    done = subprocess.run(
        [*DPC, "prepare", "msraction3d", raw, "-o", tmp_path / "out.h5", "--jobs", "1"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        preexec_fn=limited,
    )
    assert done.returncode == 1 and "the file size limit is reached; what is done" in done.stderr
    assert leftovers(tmp_path) == [".out.h5.new", ".out.h5.part"]
    again = dpc("prepare", "msraction3d", raw, "-o", tmp_path / "out.h5", "--jobs", "1")
    assert again.returncode == 0 and b"continuing: " in again.stderr and leftovers(tmp_path) == ["out.h5"]


def start(raw: Path, output: Path, count: int) -> subprocess.Popen:
    """A conversion of twelve videos in two worker processes, returned once `count` are in the unfinished file."""
    process = subprocess.Popen(
        [
            *DPC,
            "-v",
            "prepare",
            "msraction3d",
            raw,
            "-o",
            output,
            "--jobs",
            "2",
            "--points",
            "4000",
            "--sampling",
            "fps",
            "--limit",
            "12",
        ],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    part, limit = output.with_name(f".{output.name}.new"), time.monotonic() + 120
    while time.monotonic() < limit and process.poll() is None:
        if part.exists() and part.stat().st_size > count * 300_000:
            break
        time.sleep(0.01)
    return process


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 75)])
@pytest.mark.parametrize("everyone", [True, False])
def test_a_signal_in_the_middle_keeps_what_is_done(raw, tmp_path, number, code, everyone):
    """To the process alone (kill) or to its whole group (a terminal, a batch system); then the same command continues."""
    output = tmp_path / "out.h5"
    process = start(raw, output, 2)
    if process.poll() is not None:
        pytest.skip("the conversion was over before the signal came")
    os.killpg(process.pid, number) if everyone else os.kill(process.pid, number)
    _, told = process.communicate(timeout=120)
    if process.returncode == 0:
        pytest.skip("the conversion was over before the signal came")
    assert process.returncode == code, told
    assert "Traceback" not in told and "samples are kept" in told
    assert leftovers(tmp_path) == [".out.h5.new", ".out.h5.part"]
    limit = time.monotonic() + 90
    while members(process.pid) and time.monotonic() < limit:
        time.sleep(0.05)
    assert not members(process.pid)
    again = start(raw, output, 10**6)
    _, told = again.communicate(timeout=300)
    assert again.returncode == 0 and "continuing: " in told, told
    assert leftovers(tmp_path) == ["out.h5"]
    with CloudsReader(output) as reader:
        assert sorted(reader.names) == sorted(NAMES)[:12] and reader.skipped == []


def test_three_commands_in_a_pipe_with_all_points(raw, tmp_path):
    """prepare | predict | evaluate as the issue writes it, all points kept; a bad video is left out and named."""
    few = tmp_path / "raw"
    few.mkdir()
    for name in NAMES[:3]:
        shutil.copy(raw / f"{name}_sdepth.bin", few)
    (few / "a09_s01_e01_sdepth.bin").write_bytes(b"\x01\x02")
    dpc = f'"{sys.executable}" -m dpcli'
    script = (
        f'set -o pipefail; {dpc} prepare msraction3d "{few}" -o - | {dpc} classify predict - --model msraction3d-16 -o -'
        f" --clips-per-video 1 | {dpc} evaluate classification - --split all --json"
    )
    done = subprocess.run(["bash", "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "a09_s01_e01" in done.stderr and json.loads(done.stdout)["metrics"]


def test_a_dead_end_of_the_pipe_ends_the_chain(raw):
    """When the last command can't start, the first ones end without a trace of Python."""
    dpc = f'"{sys.executable}" -m dpcli'
    script = f'{dpc} prepare msraction3d "{raw}" -o - --limit 4 | {dpc} info - --samples 0'
    done = subprocess.run(["bash", "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2 and "Traceback" not in done.stderr


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_the_file_says_what_was_skipped_and_why(tmp_path, dpc_here, jobs):
    folder = write_msr(tmp_path / "raw", NAMES[:3])
    (folder / "a09_s01_e01_sdepth.bin").write_bytes(b"")
    output = tmp_path / "out.h5"
    words = ("prepare", "msraction3d", folder, "-o", output, "--jobs", jobs)
    assert dpc_here(*words).returncode == 0
    with h5py.File(output) as file:
        assert file.attrs["skipped"] == 1
    told = json.loads(dpc_here("info", output, "--json").stdout)["skipped"]
    assert [entry["name"] for entry in told] == ["a09_s01_e01"] and "0 bytes" in told[0]["reason"]
    assert "skipped              a09_s01_e01: " in dpc_here("info", output).stdout.decode()
    again = dpc_here(*words)
    assert "already complete" in again.stderr.decode() and b"1 skipped" in again.stdout


def test_nothing_skipped_leaves_no_word(tmp_path, dpc_here):
    folder = write_msr(tmp_path / "raw", NAMES[:2])
    assert dpc_here("prepare", "msraction3d", folder, "-o", tmp_path / "out.h5", "--jobs", "1").returncode == 0
    with h5py.File(tmp_path / "out.h5") as file:
        assert "skipped" not in file and "skipped" not in file.attrs
    assert b"\nskipped" not in dpc_here("info", tmp_path / "out.h5").stdout


def test_many_and_odd_reasons_survive(tmp_path):
    """More than an attribute holds, and names that are no UTF-8."""
    rows = [(f"video {n}\udcff", "because " * 30) for n in range(2000)]
    path = tmp_path / "many.h5"
    with CloudsWriter(path) as writer:
        writer.write(CloudSequence.from_frames("one", [np.zeros((3, 3), np.float32)]))
        writer.skipped = rows
    with CloudsReader(path) as reader:
        assert len(reader.skipped) == 2000
        assert reader.skipped[7] == ("video 7?", "because " * 30)
    with h5py.File(tmp_path / "odd.h5", "w") as file:
        write_skipped(file, [("a\0b", "c")])
        assert read_skipped(file) == [("a b", "c")]


@pytest.fixture(scope="module")
def named(tmp_path_factory) -> Path:
    """Scores whose classes have names that ASCII can't spell, and that would color a terminal and clear it."""
    path = tmp_path_factory.mktemp("named") / "scores.h5"
    with ScoresWriter(path, class_names=["p\u00fcnch", "\x1b[31mred\x9b2J"]) as writer:
        for k in range(4):
            writer.write(f"v{k}", np.float32([0.25, 0.75]), label=k % 2, split="test")
    return path


def shell(line: str, path: Path, **env: str) -> subprocess.CompletedProcess:
    """A line of bash in which DPC is the command and F the file."""
    return subprocess.run(
        ["bash", "-c", line.replace("DPC", f'"{sys.executable}" -m dpcli').replace("F", f"'{path}'")],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "PYTHONPATH": str(ROOT), **env},
    )


@pytest.mark.parametrize(
    ("line", "code", "said"),
    [
        ("DPC info F >&-", 0, ""),
        ("DPC evaluate classification F >&-", 0, ""),
        ("DPC info F >&- 2>&- <&-", 0, ""),
        ("DPC info absent 2>&-", 3, ""),
        ("DPC classify fuse F F.copy -o - --force >&-", 2, "-o -: standard output is closed"),
        ("DPC info - <&-", 2, "-: standard input is closed; pipe a command"),
        ("DPC evaluate report - --markdown <&-", 2, "-: standard input is closed; pipe a command"),
        ("DPC evaluate classification <(cat F)", 3, "a FIFO, expected a regular file; to read from a pipe give `-`"),
        ("DPC prepare split <(cat F) -o x.h5", 3, "a FIFO, expected a regular file; to read from a pipe give `-`"),
    ],
)
def test_closed_streams_and_pipes_in_the_place_of_files(named, line, code, said):
    shutil.copy(named, f"{named}.copy")
    before = named.read_bytes()
    done = shell(line, named)
    assert (done.returncode, done.stdout) == (code, "") and said in done.stderr and "a bug" not in done.stderr
    assert bool(said) == bool(done.stderr) and named.read_bytes() == before and "Exception" not in done.stderr


@pytest.mark.parametrize("stderr", ["2>/dev/full", "2> >(true)"])
@pytest.mark.parametrize("debug", ["", "--debug"])
def test_messages_that_nobody_can_be_told_do_not_end_the_work(named, tmp_path, stderr, debug):
    """The log is on a full disk, or nobody reads the pipe any more."""
    for sample in "ab":
        (tmp_path / "raw" / sample).mkdir(parents=True)
        np.save(tmp_path / "raw" / sample / "0.npy", np.ones((3, 3), np.float32))
    (tmp_path / "raw" / "b" / "1.npy").write_bytes(b"no array")  # is skipped, which is told
    words = f"prepare clouds {tmp_path}/raw -o {tmp_path}/o.h5 --jobs 2 -v {debug}"
    done = shell(f"exec {stderr}; sleep 0.2; DPC {words}", named)
    assert done.returncode == 0 and os.listdir(tmp_path) in (["raw", "o.h5"], ["o.h5", "raw"]), done
    with CloudsReader(tmp_path / "o.h5") as reader:
        assert reader.names == ["a"] and [name for name, _ in reader.skipped] == ["b"]
    done = shell(f"exec {stderr}; sleep 0.2; DPC info absent {debug}", named)
    assert done.returncode == 3, done


@pytest.mark.parametrize(
    "words", ["info F --page x.html", "evaluate report F -o x.html", "evaluate classification F --picture x.png"]
)
def test_a_current_folder_that_was_removed_is_said(named, tmp_path, words):
    done = shell(f"cd {tmp_path}; mkdir gone; cd gone; rmdir ../gone; DPC {words}", named)
    assert done.returncode == 3 and done.stderr.startswith("dpc: error: the current folder was removed; "), done.stderr
    assert done.stderr.count("\n") == 1


def test_who_has_no_home_gets_no_folder_called_like_it(monkeypatch):
    """A container's user without HOME and without an entry among the system's: numba kept its cache in ./~"""
    monkeypatch.setenv("PYTHONSAFEPATH", "")
    monkeypatch.setenv("MPLBACKEND", "")
    monkeypatch.delenv("HOME")
    monkeypatch.setattr("pwd.getpwuid", Mock(side_effect=KeyError))
    settle_interpreter()
    assert os.path.expanduser("~/.cache") == "/dev/null/.cache"


def test_a_backend_that_matplotlib_no_longer_has_draws_no_picture(monkeypatch):
    """Old settings of shells name it; each picture and page ended as a bug."""
    monkeypatch.setenv("PYTHONSAFEPATH", "")
    monkeypatch.setenv("MPLBACKEND", "Qt4Agg")
    with pytest.raises(ValueError, match="not a valid value for backend"):
        validate_backend(os.environ["MPLBACKEND"])
    settle_interpreter()
    validate_backend(os.environ["MPLBACKEND"])


@pytest.mark.parametrize(("given", "variable"), [(["-OO", "-m", "dpcli"], "1"), (["-m", "dpcli"], "2")])
def test_docstrings_are_kept_since_they_are_the_help(monkeypatch, given, variable):
    """Python drops them where it is asked to, as some images of containers do for all programs."""
    monkeypatch.setenv("PYTHONSAFEPATH", "")
    monkeypatch.setenv("PYTHONOPTIMIZE", variable)
    monkeypatch.setattr("sys.orig_argv", [sys.executable, *given, "info"])
    monkeypatch.setattr("sys.flags", Mock(optimize=2))
    monkeypatch.setattr("os.execv", started := Mock())
    settle_interpreter()
    started.assert_called_once_with(sys.executable, [sys.executable, "-m", "dpcli", "info"])
    assert "PYTHONOPTIMIZE" not in os.environ


def test_what_a_terminal_can_not_show_is_spelled(named):
    ascii_only = {"PYTHONUTF8": "0", "LC_ALL": "POSIX", "PYTHONCOERCECLOCALE": "0"}
    shutil.copy(named, other := named.with_name("p\u00fcnch.h5"))  # the same text as name of a file and of a class
    for line in ("DPC info F", "DPC evaluate classification F", "DPC evaluate classification F --markdown"):
        done = shell(line, other, **ascii_only)
        assert done.returncode == 0 and done.stdout.count("p\\xfcnch") >= 2 and "udc" not in done.stdout, done.stderr
        done = shell(line, other, PYTHONUTF8="1")
        assert (
            "p\u00fcnch" in done.stdout
            and "\\x1b[31mred\\x9b2J" in re.sub(r"\\([\\[])", r"\1", done.stdout)  # markdown escapes both
            and not {"\x1b", "\x9b"} & set(done.stdout)
        )
