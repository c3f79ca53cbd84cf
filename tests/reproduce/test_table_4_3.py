"""The script behind `make table-4.3`, at toy size."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import trimesh

from dpcli.reproduce import runs
from dpcli.reproduce.table_4_3 import METRICS, VIEWS, main


def test_the_thesis_has_a_number_for_every_metric():
    for (_, data), aps in zip(
        VIEWS.values(), ([42.6, 74.5, 72.3, 73.9, 92.3, 93.9], [39.3, 70.3, 69.8, 71.9, 86.8, 88.1])
    ):
        found = runs.thesis_numbers("4.3", f"unsupervised, {data}")
        assert [numbers[0] for numbers in found.values()] == aps and list(found)[-1] == "network, unsupervised"
        assert all(len(numbers) == len(METRICS) for numbers in found.values())


def test_a_toy_table_is_made_once(tmp_path, monkeypatch, dpc_told, capfd):
    monkeypatch.setattr(runs, "dpc", dpc_told)
    meshes, folder = tmp_path / "meshes", tmp_path / "table"
    for kind, sides in enumerate([(1, 2, 0.6), (3, 1, 1), (0.5, 0.5, 2)]):
        (meshes / f"class{kind % 2}").mkdir(parents=True, exist_ok=True)
        trimesh.creation.box(np.array(sides)).export(meshes / f"class{kind % 2}" / f"box{kind}.obj")
    words = [folder, "--meshes", meshes, "--rooms", 1, "--points", 64, "--methods", "dbscan,ward"]
    main([str(word) for word in words])
    text = (folder / "table.md").read_text()
    assert text in capfd.readouterr().out and text.count("| dbscan |") == text.count("| ward |") == 2
    assert "## full" in text and "## single view" in text and "| *network, unsupervised, thesis* | 88.1 |" in text
    made = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.h5")}
    main([str(word) for word in words])
    assert {path.name: path.stat().st_mtime_ns for path in folder.glob("*.h5")} == made


def test_an_unknown_method_is_told(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["table_4_3"])
    with pytest.raises(SystemExit):
        main([str(tmp_path), "--meshes", str(tmp_path), "--methods", "magic"])
    assert "no method 'magic'" in capsys.readouterr().err
