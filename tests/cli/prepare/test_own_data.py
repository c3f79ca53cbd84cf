"""The walk of docs/own_data.md from a radar's table to a trained classifier."""

from __future__ import annotations

import csv
import re
import shlex
from pathlib import Path

import numpy as np

from dpcli.store import CloudsReader
from tests.support.commands import exit_code

PAGE = Path(__file__).parents[3] / "docs" / "own_data.md"


def four_commands() -> list[list[str]]:
    section = PAGE.read_text().split("## A radar's table to a classifier")[1].split("Four commands:")[1]
    lines = re.findall(r"^    dpc (.*)$", section.split("\n## ")[0], re.MULTILINE)
    return [shlex.split(line) for line in lines]


def write_radar(folder: Path, recordings: int = 4, frames: int = 16) -> None:
    """Writes what the page shows: a table with decimal commas, and labels; one class moves in x, the other in z."""
    rng = np.random.default_rng(0)
    with (folder / "radar.csv").open("w", newline="") as file:
        rows = csv.writer(file, delimiter=";")
        rows.writerow("recording frame time x y z velocity snr".split())
        for recording in range(recordings):
            for frame in range(frames):
                moved = np.sin(frame / 3) * 0.4
                offset = [moved, 1.5, 0] if recording % 2 else [0, 1.5, moved]
                for point in rng.normal(0, 0.1, (rng.integers(4, 9), 3)) + offset:
                    cells = [frame / 20, *point, 0.1, 12.5]
                    rows.writerow([recording, frame, *(f"{cell:.3f}".replace(".", ",") for cell in cells)])
    rows = [
        f"radar/{k},{'wave' if k % 2 else 'push'},{k // 2},{'test' if k >= 2 else 'train'}" for k in range(recordings)
    ]
    (folder / "labels.csv").write_text("\n".join(["name,label,subject,split", *rows]) + "\n")


def test_a_radars_table_becomes_a_classifier_in_the_pages_four_commands(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_radar(tmp_path)
    commands = four_commands()
    assert [words[:2] for words in commands] == [
        ["prepare", "clouds"],
        ["classify", "train"],
        ["classify", "predict"],
        ["evaluate", "classification"],
    ]
    for words in commands:
        more = ["--epochs", "1", "--set", "clips_per_video=1"] if words[:2] == ["classify", "train"] else []
        capfd.readouterr()
        assert exit_code(*words, *more) == 0, capfd.readouterr().err
    shown = capfd.readouterr().out
    with CloudsReader(tmp_path / "radar.h5") as reader:
        assert len(reader) == 4 and list(reader.class_names) == ["push", "wave"]
    assert "the 2 samples" in shown
