"""Which sequences a command takes, and which a training holds out."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.errors import DataError, UsageError
from dpcli.segment.frame_pairs import PairSource, choose_points
from dpcli.segment.sequence_splits import hold_out_sequences, sequences_of_split
from dpcli.segment.training.settings import Schedule
from dpcli.store import CloudsReader


def test_splits_and_choices(data):
    reader = CloudsReader(data)
    assert hold_out_sequences(reader, "auto", 0) == ([0, 1, 2, 3], [])
    train, held = hold_out_sequences(reader, "0.25", 0)
    assert len(train) == 3 and len(held) == 1 and not set(train) & set(held)
    assert hold_out_sequences(reader, "none", 0) == ([0, 1, 2, 3], [])
    assert sequences_of_split(reader, "test", "x.h5") == [4, 5] and len(sequences_of_split(reader, "all", "x.h5")) == 6
    with pytest.raises(DataError, match="x.h5: no sequence of split 'val'; it has"):
        sequences_of_split(reader, "val", "x.h5")
    with pytest.raises(UsageError, match="fraction"):
        hold_out_sequences(reader, "1.5", 0)
    rng = np.random.default_rng(0)
    assert sorted(choose_points(5, 5, rng)) == [0, 1, 2, 3, 4] and set(choose_points(3, 8, rng)) == {0, 1, 2}
    with pytest.raises(UsageError, match="batch = 0: expected at least 1"):
        Schedule(batch=0)
    with pytest.raises(DataError, match="two frames"):
        PairSource(reader, [], 8, 0)
