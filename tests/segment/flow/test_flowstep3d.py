"""The flow network: its layers written out, its symmetries, the loss, training that stops and goes on, files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from dpcli.errors import DataError, Stopped, UsageError
from dpcli.ops import knn
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.signals import StopRequest
from dpcli.segment.flow.config import PRESETS, FlowConfig, FlowSchedule
from dpcli.segment.flow.estimators import estimate_flow
from dpcli.segment.flow.flowstep3d import FlowStep3D, SetConv
from dpcli.segment.flow.losses import chamfer, flow_loss
from dpcli.segment.flow.model_file import load_flow_model, save_flow_model
from dpcli.segment.flow.trainer import COLUMNS, FlowTrainer, augment_pair
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter

TINY = FlowConfig(local=(8, 8), deep=(8, 8), hidden=8, head=8, neighbors=6, iterations=3)


pytestmark = pytest.mark.usefixtures("one_thread")


def clouds(seed: int, count: int = 64) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    return tuple(torch.tensor(rng.random((2, count, 3)) * 0.6, dtype=torch.float32) for _ in range(2))


def network(config: FlowConfig = TINY) -> FlowStep3D:
    """With a last layer that does something, as after training."""
    torch.manual_seed(0)
    model = FlowStep3D(config)
    torch.nn.init.normal_(model.last.weight, std=0.1)
    return model.eval()


def test_set_conv_written_out() -> None:
    """The split first layer is the layer on [offset, feature]; then the rest, and the maximum over neighbors."""
    torch.manual_seed(1)
    layer = SetConv(5, 7, "layer", 2)
    points, features, centers = torch.randn(1, 20, 3), torch.randn(1, 20, 5), torch.randn(1, 4, 3)
    _, idx = knn(centers, points, 6)
    weight = torch.cat([layer.place.weight, layer.feature.weight], 1)
    ours = layer(points, features, idx, centers)
    for m in range(4):
        rows = [torch.cat([points[0, j] - centers[0, m], features[0, j]]) for j in idx[0, m]]
        hidden = layer.rest(layer.first((torch.stack(rows) @ weight.T)[None]))
        torch.testing.assert_close(ours[0, m], hidden[0].amax(0), rtol=0, atol=1e-5)


@pytest.mark.parametrize(("name", "count"), [("compact", 125_988), ("release", 555_844)])
def test_configurations(name: str, count: int) -> None:
    config = PRESETS[name]["network"]
    assert sum(p.numel() for p in FlowStep3D(config).parameters()) == count
    assert FlowConfig.from_json(config.to_json()) == config
    with pytest.raises(UsageError, match="norm = none: expected one of layer, batch"):
        FlowConfig(norm="none")


def test_untrained_network_gives_the_global_match_and_every_weight_learns() -> None:
    torch.manual_seed(0)
    fresh = FlowStep3D(TINY)
    flows = fresh(*clouds(0))
    assert len(flows) == 3 and all(f.shape == (2, 64, 3) for f in flows)
    torch.testing.assert_close(flows[0], flows[-1])  # the last layer starts at zero
    model = network().train()
    flow_loss(*clouds(0), model(*clouds(0)))[0].backward()
    still = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    assert not still, still


def test_shifting_both_frames_changes_nothing() -> None:
    first, second = clouds(1)
    model, offset = network(), torch.tensor([3.0, -1.0, 0.5])
    flow = model(first, second)[-1]
    torch.testing.assert_close(model(first + offset, second + offset)[-1], flow, rtol=0, atol=1e-4)
    assert (model(first, second + offset)[-1] - flow).abs().max() > 0.1  # the checker is no constant


def test_chamfer_by_brute_force_and_its_gradient() -> None:
    first, second = (c.double()[:, :9] for c in clouds(3))
    distance = torch.cdist(first, second)
    assert float(chamfer(first, second)) == pytest.approx(float(distance.amin(1).mean() + distance.amin(2).mean()))
    moved = first.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: chamfer(x, second), (moved,))
    same = first.clone().requires_grad_()
    chamfer(same, first).backward()
    assert not same.grad.any()


def test_golden_chamfer(golden_file) -> None:
    golden = {key: torch.from_numpy(value) for key, value in golden_file("multibody_ops.npz").items()}
    ours = chamfer(golden["pc1"] + golden["flow"], golden["pc2"])
    torch.testing.assert_close(ours, golden["flow_chamfer"], rtol=0, atol=1e-6)


def test_augmented_is_affine_and_moves_frames_apart_a_little() -> None:
    pair = np.random.default_rng(4).random((2, 30, 3)).astype(np.float32)
    pair[1] = pair[0]
    changed = augment_pair(pair, np.random.default_rng(5))
    assert changed.dtype == np.float32 and changed.shape == pair.shape
    gap = changed[1] - changed[0]
    np.testing.assert_allclose(gap, np.broadcast_to(gap[0], gap.shape), atol=1e-6)
    assert 0 < np.abs(gap).max() <= 0.01 + 1e-6
    fit = np.linalg.lstsq(np.c_[pair[0], np.ones(30)], changed[0], rcond=None)[0][:3].T
    assert np.all(np.abs(np.linalg.svd(fit)[1] - 1) < 0.051) and not np.allclose(fit, np.eye(3), atol=1e-3)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """Boxes that shift by 0.08 of their size from frame to frame."""
    path = tmp_path_factory.mktemp("flow") / "clouds.h5"
    with CloudsWriter(path, fields=["part", "pose"]) as writer:
        for i in range(6):
            rng = np.random.default_rng(i)
            pose = np.tile(np.eye(4), (3, 1, 1, 1))
            pose[:, 0, 0, 3] = 0.08 * np.arange(3)
            frames = [rng.random((80, 3)) * [0.7, 0.5, 0.4] + pose[t, 0, :3, 3] for t in range(3)]
            part = [np.zeros(80, np.int16)] * 3
            split = "train" if i < 5 else "validation"
            writer.write(CloudSequence.from_frames(f"b{i}", frames, part=part, pose=pose, split=split))
    return path


def train(
    data: Path, folder: Path, steps: int, stop: StopRequest | None = None, batch: int = 2, config: FlowConfig = TINY
) -> FlowStep3D:
    run = RunFolder(folder, {"seed": 1}, columns=COLUMNS)
    schedule, device = FlowSchedule(steps=steps, batch=batch, points=64), torch.device("cpu")
    with CloudsReader(data) as reader:
        trainer = FlowTrainer(
            reader, run, config, schedule, seed=1, device=device, stop=stop or StopRequest(), log_every=5
        )
        with run:
            return trainer.run()


class StopAfter(StopRequest):
    """Asks for a stop once it has been looked at `looks` times."""

    def __init__(self, looks: int) -> None:
        self.looks, self.name = looks, "SIGTERM"

    @property
    def requested(self) -> bool:
        self.looks -= 1
        return self.looks < 0

    @requested.setter
    def requested(self, value: bool) -> None:
        raise AssertionError(value)


def test_stopped_and_continued_is_the_same(data: Path, tmp_path: Path) -> None:
    whole = train(data, tmp_path / "whole", 6)
    with pytest.raises(Stopped, match="saved at step"):
        train(data, tmp_path / "cut", 6, StopAfter(2))
    assert not (tmp_path / "cut" / "best.safetensors").exists()
    again = train(data, tmp_path / "cut", 6)
    for (name, ours), theirs in zip(whole.state_dict().items(), again.state_dict().values()):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6, msg=name)
    assert (tmp_path / "cut" / "log.csv").read_text().count("\n") == 3  # steps 5 and 6, and the header


def test_training_lowers_the_loss_and_its_file_estimates_flow(data: Path, tmp_path: Path) -> None:
    train(data, tmp_path / "run", 25, batch=4, config=FlowConfig(iterations=2))
    rows = json.loads((tmp_path / "run" / "log.json").read_text())
    assert rows[-1]["loss"] < rows[0]["loss"] and rows[-1]["validation_loss"] < rows[0]["validation_loss"]
    assert all(np.isfinite(row["validation_epe"]) for row in rows)
    model, notes = load_flow_model(str(tmp_path / "run"))
    assert not model.training and notes["seed"] == 1
    first, second = clouds(6, 100)
    flow = estimate_flow(first, second[:, :70], str(tmp_path / "run"))
    assert flow.shape == first.shape and flow.isfinite().all()
    scaled = estimate_flow(first * 8 + 2, second[:, :70] * 8 + 2, str(tmp_path / "run" / "best.safetensors"))
    torch.testing.assert_close(scaled / 8, flow, rtol=0, atol=1e-3)


@pytest.mark.parametrize("count", [1, 5, 16, 17])
def test_small_and_flat_clouds_give_finite_flow(count: int, tmp_path: Path) -> None:
    save_flow_model(tmp_path / "m.safetensors", network(), {})
    for cloud in (torch.rand(1, count, 3), torch.zeros(1, count, 3), torch.rand(1, count, 1).expand(-1, -1, 3)):
        flow = estimate_flow(cloud, cloud + 0.5, str(tmp_path / "m.safetensors"))
        assert flow.shape == cloud.shape and flow.isfinite().all()
    still = estimate_flow(torch.zeros(1, count, 3), torch.full((1, 4, 3), 0.5), str(tmp_path / "m.safetensors"))
    torch.testing.assert_close(still, torch.full((1, count, 3), 0.5))


def test_large_clouds_are_thinned(tmp_path: Path) -> None:
    save_flow_model(tmp_path / "m.safetensors", network(), {})
    first, second = clouds(7, 2100)
    flow = estimate_flow(first[:1], second[:1], str(tmp_path / "m.safetensors"))
    assert flow.shape == (1, 2100, 3) and flow.isfinite().all()


def test_damaged_and_foreign_files_end_with_a_sentence(tmp_path: Path) -> None:
    cloud = torch.rand(1, 32, 3)
    path = tmp_path / "m.safetensors"
    path.write_bytes(b"nonsense")
    with pytest.raises(DataError, match="not a complete safetensors"):
        estimate_flow(cloud, cloud, str(path))
    from safetensors.torch import save_file

    save_file({"x": torch.zeros(1)}, path, {"format": "dpc-parts-1"})
    with pytest.raises(DataError, match="expected 'dpc-flow-1'"):
        estimate_flow(cloud, cloud, str(path))
