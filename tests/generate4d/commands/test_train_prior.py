"""`dpc generate4d train-prior` as its users run it: train on made-up creatures, stop, continue, mistakes."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file

from dpcli.generate4d.commands.train_prior import train_shape_prior
from dpcli.generate4d.shape.model_file import load_shape_model, save_shape_model
from dpcli.generate4d.shape.training.rounds import Sources, Window
from dpcli.generate4d.shape.training.settings import PRESETS, ShapeTraining
from dpcli.generate4d.shape.training.trainer import ShapeTrainer
from dpcli.prepare.synthetic.shape_pictures import picture_sources
from tests.support.commands import exit_code
from tests.support.gltf_files import arm, quad
from tests.support.pretend_card import pretend_card

# two rounds of pictures, as many steps of each; every step ends with a row and a state
WORDS = ("--preset", "tiny", "--jobs", 1, "--steps", 8, "--set", "reuse=1", "--set", "validation=6")


# all trainings here, also that of a process of its own, add in one order
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def trained(one_thread, tmp_path_factory):
    """A training that nobody stopped."""
    folder = tmp_path_factory.mktemp("prior") / "run"
    assert exit_code("generate4d", "train-prior", "-o", folder, *WORDS) == 0
    return folder


def test_training_leaves_what_people_look_for(trained):
    rows = json.loads((trained / "log.json").read_text())
    assert len(rows) == rows[-1]["step"] == 8 and all(np.isfinite(row["validation_loss"]) for row in rows)
    assert rows[0]["validation_inflated"] == rows[-1]["validation_inflated"] > 0
    assert (trained / "curves.png").read_bytes()[:4] == b"\x89PNG" and (trained / "settings.toml").exists()
    assert {value.dtype.itemsize for value in load_file(trained / "best.safetensors").values()} <= {2, 8}
    with (trained / "log.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(rows)


def test_a_stopped_run_ends_like_one_that_was_not(trained, tmp_path, monkeypatch):
    """SIGTERM saves and exits 75, kill -9 goes back to the last saved state; the weights are equal to the bit."""
    words = ("generate4d", "train-prior", "-o", tmp_path / "stopped", *WORDS)
    step = ShapeTrainer._one_step

    def terminated(trainer: ShapeTrainer, window: Window) -> None:
        if trainer.step == 2:
            signal.raise_signal(signal.SIGTERM)
        step(trainer, window)

    with monkeypatch.context() as patched:
        patched.setattr(ShapeTrainer, "_one_step", terminated)
        assert exit_code(*words) == 75 and _step(tmp_path / "stopped") == 3
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[3]), "OMP_NUM_THREADS": "1"}
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen([sys.executable, "-m", "dpcli", *map(str, words)], env=environment, **silent)
    deadline = time.monotonic() + 200
    while _step(tmp_path / "stopped") <= 4 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.kill()
    assert process.wait(timeout=200) in (-9, 0)
    assert exit_code(*words) == 0
    ours, theirs = (load_file(place / "last.safetensors") for place in (tmp_path / "stopped", trained))
    assert all(np.array_equal(ours[key], theirs[key]) for key in theirs)


def _step(folder: Path) -> int:
    """The last step in a run's log; 0 without one."""
    path = folder / "log.json"
    return json.loads(path.read_text())[-1]["step"] if path.exists() else 0


def test_it_goes_on_from_weights_of_the_same_sizes_only(trained, tmp_path, capsys):
    more = ("--init", trained, "--steps", 2)
    assert exit_code("generate4d", "train-prior", "-o", tmp_path / "more", *WORDS, *more) == 0
    scored = (*WORDS, "--init", trained, "--steps", 0)
    assert exit_code("generate4d", "train-prior", "-o", tmp_path / "scored", *scored) == 0
    before, now = (load_file(place / "best.safetensors") for place in (trained, tmp_path / "scored"))
    assert all(np.array_equal(now[key], before[key]) for key in before) and _step(tmp_path / "scored") == 0
    assert exit_code("generate4d", "train-prior", "-o", tmp_path / "nothing", *WORDS, "--steps", 0) == 2
    assert "steps = 0 scores the weights of init again, and none are given" in capsys.readouterr().err
    wide = ("--set", "widths=8,24")
    assert exit_code("generate4d", "train-prior", "-o", tmp_path / "wide", *WORDS, *more, *wide) == 2
    assert "another configuration" in capsys.readouterr().err


def test_a_run_goes_on_with_the_models_and_weights_it_began_with_only(trained, tmp_path, capsys):
    """Other contents under the same names are another training: nothing of the first one counts as this one's result."""
    models, weights = tmp_path / "models", tmp_path / "init.safetensors"
    models.mkdir()
    quad(1.0).write(models / "a.glb")
    (models / "._a.glb").write_bytes(b"what macOS writes beside a file")
    shutil.copy(trained / "best.safetensors", weights)
    words = ("generate4d", "train-prior", models, "--init", weights, *WORDS, "--steps", 1, "--set", "made=0.5")
    assert exit_code(*words, "-o", tmp_path / "run") == 0
    assert exit_code(*words, "-o", tmp_path / "run") == 0 and "finished already" in capsys.readouterr().err
    arm().write(models / "a.glb")
    assert exit_code(*words, "-o", tmp_path / "run") == 2 and "other models" in capsys.readouterr().err
    quad(1.0).write(models / "a.glb")
    save_shape_model(weights, load_shape_model(trained)[0], {"size": 16, "confidence": [0.5] * 17})
    assert exit_code(*words, "-o", tmp_path / "run") == 2 and "other init weights" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("--set", "size=30"), 2, "size = 30: expected a multiple of 4"),
        (("nosuch.glb",), 3, "nosuch.glb: no such file or folder"),
        (("--held-out", "nosuch.txt"), 3, "nosuch.txt: no such file"),
    ],
)
def test_mistakes_are_said(words, code, said, tmp_path, capsys):
    assert exit_code("generate4d", "train-prior", *words, "-o", tmp_path / "run", *WORDS) == code
    assert said in " ".join(capsys.readouterr().err.split())


def test_a_card_learns_what_the_cpu_learns(tmp_path):
    """All of a training on a pretended card: pictures, inflation, steps, validation; the same errors, row by row."""
    settings = ShapeTraining(**PRESETS["tiny"])
    schedule = replace(settings.schedule, steps=4, round=8, reuse=2)
    settings = settings._replace(schedule=schedule, data=replace(settings.data, validation=6))
    sources = picture_sources([], [], schedule.size, 0, made=1.0, moving=0.0, views=2, warp=0.1)
    makes = Sources(*(source.make for source in sources))
    rows = {}
    for device in ("cpu", "cuda"):
        with pretend_card() if device == "cuda" else contextlib.nullcontext():
            train_shape_prior(tmp_path / device, settings, makes, {}, seed=0, jobs=1, force=False, device=device)
        rows[device] = [list(row.values())[:-1] for row in json.loads((tmp_path / device / "log.json").read_text())]
    assert len(rows["cpu"]) == 4 and np.ptp([row[1] for row in rows["cpu"]]) > 0
    assert np.allclose(rows["cuda"], rows["cpu"], rtol=1e-3, atol=1e-4)
