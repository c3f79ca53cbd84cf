"""The script behind `make table-4.1`, at toy size."""

from __future__ import annotations

from pathlib import Path

import pytest

from dpcli.reproduce import runs, table_4_1
from dpcli.reproduce.table_4_1 import METRICS, ROWS, table
from dpcli.store import CloudsReader
from tests.support.commands import exit_code


def test_rows_have_the_thesis_numbers_and_grow_by_one_switch() -> None:
    thesis = runs.thesis_rows("4.1")
    assert all(len(row["values"]) == len(METRICS) for row in thesis)
    assert [row["values"][0] for row in thesis] == [45.2, 51.7, 55.3, 54.8, 57.0, 63.8]
    assert len({words for _, words in ROWS.values()}) == len(ROWS) == len(thesis)


def test_table_says_what_is_missing() -> None:
    text = table({"full": dict.fromkeys(METRICS, 0.5) | {"ap": None}}, "about")
    assert "63.8 / – | 61.3 / 50.0 |" in text and "45.2 / –" in text and text.endswith("about\n")


@pytest.fixture(scope="module")
def objects(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("table") / "objects.h5"
    made = exit_code(
        "prepare",
        "synthetic",
        "articulated",
        "-o",
        path,
        "--kinds",
        "laptop,scissors",
        "--objects",
        2,
        "--frames",
        2,
        "--points",
        64,
        "--sequences-per-object",
        2,
        "--fractions",
        "0.5,0,0.5",
    )
    assert made == 0
    with CloudsReader(path) as reader:
        assert {"train", "test"} <= set(reader.splits)
    return path


def test_a_toy_table_is_made_and_running_again_trains_nothing(objects, tmp_path, monkeypatch, dpc_told, capfd) -> None:
    monkeypatch.setattr(table_4_1, "dpc", dpc_told)
    budget = ["--epochs", "1", "--set", "pairs_per_epoch=2", "--batch", "2", "--points", "64"]
    words = [str(objects), str(objects), str(tmp_path / "t"), "--rows", "past", "--", *budget]
    table_4_1.main(words)
    first = capfd.readouterr().out
    logs = {path.parent.name: path.read_bytes() for path in (tmp_path / "t").glob("*/log.json")}
    assert sorted(logs) == ["full", "past"]  # which starts from the other
    table_4_1.main(words)
    assert capfd.readouterr().out == first == (tmp_path / "t" / "table.md").read_text()
    assert "--epochs 1" in first and "pooled per point, past flow | 55.3 / " in first
    assert logs == {name: (tmp_path / "t" / name / "log.json").read_bytes() for name in logs}  # not a step more


def test_a_file_that_is_not_there_is_told(tmp_path, capsys) -> None:
    with pytest.raises(SystemExit, match="3"):
        runs.digest(tmp_path / "nosuch.h5")
    assert "nosuch.h5: no such file" in capsys.readouterr().err
