"""The angles of the whole, errors of layers and the confidence, against closed forms and brute force."""

from __future__ import annotations

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dpcli.errors import DpcError
from dpcli.generate4d.shape.config import ShapeConfig
from dpcli.generate4d.shape.learned import choose_angles
from dpcli.generate4d.shape.network import ShapeNetwork, tilted_plane
from dpcli.generate4d.shape.training.confidence import confidence, fit_confidence
from dpcli.generate4d.shape.training.losses import depth_error, object_angles, object_length, shape_loss
from dpcli.generate4d.shape.training.rounds import Batch
from dpcli.generate4d.shape.training.trainer import ShapeTrainer

NONE = math.nan


def _slab(across: float, down: float, thick: float = 0.1) -> torch.Tensor:
    """The layers (1,4,40,40) of a slab turned by two angles, seen through a square window."""
    middle = tilted_plane(torch.tensor([[across, down]]), 40)[0, 0]
    layers = torch.full((1, 4, 40, 40), NONE)
    window = slice(2, 38), slice(2, 38)
    layers[0, 0][window], layers[0, 1][window] = middle[window] - thick / 2, middle[window] + thick / 2
    return layers


@pytest.mark.parametrize(("across", "down"), [(0.5, 0.0), (-0.8, 0.3), (0.0, -0.6)])
def test_angles_of_a_turned_slab(across, down):
    found = object_angles(_slab(across, down))[0]
    assert found.tolist() == pytest.approx([across, down], abs=0.04)
    mirrored = object_angles(_slab(across, down).flip(-1))[0]
    assert mirrored.tolist() == pytest.approx([-found[0].item(), found[1].item()], abs=1e-5)


def test_the_error_counts_the_layers_that_exist():
    truth = _slab(0.0, 0.0)
    assert depth_error(truth.nan_to_num() + 0.02, truth).item() == pytest.approx(0.02, rel=1e-4)
    wrong = truth.nan_to_num()
    wrong[:, 2:] = 9.0
    assert depth_error(wrong, truth).item() == pytest.approx(0, abs=1e-6)


def test_bins_hold_an_angle_between_the_nearest_two():
    model = ShapeNetwork(ShapeConfig(widths=(4, 8), hidden=8, bins=7))
    angles = torch.tensor([0.1, -2.0, 1.25])
    target = model.angle_targets(angles)
    assert target.sum(-1).tolist() == pytest.approx([1, 1, 1], abs=1e-5)
    assert (target * model.centers).sum(-1).tolist() == pytest.approx([0.1, -1.25, 1.25], abs=1e-5)
    found = model.mean_angles((target + 1e-9).log())
    assert found.tolist() == pytest.approx([0.1, -1.25, 1.25], abs=1e-3)


def test_a_clip_is_turned_as_all_paths_together_say_or_not_at_all():
    model = ShapeNetwork(ShapeConfig(widths=(4, 8), hidden=8, bins=3))
    logits = torch.from_numpy(np.random.default_rng(1).normal(size=(4, 2, 3)) * 2).float()
    logits[:, 0, 2] += 12  # turned for sure; about the other axis nothing is
    found = choose_angles(model, logits)
    for axis in range(2):
        own, shares = logits[:, axis].log_softmax(-1) / 4, np.zeros((4, 3))
        for path in itertools.product(range(3), repeat=4):
            worth = sum(own[t, k] for t, k in enumerate(path)) - sum(abs(a - b) for a, b in itertools.pairwise(path))
            shares[range(4), path] += math.exp(worth)
        shares /= shares.sum(1, keepdims=True)
        mean = shares @ model.centers.numpy()
        spread = np.sqrt((shares * (model.centers.numpy() - mean[:, None]) ** 2).sum(1))
        assert found[:, axis].numpy() == pytest.approx(np.where(np.abs(mean) > spread, mean, 0), abs=1e-4)
    assert (found[:, 0] > 0.5).all() and (found[:, 1] == 0).all()


def test_confidence_tells_things_from_creatures_and_leaves_the_middle_to_these():
    """Features of any scale and offset, one of them always the same; seen again and new ones."""
    rng = np.random.default_rng(1)
    creatures, things = (
        np.append(1000 + 50 * (rng.normal(size=(200, 30)) + middle), np.ones((200, 1)), axis=1) for middle in (1, -1)
    )
    fitted = fit_confidence(creatures[:100], things[:100])
    assert len(fitted) == 32
    assert (confidence(creatures[100:], fitted) >= 0.5).all() and (confidence(things[100:], fitted) < 0.5).mean() > 0.9
    assert confidence(np.array([[1000.0] * 30 + [1]]), fitted) > 0.6
    assert confidence(np.array([[1e9] * 31, [-1e9] * 31]), fitted).tolist() == pytest.approx([1, 0])


def test_a_loss_that_runs_away_from_where_it_began_ends_the_training():
    trainer = SimpleNamespace(watch=None, step=0, _learning_rate=lambda: 1.0)
    for loss in (3.0, 40.0, float("nan"), 3.0):
        ShapeTrainer._look_at(trainer, loss, True)
    with pytest.raises(DpcError, match=r"training diverged \(step 1, learning rate 1\): the loss grew to .*, from 3"):
        ShapeTrainer._look_at(trainer, 1e6, True)


def test_the_length_of_a_turned_ellipsoid_is_that_of_its_axis():
    """A ball has length 0, one that is drawn out along the line of sight the logarithm of by how much, however it leans."""
    axis = (torch.arange(40) + 0.5) / 40 - 0.5
    half = (0.16 - axis[:, None].square() - axis.square()).clamp(min=0).sqrt()
    for factor in (0.5, 1.0, 3.0):
        for angles in (torch.zeros(1, 2), torch.tensor([[0.6, -0.3]])):
            depth = tilted_plane(angles, 40) + torch.stack([-half, half])[None] * factor
            layers = torch.full((1, 4, 40, 40), NONE)
            layers[:, :2] = torch.where(half > 0, depth, NONE)
            batch = Batch(half.expand(1, 5, 40, 40), layers)
            assert object_length(batch, angles).item() == pytest.approx(math.log(factor), abs=0.02)


def test_the_length_is_learned_and_known_to_the_decoder():
    """After some steps on long and short objects that look alike but for their color, the network names which is which."""
    torch.manual_seed(0)
    model = ShapeNetwork(ShapeConfig(widths=(8, 16), hidden=16, bins=9, lengths=True))
    half = 0.2 * torch.ones(16, 16, 16)
    long = torch.arange(16) % 2 == 0
    reach = torch.where(long, 0.5, 0.2)[:, None, None, None]
    depth = torch.cat([-reach, reach], 1).expand(-1, -1, 16, 16)
    layers = torch.cat([depth, torch.full_like(depth, NONE)], 1)
    color = torch.where(long, 1.0, 0.0)[:, None, None, None].expand(-1, 3, 16, 16)
    batch = Batch(torch.cat([color, torch.ones(16, 1, 16, 16), half[:, None]], 1), layers)
    optimizer = torch.optim.Adam(model.parameters(), 0.01)
    for _ in range(60):
        loss, _ = shape_loss(model, batch, torch.zeros(16, dtype=torch.bool))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    encoded = model.eval().encode(batch.pictures)
    named = model.mean_length(encoded.lengths)
    assert named[long].mean().item() == pytest.approx(math.log(2.5), abs=0.15) and named[~long].abs().mean() < 0.15
    first, second = (
        model.decode(encoded, batch.pictures, torch.zeros(16, 2), x)[0] for x in (0 * named, 1 + 0 * named)
    )
    assert ((second[:, 1] - second[:, 0]) / (first[:, 1] - first[:, 0])).mean() > 1.5
