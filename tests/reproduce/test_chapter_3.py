"""The tables and figures of chapter 3: what the thesis says, what a stopped run keeps, and one real run of a few clips."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.model_file import ModelInfo, load_model, save_model
from dpcli.classify.settings import network_config
from dpcli.cli.app import main
from dpcli.reproduce import accuracy_tables, few_videos, figure_3_5, figure_3_8, figure_a_4, runs, table_3_1
from dpcli.reproduce.accuracy_tables import EXPERIMENTS, Plan, thesis_value
from dpcli.runtime.settings.catalog import Given
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, ScoresReader, ScoresWriter

ROOT = Path(__file__).resolve().parents[2]
PNG = b"\x89PNG\r\n\x1a\n"
BUDGET = ("--points", "48", "--batch", "4", "--epochs", "1", "--set", "epochs_dynamic=1", "--device", "cpu")

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def clouds(tmp_path_factory) -> Path:
    """Two gestures that differ in the direction of a blob's motion; one test video is shorter than four frames."""
    path, rng = tmp_path_factory.mktemp("data") / "clouds.h5", np.random.default_rng(0)
    with CloudsWriter(path, class_names=["left", "right"]) as writer:
        for i in range(10):
            frames = 3 if i == 9 else 5
            body = rng.normal(size=(frames, 60, 3)) * [0.2, 0.5, 0.1]
            body[:, :30, 0] += (1 if i % 2 else -1) * np.linspace(-0.5, 0.5, frames)[:, None]
            split = "train" if i < 4 else "test"
            writer.write(CloudSequence.from_frames(f"v{i}", list(body.astype(np.float32)), label=i % 2, split=split))
    return path


def here(*words: object) -> str:
    """`runs.dpc` without a new process."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        try:
            main([str(word) for word in words])
        except SystemExit as ended:
            if ended.code:
                raise
    return out.getvalue()


class Pretended:
    """A `dpc` that writes down what it is asked and makes up results; `stop`: which training ends with exit code 75."""

    def __init__(self, stop: int = 0, refuse: tuple[str, ...] = ()) -> None:
        self.calls: list[list[str]] = []
        self.stop, self.refuse = stop, refuse

    def __call__(self, *words: object) -> str:
        told = [str(word) for word in words]
        self.calls.append(told)
        if told[1] in self.refuse:
            raise SystemExit(2)
        return getattr(self, told[1].replace("-", "_"))(told)

    @property
    def trained(self) -> list[list[str]]:
        return [call for call in self.calls if call[1] == "train"]

    def train(self, told: list[str]) -> str:
        if len(self.trained) == self.stop:
            raise SystemExit(75)
        folder = Path(told[told.index("-o") + 1])
        folder.mkdir(parents=True, exist_ok=True)
        accuracies = (0.25, len(self.trained) % 5 / 4)
        rows = [
            {"stage": stage, "epoch": k + 1, "validation_accuracy": accuracies[k]}
            for stage in ("static", "dynamic")
            for k in (0, 1)
        ]
        (folder / "log.json").write_text(json.dumps(rows))
        return ""

    def predict(self, told: list[str]) -> str:
        Path(told[told.index("-o") + 1]).write_text(" ".join(told))
        return ""

    def classification(self, told: list[str]) -> str:
        short = "drop-short" in told[2]
        counts = (
            {"samples": 287, "correct": {"fused": 270}}
            if short
            else {"samples": 297, "correct": {"static": 250, "dynamic": 260, "fused": 270}}
        )
        return json.dumps({"denominators": counts})

    def estimate_flow(self, told: list[str]) -> str:
        return self.predict(told)

    def fuse(self, told: list[str]) -> str:
        return self.predict(told)

    def profile(self, told: list[str]) -> str:
        return json.dumps(
            {
                "parameters": {"static": 741_652, "total": 1_598_536},
                "macs_per_clip": {"static": 2e9, "total": 4.5e9},
                "paper_style_parameters": {"static": 2.126, "total": 3.17},
                "paper_style_gflops": {"static": 4.67, "total": 9.4},
            }
        )


@pytest.fixture(scope="module")
def real(clouds) -> Path:
    """Table 3.4 with one real cell: four frames, one seed, one epoch of each stream."""
    folder = clouds.parent / "table"
    accuracy_tables.make(EXPERIMENTS["3.4"], {"clouds": clouds}, folder, Plan("tiny", 1, BUDGET), [0], ["4"], here)
    return folder


def test_one_real_cell_makes_a_line_with_both_conventions(real):
    line = next(row for row in (real / "table.md").read_text().splitlines() if row.startswith("| 4 frames"))
    with_all, without_short = (ScoresReader(real / "tiny-4-seed0" / name) for name in ("scores.h5", "scores-long.h5"))
    assert len(with_all.names) == 6 and len(without_short.names) == 5 and "v9" not in without_short.names
    right = {key: int((own.argmax(1) == with_all.labels).sum()) for key, own in with_all.streams.items()}
    right["fused"] = int((with_all.scores.argmax(1) == with_all.labels).sum())
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[1:3] == [f"– / {100 * right[stream] / 6:.2f}" for stream in ("static", "dynamic")]
    assert cells[3:6] == [f"79.80 / {100 * right['fused'] / 6:.2f}", "1", "6"]
    long = int((without_short.scores.argmax(1) == without_short.labels).sum())
    assert cells[6] == f"{100 * long / 5:.2f} of 5" and "PSTNet 81.14" in cells[7]


def test_a_finished_cell_is_passed_over_and_other_words_are_not_mixed_in(real, clouds):
    files = [*real.glob("tiny-4-seed0/*.json"), *real.glob("tiny-4-seed0/model/*"), *real.glob("tiny-4-seed0/*.h5")]
    before, asked = [path.stat().st_mtime_ns for path in files], Pretended()
    plan = Plan("tiny", 1, BUDGET)
    again = accuracy_tables.make(EXPERIMENTS["3.4"], {"clouds": clouds}, real, plan, [0], ["4"], asked)
    assert asked.calls == [] and len(files) > 6 and [path.stat().st_mtime_ns for path in files] == before
    assert again["4"][0]["samples"] == 6
    longer = accuracy_tables.Plan("tiny", 1, (*BUDGET, "--epochs", "2"))
    assert longer.cell(EXPERIMENTS["3.4"].settings[0], 0, clouds, real).known() is None
    with pytest.raises(SystemExit) as ended:  # the real command refuses to go on with other words
        longer.cell(EXPERIMENTS["3.4"].settings[0], 0, clouds, real).run(here)
    assert ended.value.code == 2 and [path.stat().st_mtime_ns for path in files] == before


def test_a_stopped_table_keeps_what_is_done_and_goes_on(clouds, tmp_path):
    words = [
        "3.4",
        "-",
        str(tmp_path),
        "--clouds",
        str(clouds),
        "--seeds",
        "0,1",
        "--only",
        "4 16",
        "--",
        "--epochs",
        "3",
    ]
    stopped = Pretended(stop=3)
    with pytest.raises(SystemExit) as ended:
        accuracy_tables.main(words, stopped)
    assert ended.value.code == 75 and [call[-1] for call in stopped.trained] == ["0", "0", "1"]  # settings, then seeds
    assert [call[call.index("--frames") + 1] for call in stopped.trained] == ["16", "4", "16"]
    half = (tmp_path / "table.md").read_text()
    assert "84.30 / 84.18" in half and "83.84 / –" in half
    going_on = Pretended()
    accuracy_tables.main(words, going_on)
    assert len(going_on.trained) == 2 and all(call[call.index("--seed") + 1] == "1" for call in going_on.trained)
    whole, shorter = (" ".join(call) for call in going_on.trained)
    assert "--validation none --epochs 3 --frames 16" in whole and "--init" not in whole
    start = tmp_path / "quick-16-seed1" / "model"
    assert f"--epochs 3 --init {start} --epochs 15 --set epochs_dynamic=40 --lr 0.0005 --frames 4" in shorter
    assert "from whose network of the same seed" in half
    line = next(row for row in (tmp_path / "table.md").read_text().splitlines() if row.startswith("| 16 frames"))
    assert line.split(" | ")[1:6] == ["84.30 / 84.18 ± 0.00", "– / 87.54 ± 0.00", "91.92 / 90.91 ± 0.00", "2", "297"]
    assert list(json.loads((tmp_path / "results.json").read_text())["cells"]["16"]) == ["0", "1"]


def test_other_lengths_go_on_from_the_first_one_or_stand_alone(clouds, tmp_path):
    """A real network of 4 frames learns on from the real one of 16; with `--from none` it starts anew, in another folder."""
    plan, padded = Plan("tiny", 1, BUDGET, "16", ("--lr", "1e-9")), replace(EXPERIMENTS["3.4"], short=False)
    found = accuracy_tables.make(padded, {"clouds": clouds}, tmp_path, plan, [0], ["4"], here)
    assert sorted(key for key, seeds in found.items() if seeds) == ["16", "4"]
    first, second = (load_model(str(tmp_path / f"tiny-{name}-seed0" / "model"), None)[0] for name in ("16", "4-from16"))
    assert second.config.num_frames == 4
    for (name, before), after in zip(first.named_parameters(), second.parameters()):
        torch.testing.assert_close(before, after, atol=1e-6, rtol=0, msg=name)  # a rate this small changes nothing
    alone = Pretended()
    accuracy_tables.main(
        ["3.4", "-", str(tmp_path), "--clouds", str(clouds), "--seeds", "0", "--only", "4", "--from", "none"], alone
    )
    assert len(alone.trained) == 1 and "--init" not in alone.trained[0] and (tmp_path / "quick-4-seed0").is_dir()


def test_a_length_that_is_not_there_ends_with_a_sentence(clouds, tmp_path, capsys):
    for words, said in (
        (["3.4", "--from", "20"], "--from: no setting '20'; there are 4, 8, 12, 16, 24"),
        (["3.2", "--from", "kinet"], "--from: the settings of table 3.2 don't go on"),
    ):
        with pytest.raises(SystemExit) as ended:
            accuracy_tables.main([words[0], "-", str(tmp_path), *words[1:], "--clouds", str(clouds)], Pretended())
        assert ended.value.code == 2 and said in capsys.readouterr().err


def test_numbers_of_the_thesis():
    found = {(number, one.key): thesis_value(own, one) for number, own in EXPERIMENTS.items() for one in own.settings}
    assert [found["3.4", str(n)] for n in (4, 8, 12, 16, 24)] == [79.80, 83.84, 88.53, 91.92, 93.27]
    assert (found["3.2", "kinet"], found["3.3", "bbox"], found["3.3", "no-bbox"]) == (89.1, 95.2, 94.1)
    assert (found["3.5", "xsub"], found["3.5", "xview"]) == (92.3, 96.4)
    assert (
        figure_3_8.THESIS["dgcnn", "kinet"] == (5.83, 5.85, 89.82)
        and figure_3_8.THESIS["pointnet2", "flow"][0] == 163.93
    )
    assert "PointLSTM-middle 94.70" in accuracy_tables.peers(EXPERIMENTS["3.3"], EXPERIMENTS["3.3"].settings[0])
    assert accuracy_tables.peers(EXPERIMENTS["3.3"], EXPERIMENTS["3.3"].settings[1]) == "Key frames 71.90"
    assert runs.spread([90.0, 92.0]) == "91.00 ± 1.41" and runs.spread([90.0]) == "90.00" and runs.spread([]) == "–"


@pytest.mark.parametrize("modelnet", ["", "shapes"])
def test_ablations_share_the_networks_that_the_thesis_shares(clouds, tmp_path, modelnet):
    asked = Pretended()
    asked.modelnet40 = asked.predict
    words = ["msraction3d", "-", str(tmp_path), "--clouds", str(clouds), "--seeds", "0", "--preset", "tiny"]
    table_3_1.main([*words, *(["--modelnet", modelnet] if modelnet else []), "--", "--epochs", "3"], asked)
    told = {Path(call[call.index("-o") + 1]).parent.name: " ".join(call) for call in asked.trained}
    text = (tmp_path / "table.md").read_text()
    assert "numbers are NvGesture's" in text and "| i. | static, from scratch | 82.60 / 84.18 | 1 | 297 |" in text
    if not modelnet:
        assert set(told) == {"tiny-scratch-seed0", "tiny-scratch-normals-seed0", "tiny-scratch-weights-seed0"}
        assert "Rows ii, iv, v, vi, vii need ModelNet40" in text and "| vii. |" not in text
        return
    assert len(asked.trained) == 5  # the shapes, from scratch, pretrained, and two switches
    assert "pretrain=true" in asked.trained[0] and "tiny-modelnet40" in told["tiny-pretrained-seed0"]
    for name, switch in (("normals", "normals=false"), ("weights", "weighting=none")):
        own = told[f"tiny-pretrained-{name}-seed0"]
        assert own.index("--epochs 3") < own.index("--epochs 0") and switch in own  # the last one counts
        assert "tiny-pretrained-seed0/model" in own
    assert "| vii. | both, pretrained | 89.10 / 90.91 |" in text and "| v. |" in text and "need ModelNet40" not in text


def test_sweeps_share_the_static_stream_of_a_fold(clouds, tmp_path):
    asked, words = (
        Pretended(stop=9),
        ["msraction3d", "-", str(tmp_path), "--clouds", str(clouds), "--folds", "2", "--preset", "tiny"],
    )
    words += [
        "--sweep",
        "reduction=0.25,0.5",
        "--sweep",
        "group_size=2,4",
        "--sweep",
        "temporal_radius=",
        "--sweep",
        "radius=0.5,1",
    ]
    with pytest.raises(SystemExit):
        figure_3_5.main(words, asked)
    going_on = Pretended()
    figure_3_5.main(words, going_on)
    done = asked.trained[:-1] + going_on.trained
    # a fold: two static streams (two radii), and the dynamic streams of 0.25, the thesis's choice and radius 1
    assert len(done) == 2 * (2 + 3) and {call[call.index("--validation") + 1] for call in done} == {
        "fold:0/2",
        "fold:1/2",
    }
    static = [call for call in map(" ".join, done) if "--set static_from=" not in call]
    assert len(static) == 4 and not any("reduction=" in call or "group_size=" in call for call in static)
    assert all("--set epochs_dynamic=0 " in call for call in static)
    assert sum("--set radius=1,2 " in call for call in static) == 2  # the second stage's is twice as large
    text = (tmp_path / "table.md").read_text()
    assert "Group size 2 is left out" in text and text.count("| yes |") == 3 and "(c)" not in text
    assert (tmp_path / "figure.png").read_bytes().startswith(PNG)


def test_a_job_trains_its_own_folds_and_shows_everyones(clouds, tmp_path, monkeypatch):
    monkeypatch.setattr(figure_3_5, "picture", lambda *_: None)
    words = ["msraction3d", "-", str(tmp_path), "--clouds", str(clouds), "--folds", "3", "--preset", "tiny"]
    words += ["--sweep", "group_size=4,8", *(f"--sweep={key}=" for key in ("reduction", "temporal_radius", "radius"))]
    second, first, everyone = Pretended(), Pretended(), Pretended()
    figure_3_5.main([*words, "--only", "1"], second)
    assert {call[call.index("--validation") + 1] for call in second.trained} == {"fold:1/3"}
    assert "| 4 | 1 |" in (text := (tmp_path / "table.md").read_text()) and "| 8 | 1 |" in text
    figure_3_5.main([*words, "--only", "0 1"], first)
    assert {call[call.index("--validation") + 1] for call in first.trained} == {"fold:0/3"}
    assert "| 4 | 2 |" in (text := (tmp_path / "table.md").read_text()) and "| 8 | 2 |" in text
    figure_3_5.main(words, everyone)
    assert {call[call.index("--validation") + 1] for call in everyone.trained} == {"fold:2/3"}
    assert "| 4 | 3 |" in (text := (tmp_path / "table.md").read_text()) and "| 8 | 3 |" in text
    assert not list(tmp_path.glob(".*"))


def test_a_fold_that_is_not_there_is_told(tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        figure_3_5.main(
            ["msraction3d", "-", str(tmp_path), "--clouds", "-", "--folds", "3", "--only", "3"], Pretended()
        )
    assert "--only 3: expected folds from 0 to 2 (--folds 3)" in capsys.readouterr().err


def test_a_box_is_the_quartiles_of_the_folds():
    text = figure_3_5.table({"radius": {0.5: [10.0, 20.0, 30.0, 40.0, 50.0], 1.0: []}}, "")
    assert (
        "| 0.5 | 5 | 10.00 | 20.00 | 30.00 | 40.00 | 50.00 | yes |" in text
        and "| 1 | – | – | – | – | – | – |  |" in text
    )


def test_the_last_epoch_counts_for_a_fold(tmp_path):
    accuracies = (("static", 1.0), ("dynamic", 0.75), ("dynamic", 0.5), ("dynamic", None))
    (tmp_path / "log.json").write_text(
        json.dumps([{"stage": stage, "validation_accuracy": own} for stage, own in accuracies])
    )
    assert figure_3_5.last_accuracy(tmp_path, "dynamic") == {"last": 0.5, "best": 0.75, "epochs": 3}


def test_backbones_and_a_flow_baseline_that_fails(clouds, tmp_path):
    words = ["-", str(tmp_path), "--clouds", str(clouds), "--seeds", "0", "--backbones", "pointnet2,dgcnn"]
    asked = Pretended(refuse=("estimate-flow",))
    figure_3_8.main(words, asked)
    text = (tmp_path / "table.md").read_text()
    assert "| Static PointNet++ | 4.82 / 4.67 | 2.13 / 2.13 | 4, 0.742 | 4, 0.742 | 84.30 / 84.18 | 1 | 297 |" in text
    # the thesis's 3.20 M only comes out when the frozen static stream's 741,652 weights have no moments of Adam
    assert f"| Kinet (PointNet++) | 10.35 / 9.40 | 3.20 / {4.58 - 2 * 741_652 / 2**20:.2f} |" in text
    assert "| Flow-based two streams (DGCNN) | 164.95 / 9.34 | 14.04 / 4.25 |" in text and "89.56 / – | – | – |" in text
    assert "`segment estimate-flow` ended with exit code 2" in text and "SpiderCNN" not in text.split("Accuracies")[0]
    assert (tmp_path / "figure.png").read_bytes().startswith(PNG)
    whole = Pretended()
    figure_3_8.main(words, whole)
    assert len(whole.trained) == 2 and all("flow-quick-icp.h5" in call[2] for call in whole.trained)  # the rest is kept
    text = (tmp_path / "table.md").read_text()
    assert (
        "163.93 / 9.34 | 7.79 / 4.25 | 8, 1.483 | 8, 1.483 | 90.23 / 90.91 | 1 | 297 |" in text
        and "exit code" not in text
    )


def test_a_stop_in_the_flow_baseline_is_no_failure(clouds, tmp_path, monkeypatch):
    monkeypatch.setattr(figure_3_8, "picture", lambda *_: None)
    asked = Pretended(stop=3)
    with pytest.raises(SystemExit) as ended:
        figure_3_8.main(
            ["-", str(tmp_path), "--clouds", str(clouds), "--seeds", "0", "--backbones", "pointnet2"], asked
        )
    assert ended.value.code == 75


def test_gains_of_classes(tmp_path, real):
    with ScoresWriter(tmp_path / "s.h5", class_names=["clap", "Hand catch", "never"], streams=("static",)) as writer:
        for i, (label, static, fused) in enumerate(((0, 0, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1))):
            rows = np.eye(3, dtype=np.float32)
            writer.write(f"v{i}", rows[fused], label=label, split="test", streams={"static": rows[static]})
    found = figure_a_4.make(tmp_path / "out", [tmp_path / "s.h5"], [tmp_path / "s.h5"])
    assert found["kinet"][:2].tolist() == [-50, 50] and np.isnan(found["kinet"][2])
    lines = (tmp_path / "out" / "table.md").read_text().splitlines()
    order = [line.split(" | ")[0] for line in lines if line.startswith("| ")][2:]
    assert order == ["| Hand catch", "| clap", "| never", "| mean over classes"]
    assert "| Hand catch | 50.0 | +50.0 | more than +30 | +50.0 | – |" in lines
    assert (tmp_path / "out" / "figure.png").read_bytes().startswith(PNG)
    figure_a_4.main([str(tmp_path / "real"), str(real / "tiny-4-seed0" / "scores.h5"), "--flow", "absent*.h5"])
    assert "left" in (tmp_path / "real" / "table.md").read_text()
    with pytest.raises(SystemExit, match="other classes"):
        figure_a_4.main(
            [str(tmp_path / "x"), str(tmp_path / "s.h5"), "--flow", str(real / "tiny-4-seed0" / "scores.h5")]
        )


def test_new_classes_are_numbered_anew_and_their_neighbors_found(clouds, tmp_path):
    made = few_videos.write_classes(clouds, tmp_path / "new.h5", [1], 1, 0)
    with CloudsReader(made) as reader:
        assert reader.class_names == ["right"] and set(reader.labels.tolist()) == {0}
        assert reader.splits.count("train") == 1 and reader.splits.count("test") == 3
    both = few_videos.write_classes(clouds, tmp_path / "both.h5", [1, 0], None, 0)
    with CloudsReader(both) as reader, CloudsReader(clouds) as before:
        assert reader.class_names == ["right", "left"] and len(reader) == len(before)
        assert reader.labels.tolist() == [1 - label for label in before.labels]
    config, model = network_config(Given("tiny", sets={"frames": 4, "points": 48}), 2), tmp_path / "m.safetensors"
    save_model(model, Kinet(config), ModelInfo(config, ["a", "b"]))
    found = few_videos.nearest(model, both, 0)
    assert found["videos"] == 6 and 0 <= found["accuracy"] <= 1


FOLDERS = "NVGESTURE MSRACTION SHREC17 NTU60 SAPIEN MESHES OGC ARTEMIS KITTI_SF KITTI_DET SEMANTICKITTI MAKEFLAGS PROFILE".split()


@pytest.mark.parametrize(
    "target, variable",
    [
        ("table-3.1", "NVGESTURE=folder or MSRACTION=folder"),
        ("table-3.2", "NVGESTURE=folder"),
        ("table-3.3", "SHREC17=folder"),
        ("table-3.4", "MSRACTION=folder"),
        ("table-3.5", "NTU60=folder"),
        ("figure-3.5", "NVGESTURE=folder or MSRACTION=folder"),
        ("figure-3.8", "MSRACTION=folder"),
        ("table-A.1", "MSRACTION=folder"),
        ("figure-A.4", "MSRACTION=folder"),
        ("few-videos", "MSRACTION=folder"),
        ("segments", "MSRACTION=folder"),
        ("table-4.1", "SAPIEN=folder"),
        ("table-4.2", "SAPIEN=folder"),
        ("table-4.3", "MESHES=folder"),
        ("table-4.4", "KITTI_SF=folder"),
        ("table-4.5", "KITTI_DET=folder"),
        ("table-4.6", "SEMANTICKITTI=folder"),
        ("table-5.1", "MESHES=folder"),
        ("table-5.2", "MESHES=folder"),
        ("figure-5.3", "MESHES=folder"),
        ("prior", "MESHES=folder"),
    ],
)
def test_a_target_without_its_folder_says_which_variable_to_give(target, variable, tmp_path):
    if not (ROOT / "Makefile").exists() or shutil.which("make") is None:
        pytest.skip("no make here")
    empty = {key: "" for key in FOLDERS}
    words = ["make", "--no-print-directory", "-n", f"VENV={tmp_path}", target]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, env={**os.environ, **empty})
    assert done.returncode == 2 and f"make {target} needs {variable}" in done.stderr
    assert done.stdout == "", "the environment is made, for minutes, before the missing folder is told"


def test_a_failing_command_ends_the_program_with_its_exit_code(tmp_path, capfd):
    with pytest.raises(SystemExit) as ended:
        runs.dpc("info", tmp_path / "absent.h5")
    assert ended.value.code in (2, 3) and "absent.h5" in capfd.readouterr().err
