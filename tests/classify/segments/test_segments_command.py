"""`dpc classify predict --segments` on small recordings: tables, times that run backwards, odd frames, pipelines."""

from __future__ import annotations

import csv
import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from dpcli.classify.network.model_file import save_model
from dpcli.store import CloudSequence, CloudsWriter
from tests.classify.stream.test_stream import NAMES, untrained
from tests.support.commands import exit_code


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("model") / "m.safetensors"
    save_model(path, *untrained())
    return path


def recordings(path: Path, time: np.ndarray | None = None) -> Path:
    """One recording of 30 frames, some of them of 0 to 3 points, and one shorter than a window."""
    rng = np.random.default_rng(0)
    frames = [rng.normal(size=(k % 5 if 10 < k < 16 else 40, 3)) for k in range(30)]
    fields = () if time is None else ("time",)
    with CloudsWriter(path, class_names=NAMES, fields=fields) as writer:
        for name, own in (("long", frames), ("short", frames[:2])):
            given = {} if time is None else {"time": time[: len(own)]}
            writer.write(CloudSequence.from_frames(name, own, **given))
    return path


def run(*words: object) -> int:
    return exit_code("classify", "predict", *map(str, words), "--segments")


def rows(text: str) -> dict[str, list[dict]]:
    found: dict[str, list[dict]] = {}
    for row in csv.DictReader(io.StringIO(text)):
        found.setdefault(row["recording"], []).append(row)
    return found


def test_segments_cover_their_recordings_in_both_forms(model, tmp_path, capsys):
    clouds = recordings(tmp_path / "c.h5", np.arange(30) / 10)
    assert run(clouds, "--model", model, "-o", tmp_path / "s.json") == 0
    assert "in 2 recordings" in capsys.readouterr().out
    assert run(clouds, "--model", model, "-o", "-") == 0
    printed = rows(capsys.readouterr().out)
    kept = json.loads((tmp_path / "s.json").read_text())
    assert kept["class_names"] == NAMES and kept["provenance"][-1]["config"]["segments"]["hop"] == 1
    assert [row["start"] for row in kept["segments"]] == [int(row["start"]) for own in printed.values() for row in own]
    for name, frames in (("long", 30), ("short", 2)):
        ends = [0, *(int(row["end"]) for row in printed[name])]
        assert ends[-1] == frames and [int(row["start"]) for row in printed[name]] == ends[:-1]
        assert all(float(row["end_seconds"]) == pytest.approx((int(row["end"]) - 1) / 10) for row in printed[name])


def test_a_number_rejects_all_and_the_shortest_length_is_kept(model, tmp_path, capsys):
    clouds = recordings(tmp_path / "c.h5")
    assert run(clouds, "--model", model, "-o", "-", "--reject-below", 1) == 0
    assert {row["class"] for own in rows(capsys.readouterr().out).values() for row in own} == {""}
    assert run(clouds, "--model", model, "-o", "-", "--shortest", 10) == 0
    assert all(int(row["end"]) - int(row["start"]) >= 10 for row in rows(capsys.readouterr().out)["long"])


def test_frames_without_points_and_short_recordings_are_told(model, tmp_path, capsys):
    assert run(recordings(tmp_path / "c.h5"), "--model", model, "-o", "-") == 0
    said = capsys.readouterr().err
    assert "1 frame without points in 1 video taken as points at the origin: long" in said
    assert "1 recording of fewer than" in said and "so one segment each: short" in said


def test_time_that_runs_backwards_is_told_and_left_out(model, tmp_path, capsys):
    time = np.arange(30) / 10
    time[20:] -= 1.5
    assert run(recordings(tmp_path / "c.h5", time), "--model", model, "-o", "-") == 0
    said = capsys.readouterr()
    assert "long: time runs back 1 time, first at frame 20" in said.err
    assert all(not row["start_seconds"] for row in rows(said.out)["long"])


def test_seconds_without_a_frame_are_told(model, tmp_path, capsys):
    time = np.arange(30) / 10
    time[20:] += 90
    assert run(recordings(tmp_path / "c.h5", time), "--model", model, "-o", "-") == 0
    assert "over 2 s within 1 of 2 videos: long (at most 90.1 s, after frame 19 of long)" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words, told",
    [
        (["-o", "s.h5"], "written as .csv or .json"),
        (["-o", "s.csv", "--hop", "9"], "would never be seen"),
        (["-o", "s.csv", "--jobs", "2"], "--jobs does not go with --segments"),
        (["-o", "s.csv", "--stream"], "--segments does not go with --stream"),
        ([], "Missing option"),
    ],
)
def test_wrong_use_is_refused(model, tmp_path, capsys, words, told):
    assert run(recordings(tmp_path / "c.h5"), "--model", model, *words) == 2
    assert told in capsys.readouterr().err


def test_what_is_printed_is_evaluated_from_stdin(model, tmp_path, monkeypatch, capsys):
    clouds, truth = recordings(tmp_path / "c.h5"), tmp_path / "t.csv"
    truth.write_text(f"recording,start,end,class\nlong,0,30,{NAMES[0]}\nshort,0,2,{NAMES[1]}\n")
    assert run(clouds, "--model", model, "-o", "-") == 0
    (tmp_path / "printed.csv").write_text(capsys.readouterr().out)
    with open(tmp_path / "printed.csv") as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        assert exit_code("evaluate", "segments", "-", "--truth", truth, "--json") == 0
    assert json.loads(capsys.readouterr().out)["denominators"]["frames"] == 32
