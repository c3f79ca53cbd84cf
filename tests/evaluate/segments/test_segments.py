"""Segmental metrics against the published way of counting frames' labels, by hand, and tables that are damaged."""

from __future__ import annotations

import json
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.cli.app import main
from dpcli.errors import DataError
from dpcli.evaluate.segments.metrics import count_recording, segments_weighted
from dpcli.store.tables.segments import Segment, Segments, read_segments, segments_text
from tests.support.evaluating import evaluate

CLASSES = ["", "bow", "clap", "wave"]
LABELS = st.lists(st.integers(0, 3), min_size=1, max_size=24)


def pieces(labels: list[int]) -> list[tuple[int, int, int]]:
    """Label, start and end of the runs of a list of frames' labels."""
    made, at = [], 0
    for label, run in groupby(labels):
        count = len(list(run))
        made.append((label, at, at + count))
        at += count
    return made


def segments(labels: list[int]) -> list[Segment]:
    return [Segment(start, end, CLASSES[label]) for label, start, end in pieces(labels)]


def by_frames(predicted: list[int], true: list[int]) -> dict[str, float]:
    """The metrics from labels of frames: distances by recursion, true positives by visiting segments in order."""
    ours, theirs = ([one for one in pieces(side) if one[0]] for side in (predicted, true))

    def distance(i: int, j: int) -> int:
        if min(i, j) == 0:
            return max(i, j)
        known = table.get((i, j))
        if known is None:
            same = distance(i - 1, j - 1) + (ours[i - 1][0] != theirs[j - 1][0])
            known = table[i, j] = min(distance(i - 1, j) + 1, distance(i, j - 1) + 1, same)
        return known

    table: dict[tuple[int, int], int] = {}
    found = {"frame_accuracy": float(np.mean(np.array(predicted) == np.array(true)))}
    longest = max(len(ours), len(theirs))
    found["edit_score"] = 1 - distance(len(ours), len(theirs)) / longest if longest else float("nan")
    for overlap in (0.1, 0.25, 0.5):
        used, wrong = [False] * len(theirs), 0
        for label, start, end in ours:
            frames = set(range(start, end))
            shares = [
                len(frames & set(range(a, b))) / len(frames | set(range(a, b))) if own == label else 0.0
                for own, a, b in theirs
            ]
            best = max(range(len(theirs)), key=shares.__getitem__, default=None)
            if best is not None and shares[best] >= overlap and not used[best]:
                used[best] = True
            else:
                wrong += 1
        right, missed = sum(used), len(theirs) - sum(used)
        precision = right / (right + wrong) if right + wrong else float("nan")
        recall = right / (right + missed) if theirs else float("nan")
        both = 2 * precision * recall / (precision + recall) if right else (0.0 if longest else float("nan"))
        found[f"f1_{round(100 * overlap)}"] = both
    return found


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_the_metrics_are_those_of_the_frames_labels(data):
    true = data.draw(LABELS)
    predicted = data.draw(st.lists(st.integers(0, 3), min_size=len(true), max_size=len(true)))
    counts = count_recording(segments(predicted), segments(true))
    found = {key: float(value[0]) for key, value in segments_weighted([counts])(np.ones((1, 1))).items()}
    assert found == pytest.approx(by_frames(predicted, true), nan_ok=True)


def test_recordings_are_pooled_by_frames_and_segments_and_averaged_by_edit_score():
    long = count_recording(segments([1] * 30), segments([1] * 30))
    short = count_recording(segments([2, 2, 3, 3]), segments([3, 3, 3, 3]))
    found = {key: value[0] for key, value in segments_weighted([long, short])(np.ones((1, 2))).items()}
    assert found["frame_accuracy"] == pytest.approx(32 / 34)
    assert found["edit_score"] == pytest.approx((1 + 0.5) / 2)
    assert found["f1_50"] == pytest.approx(2 * 2 / (2 * 2 + 1))


def table(path, rows: str) -> str:
    path.write_text("recording,start,end,class\n" + rows)
    return str(path)


def run(*words: str):
    return evaluate("segments", *words)


def test_the_command_compares_tables_in_any_form_and_order(tmp_path):
    truth = table(tmp_path / "t.csv", "b,0,10,wave\na,20,40,bow\na,0,20,wave\n")
    guess = Segments({"a": [Segment(0, 20, "wave", 0.9), Segment(20, 40, "wave", 0.5)], "b": [Segment(0, 10, "wave")]})
    for name in ("p.csv", "p.json"):
        (tmp_path / name).write_text(segments_text(guess, f".{name[2:]}"))
        found = json.loads(run(str(tmp_path / name), "--truth", truth, "--json").stdout)
        assert found["metrics"]["frame_accuracy"] == pytest.approx(0.6)
        assert found["metrics"]["edit_score"] == pytest.approx(0.75)
        assert found["denominators"] == {"recordings": 2, "frames": 50, "true_segments": 3, "predicted_segments": 2}
    told = run(str(tmp_path / "p.csv"), "--truth", truth).stdout
    assert "frame accuracy" in told and "F1@50" in told and "By recording" in told


@pytest.mark.parametrize(
    "rows, told",
    [
        ("a,0,10,wave\na,5,20,bow\n", "overlap"),
        ("a,10,10,wave\n", "not after its start"),
        ("a,-1,10,wave\n", "line 2: start '-1'"),
        ("a,0,1e99,wave\n", "end '1e99'"),
        ("a,0.5,3,wave\n", "a frame's number, whole and from 0 to 20,000,000 (of seconds: times the frame rate)"),
        ("a,x,3,wave\n", "start 'x'"),
        (",0,3,wave\n", "recording ''"),
        ("a,0\n", "end None"),
        ("", "holds no segment"),
        ("b,0,3,wave\n", "no recording of this name"),
        ("a,0,3,Wave\n", "spell them alike"),
        ("a,0,3,wave\nc,0,3,wave\n", "the prediction lacks 'c'"),
    ],
)
def test_a_bad_table_is_named(tmp_path, capsys, rows, told):
    truth = table(tmp_path / "t.csv", rows)
    guess = table(tmp_path / "p.csv", "a,0,3,wave\n")
    with pytest.raises(SystemExit) as ended:
        main(["evaluate", "segments", guess, "--truth", truth])
    assert ended.value.code == 3
    assert told in capsys.readouterr().err


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "{}",
        "[]",
        '"segments"',
        '{"kind": "segments", "segments": 3}',
        '{"kind": "segments", "segments": [], "class_names": null}',
        '{"kind": "segments", "segments": [], "class_names": [3]}',
        '{"kind": "segments", "segments": [], "provenance": ["a"]}',
        '{"kind": "segments", "segments": [{"recording": "a", "class": "", "start": 0, "end": 1' + 400 * "0" + "}]}",
        "a,b\n1,2\n",
        "",
        "recording,start,end,class\n" + 200_000 * "x",
    ],
)
def test_what_is_no_table_is_named(tmp_path, text):
    path = tmp_path / "t.json"
    path.write_text(text)
    with pytest.raises(DataError, match=r"t\.json"):
        read_segments(path)


@pytest.mark.parametrize("suffix", [".csv", ".json"])
def test_confidences_come_back_as_they_were_written(suffix):
    rows = [Segment(0, 4, "a", 0.0), Segment(4, 9, "b", 0.5), Segment(9, 12, "a")]
    found = read_segments("t", segments_text(Segments({"r": rows}), suffix)).recordings["r"]
    assert [str(one.confidence) for one in found] == ["0.0", "0.5", "nan"]


def test_a_recording_in_which_nothing_happens_has_a_row_without_a_class(tmp_path, capsys):
    guess = table(tmp_path / "p.csv", "a,0,3,wave\nb,0,4,\n")
    with pytest.raises(SystemExit):
        main(["evaluate", "segments", guess, "--truth", table(tmp_path / "t.csv", "a,0,3,wave\n")])
    assert "the truth lacks 'b'; where nothing happens in one, a row with an empty class" in capsys.readouterr().err
    truth = table(tmp_path / "t.csv", "a,0,3,wave\nb,0,4,\n")
    found = json.loads(run(guess, "--truth", truth, "--json").stdout)
    assert found["metrics"]["frame_accuracy"] == 1 and found["denominators"]["recordings"] == 2
