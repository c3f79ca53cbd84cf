"""Flows kept between runs: nothing is changed twice, first flows are handed on."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dpcli.errors import DataError, UsageError
from dpcli.segment.training.flow_store import FlowStore


def test_flow_store_changes_nothing_twice_and_hands_first_flows_on(tmp_path):
    store = FlowStore(tmp_path, 3, 5, fresh=True)
    assert store.get(1) is None and store.shows_bodies(1) is None
    store.put_first(1, torch.ones(2, 5, 3), True)
    store.put(1, torch.full((2, 5, 3), 2.0))
    pending = store.pending()
    store.flush()
    again = FlowStore(tmp_path, 3, 5, fresh=False)
    again.restore(pending)  # as after a kill between saving the state and flushing
    assert float(again.get(1).mean()) == 2 and again.shows_bodies(1) and again.get(2) is None
    (tmp_path / "other").mkdir()
    other = FlowStore(tmp_path / "other", 3, 5, fresh=True, take_from=tmp_path)
    assert float(other.get(1).mean()) == 1 and other.shows_bodies(1) and other.get(0) is None
    with pytest.raises(UsageError, match="flows_of = "):
        FlowStore(tmp_path / "other", 4, 5, fresh=True, take_from=tmp_path)


@pytest.mark.parametrize("name", ["flows_first.npy", "flows.npy", "flows_known.npy"])
@pytest.mark.parametrize("lost", ["gone", "of other pairs", "cut"])
def test_a_run_does_not_go_on_with_zeros_in_the_place_of_lost_flows(tmp_path, name, lost):
    store = FlowStore(tmp_path, 3, 5, fresh=True)
    store.put_first(1, torch.ones(2, 5, 3), True)
    store.flush()
    if lost == "gone":
        (tmp_path / name).unlink()
    elif lost == "of other pairs":
        np.save(tmp_path / name, np.load(tmp_path / name)[:2])
    else:
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:100])
    with pytest.raises(DataError, match=name):
        FlowStore(tmp_path, 3, 5, fresh=False)
