"""The program behind `make table-5.1`, on a box that turns."""

from __future__ import annotations

import sys
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest

from dpcli.reproduce import runs
from dpcli.reproduce.scenes import table_5_1
from dpcli.reproduce.scenes.table_5_1 import film_artemis, table
from tests.support.gltf_files import GlbFile


def _box(path: Path) -> Path:
    """A box that turns a quarter about the upright within a second."""
    file = GlbFile()
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-0.5, 0.5) for z in (-0.4, 0.4)])
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = [[a, b, c] for a, b, c, _ in faces] + [[a, c, d] for a, _, c, d in faces]
    primitive = {"attributes": {"POSITION": file.add(corners)}, "indices": file.add(np.ravel(triangles), "u2")}
    file.tree |= {
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    file.animate(0, "rotation", [0, 1], [[0, 0, 0, 1], [0, np.sin(np.pi / 4), 0, np.cos(np.pi / 4)]])
    path.parent.mkdir(parents=True)
    return file.write(path)


class _OneAtATime:
    """Stands for the pool of threads: commands in this process take over its signals, which only its first thread may."""

    def __init__(self, _jobs: int) -> None:
        pass

    def __enter__(self) -> _OneAtATime:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def submit(self, function, *values) -> Future:
        done = Future()
        done.set_result(function(*values))
        return done


def test_a_toy_table_is_made_and_running_again_fits_nothing(tmp_path, monkeypatch, dpc_told, capfd) -> None:
    monkeypatch.setattr(table_5_1, "dpc", dpc_told)
    monkeypatch.setattr(runs, "ThreadPoolExecutor", _OneAtATime)
    _box(tmp_path / "meshes" / "boxes" / "Box.glb")
    words = ["table_5_1", str(tmp_path / "t"), "--meshes", str(tmp_path / "meshes"), "--clips", "boxes/Box.glb:0"]
    words += ["--size", "48", "--frames", "2", "--rows", "flat,prior", "--", "--preset", "tiny"]
    words += ["--set", "dense_steps=2", "--set", "sparse_steps=2"]
    monkeypatch.setattr(sys, "argv", words)
    table_5_1.main()
    text = (tmp_path / "t" / "table.md").read_text()
    assert text in capfd.readouterr().out
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert [row.split(" | ")[0] for row in rows[1:3]] == ["| flat", "| prior"]
    cells = {row.split(" | ")[0][2:]: row.strip("| ").split(" | ") for row in rows[1:3]}
    assert 0.2 < float(cells["flat"][4]) < 1 and cells["flat"][12] == "–" != cells["prior"][12]
    assert float(cells["flat"][9]) > 30  # the input view of a cut-out is the picture itself, but for its edge
    made = {path: path.stat().st_mtime_ns for path in (tmp_path / "t").iterdir() if path.suffix == ".h5"}
    table_5_1.main()
    assert (tmp_path / "t" / "table.md").read_text() == text
    assert made == {path: path.stat().st_mtime_ns for path in made}


def test_means_have_intervals_and_what_is_missing_is_a_dash() -> None:
    values = [{"per_role": {"test": {"psnr": value}}} for value in (20.0, 22.0)]
    line = table({"prior": values}, "profile").splitlines()[4]
    assert line.startswith("| prior | 21.00 ± 1.96 | – | – |")  # 1.96 standard errors of 1


def test_a_folder_without_animals_is_said(tmp_path) -> None:
    (tmp_path / "Bear").mkdir()
    (tmp_path / "Bear" / "CamPose.inf").touch()  # whose pictures are not unpacked
    with pytest.raises(SystemExit, match="no ANIMAL/CamPose.inf"):
        film_artemis(tmp_path, tmp_path, 64, 4)
