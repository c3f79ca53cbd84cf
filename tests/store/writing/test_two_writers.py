"""Two processes that write one file: what the first one made is whole under its name, whatever the second one does."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from dpcli.errors import UsageError
from dpcli.runtime import whole_file as module
from dpcli.runtime.whole_file import put_in_place, whole_file
from dpcli.store.writing import atomic_file
from dpcli.store.writing.atomic_file import AtomicFile
from tests.support.prepare_helpers import ROOT

OTHER = """
import sys
from pathlib import Path
from dpcli.errors import DpcError
from dpcli.store.writing.atomic_file import AtomicFile
try:
    AtomicFile(sys.argv[1]).discard()
except DpcError as error:
    print(error)
"""
STOPPED = """
import os, sys
from pathlib import Path
from dpcli.runtime.whole_file import whole_file
with whole_file(Path(sys.argv[1])) as part:
    part.write_text("half")
    print("half", flush=True)
    sys.stdin.read()
"""


def python(code: str, *words: object, **env: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, words)],
        env={**os.environ, "PYTHONPATH": str(ROOT), **env},
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.parametrize("moment", ["in the middle", "as it is brought to the disk"])
@pytest.mark.parametrize("locking", ["", "TRUE", "FALSE"])
def test_a_second_writer_of_an_hdf5_file_is_refused_before_it_empties_the_first_ones(
    moment, locking, tmp_path, monkeypatch
):
    path, said = tmp_path / "a.h5", []

    def bring(part: Path, target: Path) -> None:
        if moment == "as it is brought to the disk":
            said.append(python(OTHER, path, HDF5_USE_FILE_LOCKING=locking).stdout)
        put_in_place(part, target)

    monkeypatch.setattr(atomic_file, "put_in_place", bring)
    with AtomicFile(path) as file:
        file["a"] = np.arange(10**5)
        file.flush()
        if moment == "in the middle":
            said.append(python(OTHER, path, HDF5_USE_FILE_LOCKING=locking).stdout)
    assert said == [f"{path}: cannot write (another dpc is writing it)\n"]
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["a"][()], np.arange(10**5))
    assert os.listdir(tmp_path) == ["a.h5"]
    assert python(OTHER, path).stdout == ""  # the first one is done


def test_hdf5_that_is_told_to_lock_writes_all_the_same(tmp_path):
    code = "import sys; from dpcli.store.writing.atomic_file import AtomicFile\nwith AtomicFile(sys.argv[1]) as file: file['a'] = 1"
    done = python(code, tmp_path / "a.h5", HDF5_USE_FILE_LOCKING="TRUE")
    assert (done.returncode, done.stderr, os.listdir(tmp_path)) == (0, "", ["a.h5"])


def test_of_two_writers_of_another_file_the_last_one_wins_and_a_killed_one_leaves_nothing(tmp_path):
    path = tmp_path / "a (1).html"
    other = subprocess.Popen(
        [sys.executable, "-c", STOPPED, path],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert other.stdout.readline() == "half\n"
    with whole_file(path) as part:
        part.write_text("whole")
    assert path.read_text() == "whole" and len(os.listdir(tmp_path)) == 2
    other.kill()
    other.communicate()
    with whole_file(path) as part:
        part.write_text("again")
    assert path.read_text() == "again" and os.listdir(tmp_path) == [path.name]


def test_what_only_looks_like_the_rest_of_a_killed_run_stays(tmp_path, monkeypatch):
    """Of a process that runs, of another file, or with a number that is no process's."""
    monkeypatch.setattr(module.os, "getpid", lambda: 7)
    names = [f".a.html.{os.getppid()}.part.html", ".b.html.999999999.part.html", f".a.html.{10**30}.part.html"]
    for name in names:
        (tmp_path / name).write_text("kept")
    (tmp_path / ".a.html.999999999.part.html").mkdir()
    with whole_file(tmp_path / "a.html") as part:
        part.write_text("whole")
    assert sorted(os.listdir(tmp_path)) == sorted([*names, "a.html"])


def _write_folder(path, names):
    with whole_file(path) as part:
        part.mkdir()
        for name in names:
            (part / name).write_text(name)


def test_a_folder_is_replaced_by_renaming_so_that_a_kill_leaves_none_half_removed(tmp_path, monkeypatch):
    """Killed as the old folder is removed, the new one is whole under its name; the next run removes what is left of the old."""
    _write_folder(tmp_path / "out", "abc")

    def killed(path, **how):
        assert sorted(os.listdir(tmp_path / "out")) == ["d", "e"]
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(module.shutil, "rmtree", killed)
        _write_folder(tmp_path / "out", "de")
    assert sorted(os.listdir(tmp_path / "out")) == ["d", "e"]
    left = next(path for path in tmp_path.iterdir() if path.name != "out")
    left.rename(tmp_path / ".out.999999999.old")
    _write_folder(tmp_path / "out", "f")
    assert os.listdir(tmp_path) == ["out"] and os.listdir(tmp_path / "out") == ["f"]


def test_a_folder_that_cannot_be_replaced_stays(tmp_path, monkeypatch):
    _write_folder(tmp_path / "out", "abc")
    rename = os.replace

    def refusing(old, new):
        if str(old).endswith(".part"):
            raise PermissionError(1, "not permitted")
        rename(old, new)

    with monkeypatch.context() as patch, pytest.raises(PermissionError):
        patch.setattr(module.os, "replace", refusing)
        _write_folder(tmp_path / "out", "de")
    assert os.listdir(tmp_path) == ["out"] and sorted(os.listdir(tmp_path / "out")) == ["a", "b", "c"]


def test_a_link_to_a_folder_is_written_through(tmp_path):
    (tmp_path / "far").mkdir()
    _write_folder(tmp_path / "far" / "real", "abc")
    (tmp_path / "out").symlink_to("far/real")
    _write_folder(tmp_path / "out", "de")
    assert (tmp_path / "out").is_symlink() and os.listdir(tmp_path / "far") == ["real"]
    assert sorted(os.listdir(tmp_path / "out")) == ["d", "e"]


def test_a_link_to_a_file_is_replaced_and_told(tmp_path, capsys):
    """Who reads what it led to would else take the old content for the new one."""
    old, link = tmp_path / "old.h5", tmp_path / "link.h5"
    old.write_bytes(b"old")
    link.symlink_to(old)
    with AtomicFile(link) as file:
        file["a"] = 1
    assert old.read_bytes() == b"old" and not link.is_symlink()
    told = f"dpc: warning: {link}: was a link and is a file now; {old}, where it led to, is as it was\n"
    assert capsys.readouterr().err == told
    with whole_file(link) as part:
        part.write_bytes(b"new")
    assert link.read_bytes() == b"new" and capsys.readouterr().err == ""


def test_the_current_folder_is_not_replaced(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in (".", str(tmp_path), f"../{tmp_path.name}"):
        with pytest.raises(UsageError, match="is the current folder, which can't be replaced; name a new one in it"):
            module.check_replaced(Path(name), ("*.png",))
