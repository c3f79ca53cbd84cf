"""The script behind `make table-4.1`, at toy size."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from dpcli.reproduce.table_4_1 import METRICS, ROWS, table
from dpcli.store import CloudsReader
from tests.support.prepare_helpers import ROOT


def test_rows_have_the_thesis_numbers_and_grow_by_one_switch() -> None:
    assert all(len(row.thesis) == len(METRICS) for row in ROWS.values())
    assert [row.thesis[0] for row in ROWS.values()] == [45.2, 51.7, 55.3, 54.8, 57.0, 63.8]
    assert len({row.words for row in ROWS.values()}) == len(ROWS)


def test_table_says_what_is_missing() -> None:
    text = table({"full": dict.fromkeys(METRICS, 0.5) | {"ap": None}}, "about")
    assert "63.8 / – | 61.3 / 50.0 |" in text and "45.2 / –" in text and text.endswith("about\n")


@pytest.fixture(scope="module")
def objects(dpc, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("table") / "objects.h5"
    made = dpc(
        "prepare",
        "synthetic",
        "articulated",
        "-o",
        path,
        "--kinds",
        "laptop,scissors",
        "--objects",
        4,
        "--frames",
        2,
        "--points",
        64,
        "--sequences-per-object",
        2,
        "--fractions",
        "0.5,0,0.5",
    )
    assert made.returncode == 0, made.stderr.decode()
    with CloudsReader(path) as reader:
        assert {"train", "test"} <= set(reader.splits)
    return path


def test_a_toy_table_is_made_and_running_again_trains_nothing(objects, tmp_path) -> None:
    words = [
        sys.executable,
        "-m",
        "dpcli.reproduce.table_4_1",
        objects,
        objects,
        tmp_path / "t",
        "--rows",
        "past",
        "--",
        "--epochs",
        "1",
        "--set",
        "pairs_per_epoch=4",
        "--batch",
        "2",
        "--points",
        "64",
    ]
    first = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert first.returncode == 0, first.stderr
    logs = {path.parent.name: path.read_bytes() for path in (tmp_path / "t").glob("*/log.json")}
    assert sorted(logs) == ["full", "past"]  # which starts from the other
    again = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert again.returncode == 0, again.stderr
    assert again.stdout == first.stdout == (tmp_path / "t" / "table.md").read_text()
    assert "--epochs 1" in first.stdout and "pooled per point, past flow | 55.3 / " in first.stdout
    assert logs == {name: (tmp_path / "t" / name / "log.json").read_bytes() for name in logs}  # not a step more
