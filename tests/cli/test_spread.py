"""Predictions spread over processes, shards and clusters, some of them killed: always the bytes of one plain run."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.model_file import ModelInfo, save_model
from dpcli.classify.presets import PRESETS
from dpcli.store import CloudsWriter
from dpcli.store.file import file_kind
from tests.support.commands import exit_code, typed
from tests.support.drawers import drawer
from tests.support.sessions import workers_of

ROOT = Path(__file__).resolve().parents[2]
COUNT = 7
COMMANDS = {
    "scores": ("classify", "predict", "videos.h5", "--model", "model.safetensors", "--batch", "3"),
    "parts": ("segment", "predict", "videos.h5", "--method", "ward", "--flow", "nearest", "--points", "40"),
    "network's parts": ("segment", "predict", "videos.h5", "--fast", "--flow", "nearest", "--points", "40"),
    "flow": ("segment", "estimate-flow", "videos.h5", "--flow", "nearest", "--points", "20"),
}


def save_untrained(path: Path, seed: int = 0) -> None:
    torch.manual_seed(seed)
    config = PRESETS["tiny"]["network"]
    config = type(config)(**{**config.__dict__, "num_classes": 2, "num_frames": 3, "points_per_frame": 48})
    save_model(path, Kinet(config), ModelInfo(config, ["a", "b"], "clips", {}))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Videos of different lengths, so that batches of clips would not end where videos end, and an untrained network."""
    folder = tmp_path_factory.mktemp("spread")
    with CloudsWriter(folder / "videos.h5", class_names=["a", "b"], fields=["part"]) as writer:
        for number in range(COUNT):
            writer.write(drawer(f"v{number}", number, frames=3 + number % 3, points=60, label=number % 2))
    save_untrained(folder / "model.safetensors")
    return folder


@pytest.fixture(scope="module")
def whole(folder) -> dict[str, bytes]:
    """What one plain run of each command writes, in this process."""
    made = {}
    for name, words in COMMANDS.items():
        here(folder, *words, "-o", folder / f"{name}.h5")
        made[name] = (folder / f"{name}.h5").read_bytes()
    return made


def here(folder: Path, *words: object) -> None:
    """Runs a command in this process, in this folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert typed(*words) == 0


def start(folder: Path, *words: object) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "dpcli", *map(str, words)],
        cwd=folder,
        env={
            **os.environ,
            "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
            "OMP_NUM_THREADS": "1",
        },
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    )


def run(folder: Path, *words: object) -> subprocess.CompletedProcess:
    process = start(folder, *words)
    out, err = process.communicate(timeout=300)
    return subprocess.CompletedProcess(words, process.returncode, out, err)


@pytest.mark.parametrize("name", COMMANDS)
def test_shards_made_side_by_side_and_merged_are_one_run(folder, whole, tmp_path, name):
    """One of them in a process of its own, killed with -9 and made again. All are, at once, as GNU parallel runs them, for
    the quickest command; the others' are made here, for whom a process would add only its start."""
    shards = [tmp_path / f"part-{k}.h5" for k in range(3)]
    words = [(*COMMANDS[name], "--shard", f"{k}/3", "-o", path) for k, path in enumerate(shards)]
    running = {k: start(folder, *words[k]) for k in (range(3) if name == "flow" else [1])}
    kill_once_it_writes(running.pop(1), tmp_path / ".part-1.h5.part", shards[1])
    for process in running.values():
        _, err = process.communicate(timeout=300)
        assert process.returncode == 0, err
    for k in {0, 1, 2} - running.keys():
        here(folder, *words[k])
    assert exit_code("prepare", "merge", *reversed(shards), "-o", tmp_path / "all.h5") == 0
    assert (tmp_path / "all.h5").read_bytes() == whole[name]
    assert {path.name for path in tmp_path.iterdir()} == {"all.h5", *(path.name for path in shards)}


def kill_once_it_writes(process: subprocess.Popen, journal: Path, out: Path) -> None:
    deadline = time.monotonic() + 120
    while process.poll() is None and not journal.exists() and not out.exists() and time.monotonic() < deadline:
        time.sleep(0.005)
    process.kill()
    process.communicate(timeout=90)


def test_a_worker_killed_in_the_middle_costs_only_time(folder, whole, tmp_path):
    name = "network's parts"
    process = start(folder, *COMMANDS[name], "--jobs", "2", "-o", tmp_path / "a.h5")
    deadline, killed = time.monotonic() + 120, []
    while process.poll() is None and not killed and time.monotonic() < deadline:
        busy = [pid for pid in workers_of(process.pid) if process_time(pid) > 1.0]  # it has loaded its libraries
        for pid in busy[:1]:
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)
        time.sleep(0.1)
    _, err = process.communicate(timeout=300)
    assert killed and process.returncode == 0, err
    assert (tmp_path / "a.h5").read_bytes() == whole[name], err


def process_time(pid: int) -> float:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.parametrize("name", ["scores", "flow"])
def test_a_dask_cluster_writes_the_same_bytes(folder, whole, tmp_path, name):
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    done = run(folder, *COMMANDS[name], "--dask", "local", "--jobs", "2", "-o", tmp_path / "a.h5")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.h5").read_bytes() == whole[name]


@pytest.mark.parametrize("task", ["segmentation", "motion"])
def test_an_evaluation_in_shards_has_the_numbers_of_one(folder, whole, tmp_path, monkeypatch, capsys, task):
    monkeypatch.chdir(folder)
    with CloudsWriter("truth.h5", class_names=["a", "b"], fields=["part", "pose"], force=True) as writer:
        for number in range(COUNT):
            writer.write(drawer(f"v{number}", number, frames=3 + number % 3, points=60, label=number % 2))
    words = ("evaluate", task, "parts.h5", "--truth", "truth.h5", "--resamples", "100")

    def result(*given: object) -> dict:
        capsys.readouterr()
        assert exit_code(*given, "--json") == 0
        return json.loads(capsys.readouterr().out)

    plain = result(*words)
    shards = [tmp_path / f"{k}.h5" for k in range(3)]
    for k, path in enumerate(shards):
        assert result(*words, "--shard", f"{k}/3", "-o", path)["samples"]["number"] == len(range(k, COUNT, 3))
    assert exit_code("prepare", "merge", *shards, "-o", tmp_path / "all.h5") == 0
    merged = result("evaluate", task, tmp_path / "all.h5", "--resamples", "100")
    assert merged | {"input": "parts.h5"} == plain
    assert result(*words, "--jobs", "2", "-o", tmp_path / "whole.h5") == plain
    assert (tmp_path / "whole.h5").read_bytes() == (tmp_path / "all.h5").read_bytes()
    assert exit_code(*words, "--shard", "0/3") == 2 and "-o FILE is missing" in capsys.readouterr().err
    assert exit_code("evaluate", task, shards[0]) == 3 and "dpc prepare merge joins" in capsys.readouterr().err
    other = {"segmentation": "motion", "motion": "segmentation"}[task]
    assert exit_code("evaluate", other, tmp_path / "all.h5") == 3 and task in capsys.readouterr().err


def test_more_shards_than_videos_and_a_shard_again(folder, whole, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    shards = [tmp_path / f"{k}.h5" for k in range(COUNT + 2)]
    for k, path in enumerate(shards):
        assert exit_code(*COMMANDS["flow"], "--shard", f"{k}/{COUNT + 2}", "-o", path) == 0
    assert exit_code(*COMMANDS["flow"], "--shard", f"0/{COUNT + 2}", "-o", shards[0]) == 0
    assert "already complete" in capsys.readouterr().err
    assert exit_code(*COMMANDS["flow"], "-o", shards[0]) == 2  # the whole is other work than a shard
    assert exit_code("prepare", "merge", *shards, "-o", tmp_path / "all.h5") == 0
    assert np.array_equal(content(tmp_path / "all.h5"), content(folder / "flow.h5"))


def content(path: Path) -> np.ndarray:
    import h5py

    with h5py.File(path) as file:
        return file["scene_flow"][:]


def test_mixtures_are_refused_with_what_differs(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    save_untrained(tmp_path / "other.safetensors", seed=1)
    with CloudsWriter(tmp_path / "videos.h5", class_names=["a", "b"], fields=["part"]) as writer:
        for number in range(2):
            writer.write(drawer(f"v{number}", number + 50, frames=3, label=number))
    base, first = list(COMMANDS["scores"]), tmp_path / "0.h5"
    assert exit_code(*base, "--shard", "0/2", "-o", first) == 0
    other = {
        "other weights": [*base[:4], tmp_path / "other.safetensors", *base[5:]],
        "clips_per_video 1, now absent": [*base, "--clips-per-video", "1"],
        "another clouds file": [*base[:2], tmp_path / "videos.h5", *base[3:]],
        "seed 4, now 0": [*base, "--seed", "4"],
        "holds parts": list(COMMANDS["parts"]),
    }
    for number, (said, words) in enumerate(other.items()):
        second = tmp_path / f"b{number}.h5"
        assert exit_code(*words, "--shard", "1/2", "-o", second) == 0
        capsys.readouterr()
        assert exit_code("prepare", "merge", second, first, "-o", tmp_path / "all.h5") == 2
        told = capsys.readouterr().err
        assert said in told and str(first) in told, told
    assert exit_code(*base, "-o", tmp_path / "whole.h5") == 0
    assert exit_code("prepare", "merge", first, tmp_path / "whole.h5", "-o", tmp_path / "all.h5") == 2
    assert "is not a shard" in capsys.readouterr().err and not (tmp_path / "all.h5").exists()
    assert file_kind(first) == "scores"


def test_a_video_that_kills_whoever_scores_it_is_named_and_the_others_are_scored(folder, tmp_path):
    """By a backbone of the user's own, which dies at the one video of another shape."""
    (tmp_path / "deadly.py").write_text(DEADLY)
    process = subprocess.run(
        [sys.executable, "-c", RUN_DEADLY, folder / "videos.h5", tmp_path / "flow.h5"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert process.returncode == 0, process.stderr
    assert "1 skipped:" in process.stderr and "v4: the process that worked on it died" in process.stderr
    assert process.stdout.split() == ["6", "v4"]


DEADLY = """
import os, signal
from dpcli.segment.commands.estimate_flow import FlowOfSequence
class Deadly(FlowOfSequence):
    def __call__(self, sequence):
        if sequence.name == "v4":
            os.kill(os.getpid(), signal.SIGKILL)
        return super().__call__(sequence)
"""
RUN_DEADLY = """
import sys
from dpcli.runtime.machines.spread import Spread
from dpcli.segment.commands import estimate_flow as module
from dpcli.store import CloudsReader
if __name__ == "__main__":
    from deadly import Deadly
    module.FlowOfSequence = Deadly
    options = dict(flow="nearest", points=20, as_points=False, split="all", seed=0, device="cpu", force=False)
    module.estimate_flow_of_file(sys.argv[1], sys.argv[2], **options, spread=Spread(jobs=2))
    made = CloudsReader(sys.argv[2])
    print(len(made), *(name for name, _ in made.skipped))
"""
