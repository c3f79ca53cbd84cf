"""The programs behind `make table-5.2` and `make figure-5.3`: which fits they ask for, and what they make of the scores."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from dpcli.reproduce.scenes import figure_5_3, table_5_2


@pytest.fixture
def asked(monkeypatch, tmp_path) -> list[list[str]]:
    """The `dpc` commands, which are noted and leave a file each instead of being run; scores rise with control points."""
    words_of: list[list[str]] = []

    def dpc(*words: object) -> str:
        words = [str(word) for word in words]
        words_of.append(words)
        if "-o" in words:
            Path(words[words.index("-o") + 1]).touch()
        psnr = 20.0 + ("512" in str(words))
        roles = {role: {"psnr": psnr, "ssim": 0.9} for role in ("test", "reference")}
        scores = {"per_role": roles, "parts": {"adjusted_rand_index": 0.5}, "tracks": {"epe_of_diameter": 0.02}}
        return json.dumps({"metrics": scores, "denominators": {"parts": {"discovered": 3}}})

    monkeypatch.setattr(table_5_2, "dpc", dpc)
    (tmp_path / "Cow.glb").touch()
    return words_of


def run(monkeypatch, program, tmp_path, *words: str) -> str:
    monkeypatch.setattr(sys, "argv", ["program", str(tmp_path), str(tmp_path / "out"), "--clips", "Cow:Run", *words])
    program.main()
    return (tmp_path / "out" / "table.md").read_text()


def test_values_are_swept_and_done_once(asked, monkeypatch, tmp_path):
    words = ("--sweep", "control_points=512,32", "--prior", "network")
    text = run(monkeypatch, figure_5_3, tmp_path, *words)
    fits = [one for one in asked if one[:2] == ["generate4d", "fit"]]
    assert [one[-1] for one in sorted(fits)] == ["control_points=32", "control_points=512"]
    assert all(one[one.index("--prior") + 1] == "network" for one in fits)
    assert (
        "| 32 | 20.000 | 0.900 | 0.500 | 3.000 |  |" in text
        and "| 512 | 21.000 | 0.900 | 0.500 | 3.000 | yes |" in text
    )
    assert (tmp_path / "out" / "figure.png").read_bytes().startswith(b"\x89PNG")
    asked.clear()
    assert run(monkeypatch, figure_5_3, tmp_path, *words) == text
    assert [one[0] for one in asked] == ["prepare"]  # which passes over what is there
    run(monkeypatch, figure_5_3, tmp_path, *words, "--steps", "20,30")
    assert [one[:2] for one in asked].count(["generate4d", "fit"]) == 2 and "dense_steps=20" in str(asked)


def test_a_sweep_of_nothing_is_said(monkeypatch, capsys):
    for option in ("width=8", "control_points=", "temporal_weight=x"):
        with pytest.raises(SystemExit, match="2"):
            figure_5_3.swept([option])
    assert "expected NAME=1,2,... with one of control_points, temporal_weight" in capsys.readouterr().err


def test_rows_switch_off_what_they_say(asked, monkeypatch, tmp_path):
    text = run(monkeypatch, table_5_2, tmp_path)
    fits = [one for one in asked if one[:2] == ["generate4d", "fit"]]
    off = [{word for word in one if word.endswith("=false")} for one in fits]
    assert sorted(map(len, off)) == [0, 1, 2, 2, 3] and "| (e) + dense to sparse | 20.00 | 0.9000 |" in text


@pytest.mark.parametrize(("words", "said"), [(("--clips", "Cow"), "MODEL:CLIP"), (("--steps", "200"), "two numbers")])
def test_words_that_say_too_little_are_told(words, said, monkeypatch, tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        run(monkeypatch, table_5_2, tmp_path, *words)
    assert said in capsys.readouterr().err
