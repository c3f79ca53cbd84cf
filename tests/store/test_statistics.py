"""Statistics of an evaluation come back to the bit, and damage is told."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.store.statistics import StatisticsReader, StatisticsWriter


def write(path) -> dict:
    rng = np.random.default_rng(0)
    values = {
        "label": 3,
        "pairs": rng.integers(0, 9, (4, 2)).astype(np.int32),
        "none": np.zeros((0, 2), bool),
        "inner": {
            "error": rng.normal(size=5) * 1e-30,
            "nan": np.array([np.nan, np.inf, -0.0]),
            "n": np.int64(2**62 + 1),
        },
    }
    with StatisticsWriter(path, class_names=["a"], provenance=[{"command": "dpc"}]) as writer:
        writer.write("one", values)
    return values


def test_values_come_back_to_the_bit(tmp_path):
    values = write(tmp_path / "a.h5")
    back = StatisticsReader(tmp_path / "a.h5").read(0)
    assert back["label"] == 3 and back["inner"]["n"] == 2**62 + 1
    for mine, own in ((values, back), (values["inner"], back["inner"])):
        for key in mine:
            if isinstance(mine[key], np.ndarray):
                assert mine[key].dtype == own[key].dtype and mine[key].shape == own[key].shape
                assert mine[key].tobytes() == own[key].tobytes()


@pytest.mark.parametrize("text", ["", "[1", '{"a": {"dtype": "<f8", "shape": [3], "values": [1]}}'])
def test_a_damaged_row_is_told(tmp_path, text):
    write(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["statistics"][0] = text
    with pytest.raises(DataError, match="statistics of 'one' are damaged"):
        StatisticsReader(tmp_path / "a.h5").read(0)
