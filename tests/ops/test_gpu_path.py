"""The lines that only a GPU takes, on a pretended one: nothing forgotten on the CPU, and the CPU's numbers come out."""

from __future__ import annotations

import os
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch

from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.presets import PRESETS
from dpcli.generate4d.optimizer import SceneOptimizer, StepResult
from dpcli.ops.backend import reference_only
from dpcli.runtime.mixed_precision import wanted
from dpcli.store import ScoresReader
from dpcli.store.gaussians import read_scene
from dpcli.store.parts import PartsReader
from tests.classify.commands.test_train_predict import TRAIN, gestures
from tests.classify.network.backbones.test_backbones import tiny
from tests.generate4d.test_fit import toy_views
from tests.support.drawers import TRAIN as TRAIN_PARTS
from tests.support.drawers import drawers
from tests.support.pretend_card import Resident, pretend_card


@pytest.fixture
def card():
    with pretend_card():
        yield


@pytest.mark.parametrize(
    "mistake",
    [
        lambda x: x + torch.ones(4, 3),
        lambda x: torch.cat([torch.zeros(1, 3), x]),
        lambda x: x @ torch.eye(3),
        lambda x: torch.nn.Linear(3, 2)(x),
        lambda x: torch.ones(4, 3)[x[:, 0] > 0],
        lambda x: torch.where(x > 0, x, torch.zeros(4, 3)),
        lambda x: torch.randn(3, device=x.device, generator=torch.Generator()),
        lambda x: x.numpy(),
        lambda x: np.asarray(x),
    ],
)
def test_the_card_refuses_what_a_gpu_refuses(card, mistake):
    x = torch.randn(4, 3, device="cuda")
    with pytest.raises((RuntimeError, TypeError), match="same device|indices should be|for generator|to numpy"):
        mistake(x)


def test_the_card_allows_what_a_gpu_allows(card):
    x = torch.arange(6.0, device="cuda").reshape(2, 3)
    y = x * torch.tensor(2.0) + 1
    y[torch.tensor([0])] = 0.0
    y[1:].copy_(torch.ones(1, 3))
    assert isinstance(y, Resident) and y.device.type == "cuda" and float(y.sum()) == 3
    assert y.cpu().numpy().tolist() == [[0, 0, 0], [1, 1, 1]] and x.to(torch.float64).device == x.device


def small(backbone: str) -> KinetConfig:
    if backbone == "pointnet2":
        return replace(PRESETS["tiny"]["network"], num_classes=3, num_frames=4, points_per_frame=12, centroids=(16, 8))
    return tiny(backbone)


@pytest.mark.parametrize("backbone", ["pointnet2", "dgcnn", "spidercnn", "tests.support.tiny_backbone:TinyBackbone"])
def test_kinet_s_loss_and_gradients_on_the_card_are_the_cpu_s(card, backbone):
    config = small(backbone)
    clip = torch.randn(3, 4, 12, 3, generator=torch.Generator().manual_seed(0)) * 0.3
    found = []
    for device in ("cpu", "cuda"):
        torch.manual_seed(0)
        model = Kinet(config).to(device).train()
        with reference_only():  # the CPU's kernels round otherwise
            points, known = clip.to(device), torch.arange(3, device=device)
            loss = torch.nn.functional.cross_entropy(model.static_logits(points), known)
            model.static.eval()  # frozen under the dynamic stream
            loss = loss + torch.nn.functional.cross_entropy(model.dynamic_logits(points), known)
            loss.backward()
        gradients = {name: one.grad.cpu() for name, one in model.named_parameters() if one.grad is not None}
        found.append((float(loss.detach()), gradients))
    (loss, gradients), (other, others) = found
    assert loss == pytest.approx(other, rel=1e-5) and gradients.keys() == others.keys() and len(gradients) > 8
    for name, one in gradients.items():
        assert torch.allclose(one, others[name], rtol=1e-3, atol=1e-5 * float(one.abs().max() + 1)), name


def test_a_constant_left_on_the_cpu_is_found(card, monkeypatch):
    """The broken twin: the same network, one number made without its device."""
    model = Kinet(small("pointnet2")).to("cuda")
    forward = model.static.forward
    monkeypatch.setattr(model.static, "forward", lambda groups: forward(groups) + torch.zeros(3))
    with pytest.raises(RuntimeError, match="same device"):
        model.static_logits(torch.randn(3, 4, 12, 3, device="cuda"))


def test_actions_are_learned_and_told_on_the_card_as_on_the_cpu(card, dpc_here, tmp_path):
    data, model = gestures(tmp_path / "clouds.h5", videos=6), tmp_path / "model"
    done = dpc_here(
        "classify",
        "train",
        data,
        "-o",
        model,
        *TRAIN,
        "--set",
        "centroids=16,8",
        "--epochs",
        1,
        "--set",
        "epochs_dynamic=1",
        "--set",
        "workers=0",
        "--set",
        "draws=1",
        "--set",
        "static_temporal_radius=0",
    )
    assert done.returncode == 0 and b"training on pretend card" in done.stderr, done.stderr
    scores = []
    for device in ("cuda", "cpu"):
        told = tmp_path / f"{device}.h5"
        done = dpc_here("classify", "predict", data, "--model", model, "-o", told, "--device", device)
        assert done.returncode == 0, done.stderr
        scores.append(ScoresReader(told).scores)
    assert np.allclose(*scores, atol=1e-5)
    done = dpc_here("classify", "explain", "pac", data, "--model", model, "-o", tmp_path / "pac.h5")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("command", ["predict", "train"])
def test_a_trained_estimator_of_flow_runs_where_the_command_does(card, command, dpc_here, tmp_path, monkeypatch):
    from dpcli.segment.flow import model_file

    used, estimate = set(), model_file._estimate_pair
    monkeypatch.setattr(
        model_file,
        "_estimate_pair",
        lambda model, *clouds: used.add(next(model.parameters()).device.type) or estimate(model, *clouds),
    )
    data, estimator = drawers(tmp_path / "clouds.h5", 3), tmp_path / "flow"
    words = ("--steps", 1, "--batch", 1, "--set", "points=32", "--set", "iterations=1", "--device", "cpu")
    done = dpc_here("segment", "flow", data, "-o", estimator, *words)
    assert done.returncode == 0, done.stderr
    words = ("--method", "ward", "--points", 48, "--split", "test")
    if command == "train":
        words = ("--points", 48, "--batch", 1, "--epochs", 1, "--set", "pairs_per_epoch=1")
    for device in ("cuda", "cpu"):
        made = tmp_path / (f"{device}.h5" if command == "predict" else device)
        done = dpc_here("segment", command, data, "-o", made, *words, "--flow", estimator, "--device", device)
        assert done.returncode == 0, done.stderr
        assert used == {device}
        used.clear()
    if command == "predict":
        found = [PartsReader(tmp_path / f"{device}.h5").read_parts(0).flow for device in ("cuda", "cpu")]
        np.testing.assert_allclose(*map(np.concatenate, found), atol=1e-4)
    else:
        found = [np.load(tmp_path / device / "flows_first.npy") for device in ("cuda", "cpu")]
        assert np.abs(found[0]).max() > 0
        np.testing.assert_allclose(*found, atol=1e-4)


def test_parts_are_learned_and_found_on_the_card_as_on_the_cpu(card, dpc_here, tmp_path):
    data, model = drawers(tmp_path / "clouds.h5", 3), tmp_path / "model"
    words = ["pairs_per_epoch=2" if word == "pairs_per_epoch=6" else word for word in TRAIN_PARTS]
    words += ["--epochs", 1]
    done = dpc_here("segment", "train", data, "-o", model, *words)
    assert done.returncode == 0 and b"training on cuda" in done.stderr, done.stderr
    masks = []
    for device in ("cuda", "cpu"):
        found = tmp_path / f"{device}.h5"
        done = dpc_here(
            "segment",
            "predict",
            data,
            "-o",
            found,
            "--model",
            model,
            "--flow",
            "nearest",
            "--device",
            device,
            "--split",
            "all",
            "--set",
            "amp=false",
        )
        assert done.returncode == 0, done.stderr
        with PartsReader(found) as reader:
            masks.append(np.concatenate([reader.read_parts(i).probability for i in range(len(reader))]))
    assert np.mean(np.abs(masks[0] - masks[1]).max(-1) < 1e-3) > 0.98  # ties at part borders


def test_a_scene_fitted_on_the_card_stops_and_goes_on(card, dpc_here, tmp_path, monkeypatch):
    views, scene = toy_views(tmp_path / "views.h5"), tmp_path / "scene.h5"
    words = (
        "generate4d",
        "fit",
        views,
        "-o",
        scene,
        "--preset",
        "tiny",
        "--size",
        16,
        "--set",
        "gaussians=40",
        "--set",
        "control_points=8",
        "--set",
        "dense_steps=2",
        "--set",
        "sparse_steps=2",
    )
    take_step = SceneOptimizer.take_step

    def stop_after_three(optimizer: SceneOptimizer) -> StepResult:
        result = take_step(optimizer)
        if optimizer.step == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        return result

    with monkeypatch.context() as patched:
        patched.setattr(SceneOptimizer, "take_step", stop_after_three)
        done = dpc_here(*words)
    assert done.returncode not in (0, 1) and b"saved at step 3" in done.stderr, done.stderr
    done = dpc_here(*words)
    assert done.returncode == 0 and read_scene(scene).num_gaussians == 40, done.stderr


def test_mixed_precision_comes_unasked_only_where_the_gpu_has_it(card, monkeypatch):
    device = torch.device("cuda")
    assert wanted(None, device) and not wanted(False, device)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: including_emulation)
    assert not wanted(None, device) and wanted(True, device)
