"""The script behind `make table-4.4` to `4.6`, on folders of a few points in the published formats."""

from __future__ import annotations

import pytest

from dpcli.reproduce import runs, street_tables
from dpcli.reproduce.street_tables import GROUPS, METHODS, NUMBER, main
from dpcli.reproduce.table_4_3 import METRICS
from tests.prepare.scans.test_kitti import make_scene, write_detection, write_scenes
from tests.prepare.scans.test_semantickitti import LABELS, sequences, visible, write_scans


def semantickitti(raw):
    """Drive 08 of four scans."""
    names = [f"{scan:06}" for scan in range(4)]
    scans = {name: visible(70, scan) for scan, name in enumerate(names)}
    write_scans(sequences(raw) / "08", scans, {name: LABELS * 10 for name in names})
    return raw


RAW = {
    "kitti-sf": (lambda raw: write_scenes(raw, {"000100": make_scene(1), "000007": make_scene(2)}), "ward,scene"),
    "kitti-det": (lambda raw: (write_detection(raw), raw)[1], "ward"),
    "semantickitti": (semantickitti, "ward,scene"),
}


def test_the_thesis_has_a_number_for_every_metric():
    found = [runs.thesis_numbers(NUMBER[name], end) for name, groups in GROUPS.items() for end in groups.values()]
    assert all(len(row) == len(METRICS) for part in found for row in part.values())
    assert [part["network, unsupervised"][0] for part in found] == [53.6, 41.3, 46.9, 47.4, 44.2]


@pytest.mark.parametrize("command", RAW)
def test_a_toy_table_is_made_once(command, tmp_path, monkeypatch, dpc_told, capfd):
    monkeypatch.setattr(street_tables.runs, "dpc", dpc_told)
    monkeypatch.setattr(street_tables, "JUDGING", ("--ignore-below", 2))  # toy objects have fewer than 50 points
    groups = list(GROUPS[command].items())
    monkeypatch.setitem(GROUPS, command, dict(groups[-1:]))  # one group of drives shows it
    make, methods = RAW[command]
    words = [str(tmp_path / "table"), f"--{command}", str(make(tmp_path / "raw")), "--methods", methods]
    main([*words, "--points", "64"])
    text = (tmp_path / "table" / "table.md").read_text()
    assert all(text.count(f"\n| {method} |") == 1 for method in methods.split(","))
    assert text.count("| *network, unsupervised, thesis* |") == 1 and text in capfd.readouterr().out
    made = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "table").glob("*-ward*.h5")}
    main([*words, "--points", "64"])
    assert made == {path.name: path.stat().st_mtime_ns for path in (tmp_path / "table").glob("*-ward*.h5")}


def test_a_method_that_needs_motion_is_refused_for_single_scans(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main([str(tmp_path), "--kitti-det", str(tmp_path), "--methods", "scene"])
    assert "--methods of kitti-det: no method 'scene'; there are network, ward, dbscan" in capsys.readouterr().err
    assert set(METHODS["kitti-det"]) < set(METHODS["kitti-sf"])
