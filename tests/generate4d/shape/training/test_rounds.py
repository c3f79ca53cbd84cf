"""Rounds of pictures: what a batch is drawn from, the window after a stop, and variation that keeps layers on pixels."""

from __future__ import annotations

import pickle
from functools import partial
from multiprocessing.reduction import ForkingPickler

import numpy as np
import pytest
import torch

from dpcli.generate4d.shape.training.rounds import Batch, Window, draw_round, open_window, vary


class _Models:
    """Pictures whose red says the round's number."""

    def __init__(self, number: int, count: int) -> None:
        self.rgba = torch.full((count, 4, 8, 8), 255, dtype=torch.uint8)
        self.rgba[:, 0] = number

    def draw(self, device: torch.device | str) -> tuple[torch.Tensor, torch.Tensor]:
        return self.rgba, torch.zeros_like(self.rgba).half()


def _held(window: Window) -> list[int]:
    return [int(one.rgba[0, 0, 0, 0]) for one in window._held]


@pytest.mark.parametrize("kept", [2, 5, 8])
def test_a_window_that_is_opened_again_holds_what_it_would_have_held(kept):
    with open_window(_Models, 3, kept, 0, 6, 1) as window:
        seen = []
        for _ in range(6):
            window.advance()
            seen.append(_held(window))
    assert len(seen[0]) == min(kept, 4) and all(len(one) <= kept for one in seen)
    for at in range(1, 6):
        with open_window(_Models, 3, kept, at, 6, 1) as window:
            window.advance()
            assert _held(window) == seen[at]


def test_what_goes_wrong_in_a_round_is_raised():
    with pytest.raises(ZeroDivisionError), open_window(partial(_fail), 3, 2, 0, 1, 1) as window:
        window.advance()


def _fail(number: int, count: int) -> _Models:
    return _Models(number // 0, count)


def test_a_batch_comes_from_all_rounds_and_repeats():
    rounds = [draw_round(_Models(number, 9)) for number in (0, 255)]
    window = Window(iter(rounds), 2)
    window.advance()
    window.advance()
    first, again = (window.draw(40, np.random.default_rng(2)) for _ in range(2))
    assert torch.equal(first.pictures, again.pictures) and first.pictures.shape == (40, 5, 8, 8)
    full = first.pictures[:, 3].flatten(1).amax(1) > 0
    assert full.all() and 0.2 < (first.pictures[:, 0].flatten(1).amax(1) > 0.3).float().mean() < 0.8


def test_variation_keeps_layers_on_their_pixels():
    rng = np.random.default_rng(0)
    inside = torch.zeros(64, 1, 24, 24)
    inside[:, :, 6:18, 3:21] = 1
    depth = torch.where(inside > 0, torch.linspace(-0.5, 0.5, 24), torch.nan).expand(-1, 4, -1, -1)
    pictures = torch.cat([inside.expand(-1, 4, -1, -1), 0.1 * inside], 1)
    varied = vary(Batch(pictures, depth), rng)
    assert torch.equal(varied.pictures[:, 3] > 0.5, ~varied.depth[:, 0].isnan())
    assert set(np.unique(varied.depth[~varied.depth.isnan()].numpy().round(4))) <= set(
        np.unique(depth[~depth.isnan()].numpy().round(4))
    )
    rising = torch.nan_to_num(varied.depth[:, 0].diff(dim=-1)).sum((1, 2)) > 0
    assert 16 < int(rising.sum()) < 48  # about half are mirrored
    assert len({tuple(color) for color in varied.pictures[:, :3, 12, 12].numpy().round(3).tolist()}) > 20


def test_a_round_goes_to_another_process_without_shared_memory():
    """What is sent holds all its bytes, and no handle of a file that a small /dev/shm or few open files could refuse."""
    one = draw_round(_Models(7, 5))
    sent = bytes(ForkingPickler.dumps(one))
    assert len(sent) > sum(tensor.numel() * tensor.element_size() for tensor in (one.rgba, one.thickness, one.depth))
    again = pickle.loads(sent)
    assert all(torch.equal(getattr(again, key), getattr(one, key)) for key in ("rgba", "thickness", "depth"))
