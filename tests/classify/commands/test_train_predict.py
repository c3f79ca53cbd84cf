"""`dpc classify` as people use it: pipes, signals, kills, wrong input."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from dpcli.classify.commands import predict
from dpcli.classify.confidence import stored_confidence
from dpcli.classify.data.validation_split import carve_validation
from dpcli.classify.data.videos import held_out
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.model_file import ModelInfo, load_model
from dpcli.classify.training.trainer import Trainer
from dpcli.errors import DataError, UsageError
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, ScoresReader
from tests.support.commands import exit_code, piped

ROOT = Path(__file__).resolve().parents[3]
TRAIN = ("--preset", "tiny", "--frames", "4", "--points", "64", "--batch", "2", "--seed", "3", "--validation", "0.34")


def gestures(path: Path, videos: int = 12, frames: int = 6) -> Path:
    """Two classes that differ only in the direction of a blob's motion, two splits."""
    rng = np.random.default_rng(0)
    with CloudsWriter(path, class_names=["left", "right"]) as writer:
        for i in range(videos):
            sign = 1 if i % 2 else -1
            body = rng.normal(size=(frames, 90, 3)) * [0.2, 0.5, 0.1]
            body[:, :45, 0] += sign * np.linspace(-0.5, 0.5, frames)[:, None]
            writer.write(
                CloudSequence.from_frames(
                    f"v{i}", list(body.astype(np.float32)), label=i % 2, split="test" if i % 3 == 2 else "train"
                )
            )
    return path


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return gestures(tmp_path_factory.mktemp("data") / "clouds.h5")


@pytest.fixture(scope="module")
def run_folder(data) -> Path:
    folder = data.parent / "run"
    words = ("classify", "train", data, "-o", folder, *TRAIN, "--epochs", 2, "--set", "epochs_dynamic=2")
    assert exit_code(*words) == 0
    return folder


def test_training_leaves_weights_logs_and_a_picture(run_folder):
    log = json.loads((run_folder / "log.json").read_text())
    assert [(row["stage"], row["epoch"]) for row in log] == [
        ("static", 1),
        ("static", 2),
        ("dynamic", 1),
        ("dynamic", 2),
    ]
    assert all(np.isfinite(row["loss"]) and 0 <= row["validation_accuracy"] <= 1 for row in log)
    assert (run_folder / "log.csv").read_text().count("\n") == 5
    assert (run_folder / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert (run_folder / "best.safetensors").stat().st_size > 100_000


def test_training_fits_a_confidence_that_streams_and_segments_take(data, run_folder, dpc_here):
    found = stored_confidence(load_model(run_folder)[1].notes)
    assert 0.04 < found.temperature < 21 and 0 <= found.threshold <= 1
    assert found.clips > 0 and found.kept >= 0.95 and "validation videos" in found.source
    words = ("--model", run_folder, "--split", "all", "--segments", "--reject-below", "auto", "-o", "-")
    done = dpc_here("classify", "predict", data, *words)
    assert done.returncode == 0 and done.stdout.startswith(b"recording,start,end,class,confidence")


def test_a_pipe_and_files_give_the_same_scores_and_evaluation(data, run_folder, dpc_here, tmp_path):
    by_file = dpc_here("classify", "predict", data, "--model", run_folder, "-o", tmp_path / "s.h5")
    assert by_file.returncode == 0, by_file.stderr.decode()
    through = piped("classify", "predict", "-", "--model", run_folder, "-o", "-", stdin=data.read_bytes())
    assert through.returncode == 0 and through.stdout[1:4] == b"HDF"
    (tmp_path / "p.h5").write_bytes(through.stdout)
    a, b = ScoresReader(tmp_path / "s.h5"), ScoresReader(tmp_path / "p.h5")
    assert np.array_equal(a.scores, b.scores) and a.names == b.names == [f"v{i}" for i in range(12) if i % 3 == 2]
    np.testing.assert_allclose(a.scores, (a.streams["static"] + a.streams["dynamic"]) / 2, atol=1e-6)
    np.testing.assert_allclose(a.scores.sum(1), 1, atol=1e-5)
    report = piped("evaluate", "classification", "-", "--json", stdin=through.stdout)
    assert report.returncode == 0, report.stderr.decode()
    answer = json.loads(report.stdout)
    assert answer["units"]["accuracy"] == "fraction"
    value = answer["metrics"]["accuracy"]
    assert value == pytest.approx((a.scores.argmax(1) == a.labels).mean())


def test_predictions_don_t_depend_on_the_batch(data, run_folder, dpc_here, tmp_path):
    for size in (1, 7):
        dpc_here("classify", "predict", data, "--model", run_folder, "-o", tmp_path / f"{size}.h5", "--batch", size)
    a, b = (ScoresReader(tmp_path / f"{size}.h5").scores for size in (1, 7))
    assert np.array_equal(a, b)


def test_a_video_has_the_same_scores_at_any_place_of_any_file(data, run_folder, dpc_here, tmp_path):
    reader, found = CloudsReader(data), {}
    for name, order in (("all", range(12)), ("turned", range(11, -1, -1)), ("alone", [7])):
        with CloudsWriter(tmp_path / f"{name}-clouds.h5", class_names=reader.class_names) as writer:
            for i in order:
                writer.write(reader.read(i))
        dpc_here(
            *("classify", "predict", tmp_path / f"{name}-clouds.h5", "--model", run_folder, "--split", "all"),
            *("-o", tmp_path / f"{name}.h5"),
        )
        scores = ScoresReader(tmp_path / f"{name}.h5")
        found[name] = dict(zip(scores.names, np.stack([scores.scores, *scores.streams.values()], 1)))
    for others in (found["turned"], found["alone"]):
        for video, scores in others.items():
            np.testing.assert_array_equal(scores, found["all"][video])


def test_runs_are_called_by_the_seed_of_their_training(data, run_folder, dpc_here, tmp_path):
    """Not by the prediction's, which is 0 for all."""
    for name in ("a", "b"):
        dpc_here("classify", "predict", data, "--model", run_folder, "-o", tmp_path / f"{name}.h5")
    text = dpc_here("evaluate", "runs", tmp_path / "a.h5", tmp_path / "b.h5", "--metrics", "accuracy").stdout.decode()
    assert "seed 3 #1" in text and "seed 3 #2" in text and "seed 0" not in text


def test_predicting_again_is_done_at_once_and_other_work_is_refused(data, run_folder, dpc_here, tmp_path):
    words = ("classify", "predict", data, "--model", run_folder, "-o", tmp_path / "s.h5")
    assert dpc_here(*words).returncode == 0
    before = (tmp_path / "s.h5").read_bytes()
    again = dpc_here(*words)
    assert again.returncode == 0 and b"already complete" in again.stderr
    other = dpc_here(*words, "--split", "all")
    assert other.returncode == 2 and b"--force" in other.stderr and (tmp_path / "s.h5").read_bytes() == before


ENDS_EARLY = """
import sys
from dpcli.cli.app import main
from tests.classify.commands.test_train_predict import end_early
end_early(*map(int, (sys.argv.pop(1), sys.argv.pop(1))))
main()
"""


def end_early(number: int, after: int, replace: Callable = setattr) -> None:
    """Has this process send itself a signal once so many videos are scored or steps taken, or lack memory where that is 0."""
    for work, step in ((predict.ScoreVideo, "__call__"), (Trainer, "_take")):
        whole, done = getattr(work, step), []

        def ending(*words, whole=whole, done=done):
            done.append(None)
            if len(done) == after + 1 and not number:
                raise MemoryError
            if len(done) == after + 1:
                os.kill(os.getpid(), number)
            return whole(*words)

        replace(work, step, ending)


@pytest.fixture(scope="module")
def whole_scores(data, run_folder) -> Path:
    """A prediction of all videos that nothing stopped."""
    path = data.parent / "whole.h5"
    assert exit_code("classify", "predict", data, "--model", run_folder, "--split", "all", "-o", path) == 0
    return path


def ending_early(number: int, after: int, dpc_here, words: list) -> subprocess.CompletedProcess:
    """A command that `end_early` ends; by SIGKILL, in a process of its own."""
    if number == signal.SIGKILL:
        command = [sys.executable, "-c", ENDS_EARLY, int(number), after, *words]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        return subprocess.run([str(word) for word in command], capture_output=True, env=environment)
    with pytest.MonkeyPatch.context() as patch:
        end_early(number, after, patch.setattr)
        return dpc_here(*words)


@pytest.mark.parametrize(("number", "kept"), [(signal.SIGTERM, 4), (signal.SIGKILL, 3), (0, 3)])  # 0: too little memory
def test_a_stopped_and_a_killed_prediction_go_on(
    data, run_folder, whole_scores, dpc_here, tmp_path, monkeypatch, number, kept
):
    words = ["classify", "predict", data, "--model", run_folder, "--split", "all", "-o", tmp_path / "s.h5"]
    first = ending_early(number, 3, dpc_here, words)
    assert first.returncode == {signal.SIGTERM: 75, signal.SIGKILL: -9}.get(number, 1), first.stderr.decode()
    assert not (tmp_path / "s.h5").exists()
    if number == signal.SIGTERM:
        assert b"4 of 12 videos are kept; run the same command again to continue" in first.stderr
    score, scored = predict.ScoreVideo.__call__, []
    monkeypatch.setattr(
        predict.ScoreVideo, "__call__", lambda work, video: scored.append(video.name) or score(work, video)
    )
    second = dpc_here(*words, "--batch=2")
    assert second.returncode == 0 and len(scored) == 12 - kept
    assert f"continuing: {kept} of 12 videos were scored before".encode() in second.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["s.h5"]
    ours, whole = ScoresReader(tmp_path / "s.h5"), ScoresReader(whole_scores)
    assert ours.names == whole.names and ours.splits == whole.splits and ours.labels.tolist() == whole.labels.tolist()
    for name, own in (("scores", ours.scores), *ours.streams.items()):  # clips share batches otherwise: rounding
        np.testing.assert_allclose(own, whole.scores if name == "scores" else whole.streams[name], atol=1e-5)


def test_another_prediction_leaves_what_is_kept(data, run_folder, dpc_here, tmp_path):
    words = ["classify", "predict", str(data), "--model", str(run_folder), "-o", str(tmp_path / "s.h5")]
    assert ending_early(signal.SIGTERM, 1, dpc_here, [*words, "--split", "all"]).returncode == 75
    kept = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    other = dpc_here(*words, "--split", "test")
    assert other.returncode == 2 and b'config.split "all", now "test"' in other.stderr and b"--force" in other.stderr
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == kept
    forced = dpc_here(*words, "--split", "test", "--force")
    assert forced.returncode == 0 and b"continuing" not in forced.stderr
    assert set(ScoresReader(tmp_path / "s.h5").splits) == {"test"} and [path.name for path in tmp_path.iterdir()] == [
        "s.h5"
    ]


def test_the_videos_held_out_of_training_choose_the_streams_weights(data, run_folder, dpc_here, tmp_path):
    reader = CloudsReader(data)
    held = {reader.names[i] for i in carve_validation(reader, "0.34", 3)[1]}
    words = ("classify", "predict", data, "--model", run_folder, "-o")
    assert dpc_here(*words, tmp_path / "held.h5", "--split", "validation").returncode == 0
    found = ScoresReader(tmp_path / "held.h5")
    assert held == set(found.names) and set(found.splits) == {"validation"} and 0 < len(held) < 8
    looked = ("classify", "explain", "pac", data, "--model", run_folder, "-o", tmp_path / "pac.h5", "--samples", "99")
    assert dpc_here(*looked, "--split", "validation").returncode == 0
    assert set(CloudsReader(tmp_path / "pac.h5").names) == held
    dpc_here(*words, tmp_path / "test.h5")
    fused = dpc_here(
        "classify", "fuse", tmp_path / "test.h5", "-o", tmp_path / "w.h5", "--weights-from", tmp_path / "held.h5"
    )
    assert fused.returncode == 0, fused.stderr.decode()
    done = dpc_here("evaluate", "classification", tmp_path / "w.h5", "--json")
    assert set(json.loads(done.stdout)["metrics"]["streams"]) == {"static", "dynamic", "fused"}
    other = gestures(tmp_path / "other.h5", videos=15)
    refused = dpc_here(
        "classify", "predict", other, "--model", run_folder, "-o", tmp_path / "x.h5", "--split", "validation"
    )
    assert refused.returncode == 3 and b"not the file that" in refused.stderr
    assert not (tmp_path / "x.h5").exists()


def test_held_out_videos(data):
    reader = CloudsReader(data)
    info = ModelInfo(KinetConfig(), ["left", "right"], "clips", {"validation": "none"})
    with pytest.raises(UsageError, match="a model held no video out"):
        held_out(reader, info, "a model")
    subjects = [3, 3, 7, 7]
    with CloudsWriter(data.parent / "subjects.h5", class_names=["left", "right"]) as writer:
        for i, subject in enumerate(subjects):
            writer.write(
                CloudSequence.from_frames(
                    f"s{i}", [np.zeros((4, 3), np.float32)], label=i % 2, split="train", subject=subject
                )
            )
    info.notes["validation"] = "subjects:3"  # needs no digest: a person has one number in all files
    assert held_out(CloudsReader(data.parent / "subjects.h5"), info, "a model") == [0, 1]
    info.notes["validation"] = "subjects:9"
    with pytest.raises(DataError, match="none of the people whom a model held out"):
        held_out(CloudsReader(data.parent / "subjects.h5"), info, "a model")
    info.notes["validation"] = (
        "subject"  # of weights from before: another file's highest number may be one that was learned
    )
    with pytest.raises(DataError, match="not the file that a model was trained on"):
        held_out(CloudsReader(data.parent / "subjects.h5"), info, "a model")


def last_weights(folder: Path) -> dict:
    from safetensors.torch import load_file

    return load_file(folder / "best.safetensors")


def test_a_stopped_step_drops_what_it_would_have_dropped(data, tmp_path, monkeypatch):
    """Dropout's masks come from the step, not from how often the run was begun; stopped in both stages and after an epoch."""

    def run(name, *stops):
        for stop in (*stops, None):
            taken, take = [], Trainer._take

            def stopping(self, *words, taken=taken, take=take, stop=stop):
                if len(taken) == stop:
                    self.stop.requested, self.stop.name = True, "a test"
                taken.append(None)
                return take(self, *words)

            with monkeypatch.context() as patch:
                patch.setattr(Trainer, "_take", stopping)
                words = (
                    *TRAIN,
                    "--epochs",
                    "2",
                    "--set",
                    "epochs_dynamic=2",
                    "--set",
                    "dropout=0.5",
                    "--validation",
                    "none",
                )
                assert exit_code("classify", "train", data, "-o", tmp_path / name, *words) == (
                    0 if stop is None else 75
                )
        return last_weights(tmp_path / name)

    whole, parts = run("whole"), run("parts", 1, 0, 3)
    logs = [json.loads((tmp_path / name / "log.json").read_text()) for name in ("whole", "parts")]
    assert [{**row, "seconds": 0} for row in logs[0]] == [{**row, "seconds": 0} for row in logs[1]]
    assert all(torch.equal(whole[key], parts[key]) for key in whole)


def test_weights_of_another_model_are_told(data, run_folder, dpc_here, tmp_path):
    other = tmp_path / "other"
    words = (*TRAIN, "--epochs", 1, "--set", "epochs_dynamic=1", "--seed", 4, "--validation", "none")
    assert dpc_here("classify", "train", data, "-o", other, *words).returncode == 0
    for name, model, split in (("s", run_folder, "test"), ("own", run_folder, "train"), ("theirs", other, "train")):
        assert (
            dpc_here(
                "classify", "predict", data, "--model", model, "--split", split, "-o", tmp_path / f"{name}.h5"
            ).returncode
            == 0
        )
    for judge, told in (("own", False), ("theirs", True)):
        done = dpc_here(
            "classify",
            "fuse",
            tmp_path / "s.h5",
            "-o",
            tmp_path / f"f-{judge}.h5",
            "--weights-from",
            tmp_path / f"{judge}.h5",
        )
        assert done.returncode == 0 and (b"another model" in done.stderr) == told, done.stderr


def test_a_stopped_and_a_killed_run_continue_to_the_same_weights(data, run_folder, dpc_here, tmp_path):
    """SIGTERM in the middle of an epoch saves the step and exits 75; kill -9 loses at most the epoch in hand."""
    folder = tmp_path / "run"
    words = ["classify", "train", data, "-o", folder, *TRAIN, "--epochs", "2", "--set", "epochs_dynamic=2"]
    first = ending_early(signal.SIGTERM, 4, dpc_here, words)  # 3 steps an epoch, 2 epochs a stage
    assert first.returncode == 75 and b"saved at epoch 2, step 2; run the same command again" in first.stderr
    second = ending_early(signal.SIGKILL, 5, dpc_here, words)
    assert second.returncode == -signal.SIGKILL and b"stage 1 of 2, epoch 2" in second.stderr
    third = dpc_here(*words)
    assert third.returncode == 0 and b"stage 2 of 2, epoch 2" in third.stderr, third.stderr.decode()
    ours, whole = last_weights(folder), last_weights(run_folder)
    # The same steps in the same order, to rounding: after a first compilation weights were 5e-7 of their norm apart (cause unknown), and
    # Adam amplifies the last bit where a gradient is nearly zero. A lost optimizer state moves them by 0.017, a lost step by more.
    learned = [key for key in whole if whole[key].dim() > 1]
    apart = sum(float((ours[key] - whole[key]).square().sum()) for key in learned) ** 0.5
    size = sum(float(whole[key].square().sum()) for key in learned) ** 0.5
    assert apart < 0.005 * size, apart / size
    rows = [json.loads((where / "log.json").read_text()) for where in (folder, run_folder)]
    assert [(r["stage"], r["epoch"]) for r in rows[0]] == [(r["stage"], r["epoch"]) for r in rows[1]]


def test_another_configuration_on_the_same_folder_is_refused(data, run_folder, dpc_here):
    other = dpc_here(
        "classify", "train", data, "-o", run_folder, *TRAIN, "--epochs", 2, "--set", "epochs_dynamic=2", "--lr", 0.5
    )
    assert other.returncode == 2 and b"another configuration" in other.stderr and b"--force" in other.stderr
    assert b"(schedule.learning_rate 0.002, now 0.5)" in other.stderr


def test_the_settings_are_kept_read_back_and_shown(data, run_folder, dpc_here):
    """Read back over another preset they are the same run, which is finished; with one changed they are another."""
    saved = run_folder / "settings.toml"
    words = ("classify", "train", data, "-o", run_folder, "--preset", "thesis", "--config", saved, "--seed", 3)
    before = saved.read_bytes()
    again = dpc_here(*words)
    assert again.returncode == 0 and b"is finished already" in again.stderr and saved.read_bytes() == before
    other = dpc_here(*words, "--set", "dropout=0.5")
    assert other.returncode == 2 and b"(network.dropout 0.0, now 0.5)" in other.stderr and saved.read_bytes() == before
    shown = json.loads(dpc_here("info", run_folder, "--json").stdout)["settings"]
    assert (shown["network"]["points"], shown["schedule"]["epochs_dynamic"], shown["run"]["validation"]) == (
        64,
        2,
        "0.34",
    )
    text = dpc_here("info", run_folder / "last.safetensors").stdout.decode()
    assert "schedule epochs dynamic" in text and "run validation" in text


@pytest.mark.parametrize("frames, preset", [("1", "long"), ("2", "quick")])
def test_videos_of_four_clips_are_judged_as_a_whole_unless_a_preset_is_named(data, tmp_path, dpc_here, frames, preset):
    small = (
        "--frames",
        frames,
        "--points",
        "64",
        "--set",
        "centroids=16,8",
        "--set",
        "neighbors=8",
        "--epochs",
        0,
        "--set",
        "epochs_dynamic=0",
        "--validation",
        "none",
    )
    done = dpc_here("classify", "train", data, "-o", tmp_path / "auto", *small)
    assert done.returncode == 0, done.stderr.decode()
    assert (b"preset long: the median video has 6 frames, four clips of 1 or more" in done.stderr) == (preset == "long")
    named = dpc_here("classify", "train", data, "-o", tmp_path / "quick", "--preset", "quick", *small)
    assert named.returncode == 0 and b"preset long" not in named.stderr
    for run, used in (("auto", preset), ("quick", "quick")):
        schedule = json.loads((tmp_path / run / "config.json").read_text())["schedule"]
        assert schedule["video_loss"] == (used == "long")
        assert schedule["clips_per_video"] == (4 if used == "long" else 1)


def test_a_random_speed_is_for_random_clips_of_consecutive_frames(data, tmp_path, dpc_here):
    words = ("classify", "train", data, "-o", tmp_path / "run", *TRAIN, "--set", "augment_speed=0.3")
    for more in (("--timing", "uniform"), ("--set", "clips_per_video=0")):
        refused = dpc_here(*words, *more)
        assert refused.returncode == 2 and b"random clips" in refused.stderr and not (tmp_path / "run").exists()
    assert dpc_here(*words, "--epochs", 1, "--set", "epochs_dynamic=0").returncode == 0
    assert json.loads((tmp_path / "run" / "config.json").read_text())["augmentation"]["speed"] == 0.3


def test_mistakes_in_the_settings_end_with_a_sentence(tmp_path):
    from dpcli.classify.training.schedule import Schedule
    from dpcli.errors import DataError, UsageError
    from dpcli.runtime.run_folder import RunFolder

    for wrong in (
        {"batch": 0},
        {"epochs": -1},
        {"learning_rate": -1.0},
        {"decay": "foo"},
        {"workers": -1},
        {"clips_per_video": -2},
    ):
        with pytest.raises(UsageError, match="expected"):
            Schedule(**wrong)
    for option, wrong in (
        ("lr = -1.0:", {"learning_rate": -1.0}),
        ("lr_dynamic = 0:", {"learning_rate_dynamic": 0}),
        ("epochs = -1:", {"epochs": -1}),
        ("epochs_dynamic = -2:", {"epochs_dynamic": -2}),
    ):
        with pytest.raises(UsageError, match=option):
            Schedule(**wrong)
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="names a folder"):
        RunFolder(tmp_path / "file", {}, columns=["loss"])
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(DataError, match="--force"):
        RunFolder(tmp_path, {}, columns=["loss"])


def test_other_classes_and_wrong_kinds_are_refused(data, run_folder, dpc_here, tmp_path, make_sequence):
    with CloudsWriter(tmp_path / "other.h5", class_names=["up", "down"]) as writer:
        writer.write(make_sequence("x", label=0, frames=6))
    wrong = dpc_here("classify", "predict", tmp_path / "other.h5", "--model", run_folder, "-o", tmp_path / "s.h5")
    assert wrong.returncode == 3 and b"'up'" in wrong.stderr and b"'left'" in wrong.stderr
    assert b"trained for other classes; `dpc classify train" in wrong.stderr and b" --init " in wrong.stderr
    with CloudsWriter(tmp_path / "turned.h5", class_names=["right", "left"]) as writer:
        writer.write(make_sequence("x", label=0, frames=6))
    turned = dpc_here("classify", "predict", tmp_path / "turned.h5", "--model", run_folder, "-o", tmp_path / "s.h5")
    assert turned.returncode == 3 and b"these classes at other places; `dpc prepare merge" in turned.stderr
    with CloudsWriter(tmp_path / "fewer.h5", class_names=["left"]) as writer:
        writer.write(make_sequence("x", label=0, frames=6))
    fewer = dpc_here("classify", "predict", tmp_path / "fewer.h5", "--model", run_folder, "-o", tmp_path / "s.h5")
    assert fewer.returncode == 3 and b"1 class, the first of the 2 of" in fewer.stderr
    dpc_here("classify", "predict", data, "--model", run_folder, "-o", tmp_path / "scores.h5")
    kind = dpc_here("classify", "predict", tmp_path / "scores.h5", "--model", run_folder, "-o", tmp_path / "s.h5")
    assert kind.returncode == 3 and b"holds 'scores'" in kind.stderr and not (tmp_path / "s.h5").exists()
    none = dpc_here("classify", "predict", data, "--model", "nowhere", "-o", tmp_path / "s.h5")
    assert none.returncode == 3 and b"nowhere" in none.stderr


def test_truncated_and_foreign_weights_are_refused(data, run_folder, dpc_here, tmp_path):
    weights = (run_folder / "best.safetensors").read_bytes()
    (tmp_path / "half.safetensors").write_bytes(weights[: len(weights) // 2])
    (tmp_path / "pickle.safetensors").write_bytes(b"\x80\x04K\x01.")
    for name in ("half", "pickle"):
        run = dpc_here(
            "classify", "predict", data, "--model", tmp_path / f"{name}.safetensors", "-o", tmp_path / "s.h5"
        )
        assert run.returncode == 3 and b"safetensors" in run.stderr, name


def test_profile_prints_true_and_paper_counts(dpc_here):
    run = dpc_here(
        "classify", "profile", "--variant", "release", "--classes", 20, "--frames", 4, "--points", 256, "--json"
    )
    assert run.returncode == 0, run.stderr.decode()
    report = json.loads(run.stdout)
    assert report["parameters"]["static"] == 741_652 and report["parameters"]["total"] == 1_586_906
    assert report["paper_style_parameters"]["static"] == 2.126 and report["macs_per_clip"]["total"] > 1e9


def test_static_weights_of_another_run_are_a_start(data, run_folder, dpc_here, tmp_path):
    run = dpc_here(
        "classify",
        "train",
        data,
        "-o",
        tmp_path / "r",
        *TRAIN,
        "--epochs",
        0,
        "--set",
        "epochs_dynamic=1",
        "--set",
        f"static_from={run_folder}",
    )
    assert run.returncode == 0, run.stderr.decode()
    ours, theirs = last_weights(tmp_path / "r"), last_weights(run_folder)
    assert all(bool((ours[key] == theirs[key]).all()) for key in ours if key.startswith("static."))


def test_help_is_quick_and_imports_nothing_heavy():
    heavy = ("torch", "open3d", "cv2", "numba", "scipy", "matplotlib", "h5py")
    code = f"import sys; from dpcli.cli import app\nprint([m for m in {heavy} if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert run.stdout.strip() == "[]", run.stdout + run.stderr


def test_only_the_room_that_is_asked_for_is_loaded():
    code = (
        "import sys\nfrom dpcli.cli.app import main\ntry: main({words})\n"
        "finally: print(sorted(m for m in sys.modules if m.startswith('dpcli.cli.')))"
    )
    for words, loaded in ((["--help"], []), (["evaluate", "--help"], ["evaluate"]), (["-q", "info"], ["info"])):
        run = subprocess.run([sys.executable, "-c", code.format(words=words)], capture_output=True, text=True, cwd=ROOT)
        rooms = {"prepare", "classify", "segment", "generate4d", "evaluate", "info"}
        found = json.loads(run.stdout.strip().splitlines()[-1].replace("'", '"'))
        assert sorted(rooms & {name.split(".")[-1] for name in found}) == loaded, run.stdout + run.stderr


def test_every_start_is_scored(data, run_folder, dpc_here, tmp_path):
    """6 frames, clips of 4: three clips a video; their mean is the video's score."""
    import torch

    from dpcli.classify.data.clips import ClipSource
    from dpcli.classify.network.model_file import load_model
    from dpcli.classify.video_scores import batches, score_video

    model, info = load_model(str(run_folder))
    reader = CloudsReader(data)
    source = ClipSource(reader, [2], info.config)
    video = score_video(model, source, 2, None, 8, torch.device("cpu"))
    assert video.clips == 3
    with torch.inference_mode():
        rows = [model(points)[0].softmax(-1) for _, points in batches(source, source.clips(None), 1)]
    np.testing.assert_allclose(video.streams["static"], torch.cat(rows).mean(0), atol=1e-5)
