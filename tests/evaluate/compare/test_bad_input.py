"""Bad input of the commands that evaluate, and of those that compare: damaged files, other samples, other units."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.evaluate.classification.protocol import evaluate_classification
from dpcli.store import CloudSequence, CloudsWriter
from tests.support.evaluating import evaluate
from tests.support.parts_helpers import truth_sequence, write_truth
from tests.support.scores_helpers import CLASSES, write_scores


def test_intersect_of_scores_and_truth(scores, tmp_path):
    truth = tmp_path / "truth.h5"
    with CloudsWriter(truth, class_names=CLASSES) as writer:
        for i in range(10, 70):
            writer.write(CloudSequence.from_frames(f"v{i}", [np.ones((2, 3))], label=i % 3, split="test"))
    with pytest.raises(DataError, match="has no 'v0'.* 5 more, which .*--intersect"):
        evaluate_classification(scores["good"], truth)
    report = evaluate_classification(scores["good"], truth, intersect=True)
    assert report.main.samples == 50 and report.main.accuracy == 1
    assert [(e.reason, len(e.names)) for e in report.left_out] == [("the truth doesn't have", 10), ("not scored", 10)]
    assert evaluate_classification(scores["good"], truth, "all", intersect=True).main.samples == 50
    far = write_scores(tmp_path / "far.h5", set(), start=200)
    with pytest.raises(DataError, match="of which .* has none"):
        evaluate_classification(far, truth, intersect=True)


@pytest.mark.parametrize("task", ["segmentation", "motion"])
def test_another_length_unit_is_an_error(task, parts, tmp_path):
    truth = write_truth(
        tmp_path / "mm.h5", [truth_sequence(f"s{i}", seed=i, label=i % 2) for i in range(8)], length_unit="mm"
    )
    result = evaluate(task, parts["good"], "--truth", truth)
    assert isinstance(result.exception, DataError) and "length_unit 'm', but 'mm' in" in str(result.exception)
    unnamed = write_truth(
        tmp_path / "none.h5", [truth_sequence(f"s{i}", seed=i, label=i % 2) for i in range(8)], length_unit=""
    )
    assert evaluate(task, parts["good"], "--truth", unnamed).exit_code == 0


def damaged(source: Path, target: Path, change) -> Path:
    """A copy of a file with an HDF5 data set changed behind the program's back."""
    import shutil

    import h5py

    shutil.copy(source, target)
    with h5py.File(target, "r+") as file:
        change(file)
    return target


def put(name: str, row: object, value: float):
    def change(file) -> None:
        file[name][row] = value

    return change


def emptied(file) -> None:
    for key in ("name", "split", "label", "scores"):
        values = file[key][:0]
        kind = file[key].dtype
        del file[key]
        file.create_dataset(key, data=values, dtype=kind)


@pytest.mark.parametrize(
    ("what", "change", "words"),
    [
        ("scores", put("scores", 3, math.nan), "1 of .* samples with NaN or infinite scores, the first 'v3'"),
        (
            "scores",
            put("scores", (slice(5, 9), 0), math.inf),
            "4 of .* samples with NaN or infinite scores, the first 'v5'",
        ),
        ("scores", put("scores", 3, -math.inf), "1 of .* samples with NaN or infinite scores, the first 'v3'"),
        ("scores", emptied, "no samples"),
        ("parts", put("flow", 0, math.nan), "'s0': 1 of .* NaN or infinite flow, the first is point 0 of flow 0 -> 1"),
        (
            "parts",
            put("flow", slice(0, 2), math.inf),
            "'s0': 2 of .* NaN or infinite flow, the first is point 0 of flow 0 -> 1",
        ),
        (
            "parts",
            put("part_probability", 0, math.nan),
            "'s0': 1 of .* NaN or infinite probability, the first is point 0",
        ),
        ("parts", put("part_motion", 0, math.nan), "'s0': motion of part 0"),
        ("truth", put("pose", 0, math.nan), "pose"),
        ("truth", put("points", 0, math.nan), "'s0' has coordinates of NaN, infinity"),
    ],
)
def test_bad_numbers_are_named(run, scores, parts, tmp_path, what, change, words):
    """In the single command, in a comparison and among runs: an error of one or two lines, never a number."""
    source = scores["good"] if what == "scores" else parts[{"parts": "good"}.get(what, what)]
    bad = damaged(source, tmp_path / "bad.h5", change)
    task = "classification" if what == "scores" else "motion"
    given = {"scores": [bad], "parts": [bad, "--truth", parts["truth"]], "truth": [parts["good"], "--truth", bad]}[what]
    result = evaluate(task, *given)
    assert isinstance(result.exception, DataError), result.exception
    calls = [str(result.exception)]
    for command in (["compare", given[0], *given], ["runs", *given]):
        with pytest.raises(DataError) as caught:
            run(*command)
        calls.append(str(caught.value))
    for text in calls:
        assert "bad.h5" in text and len(text.splitlines()) <= 2
        assert re.search(words, text), text


def test_a_sample_is_left_out_once(run, tmp_path):
    """The truth has it, and one of the two predictions: it is missing there, and not also a sample that was not scored."""
    with CloudsWriter(tmp_path / "truth.h5", class_names=CLASSES, length_unit="m") as writer:
        for i in range(7):
            point = [np.zeros((1, 3), np.float32)]
            writer.write(CloudSequence.from_frames(f"v{i}", point, label=i % 3, split="test"))
    a, b = write_scores(tmp_path / "a.h5", {0}, 6), write_scores(tmp_path / "b.h5", {1}, 4)
    words = ("compare", a, b, "--truth", tmp_path / "truth.h5", "--intersect", "--json", "--resamples", 0)
    left_out = json.loads(run(*words))["left_out"]
    assert [(own["reason"], own["names"]) for own in left_out] == [
        ("not scored", ["v6"]),
        (f"only in {a}", ["v4", "v5"]),
    ]
