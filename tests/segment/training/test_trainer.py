"""The training loop's own judgment of held-out pairs."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from dpcli.segment.training.pair_loss import Batch
from dpcli.segment.training.settings import Objective
from dpcli.segment.training.trainer import Trainer


def test_the_rand_index_is_that_of_the_points_whose_part_is_known():
    """One unknown point hides neither its own frame nor those beside it in the batch."""
    mask = torch.eye(3)[torch.tensor([[0, 0, 1, 1, 2], [0, 0, 0, 0, 0], [0, 1, 2, 0, 1]])]

    class Fixed(torch.nn.Module):
        def forward(self, points):
            return SimpleNamespace(mask=mask)

    part = torch.tensor([[0, 0, 1, 1, -1], [4, 4, 4, 3, 3], [-1, -1, -1, -1, -1]])
    batch = Batch(torch.zeros(3, 5, 3), torch.zeros(3, 5, 3), part)
    trainer = SimpleNamespace(model=Fixed(), checking=[batch], objective=Objective(supervised=True))
    agree = (1 + 13 / 25) / 2  # all of frame 1; of frame 2's 25 pairs the 9 + 4 of one part
    assert Trainer.validate(trainer)["validation_rand_index"] == pytest.approx(agree)
    batch.part = torch.full_like(part, -1)
    assert Trainer.validate(trainer)["validation_rand_index"] is None
