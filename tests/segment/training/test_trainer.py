"""The training loop's own judgment of held-out pairs, and the flows that it continues with."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from dpcli.runtime.run_folder import RunFolder
from dpcli.segment.training.flow_store import FlowStore
from dpcli.segment.training.pair_loss import Batch
from dpcli.segment.training.settings import Objective, RunSettings
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


def test_a_kill_between_the_state_and_the_flows_loses_no_flow(tmp_path, monkeypatch):
    with RunFolder(tmp_path, {}, columns=("epoch",)) as folder:
        nothing = SimpleNamespace(state_dict=dict)
        trainer = SimpleNamespace(
            folder=folder,
            model=nothing,
            optimizer=nothing,
            training=SimpleNamespace(pairs=[0, 1], points=5),
            settings=SimpleNamespace(run=RunSettings()),
            **dict.fromkeys(("epoch", "step", "best", "sums", "spent"), 0),
        )
        Trainer._open_flows(trainer, None)
        trainer.flows.put_first(0, torch.ones(2, 5, 3), True)
        trainer.flows.put(0, torch.full((2, 5, 3), 2.0))

        def die(self):
            raise InterruptedError

        with monkeypatch.context() as patch, pytest.raises(InterruptedError):
            patch.setattr(FlowStore, "flush", die)
            Trainer._save(trainer)
        Trainer._open_flows(trainer, folder.load_state())
    assert float(trainer.flows.get(0).mean()) == 2 and trainer.flows.shows_bodies(0) and trainer.flows.get(1) is None
