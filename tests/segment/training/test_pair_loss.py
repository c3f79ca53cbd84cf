"""The loss of a batch of pairs: the truth costs least, and turning keeps pairs together."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dpcli.segment.frame_pairs import PairSource
from dpcli.segment.network.config import compact
from dpcli.segment.network.part_network import PartNetwork
from dpcli.segment.training.pair_loss import Batch, pair_loss, turn_randomly
from dpcli.segment.training.settings import Objective
from dpcli.store import CloudsReader


def test_the_right_masks_cost_less_than_wrong_ones_in_every_form(data):
    """The unsupervised loss prefers the truth to one part, to a shuffle, to a random mask."""
    reader = CloudsReader(data)
    source = PairSource(reader, [0, 1], 48, 0)
    loaded = [source.load(pair) for pair in source.pairs]
    stacked = (torch.tensor(np.stack([getattr(p, key) for p in loaded])) for key in ("points", "flow", "part"))
    batch = Batch(*(values.transpose(0, 1).flatten(0, 1) for values in stacked))

    class Fixed(torch.nn.Module):
        motion = None

        def __init__(self, mask):
            super().__init__()
            self.mask = mask

        def forward(self, points):
            return self

    right = torch.nn.functional.one_hot(batch.part, 4).float()
    wrong = {
        "one part": torch.nn.functional.one_hot(torch.zeros_like(batch.part), 4).float(),
        "shuffled": right[:, torch.randperm(48, generator=torch.Generator().manual_seed(0))],
        "even": torch.full_like(right, 0.25),
    }
    for form in ("blended", "per-part"):
        objective = Objective(form=form, cold_start=0)
        best = float(pair_loss(Fixed(right), batch, objective, 0.0, torch.Generator()).loss)
        assert best < 1e-3
        for name, mask in wrong.items():
            assert float(pair_loss(Fixed(mask), batch, objective, 0.0, torch.Generator()).loss) > 5 * best + 1e-3, (
                form,
                name,
            )


def test_turning_keeps_pairs_together():
    points = torch.randn(6, 20, 3)
    turned, rotation = turn_randomly(points, torch.Generator().manual_seed(0))
    assert torch.equal(rotation[:3], rotation[3:]) and not torch.allclose(rotation[0], rotation[1])
    assert torch.allclose(torch.cdist(points, points), torch.cdist(turned, turned), atol=1e-4)


@pytest.mark.parametrize("part", [-1, 9])
def test_the_flow_of_points_in_no_slot_s_part_teaches_nothing(part, data):
    """With labels, a point of part -1, or of a ninth where there are eight slots, counts for the motion of none of these."""
    source = PairSource(CloudsReader(data), [0], 48, 0)
    loaded = [source.load(source.pairs[0])]
    stacked = (torch.tensor(np.stack([getattr(p, key) for p in loaded])) for key in ("points", "flow", "part"))
    batch = Batch(*(values.transpose(0, 1).flatten(0, 1) for values in stacked))
    batch.part[:, :10] = part
    torch.manual_seed(0)
    network = PartNetwork(compact()).eval()
    first = pair_loss(network, batch, Objective(supervised=True), 0.0, torch.Generator()).terms
    batch.flow[:, :10] += torch.linspace(-3, 3, 30).view(10, 3)
    assert pair_loss(network, batch, Objective(supervised=True), 0.0, torch.Generator()).terms == first


def test_a_step_that_is_repeated_turns_its_copies_alike(data):
    """As after a kill: nothing may depend on how much was drawn at random before."""
    source = PairSource(CloudsReader(data), [0], 48, 0)
    loaded = source.load(source.pairs[0])
    batch = Batch(*(torch.tensor(values) for values in (loaded.points, loaded.flow, loaded.part)))
    network, objective = PartNetwork(compact()).eval(), Objective(invariance=1.0)
    first, again, other = (
        pair_loss(network, batch, objective, 0.0, torch.Generator().manual_seed(seed)).terms["invariance"]
        for seed in (0, 0, 1)
    )
    assert first == again != other
