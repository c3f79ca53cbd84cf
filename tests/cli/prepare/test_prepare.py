"""`dpc prepare` as a user runs it: results on stdout, exit codes, signals, pipes."""

from __future__ import annotations

import hashlib
import io
import os
import signal
import subprocess
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from dpcli.runtime.provenance import file_digest
from dpcli.store import CloudsReader
from tests.support.prepare_helpers import DPC, ROOT, dpc, write_msr

SYNTHETIC = ("prepare", "synthetic", "gestures", "--frames", "6", "--size", "64", "--videos-per-class")


def test_a_folder_becomes_a_file(tmp_path):
    write_msr(tmp_path / "raw", ["a01_s01_e01", "a02_s06_e01"])
    out = tmp_path / "msr.h5"
    result = dpc("prepare", "msraction3d", tmp_path / "raw", "-o", out, "--scale", "1", "--jobs", "1")
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith(f"{out}: 2 sequences, 6 frames, ") and "0 skipped" in result.stdout
    assert result.stdout.count("\n") == 1
    assert "dpc: 2 of the 567 published videos found" in result.stderr
    with CloudsReader(out) as reader:
        assert (list(reader.names), list(reader.splits)) == (["a01_s01_e01", "a02_s06_e01"], ["train", "test"])
        assert reader.length_unit == "raw depth unit" and len(reader.class_names) == 20
    assert "already complete" in dpc("prepare", "msraction3d", tmp_path / "raw", "-o", out, "--scale", "1").stderr
    other = dpc("prepare", "msraction3d", tmp_path / "raw", "-o", out)
    assert other.returncode == 2 and "scale 1.0, now 300.0" in other.stderr and "--force" in other.stderr


def test_skipped_samples_are_listed_and_the_good_ones_kept(tmp_path):
    raw = write_msr(tmp_path / "raw", ["a01_s01_e01"])
    (raw / "a02_s01_e01_sdepth.bin").write_bytes(b"")
    result = dpc("prepare", "msraction3d", raw, "-o", tmp_path / "out.h5", "--jobs", "2")
    assert result.returncode == 0 and "1 skipped" in result.stdout
    assert "a02_s01_e01: " in result.stderr and "0 bytes; the header alone takes 12" in result.stderr
    (raw / "a01_s01_e01_sdepth.bin").write_bytes(b"")
    nothing = dpc("prepare", "msraction3d", raw, "-o", tmp_path / "none.h5", "--jobs", "1")
    assert nothing.returncode == 3 and "none of the 2 samples is good" in nothing.stderr
    assert not (tmp_path / "none.h5").exists() and nothing.stdout == ""


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["msraction3d", "nowhere"], 3, "nowhere: does not exist; expected a folder with MSR-Action3D"),
        (["msraction3d", "."], 3, "no MSR-Action3D files named"),
        (["msraction3d", ".", "--train-subjects", "1,two"], 2, "--train-subjects 1,two: expected whole numbers"),
        (["depth", ".", "--fx", "500"], 2, "--fx, --cx and --cy belong together"),
        (["synthetic", "gestures", "--sampling", "best"], 2, "'best' is not one of 'random', 'fps', 'voxel'"),
        (["synthetic", "gestures", "--jobs", "0"], 2, "--jobs"),
        (["clouds"], 2, "raw"),
    ],
)
def test_mistakes_are_explained_in_a_few_lines(tmp_path, arguments, code, message):
    result = dpc("prepare", *arguments, "-o", "out.h5", cwd=tmp_path, env={**os.environ, "PYTHONPATH": pythonpath()})
    assert result.returncode == code
    assert message.lower() in result.stderr.lower() and "Traceback" not in result.stderr
    assert len(result.stderr.splitlines()) <= 8
    assert list(tmp_path.iterdir()) == [] and result.stdout == ""


def pythonpath() -> str:
    return os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])


def test_a_pipe_carries_the_same_bytes_as_a_file(tmp_path):
    piped = dpc(*SYNTHETIC, "1", "-o", "-", "--jobs", "1", text=False)
    assert piped.returncode == 0
    with h5py.File(io.BytesIO(piped.stdout)) as file:
        assert file.attrs["dpc_kind"] == "clouds"
    dpc(*SYNTHETIC, "1", "-o", tmp_path / "a.h5", "--jobs", "1")
    assert file_digest(tmp_path / "a.h5") == hashlib.sha256(piped.stdout).hexdigest()


def test_options_reach_the_readers(tmp_path):
    np.save(tmp_path / "v.npy", np.full((4, 6, 8), 2000, np.uint16))
    camera = ("--fx", "10", "--cx", "3.5", "--cy", "2.5", "--depth-scale", "500")
    timing = ("--stride", "2", "--fps", "10", "--jobs", "1")
    depth = dpc("prepare", "depth", tmp_path / "v.npy", "-o", tmp_path / "d.h5", *camera, *timing)
    assert depth.returncode == 0, depth.stderr
    with CloudsReader(tmp_path / "d.h5") as reader:
        sequence = reader.read(0)
        np.testing.assert_allclose(sequence.frame(0)[0], [-1.4, -1.0, 4.0], rtol=1e-6)
        np.testing.assert_allclose(sequence.time, [0, 0.2])
    np.save(tmp_path / "v.npy", np.ones((5, 3)))
    options = ("--unit", "mm", "--scale", "0.5", "--limit", "1", "--points", "2", "--compression", "gzip")
    clouds = dpc("prepare", "clouds", tmp_path, "-o", tmp_path / "c.h5", *options)
    assert clouds.returncode == 0, clouds.stderr
    with CloudsReader(tmp_path / "c.h5") as reader:
        assert reader.length_unit == "mm" and reader.read(0).points.tolist() == [[2, 2, 2]] * 2


VIDEOS = 25  # per class


def start(out: Path, videos: int = VIDEOS) -> subprocess.Popen:
    """A conversion of some seconds, in a process group of its own, that has written something already."""
    part = out.with_name(f".{out.name}.part")
    before, deadline = part.stat().st_size if part.exists() else 0, time.monotonic() + 60
    process = subprocess.Popen(
        [*DPC, *SYNTHETIC, str(videos), "-o", str(out), "--jobs", "2"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        start_new_session=True,
        # ignored where a shell put us in the background
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    while not (part.exists() and part.stat().st_size > before + 100_000):
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.01)
    return process


def stop(process: subprocess.Popen, number: int, whole_group: bool) -> tuple[int, str]:
    """Send a signal, to the process or to its group -> exit code, stderr. What hangs is killed and fails the test."""
    (os.killpg if whole_group else os.kill)(process.pid, number)
    try:
        stdout, stderr = process.communicate(timeout=90)  # ends when every process has closed its stderr
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        raise
    assert stdout == "" and "Traceback" not in stderr, stderr
    return process.returncode, stderr


def test_signals_stop_and_the_next_run_continues(tmp_path):
    """SIGTERM, then Ctrl-C as a terminal sends it (to all processes), then to the end: the bytes of one whole run."""
    out = tmp_path / "out.h5"
    code, stderr = stop(start(out), signal.SIGTERM, whole_group=False)
    assert code == 75 and "run the same command again to continue" in stderr
    code, stderr = stop(start(out), signal.SIGINT, whole_group=True)
    assert code == 130 and "interrupted" in stderr
    assert not out.exists() and out.with_name(".out.h5.part").exists()
    result = dpc(*SYNTHETIC, str(VIDEOS), "-o", out)
    assert result.returncode == 0 and "continuing: " in result.stderr, result.stderr
    whole = tmp_path / "whole.h5"
    dpc(*SYNTHETIC, str(VIDEOS), "-o", whole)
    assert file_digest(out) == file_digest(whole)
    assert {p.name for p in tmp_path.iterdir()} == {"out.h5", "whole.h5"}


def test_a_batch_systems_signal_to_all_processes_stops_and_leaves_none_behind(tmp_path):
    out = tmp_path / "out.h5"
    code, stderr = stop(start(out), signal.SIGTERM, whole_group=True)
    assert code == 75 and "run the same command again to continue" in stderr
    assert out.with_name(".out.h5.part").exists()


def test_preparing_imports_no_torch(tmp_path):
    code = "import sys; from dpcli.cli.app import main\ntry: main(sys.argv[1:])\nfinally: print('torch' in sys.modules)"
    command = [DPC[0], "-c", code, *SYNTHETIC, "1", "-o", tmp_path / "a.h5", "--jobs", "1", "--points", "64"]
    result = subprocess.run([*command, "--sampling", "fps"], capture_output=True, text=True, cwd=ROOT)
    assert result.stdout.splitlines()[-1] == "False", result.stderr
