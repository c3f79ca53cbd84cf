"""`dpc segment train` as its users run it: train, stop, continue, mistakes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from dpcli.cli.app import app
from dpcli.errors import DataError
from dpcli.segment.training.trainer import Trainer
from dpcli.store import CloudsWriter
from dpcli.text_files import read_toml
from tests.support.drawers import TRAIN, drawer, predicted


def test_training_leaves_what_people_look_for(run_folder):
    rows = json.loads((run_folder / "log.json").read_text())
    assert [row["epoch"] for row in rows] == [1, 2] and all(np.isfinite(row["loss"]) for row in rows)
    assert rows[0]["flow_error"] > 0 and rows[1]["motion"] is not None and rows[1]["consensus"] is not None
    assert (run_folder / "curves.png").read_bytes()[:4] == b"\x89PNG"


def test_running_again_continues_and_another_configuration_is_refused(dpc_here, data, run_folder):
    again = dpc_here("segment", "train", data, "-o", run_folder, *TRAIN)
    assert again.returncode == 0 and b"is finished already" in again.stderr and b"continuing" not in again.stderr
    other = dpc_here("segment", "train", data, "-o", run_folder, *TRAIN[:-1], 4)
    assert other.returncode == 2 and b"another configuration" in other.stderr


def test_a_command_that_fails_deletes_no_network(dpc_here, data, run_folder, tmp_path):
    """--force empties the folder only once everything else is there, checked and read."""
    folder, other = shutil.copytree(run_folder, tmp_path / "run"), shutil.copytree(run_folder, tmp_path / "other")
    (other / "flows_first.npy").unlink()
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert {"best.safetensors", "flows_first.npy", "state.pt"} <= before.keys()
    for more, said in (
        (("--init", folder), "--init"),
        (("--init", "nosuch"), "--init nosuch: no such file"),
        (("--set", f"flows_of={folder}"), "is in the folder of -o"),
        (("--set", f"flows_of={other}"), "no flows of a `dpc segment train` run"),
        (("--flow", "nosuch"), "--flow nosuch: expected icp"),
    ):
        done = dpc_here("segment", "train", data, "-o", folder, *TRAIN, "--force", *more)
        code = 3 if more[1] == "nosuch" and more[0] == "--init" else 2  # what is not there is no wrong use
        assert done.returncode == code and said in done.stderr.decode() and b"--model" not in done.stderr, (
            more,
            done.stderr,
        )
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == before, more


def test_a_finished_run_needs_its_flows_no_more(dpc_here, data, run_folder, tmp_path):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    for flows in folder.glob("*.npy"):
        flows.unlink()
    before = {path.name: path.read_bytes() for path in folder.glob("*.safetensors")}
    again = dpc_here("segment", "train", data, "-o", folder, *TRAIN)
    assert again.returncode == 0 and b"is finished already" in again.stderr
    assert {path.name: path.read_bytes() for path in folder.glob("*.safetensors")} == before


KILLED = """
import os, signal, sys
from dpcli.cli.app import main
from dpcli.segment.training.trainer import Trainer

keep = Trainer._keep_flow

def keep_and_die(self, pairs, flow):
    keep(self, pairs, flow)
    if (self.epoch, self.step) == (1, 1):
        os.kill(os.getpid(), signal.SIGKILL)

Trainer._keep_flow = keep_and_die
main(sys.argv[1:])
"""


def test_a_killed_run_ends_like_an_uninterrupted_one(data, run_folder, dpc_here, tmp_path, monkeypatch):
    """SIGTERM saves and exits 75; kill -9 loses what came after the last checkpoint; weights and flows come out equal."""
    folder = tmp_path / "killed"
    words = ("segment", "train", data, "-o", folder, *TRAIN)
    with monkeypatch.context() as patch:
        step = Trainer._step

        def step_and_stop(self, *given):
            os.kill(os.getpid(), signal.SIGTERM)
            return step(self, *given)

        patch.setattr(Trainer, "_step", step_and_stop)
        stopped = dpc_here(*words)
    assert stopped.returncode == 75 and b"saved at epoch 1, step 1" in stopped.stderr, stopped.stderr
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[3])}
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, *map(str, words)], env=environment, capture_output=True, timeout=120
    )
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    done = dpc_here(*words)
    assert done.returncode == 0, done.stderr
    from safetensors.torch import load_file

    ours, theirs = (load_file(f / "last.safetensors") for f in (folder, run_folder))
    distance = sum(float((ours[k] - theirs[k]).square().sum()) for k in ours) ** 0.5
    assert distance <= 1e-3 * sum(float(v.square().sum()) for v in theirs.values()) ** 0.5
    flows = [np.load(f / "flows.npy") for f in (folder, run_folder)]
    assert np.abs(flows[0] - flows[1]).max() < 1e-3


def test_supervised_training_learns_from_scene_flow(flow_data, tmp_path):
    def train(data: Path, name: str):
        words = ["-o", tmp_path / name, "--supervised", "--points", 48, "--batch", 2, "--epochs", 1]
        words += ["--set", "pairs_per_epoch=2"]
        return CliRunner().invoke(app, ["segment", "train", str(data), *map(str, words)])

    assert train(flow_data, "run").exit_code == 0
    rows = json.loads((tmp_path / "run" / "log.json").read_text())
    assert all(np.isfinite(row["loss"]) and row["motion"] > 0 and row["flow_error"] == 0 for row in rows)
    with CloudsWriter(tmp_path / "bare.h5", fields=["part"]) as writer:
        writer.write(drawer("d", 0, split="train"))
    refused = train(tmp_path / "bare.h5", "no").exception
    assert isinstance(refused, DataError)
    assert "poses or scene flow, but the file has no pose or scene_flow" in str(refused)


def test_supervised_training_learns_from_a_prediction(tmp_path):
    """A parts file needs no poses; its weights say that no annotation was read."""
    from dpcli.segment.network.model_file import load_model

    data = predicted(tmp_path / "parts.h5", [drawer(name, 0, split="train") for name in "ab"], unsure=5)
    words = ["--supervised", "--points", 48, "--batch", 2, "--epochs", 1, "--set", "pairs_per_epoch=2"]
    done = CliRunner().invoke(app, ["segment", "train", str(data), "-o", str(tmp_path / "run"), *map(str, words)])
    assert done.exit_code == 0, done.exception
    (row,) = json.loads((tmp_path / "run" / "log.json").read_text())
    assert np.isfinite(row["loss"]) and row["motion"] > 0
    _, notes = load_model(tmp_path / "run" / "best.safetensors")
    assert notes["supervised"] is False and notes["labels"] == "predicted"


@pytest.mark.parametrize(
    "words, said",
    [
        (("--set", "group=foo"), "group = foo: expected one of icosahedral, trivial"),
        (("--set", "pooling=foo"), "pooling = foo: expected one of point, global"),
        (("--set", "smooth=-1"), "smooth = -1: expected at least 0"),
        (("--set", "cold_start=-0.5"), "cold_start = -0.5: expected at least 0"),
        (("--set", "motion_after=-0.1"), "motion_after = -0.1: expected at least 0"),
        (("--set", "flow_decay=1.5"), "flow_decay = 1.5: expected at least 0 and at most 1"),
        (("--lr", "0"), "lr = 0: expected a number above 0"),
        (("--lr", "1e+300"), "lr = 1e+300: expected a finite number below 1e+30"),
        (("--set", "tau=0"), "tau = 0: expected a number above 0"),
        (("--set", "loss=l2"), "loss = l2: expected one of blended, per-part"),
        (("--set", "consensus=foo"), "consensus = foo: expected one of thesis, release, none"),
        (("--set", "nonsense=1"), "unknown setting nonsense"),
        (("--preset", "huge"), "preset = huge: expected one of compact, release"),
        (("--validation", "lamp"), "no class 'lamp'"),
        (("--validation", "drawer"), "--validation drawer: holds out all of the 4 training sequences"),
        (("--flow", "nowhere.safetensors"), "--flow nowhere.safetensors: expected icp, nearest"),
    ],
)
def test_a_wrong_choice_is_named_before_anything_is_made(words, said, dpc_here, data, tmp_path):
    done = dpc_here("segment", "train", data, "-o", tmp_path / "model", *TRAIN, *words)
    assert done.returncode == 2 and said in done.stderr.decode(), done.stderr
    assert not (tmp_path / "model").exists()


@pytest.mark.parametrize("words", [("train",), ("flow",)])
def test_several_processes_of_torchrun_are_refused_before_one_overwrites_the_other(
    words, dpc_here, data, tmp_path, monkeypatch
):
    monkeypatch.setenv("WORLD_SIZE", "2")
    done = dpc_here("segment", *words, data, "-o", tmp_path / "model")
    assert done.returncode == 2 and b"trains in one process, but torchrun started 2" in done.stderr
    assert not (tmp_path / "model").exists()


def test_a_run_that_diverges_is_told(dpc_here, data, tmp_path):
    done = dpc_here("segment", "train", data, "-o", tmp_path / "model", *TRAIN, "--set", "lr=1e12")
    said = done.stderr.decode()
    assert done.returncode == 1 and "training diverged (epoch " in said and "with a smaller lr" in said, said


def test_the_settings_beside_the_weights_make_the_same_run(dpc_here, data, run_folder, tmp_path):
    """`settings.toml` alone continues the run; what it says was resolved from the preset and the options."""
    said = read_toml(run_folder / "settings.toml")
    assert said["network"]["sizes"] == "compact" and said["network"]["points"] == 48
    assert said["schedule"]["pairs_per_epoch"] == 6 and said["objective"]["loss"] == "blended"
    words = ("--preset", "release", "--config", run_folder / "settings.toml", "--seed", 3)
    again = dpc_here("segment", "train", data, "-o", shutil.copytree(run_folder, tmp_path / "run"), *words)
    assert again.returncode == 0 and b"is finished already" in again.stderr, again.stderr
    other = dpc_here("segment", "train", data, "-o", run_folder, *words, "--set", "motion_head=false")
    assert other.returncode == 2 and b"network.motion_width" in other.stderr.replace(b" ", b"."), other.stderr
