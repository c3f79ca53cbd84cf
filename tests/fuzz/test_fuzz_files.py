"""The fuzzer of files: a fixed slice of it finds nothing, what it is for would be found, and findings become small."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.fuzz.damage import draw
from tests.fuzz.forks import UNEXPECTED, Ended, Limits, forked
from tests.fuzz.minimize import Budget, differences, edited, minimal
from tests.fuzz.verdict import cause, faults

ROOT = Path(__file__).parents[2]
QUIET = Ended(0, "", "", 0.1, 100 << 20)
pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks are watched as Linux does")


BAR = "dpc: train dynamic 184/320 57% 6.5 clip/s epoch 23/40 loss 2.118 eta 20s\n"


def found(tmp_path, code=0, said="", printed="", memory=100 << 20, quiet=0.0):
    return list(faults(Ended(code, said, printed, 0.1, memory, quiet), QUIET, tmp_path))


@pytest.mark.parametrize(
    "ended, words",
    [
        ({"code": 3, "said": "dpc: error: x: damaged"}, []),
        ({"code": 1, "said": "dpc: error: KeyError: 'x' (a bug, or an unusual machine; --debug shows where)"}, ["bug"]),
        ({"code": UNEXPECTED, "said": "Traceback (most recent call last)"}, ["traceback"]),
        ({"code": -signal.SIGSEGV}, ["signal SIGSEGV"]),
        ({"code": -signal.SIGXCPU}, ["hang"]),
        ({"code": -signal.SIGXCPU, "said": BAR, "quiet": 4.0}, []),
        ({"code": -signal.SIGXCPU, "said": BAR, "quiet": 19.0}, ["hang"]),
        ({"code": -signal.SIGALRM, "said": f"{BAR}dpc: warning: x\n"}, ["hang"]),
        ({"code": 1, "said": "dpc: error: not enough memory on this machine"}, ["believed a size"]),
        ({"code": 3}, ["unexplained exit 3"]),
        ({"code": 3, "said": "dpc: error: \x1b[31mRED"}, ["unprintable"]),
        ({"memory": 400 << 20}, ["memory"]),
        ({"code": 99, "said": "x"}, ["traceback"]),
        ({"code": 4, "said": "x"}, ["exit 4"]),
    ],
)
def test_what_is_wrong_is_said(ended, words, tmp_path):
    assert found(tmp_path, **ended) == words


def test_an_output_beside_an_error_is_half_written(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "o.h5").write_bytes(b"\x89HDF")
    assert found(tmp_path, 3, "dpc: error: x") == ["half-written"] == found(tmp_path)


@pytest.mark.parametrize("said, words", [("2 sequences, 0 skipped", ["silent loss"]), ("2 sequences, 1 skipped", [])])
def test_frames_lost_without_a_word_are_found(said, words, tmp_path):
    import h5py
    import numpy as np

    for folder in ("in/depth", "out"):
        (tmp_path / folder).mkdir(parents=True)
    np.save(tmp_path / "in" / "depth" / "a.npy", np.zeros((5, 2, 2)))
    with h5py.File(tmp_path / "out" / "o.h5", "w") as file:
        file["frame_offsets"] = range(5)
    assert found(tmp_path, printed=said) == words


def test_one_cause_has_one_name():
    said = 'File "/x/dpcli/store/a.py", line {}, in read\n  boom\nFile "/y/h5py/b.py", line 3, in get\nKeyError: {}'
    names = {cause("bug", Ended(1, said.format(4, name), "", 0, 0)) for name in ("'a'", "'b'")}
    assert names == {"bug: KeyError in dpcli/store/a.py read"}
    assert len({cause("x", Ended(1, f"dpc: error: {n}.npy: claims {n} points", "", 0, 0)) for n in (3, 77)}) == 1


def test_forks_are_ended_in_time():
    assert forked(lambda: time.sleep(60) or 0, Limits(seconds=0.3)).code == -signal.SIGALRM
    said = forked(lambda: print("hi") or 7, Limits())
    assert (said.code, said.printed, said.said) == (7, "hi\n", "")
    ended = forked(lambda: print("x", file=sys.stderr) or time.sleep(0.6) or 0, Limits())
    assert 0.5 < ended.quiet < 5
    assert forked(lambda: len(bytearray(2 << 30)), Limits(memory=1 << 30)).code == UNEXPECTED


def test_findings_become_small():
    tried = []

    def test(parts):
        tried.append(parts)
        return {3, 11} <= set(parts)

    assert minimal(range(20), test) == [3, 11]
    calls = len(tried)
    assert calls < 100
    tried.clear()
    assert {3, 11} < set(minimal(range(20), Budget(3, 60).limited(test))) and len(tried) == 3


@pytest.mark.parametrize("new", [b"abcdXf", b"abc", b"abXXcdef", b"", b"abcdefab"])
def test_differences_are_the_edits_between_files(new):
    assert edited(b"abcdef", differences(b"abcdef", new)) == new


def test_damages_are_the_same_each_time(tmp_path):
    made = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        (folder / "x.csv").write_text("frame,x,y\n0,1.5,2\n1,2.5,3\n")
        for number in range(20):
            for one in draw(["x.csv"], random.Random(number)):
                one.kind != "tree" and one.apply(folder)
        made.append((folder / "x.csv").read_bytes())
    assert made[0] == made[1] != b"frame,x,y\n0,1.5,2\n1,2.5,3\n"


ONLY = "info in/(g|views)|prepare (?!anim|artemis)"  # no networks, whose seeds took longer than all inputs


def test_a_slice_of_it_finds_nothing(tmp_path):
    """In a process of its own: this one may have started threads, which a fork does without."""
    words = ["--inputs", "150", "--minutes", "5", "--seed", "30", "--only", ONLY]
    command = [sys.executable, "-m", "tests.fuzz.fuzz_files", str(tmp_path), *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=400)
    assert done.returncode == 0 and "seed 30: 150 inputs, 0 bad" in done.stdout, done.stdout + done.stderr
