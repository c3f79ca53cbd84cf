"""Training shared by processes, in parts, from other weights; and what goes wrong: losses, workers, data, checkpoints."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from dpcli.classify.commands.train import check_shares
from dpcli.classify.data.clips import ClipSource
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.model_file import load_model
from dpcli.classify.settings import network_config
from dpcli.classify.training.optimizer_step import StageStep, watch_of
from dpcli.classify.training.schedule import Schedule
from dpcli.errors import UsageError
from dpcli.reproduce.runs import override
from dpcli.runtime.distributed import Processes
from dpcli.runtime.settings.catalog import Given
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, ScoresReader
from tests.classify.commands.test_train_predict import gestures
from tests.support.commands import exit_code as dpc

ROOT = Path(__file__).resolve().parents[3]
SMALL = ("--preset", "tiny", "--frames", "4", "--points", "64", "--batch", "4", "--seed", "3", "--validation", "none")
SHORT = (
    *SMALL,
    "--epochs",
    "3",
    "--set",
    "epochs_dynamic=2",
    "--lr",
    "0.0001",
    "--set",
    "label_smoothing=0.05",
    "--set",
    "draws=1",
)

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return gestures(tmp_path_factory.mktemp("data") / "clouds.h5")


@pytest.fixture(scope="module")
def alone(data) -> Path:
    folder = data.parent / "alone"
    assert dpc("classify", "train", data, "-o", folder, *SHORT) == 0
    return folder


def losses(folder: Path, stage: str) -> list[float]:
    return [row["loss"] for row in json.loads((folder / "log.json").read_text()) if row["stage"] == stage]


@pytest.fixture(scope="module")
def together(data) -> Path:
    """Two processes by torchrun: first a batch norm shared by them, then the same run as `alone`."""
    folder = data.parent / "together"
    words = ["classify", "train", str(data), "-o", str(folder), *SHORT]
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node",
        "2",
        str(ROOT / "tests" / "support" / "two_processes.py"),
        str(data.parent / "norm.pt"),
        *words,
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=600)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("training on 2 processes") == 1 and done.stdout.count("best.safetensors") == 1
    return folder


def test_a_norm_shared_by_two_processes_is_the_norm_of_the_whole_batch(together):
    values, out, gradient, weight_gradient, mean, var = torch.load(together.parent / "norm.pt", weights_only=True)
    norm = torch.nn.BatchNorm1d(3, eps=1e-3).double()
    whole = values.clone().requires_grad_()
    (norm(whole) ** 3).sum().backward()
    torch.testing.assert_close(out, norm.train()(values).detach(), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(gradient, whole.grad, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(weight_gradient, norm.weight.grad, rtol=1e-10, atol=1e-12)
    fresh = torch.nn.BatchNorm1d(3, eps=1e-3).double()
    fresh(values)
    torch.testing.assert_close((mean, var), (fresh.running_mean, fresh.running_var), rtol=1e-12, atol=1e-12)


def test_two_processes_follow_the_loss_curve_of_one(data, alone, together, tmp_path):
    """Static to rounding. The dynamic stage starts from weights that differ by it, and fits to 64 points amplify that
    (the torch reference in one process is as far from the kernels: 0.4 %). Norms of half a batch would be off by 0.7 %."""
    np.testing.assert_allclose(losses(together, "static"), losses(alone, "static"), rtol=1e-4)
    np.testing.assert_allclose(losses(together, "dynamic"), losses(alone, "dynamic"), rtol=0.02)
    assert (
        dpc(
            "classify",
            "train",
            data,
            "-o",
            tmp_path / "halves",
            *override(SHORT, ("--set", "epochs_dynamic=0", "--set", "accumulate=2")),
        )
        == 0
    )
    apart = np.abs(np.array(losses(tmp_path / "halves", "static")) / losses(alone, "static") - 1)
    assert apart.max() > 1e-3, "norms of half a batch pass for norms of the whole: the comparison proves nothing"


def test_a_batch_in_parts_has_the_gradient_of_the_batch():
    """Without batch statistics (eval mode) the parts add up exactly."""
    torch.manual_seed(0)
    config = network_config(Given("tiny", sets={"frames": 2, "points": 64}), 3)
    points, labels = torch.randn(4, 2, 64, 3) * 0.3, torch.tensor([0, 1, 2, 1])
    found = []
    for parts in (1, 4):
        torch.manual_seed(1)
        model = Kinet(config).eval()
        schedule = Schedule(1, 1, batch=4, accumulate=parts, weight_decay=0.0)
        step = StageStep(model, 0, schedule, torch.device("cpu"), Processes())
        total, _, stepped = step(points, labels, 1e-3)
        assert stepped
        found.append((total, model.static.stage2.linear2.weight.grad.clone()))
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-5)
    torch.testing.assert_close(found[0][1], found[1][1], rtol=1e-4, atol=1e-7)
    with pytest.raises(UsageError, match="accumulate = 3"):
        Schedule(batch=4, accumulate=3).share(1)
    with pytest.raises(UsageError, match="3 processes"):
        Schedule(batch=4).share(3)


def test_a_loss_per_video_is_that_of_its_clips_mean_logits():
    """And its gradient is; a step in parts, each of whole videos, adds up to the same."""
    torch.manual_seed(0)
    config = network_config(Given("tiny", sets={"frames": 2, "points": 64}), 3)
    points, labels = torch.randn(6, 2, 64, 3) * 0.3, torch.tensor([0, 0, 1, 1, 2, 2])
    grads = []
    for parts in (1, 3):
        torch.manual_seed(1)
        model = Kinet(config).eval()
        schedule = Schedule(1, 1, batch=6, clips_per_video=2, video_loss=True, accumulate=parts)
        total, right, _ = StageStep(model, 0, schedule, torch.device("cpu"), Processes())(points, labels, 0.0)
        grads.append(model.static.stage2.linear2.weight.grad.clone())
        model.zero_grad()
        logits = model.static_logits(points)
        means = torch.stack([(logits[i] + logits[i + 1]) / 2 for i in (0, 2, 4)])
        loss = -torch.log_softmax(means, -1)[torch.arange(3), torch.arange(3)].mean()
        assert total / 6 == pytest.approx(float(loss.detach()), rel=1e-5)
        assert right == 2 * int((means.argmax(-1) == torch.arange(3)).sum())
    loss.backward()
    for grad in grads:
        assert float(grad.norm()) > 1e-5
        torch.testing.assert_close(grad, model.static.stage2.linear2.weight.grad, rtol=1e-3, atol=1e-7)
    with pytest.raises(UsageError, match="2 processes x accumulate = 1 x clips_per_video = 4, which video_loss keeps"):
        Schedule(batch=4, clips_per_video=4, video_loss=True).share(2)


def test_processes_that_can_t_share_a_batch_evenly_are_refused():
    check_shares(3, Schedule(batch=4), 1)
    check_shares(4, Schedule(batch=4), 2)
    with pytest.raises(UsageError, match="batch = 4: an epoch has 3 clips"):
        check_shares(3, Schedule(batch=4), 2)


def test_label_smoothing_is_the_loss_against_a_share_of_every_class(alone):
    """Loss of clip i: (1 - s) of its class's -log p and s of the mean over the classes."""
    torch.manual_seed(0)
    model = Kinet(network_config(Given("tiny", sets={"frames": 2, "points": 64}), 3)).eval()
    points, labels = torch.randn(4, 2, 64, 3) * 0.3, torch.tensor([0, 1, 2, 1])
    with torch.no_grad():
        surprise = -torch.log_softmax(model.static_logits(points), -1).double()
    expected = 0.7 * surprise[torch.arange(4), labels].sum() + 0.3 * surprise.mean(-1).sum()
    step = StageStep(model, 0, Schedule(1, 1, batch=4, label_smoothing=0.3), torch.device("cpu"), Processes())
    assert step(points, labels, 1e-3)[0] == pytest.approx(float(expected), rel=1e-5)
    for share in (-0.1, 1.0, float("nan")):
        with pytest.raises(UsageError, match=f"label_smoothing = {share}"):
            Schedule(label_smoothing=share)
    assert json.loads((alone / "config.json").read_text())["schedule"]["label_smoothing"] == 0.05


def test_the_loss_of_no_class_is_that_against_equal_shares_of_all():
    torch.manual_seed(0)
    model = Kinet(network_config(Given("tiny", sets={"frames": 2, "points": 64}), 3)).eval()
    points, labels = torch.randn(4, 2, 64, 3) * 0.3, torch.tensor([0, -1, 2, -1])
    with torch.no_grad():
        logits = model.static_logits(points)
    shares = torch.tensor([[0.8, 0.1, 0.1], [1 / 3] * 3, [0.1, 0.1, 0.8], [1 / 3] * 3])
    step = StageStep(model, 0, Schedule(1, 1, batch=4, label_smoothing=0.3), torch.device("cpu"), Processes())
    total, right, stepped = step(points, labels, 1e-3)
    assert stepped and right == int((logits.argmax(-1) == labels).sum())
    assert total == pytest.approx(-float((shares * logits.log_softmax(-1)).sum()), rel=1e-5)


@pytest.mark.parametrize("backend", ["torch", "numba"])  # the GPU's path, on this CPU; and --amp on a CPU
@pytest.mark.parametrize("backbone", ["pointnet2", "dgcnn", "spidercnn"])
def test_mixed_precision_trains_both_streams_near_float32(backbone, backend, monkeypatch):
    monkeypatch.setenv("DPC_BACKEND", backend)
    config = network_config(Given("tiny", sets={"frames": 2, "points": 64, "backbone": backbone}), 3)
    points, labels = (
        torch.randn(4, 2, 64, 3, generator=torch.Generator().manual_seed(0)) * 0.3,
        torch.tensor([0, 1, 2, 1]),
    )
    for stage in (0, 1):
        totals = []
        for amp in (False, True):
            torch.manual_seed(1)
            model = Kinet(config)
            if stage:
                model.freeze_static()
            step = StageStep(model, stage, Schedule(1, 1, batch=4, amp=amp), torch.device("cpu"), Processes())
            total, _, stepped = step(points, labels, 1e-3)
            assert stepped and all(p.dtype == torch.float32 for p in model.parameters())
            totals.append(total)
        assert totals[0] != totals[1], "nothing was computed in bfloat16"
        assert totals[0] == pytest.approx(totals[1], rel=0.02)


def test_a_watch_stops_losses_that_run_away():
    watch = watch_of(20)
    assert all(watch.see(3.0, True) is None for _ in range(50))
    assert [watch.see(float("nan"), False) is None for _ in range(5)] == [True] * 4 + [False]
    watch = watch_of(20)
    assert all(watch.see(float("nan"), False) is None or k == 4 for k in range(5))
    watch = watch_of(20)  # single bad steps are left out, as nearly singular fits make them
    assert all(watch.see(float("nan") if k % 3 else 2.0, k % 3 == 0) is None for k in range(60))
    watch = watch_of(20)
    said = [watch.see(3.0 * 1.2**k, True) for k in range(40)]
    assert said[0] is None and "grew" in said[-1]


def test_a_diverging_run_stops_and_keeps_the_last_good_weights(data, tmp_path, capfd):
    folder = tmp_path / "run"
    assert (
        dpc(
            "classify",
            "train",
            data,
            "-o",
            folder,
            *SMALL,
            "--epochs",
            300,
            "--set",
            "epochs_dynamic=0",
            "--lr",
            "1e12",
            "--set",
            "decay=constant",
        )
        == 1
    )
    said = capfd.readouterr().err
    assert "training diverged (static stage, epoch" in said and "--lr" in said
    if "last.safetensors" in said:
        assert all(
            torch.isfinite(value).all()
            for value in load_model(str(folder / "last.safetensors"))[0].state_dict().values()
        )


class Killed(ClipSource):
    """A clip source whose loading process dies at the second clip, as the kernel kills one for want of memory."""

    def load(self, clip, *key):
        if torch.utils.data.get_worker_info() is not None and key[1] == 5:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().load(clip, *key)


def test_a_killed_loader_ends_with_a_sentence_and_the_run_continues(data, tmp_path, monkeypatch, capfd):
    from dpcli.classify.commands import train as train_command

    folder = tmp_path / "run"
    words = ("classify", "train", data, "-o", folder, *SMALL, "--epochs", 1, "--set", "epochs_dynamic=0")
    with monkeypatch.context() as patch:
        patch.setattr(train_command, "ClipSource", Killed)
        assert dpc(*words, "--set", "workers=1") == 1
    said = capfd.readouterr().err
    assert "process that loads clips was killed" in said and "saved at epoch 1" in said and "Traceback" not in said
    assert dpc(*words) == 0 and "continuing" in capfd.readouterr().err
    assert [row["epoch"] for row in json.loads((folder / "log.json").read_text())] == [1]


def test_other_frames_start_from_trained_streams(data, alone, tmp_path, capfd):
    """`--init`: weights of 4 frames begin a run of 6, of other neighborhoods; with no epochs they stay as they are."""
    longer = [*SHORT]
    longer[longer.index("4")] = "6"
    assert (
        dpc(
            "classify",
            "train",
            data,
            "-o",
            tmp_path / "six",
            *override(longer, ("--epochs", "0", "--set", "epochs_dynamic=0")),
            "--init",
            alone,
            "--set",
            "centroids=48,24",
            "--set",
            "neighbors=9",
        )
        == 0
    )
    told = capfd.readouterr().err
    assert "weights taken" in told and "from nothing" not in told and "static_temporal_radius" not in told
    ours, theirs = load_model(str(tmp_path / "six")), load_model(str(alone))
    config = ours[1].config
    assert (config.num_frames, config.centroids, config.neighbors) == (6, (48, 24), 9)
    for key, value in theirs[0].state_dict().items():
        assert torch.equal(ours[0].state_dict()[key], value), key
    within = override(SHORT, ("--epochs", "0", "--set", "epochs_dynamic=0", "--set", "static_temporal_radius=0"))
    assert dpc("classify", "train", data, "-o", tmp_path / "within", *within, "--init", alone) == 0
    assert "--set static_temporal_radius=1 keeps that" in capfd.readouterr().err
    assert (
        dpc("classify", "train", data, "-o", tmp_path / "q", "--preset", "quick", "--frames", 4, "--init", alone) == 2
    )
    assert "another network" in capfd.readouterr().err


def test_pretraining_on_single_clouds_starts_a_static_stream(data, tmp_path, capfd):
    """Shapes with labels, one frame each, as ModelNet40 is prepared; then `static_from` with other classes."""
    rng = np.random.default_rng(0)
    with CloudsWriter(tmp_path / "shapes.h5", class_names=["ball", "rod", "disc"]) as writer:
        for i in range(9):
            cloud = rng.normal(size=(90, 3)) * [(0.3, 0.3, 0.3), (0.5, 0.05, 0.05), (0.4, 0.4, 0.02)][i % 3]
            writer.write(CloudSequence.from_frames(f"s{i}", [cloud.astype(np.float32)], label=i % 3, split="train"))
    words = ("--preset", "tiny", "--points", 128, "--batch", 3, "--validation", "none")
    assert (
        dpc(
            "classify",
            "train",
            tmp_path / "shapes.h5",
            "-o",
            tmp_path / "pre",
            "--set",
            "pretrain=true",
            *words,
            "--epochs",
            1,
        )
        == 0
    )
    model, info = load_model(str(tmp_path / "pre"))
    assert info.config.num_frames == 1 and info.notes["streams"] == ["static"]
    assert (
        dpc(
            "classify",
            "predict",
            tmp_path / "shapes.h5",
            "--model",
            tmp_path / "pre",
            "-o",
            tmp_path / "s.h5",
            "--split",
            "train",
        )
        == 0
    )
    scores = ScoresReader(tmp_path / "s.h5")
    assert list(scores.streams) == ["static"] and np.array_equal(scores.scores, scores.streams["static"])
    capfd.readouterr()
    assert (
        dpc(
            "classify",
            "train",
            data,
            "-o",
            tmp_path / "r",
            *override(SHORT, ("--epochs", "0", "--set", "epochs_dynamic=0")),
            "--set",
            f"static_from={tmp_path / 'pre'}",
        )
        == 0
    )
    assert "it knows none of the 2 classes, so the last layers learn them from nothing" in capfd.readouterr().err
    started = load_model(str(tmp_path / "r"))[0]
    assert torch.equal(started.static.stage1.linear1.weight, model.static.stage1.linear1.weight)
    assert dpc("classify", "train", data, "-o", tmp_path / "x", "--set", "pretrain=true", "--frames", 8) == 2
    assert "clips of one frame" in capfd.readouterr().err


def test_one_class_and_absent_classes_are_named(tmp_path, make_sequence, capfd):
    for name, labels in (("one", [0, 0, 0]), ("absent", [0, 1, 2])):
        with CloudsWriter(tmp_path / f"{name}.h5", class_names=["up", "down", "round"]) as writer:
            for i, label in enumerate(labels):
                writer.write(
                    make_sequence(f"{name}{i}", label=label, frames=4, split="test" if label == 2 else "train")
                )
    words = ("classify", "train", "-o", tmp_path / "run", *SMALL, "--epochs", 0, "--set", "epochs_dynamic=0")
    assert dpc(*words, tmp_path / "one.h5") == 3
    assert "class 'up'" in capfd.readouterr().err
    assert dpc(*words, tmp_path / "absent.h5") == 0
    assert "never recognized: round" in capfd.readouterr().err


def test_what_can_not_be_judged_or_told_apart_is_said(tmp_path, make_sequence, capfd):
    def write(name, labels, people=None, classes=("up", "down", "round")):
        with CloudsWriter(tmp_path / f"{name}.h5", class_names=classes) as writer:
            for i, label in enumerate(labels):
                subject = people[i] if people else -1
                writer.write(make_sequence(f"{i}", label=label, frames=4, split="train", subject=subject))
        return tmp_path / f"{name}.h5"

    words = ("classify", "train", *SMALL, "--epochs", 0, "--set", "epochs_dynamic=0")
    uneven = write("uneven", [0] * 7 + [1, 2])
    assert dpc(*words, uneven, "-o", tmp_path / "a", "--validation", "0.2") == 0
    assert "none of them is of 2 of the 3 classes that were learned: down, round" in capfd.readouterr().out
    assert dpc(*words, uneven, "-o", tmp_path / "b", "--validation", "0.01") == 0
    assert "--validation 0.01: no class has so many videos" in capfd.readouterr().err
    assert load_model(tmp_path / "b")[1].notes["validation"] == "none"
    assert (
        dpc(*words, write("person", [0, 0, 1, 1], [1, 1, 2, 2]), "-o", tmp_path / "c", "--validation", "subject") == 3
    )
    assert "--validation subject holds out all videos of the others" in capfd.readouterr().err
    assert dpc(*words, uneven, "-o", tmp_path / "c", "--validation", "subject") == 2
    assert "uneven.h5 doesn't say who is seen" in capfd.readouterr().err
    with CloudsWriter(tmp_path / "held.h5", class_names=("up", "down")) as writer:
        for i, (label, split) in enumerate(zip((0, 1, 0, -1, -1, 0), ("train",) * 2 + ("validation",) * 3 + ("dev",))):
            writer.write(make_sequence(f"{i}", label=label, frames=4, split=split))
    assert dpc(*words, tmp_path / "held.h5", "-o", tmp_path / "e", "--validation", "split") == 0
    said = capfd.readouterr().err
    assert "2 videos of the split 'validation' without a label, left out: 3, 4" in said
    assert "1 video of the split 'dev' left out: 5" in said
    twice = write("twice", [0, 0, 1, 2], classes=("up", "down", "up"))
    assert dpc(*words, twice, "-o", tmp_path / "d", "--validation", "none") == 3
    assert "class names repeat, such as 'up'" in capfd.readouterr().err and not (tmp_path / "d").exists()


def test_validation_videos_that_are_left_out_are_told_and_not_counted(tmp_path, make_sequence, capfd):
    splits = {"a": "train", "b": "train", "c": "validation", "short": "validation"}
    with CloudsWriter(tmp_path / "v.h5", class_names=("up", "down")) as writer:
        for i, (name, split) in enumerate(splits.items()):
            writer.write(make_sequence(name, label=i % 2, frames=2 if name == "short" else 4, split=split))
    words = (*SMALL, "--epochs", 0, "--set", "epochs_dynamic=0", "--set", "drop_short=true", "--validation", "split")
    assert dpc("classify", "train", tmp_path / "v.h5", "-o", tmp_path / "run", *words) == 0
    said = capfd.readouterr()
    assert "1 video of fewer than 4 frames, dropped: short" in said.err
    assert "\n1 validation video" in said.out  # the accuracy is of one


def test_a_pipe_can_t_be_shared(monkeypatch, capfd):
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert dpc("classify", "train", "-", "-o", "nowhere") == 2
    assert "can't share a pipe" in capfd.readouterr().err


def test_validation_is_shared_out_among_processes(data, alone):
    """Each process judges its part of the videos: together they are all of them, once."""
    from dpcli.classify.training.trainer import Trainer
    from dpcli.runtime.run_folder import RunFolder
    from dpcli.runtime.signals import StopRequest

    class Counting(Processes):
        """The sums of one process, kept apart to be added by hand."""

        def sums(self, values, device):
            collected.append(list(values))
            return [*values[:-1], max(values[-1], 1)]

    model, info = load_model(str(alone))
    source = ClipSource(CloudsReader(data), list(range(12)), info.config, seed=3)
    folder = RunFolder(alone.parent / "judge", {}, columns=["loss"])
    found = []
    for count in (1, 2):
        collected: list[list[float]] = []
        for rank in range(count):
            trainer = Trainer(
                model,
                info,
                folder,
                Schedule(0, 1, batch=4),
                source,
                source,
                torch.device("cpu"),
                StopRequest(),
                Counting(rank, count),
            )
            trainer.stage = 1
            trainer.validate()
        found.append(np.sum(collected, 0))
    np.testing.assert_array_equal(found[0], found[1])
    assert found[0][-1] == 12
