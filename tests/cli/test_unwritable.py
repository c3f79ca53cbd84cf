"""Places nobody may write to: the same sentence and exit code in every command, before any work."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dpcli.draw.animation import write_pictures
from dpcli.errors import DataError
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.weights import find_weights
from dpcli.runtime.whole_file import DiskFull
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, ScoresWriter
from dpcli.store.pipes import check_output
from dpcli.store.writing.journal import Journal
from tests.support.commands import exit_code
from tests.support.prepare_helpers import ROOT, dpc

COMMANDS = [
    "prepare clouds raw -o ro/a.h5",
    "prepare synthetic gestures --frames 4 --size 32 -o ro/a.h5",
    "prepare synthetic animal --size 16 --frames 2 -o ro/v.h5",
    "prepare merge c.h5 -o ro/m.h5",
    "prepare split c.h5 -o ro/d",
    "classify train c.h5 -o ro/t",
    "classify predict c.h5 --model msraction3d-16 -o ro/p.h5",
    "segment predict c.h5 -o ro/p.h5",
    "segment predict c.h5 -o p.h5 --picture ro/p.png",
    "segment train c.h5 -o ro/s",
    "segment estimate-flow c.h5 -o ro/e.h5",
    "generate4d fit c.h5 -o ro/f",
    "generate4d render c.h5 -o ro/r.mp4",
    "generate4d export c.h5 -o ro/r.ply",
    "generate4d view c.h5 -o ro/r.html",
    "info c.h5 --picture ro/i.png",
    "info c.h5 --page ro/i.html",
    "evaluate classification s.h5 --split all --picture ro/c.png",
    "evaluate report s.h5 -o ro/r.md",
    "prepare merge c.h5 -o ro/there.h5 --force",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("unwritable")
    (root / "ro").mkdir()
    (root / "raw").mkdir()
    np.save(root / "raw" / "0.npy", np.ones((3, 3), np.float32))
    for path in (root / "c.h5", root / "ro" / "there.h5"):
        with CloudsWriter(path) as writer:
            writer.write(CloudSequence.from_frames("a", [np.ones((4, 3), np.float32)] * 2))
    with ScoresWriter(root / "s.h5", class_names=["a", "b"]) as writer:
        for n in range(4):
            writer.write(f"v{n}", np.eye(2)[n % 2], label=n // 2, split="test")
    return root


ONE_AFTER_THE_OTHER = """
import sys
from tests.support.commands import exit_code
for line in sys.argv[1:]:
    print("code", exit_code(*line.split()), flush=True)
"""


def in_read_only(folder: Path, lines: list[str]) -> str:
    """Runs commands where `ro` is a read-only file system; returns what they say, each with its exit code."""
    script = 'mount --bind "$D/ro" "$D/ro"; mount -o remount,ro,bind "$D/ro"; cd "$D"; exec "$@" 2>&1'
    done = subprocess.run(
        ["unshare", "-rm", "sh", "-ec", script, "sh", sys.executable, "-c", ONE_AFTER_THE_OTHER, *lines],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "D": str(folder), "PYTHONPATH": str(ROOT)},
    )
    if done.returncode != 0 and "code" not in done.stdout:
        pytest.skip(f"this machine lets nobody mount a file system of their own: {done.stderr}")
    return done.stdout


@pytest.mark.skipif(shutil.which("unshare") is None, reason="no unshare")
def test_a_read_only_file_system_is_said_alike(folder):
    said = in_read_only(folder, COMMANDS).split("code ")
    for line, told, after in zip(COMMANDS, said, said[1:], strict=False):
        lines = told.strip().split("\n")
        assert "the folder " in lines[-1] and "can't be written to (the file system is read-only)" in lines[-1], (
            line,
            told,
        )
        assert after.startswith("3\n"), (line, told)
    assert len(said) == len(COMMANDS) + 1


@pytest.mark.skipif(shutil.which("unshare") is None, reason="no unshare")
def test_what_is_complete_needs_no_room(folder, dpc):
    """The same work on a file that is there is not written again."""
    assert dpc("prepare", "clouds", "raw", "-o", "ro/made.h5", cwd=folder).returncode == 0
    said = in_read_only(folder, ["prepare clouds raw -o ro/made.h5"])
    assert "already complete" in said and said.endswith("code 0\n")


@pytest.mark.parametrize(
    "line",
    [
        "prepare merge absent.h5 -o m.h5",
        "prepare split absent.h5 -o d",
        "info absent.h5",
        "classify train absent.h5 -o t",
        "generate4d train-prior absent.h5 -o t",
    ],
)
def test_an_input_that_is_not_there_is_bad_data_everywhere(folder, dpc_here, monkeypatch, line):
    monkeypatch.chdir(folder)
    done = dpc_here(*line.split())
    assert done.returncode == 3 and b"absent.h5: no such file" in done.stderr


@pytest.mark.parametrize(
    ("name", "said"), [("folder", "holds no trained model"), ("pipe", "a FIFO, expected a regular file")]
)
def test_what_is_there_and_no_model_is_not_called_missing(name, said, tmp_path):
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(DataError, match=f"{name}: {said}; give a .safetensors file"):
        find_weights(tmp_path / name, None, "dpc classify train")


@pytest.mark.parametrize("size", ["0k", "16k", "600k"])
def test_a_full_tmpdir_is_named(folder, tmp_path, size):
    """Pipes are kept there on both sides; 0k: not even a folder can be made."""
    room = "-o size=64k,nr_inodes=1" if size == "0k" else f"-o size={size}"
    videos = 1 if size == "0k" else 40  # of each class; no more than is needed where it comes to its end
    script = (
        f'set -e; mount -t tmpfs {room} none "$TMPDIR"; set +e; cd "$D"\n'
        f'"{sys.executable}" -m dpcli prepare synthetic gestures --videos-per-class {videos} -o - | cat > "$OUT"; ls -A "$TMPDIR"\n'
    )
    done = subprocess.run(
        ["unshare", "-rm", "bash", "-c", script],
        capture_output=True,
        text=True,
        timeout=300,
        env={
            **os.environ,
            "D": str(folder),
            "TMPDIR": str(tmp_path),
            "OUT": str(folder / "out"),
            "PYTHONPATH": str(ROOT),
        },
    )
    if "mount" in done.stderr or "unshare" in done.stderr:
        pytest.skip("this machine lets nobody mount a file system of their own")
    if size == "0k":  # then Python takes the next place of its list, such as /tmp
        assert "Traceback" not in done.stderr and "a bug" not in done.stderr
        return
    assert "TMPDIR" in done.stderr and "no space left" in done.stderr and "set TMPDIR to" in done.stderr, done.stderr
    assert str(tmp_path) in done.stderr and done.stdout == "" and "Traceback" not in done.stderr


LOST = [
    "prepare split c.h5 --fractions 0.5,0,0.5 -o round",
    "prepare split c.h5 --fractions 0.5,0,0.5 -o lost/below",
    "generate4d fit c.h5 c.h5 -o lost/",
    "evaluate weights fetch alexnet --weights lost",
    "prepare synthetic gestures -o lost",
    "prepare merge c.h5 -o round --force",
    "info c.h5 --page lost",
    "prepare split c.h5 --fractions 0.5,0,0.5 -o lost.h5",
]


@pytest.mark.parametrize("line", LOST)
def test_an_output_folder_that_is_a_link_to_nowhere_is_named(line, folder, tmp_path, monkeypatch, dpc_here):
    monkeypatch.chdir(tmp_path)
    shutil.copyfile(folder / "c.h5", "c.h5")
    Path("lost").symlink_to("nowhere")
    Path("lost.h5").symlink_to("nowhere")
    Path("round").symlink_to("round")
    done = dpc_here(*line.split())
    words = (" is a link to nowhere, which is missing", " is a link in a circle")["round" in line]
    assert done.returncode == 3 and f"{words}; remove the link, or name another place" in done.stderr.decode()
    assert sorted(os.listdir()) == ["c.h5", "lost", "lost.h5", "round"]


def test_pictures_and_runs_in_a_folder_that_is_a_link_to_nowhere(tmp_path):
    (tmp_path / "lost").symlink_to("nowhere")
    with pytest.raises(DataError, match="lost is a link to nowhere, which is missing; remove the link"):
        write_pictures(tmp_path / "lost", [np.zeros((4, 4, 3), np.uint8)], fps=10)
    with pytest.raises(DataError, match="lost is a link to nowhere"), RunFolder(tmp_path / "lost", {}, columns=()):
        pass


ONE_FILE = [
    "prepare clouds raw -o taken.h5",
    "prepare merge c.h5 -o taken.h5",
    "classify baseline c.h5 -o taken.h5",
    "classify fuse s.h5 s2.h5 -o taken.h5",
    "segment joints c.h5 -o taken.h5",
    "segment predict c.h5 -o taken.h5",
    "classify explain pac c.h5 --model msraction3d-16 -o taken.h5",
    "evaluate report s.h5 -o taken.html",
    "generate4d view c.h5 -o taken.html",
    "info c.h5 --page taken.html",
]


@pytest.mark.parametrize("force", ["", " --force"])
@pytest.mark.parametrize("line", ONE_FILE)
def test_a_folder_in_the_place_of_an_output_file_is_said_alike(line, force, folder, tmp_path, monkeypatch, dpc_here):
    """Also with --force, and whether or not the command first looks whether its work is done."""
    monkeypatch.chdir(tmp_path)
    for name in ("c.h5", "s.h5"):
        shutil.copyfile(folder / name, name)
    shutil.copyfile("s.h5", "s2.h5")
    shutil.copytree(folder / "raw", "raw")
    for name in ("taken.h5", "taken.html"):
        Path(name).mkdir()
        Path(name, "mine").touch()
    done = dpc_here(*(line + force * ("info" not in line)).split())
    said = done.stderr.decode()
    assert done.returncode == 3 and f"{line.split()[-1]}: is a folder; name a file in it" in said, said
    assert Path("taken.h5", "mine").exists() and Path("taken.html", "mine").exists()


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no /proc")
@pytest.mark.parametrize("resume", [False, True])
def test_where_nobody_can_make_a_file_is_said_alike(resume):
    """With and without a journal, which is opened first."""
    with (
        pytest.raises(DataError, match=r"/proc/o.h5: cannot be written \(.*\); name a file in an existing folder"),
        CloudsWriter("/proc/o.h5", resume=resume),
    ):
        pass


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no /proc")
@pytest.mark.parametrize("name", ["o.mp4", "o.gif", "o.png"])
def test_a_clip_where_nobody_can_make_a_file_is_said_alike(name):
    with pytest.raises(DataError, match=rf"/proc/{name}: cannot be written \(.*\); name a file in an existing folder"):
        write_pictures(Path("/proc", name), [np.zeros((16, 16, 3), np.uint8)], fps=10)


def test_a_word_that_is_empty_is_no_input(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("afile").touch()
    check_output(Path("afile"), "-o", [""])


def test_a_second_full_disk_says_that_the_first_runs_samples_are_kept(tmp_path, monkeypatch):
    one = CloudSequence.from_frames("a", [np.ones((4, 3), np.float32)] * 2)
    with pytest.raises(DataError), CloudsWriter(tmp_path / "o.h5", resume=True, provenance={"seed": 1}) as writer:
        writer.write(one)
        writer.keep = True
        raise DataError("stopped")

    def full(self, *given: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch, pytest.raises(DiskFull, match="what an earlier run had done is kept") as told:
        patch.setattr(CloudsWriter, "write_again", full)
        CloudsWriter(tmp_path / "o.h5", resume=True, provenance={"seed": 1})
    assert "nothing was left" not in str(told.value)
    with CloudsWriter(tmp_path / "o.h5", resume=True, provenance={"seed": 1}) as writer:
        assert writer.written_names == ["a"]


def test_the_sample_that_found_no_room_is_not_counted_as_kept(tmp_path, monkeypatch):
    def full(self, *given: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with (
        pytest.raises(DiskFull, match="what is done, 1 sample, is kept"),
        CloudsWriter(tmp_path / "o.h5", resume=True) as writer,
    ):
        writer.write(CloudSequence.from_frames("a", [np.ones((4, 3), np.float32)] * 2))
        monkeypatch.setattr(Journal, "append", full)
        writer.write(CloudSequence.from_frames("b", [np.ones((4, 3), np.float32)] * 2))


@pytest.mark.parametrize("words", ["prepare clouds R -o o.h5", "prepare depth a.npy --labels R -o o.h5", "info R"])
def test_an_input_that_nobody_may_read_is_bad_data_everywhere(words, tmp_path, monkeypatch, capsys):
    """Where the parser finds it, too, which would call it wrong use."""
    monkeypatch.chdir(tmp_path)
    np.save("a.npy", np.ones((2, 4, 4), np.uint16))
    (tmp_path / "R").write_bytes(b"")
    may, opened = os.access, open
    monkeypatch.setattr(os, "access", lambda path, mode: may(path, mode) and os.path.basename(path) != "R")

    def refused(path, *more, **named):
        if os.path.basename(str(path)) == "R":
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return opened(path, *more, **named)

    monkeypatch.setattr("builtins.open", refused)
    assert exit_code(*words.split()) == 3 and "R: permission denied" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "option"),
    [
        ("segment predict own.h5 -o parts.h5 --ply -", "--ply"),
        ("info own.h5 --page -", "--page"),
        ("segment joints parts.h5 -o joints.h5 --picture -", "--picture"),
        ("generate4d render scene.h5 -o turn.gif --picture -", "--picture"),
        ("classify train own.h5 --preset tiny -o -", "-o"),
    ],
)
def test_what_goes_through_no_pipe_becomes_no_file_of_that_name(tmp_path, monkeypatch, capsys, words, option):
    monkeypatch.chdir(tmp_path)
    with CloudsWriter(tmp_path / "own.h5", class_names=["a", "b"]) as writer:
        for k in range(4):
            frame = np.random.default_rng(k).normal(size=(20, 3)).astype(np.float32)
            writer.write(CloudSequence.from_frames(f"s{k}", [frame, frame], label=k % 2, split="train", subject=k))
    assert exit_code(*words.split()) == 2
    assert f"{option} -: goes through no pipe here" in capsys.readouterr().err
    assert not (tmp_path / "-").exists()


def test_merge_and_split_go_through_pipes(tmp_path):
    for k in range(2):
        with CloudsWriter(tmp_path / f"{k}.h5", class_names=["a"]) as writer:
            for number in range(3):
                frame = np.random.default_rng(number).normal(size=(5, 3)).astype(np.float32)
                writer.write(CloudSequence.from_frames(f"{k}-{number}", [frame], label=0, split=("train", "test")[k]))
    first, second = tmp_path / "0.h5", tmp_path / "1.h5"
    joined = dpc("prepare", "merge", "-", second, "-o", "-", input=first.read_bytes(), text=False).stdout
    divided = dpc("prepare", "split", "-", "-o", "-", "--fractions", "0,0,1", input=joined, text=False).stdout
    (tmp_path / "whole.h5").write_bytes(divided)
    with CloudsReader(tmp_path / "whole.h5") as reader:
        assert len(reader) == 6 and set(reader.splits) == {"test"}


def test_a_first_run_that_finds_no_room_at_all_does_not_speak_of_an_earlier_one(tmp_path, monkeypatch):
    def full(self, *given: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Journal, "append", full)
    with pytest.raises(DiskFull, match="nothing was left under that name. Free space") as told:
        CloudsWriter(tmp_path / "o.h5", resume=True, provenance={"seed": 1})
    assert "earlier" not in str(told.value) and not os.listdir(tmp_path)


@pytest.mark.parametrize(
    ("words", "end", "most"),
    [
        ("prepare merge c.h5 -o", ".h5", 245),
        ("generate4d fit v.h5 -o", ".h5", 245),
        ("classify train c.h5 -o", "", 255),
        ("generate4d render c.h5 -o", ".mp4", 0),
        ("generate4d view c.h5 -o", ".html", 0),
        ("info c.h5 --picture", ".png", 0),
    ],
)
def test_a_name_too_long_for_the_unfinished_file_is_refused_before_the_work(words, end, most, folder, capsys):
    """`.NAME.part.new` lies beside an HDF5 file, `.NAME.PROCESS.part.SUFFIX` beside others."""
    most = most or 255 - len(f"..{os.getpid()}.part{end}")
    for count, refused in ((most, False), (most + 1, True), (256, True)):
        path = folder / ("ä" + "a" * (count - 2 - len(end)) + end)  # a letter of two bytes
        code = exit_code(*words.replace("c.h5", str(folder / "c.h5")).split(), str(path))
        said = capsys.readouterr().err
        assert ("the name is too long" in said) == refused, said
        if refused:
            assert code == 3 and f"({count} bytes); expected {most} at most" in said
        assert not any(one.name.startswith(".") for one in folder.iterdir())


def test_a_long_name_is_written_up_to_the_last_letter(tmp_path):
    path = tmp_path / ("a" * 242 + ".h5")
    words = "prepare synthetic gestures --videos-per-class 1 --frames 4 --size 32 --jobs 1 -o"
    assert exit_code(*words.split(), str(path)) == 0 and [one.name for one in tmp_path.iterdir()] == [path.name]


def test_a_picture_folder_of_too_long_a_name_is_a_sentence(tmp_path):
    with pytest.raises(DataError, match=r"cannot be written \(File name too long\); give it a shorter name"):
        write_pictures(tmp_path / ("a" * 250), [np.zeros((16, 16, 3), np.uint8)], fps=5)
