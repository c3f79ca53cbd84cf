"""Mixed precision of the part network, on CPU: products in bfloat16, geometry in float32."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from dpcli.runtime.mixed_precision import full_precision, is_reduced, reduced_products, wanted
from dpcli.segment.network.config import Layer, PartConfig
from dpcli.segment.network.model_file import default_model, load_model
from dpcli.segment.network.neighborhood import kernel_weights
from dpcli.segment.network.part_network import PartNetwork
from dpcli.segment.training.losses import supervised_loss

CPU = torch.device("cpu")


def small() -> PartConfig:
    layer = lambda c, s, r: Layer(c, s, r, (0.6 * r) ** 2, 16, 0.65 * r)  # noqa: E731
    return PartConfig(
        ((layer(4, 2, 0.25),), (layer(8, 2, 0.4), layer(8, 1, 0.4))),
        decoder=((16, 16), (16, 16)),
        slots=4,
        slot_width=16,
        slot_layers=1,
        embedding=16,
        motion_width=8,
        motion_layers=(8, 8),
    )


def boxes(count: int, points: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Clouds (B,N,3) of a body and a lid, and which of the two each point is in (B,N)."""
    rng = np.random.default_rng(seed)
    body = rng.uniform(-0.5, 0.5, (count, points // 2, 3)) * [0.9, 0.6, 0.3]
    lid = rng.uniform(-0.5, 0.5, (count, points - points // 2, 3)) * [0.9, 0.5, 0.05] + [0, 0.1, 0.4]
    label = torch.arange(points).ge(points // 2).long().expand(count, -1)
    return torch.from_numpy(np.float32(np.concatenate([body, lid], 1))), label


def test_who_gets_it() -> None:  # unasked on a GPU: test_gpu_path
    assert not wanted(None, CPU)
    assert wanted(True, CPU) and not wanted(False, torch.device("cuda:0"))


def test_masks_of_the_shipped_network_hardly_change() -> None:
    model, _ = load_model(default_model())
    points, _ = boxes(2, 256, 0)
    with torch.inference_mode():
        exact = model.eval()(points).mask
        model.mixed = True
        mixed = model(points).mask
    assert mixed.dtype == torch.float32 and mixed.isfinite().all()
    change = (mixed - exact).abs()
    assert 0 < change.mean() < 0.02 and (mixed.argmax(-1) == exact.argmax(-1)).float().mean() > 0.97


def test_products_are_reduced_and_geometry_is_not() -> None:
    matrix = torch.rand(4, 4)
    offsets, positions = 0.1 * torch.randn(1, 5, 6, 3), 0.1 * torch.randn(13, 3)
    exact = kernel_weights(offsets, positions, 0.01)
    with reduced_products(CPU, True):
        assert is_reduced(matrix) and (matrix @ matrix).dtype == torch.bfloat16
        assert torch.equal(kernel_weights(offsets, positions, 0.01), exact)
        assert full_precision(lambda a: a @ a)(matrix.bfloat16()).dtype == torch.float32
        blurred = kernel_weights.__wrapped__(offsets, positions, 0.01)  # the same without its protection
    assert (blurred.float() - exact).abs().max() > 1e-3
    with reduced_products(CPU, False):
        assert not is_reduced(matrix) and (matrix @ matrix).dtype == torch.float32


def test_the_gradient_is_that_of_float32_nearly() -> None:
    torch.manual_seed(0)
    model = PartNetwork(small())
    points, label = boxes(2, 64, 1)
    grads = []
    for mixed in (False, True):
        model.mixed = mixed
        model.zero_grad(set_to_none=True)
        supervised_loss(model(points).mask, label).backward()
        own = [p.grad for p in model.parameters() if p.grad is not None]
        assert all(g.dtype == torch.float32 and g.isfinite().all() for g in own)
        grads.append(torch.cat([g.flatten() for g in own]))
    assert torch.nn.functional.cosine_similarity(*grads, dim=0) > 0.98
    assert not torch.equal(*grads)


def test_the_loss_falls() -> None:
    torch.manual_seed(0)
    model = PartNetwork(small())
    model.mixed = True
    optimizer = torch.optim.Adam(model.parameters(), lr=0.01)
    losses = []
    for step in range(25):
        points, label = boxes(4, 64, step)
        loss = supervised_loss(model(points).mask, label)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert np.mean(losses[-5:]) < 0.6 * np.mean(losses[:3])


@pytest.mark.parametrize("words", [["--fast", "--set", "amp=true"], []])
def test_the_switch_reaches_the_file(dpc_here, tmp_path, words: list[str]) -> None:
    made = dpc_here(
        "prepare",
        "synthetic",
        "articulated",
        "-o",
        tmp_path / "o.h5",
        "--objects",
        1,
        "--sequences-per-object",
        1,
        "--frames",
        2,
        "--points",
        64,
    )
    assert made.returncode == 0, made.stderr.decode()
    done = dpc_here("segment", "predict", tmp_path / "o.h5", "-o", tmp_path / "p.h5", *words)
    assert done.returncode == 0, done.stderr.decode()
    told = json.loads(dpc_here("info", tmp_path / "p.h5", "--json").stdout)
    assert told["provenance"][-1]["config"].get("amp", False) is bool(words)
