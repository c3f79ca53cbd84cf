"""`dpc evaluate classification`: protocol, truth, output forms, pictures, bad input."""

from __future__ import annotations

import io
import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from dpcli.cli.evaluate.output import print_tables
from dpcli.errors import DataError, UsageError
from dpcli.evaluate.classification.protocol import evaluate_classification
from dpcli.evaluate.classification.result_json import classification_json
from dpcli.evaluate.classification.tables import classification_notes, classification_tables
from dpcli.evaluate.text_tables import markdown_tables
from dpcli.store import CloudSequence, CloudsWriter, ScoresWriter
from tests.support.evaluating import evaluate

NAMES = ("wave", "push", "pull")
# (name, split, label, static's best, dynamic's best, fused best)
ROWS = [
    ("a", "train", 0, 0, 0, 0),
    ("b", "test", 0, 1, 0, 0),
    ("c", "test", 1, 1, 2, 1),
    ("d", "test", 1, 0, 1, 2),
    ("e", "test", -1, 0, 0, 0),
    ("f", "test", 2, 0, 2, 2),
]


@pytest.fixture
def scores(tmp_path: Path) -> Path:
    """Test samples with a label: b c d f; right: static 1, dynamic 3, fused 3 of 4."""
    one_hot = np.eye(len(NAMES), dtype=np.float32)
    path = tmp_path / "scores.h5"
    with ScoresWriter(path, class_names=NAMES, streams=("static", "dynamic")) as writer:
        for name, split, label, static, dynamic, fused in ROWS:
            streams = {"static": one_hot[static], "dynamic": one_hot[dynamic]}
            writer.write(name, one_hot[fused], label=label, split=split, streams=streams)
    return path


def write_truth(path: Path, labels: dict[str, int], names: tuple[str, ...] = NAMES, split: str = "test") -> Path:
    with CloudsWriter(path, class_names=names) as writer:
        for name, label in labels.items():
            writer.write(CloudSequence.from_frames(name, [np.ones((2, 3))], label=label, split=split))
    return path


def run(*arguments: object):
    return evaluate("classification", *arguments)


def test_json_by_hand(scores: Path) -> None:
    result = run(scores, "--json")
    found = json.loads(result.stdout)  # one object, nothing else on stdout
    metrics = found["metrics"]
    assert found["protocol"]["split"] == "test" and found["denominators"]["samples"] == 4
    assert {k: v["accuracy"] for k, v in metrics["streams"].items()} == {"static": 0.25, "dynamic": 0.75, "fused": 0.75}
    assert list(metrics["streams"]) == ["static", "dynamic", "fused"]
    assert metrics["accuracy"] == 0.75 and found["units"]["accuracy"] == "fraction"
    assert metrics["confusion"] == [[1, 0, 0], [0, 1, 1], [0, 0, 1]]
    assert metrics["balanced_accuracy"] == pytest.approx((1 + 0.5 + 1) / 3)
    assert [row["recall"] for row in metrics["per_class"]] == [1, 0.5, 1]
    left_out = {entry["reason"]: entry["names"] for entry in found["left_out"]}
    assert left_out == {"not of split 'test'": ["a"], "unknown label (-1)": ["e"]}


def test_undefined_numbers_are_null(scores: Path) -> None:
    found = json.loads(run(scores, "--json", "--split", "train").stdout)
    assert [row["recall"] for row in found["metrics"]["per_class"]] == [1, None, None]
    assert found["metrics"]["accuracy"] == 1 and found["denominators"]["classes_that_occur"] == 1


def test_split_all_takes_every_labeled_sample(scores: Path) -> None:
    assert evaluate_classification(scores, split="all").main.samples == 5


def test_table_says_of_what(scores: Path) -> None:
    text = run(scores).stdout
    assert "75.0 %" in text and "3/4" in text and "25.0 %" in text and "1/4" in text
    assert "4 samples of split 'test', 3 of 3 classes occur" in text
    assert "unknown label (-1): 1 (e)" in text and "not of split 'test': 1." in text


def test_markdown_is_the_same_numbers(scores: Path) -> None:
    text = run(scores, "--markdown").stdout
    lines = [line for line in text.splitlines() if line.startswith("| fused")]
    assert len(lines) == 1 and [cell.strip() for cell in lines[0].strip("|").split("|")][:3] == [
        "fused",
        "75.0 %",
        "3/4",
    ]
    widths = {
        line.count("|") for line in text.split("**By class**")[1].split("**")[0].splitlines() if line.startswith("|")
    }
    assert len(widths) == 1  # a table with ragged rows does not render


def test_a_class_name_is_text_not_markup(tmp_path: Path) -> None:
    path = tmp_path / "s.h5"
    with ScoresWriter(path, class_names=["[red]a|b", "c"]) as writer:
        writer.write("x", np.array([1.0, 0]), label=0)
    assert "[red]a|b" in run(path).stdout
    assert r"\[red\]a\|b" in run(path, "--markdown").stdout


def test_truth_replaces_labels_and_splits(scores: Path, tmp_path: Path) -> None:
    truth = write_truth(tmp_path / "t.h5", {"f": 0, "e": 0, "d": 2, "c": 1, "b": 0, "a": 1})
    report = evaluate_classification(scores, truth)
    assert (report.main.correct, report.main.samples) == (4, 6)  # a f wrong; e now known; a now of split test
    assert str(truth) in json.dumps(classification_json(report, "x"))


def test_truth_without_a_scored_sample_names_it(scores: Path, tmp_path: Path) -> None:
    truth = write_truth(tmp_path / "t.h5", {"a": 0, "b": 0, "c": 1, "d": 1})
    with pytest.raises(DataError, match="no 'e', 'f', which"):
        evaluate_classification(scores, truth)


def test_an_unscored_sample_of_the_truth_is_an_error(scores: Path, tmp_path: Path) -> None:
    truth = write_truth(tmp_path / "t.h5", dict.fromkeys("abcdefxyz", 0))
    with pytest.raises(DataError, match="scores no 'x', 'y', 'z' among the test samples"):
        evaluate_classification(scores, truth)
    with pytest.raises(DataError, match="among the samples"):
        evaluate_classification(scores, truth, split="all")


def test_unscored_samples_of_another_split_are_fine(scores: Path, tmp_path: Path) -> None:
    path = tmp_path / "t.h5"
    with CloudsWriter(path, class_names=NAMES) as writer:
        for name in "abcdefz":
            split = "train" if name == "z" else "test"
            writer.write(CloudSequence.from_frames(name, [np.ones((1, 3))], label=0, split=split))
    assert evaluate_classification(scores, path).main.samples == 6


def test_truth_with_other_classes_names_the_first(scores: Path, tmp_path: Path) -> None:
    labels = dict.fromkeys("abcdef", 0)
    with pytest.raises(DataError, match="class 1 is 'pull', in .* it is 'push'; `dpc prepare merge"):
        evaluate_classification(scores, write_truth(tmp_path / "t.h5", labels, ("wave", "pull", "push")))
    with pytest.raises(DataError, match="4 classes, but .* scores 3"):
        evaluate_classification(scores, write_truth(tmp_path / "u.h5", labels, (*NAMES, "more")))
    with pytest.raises(DataError, match="2 classes, but .* scores 3; `dpc prepare merge"):
        evaluate_classification(scores, write_truth(tmp_path / "w.h5", labels, NAMES[1:]))
    with pytest.raises(DataError, match="label 7 of 'b'"):
        evaluate_classification(scores, write_truth(tmp_path / "v.h5", {**labels, "b": 7}, ()))


def test_a_split_that_is_not_there_lists_those_that_are(scores: Path) -> None:
    with pytest.raises(DataError, match="no sample of split 'val'; the file has test, train"):
        evaluate_classification(scores, split="val")


def test_no_labels_at_all_points_to_truth(tmp_path: Path) -> None:
    path = tmp_path / "s.h5"
    with ScoresWriter(path, class_names=NAMES) as writer:
        writer.write("x", np.zeros(3))
    with pytest.raises(DataError, match="1 sample without a label.*--truth"):
        evaluate_classification(path)


@pytest.mark.parametrize(("value", "said"), [(np.nan, "NaN or infinite"), (np.inf, "NaN or infinite")])
def test_scores_that_are_no_numbers(scores: Path, value: float, said: str) -> None:
    with h5py.File(scores, "r+") as file:
        file["scores"][2, 1] = value
    with pytest.raises(DataError, match=said):
        evaluate_classification(scores)


def test_a_label_out_of_range_is_named(scores: Path) -> None:
    with h5py.File(scores, "r+") as file:
        file["label"][3] = 3
    with pytest.raises(DataError, match="label 3 of 'd'"):
        evaluate_classification(scores)


def test_a_file_without_samples(scores: Path) -> None:
    with h5py.File(scores, "r+") as file:
        for name in ("scores", "label", "name", "split", "streams/static", "streams/dynamic"):
            empty = file[name][:0]
            kind = file[name].dtype
            del file[name]
            file.create_dataset(name, data=empty, dtype=kind)
    with pytest.raises(DataError, match="no sample"):
        evaluate_classification(scores)


def many_classes(path: Path, classes: int) -> Path:
    rng = np.random.default_rng(classes)
    with ScoresWriter(path, class_names=[f"action {i} with $words$" for i in range(classes)]) as writer:
        for index in range(4 * classes):
            row = rng.normal(size=classes)
            row[index % classes] += 2
            writer.write(f"s{index}", row, label=index % classes)
    return path


def test_the_matrix_is_a_table_up_to_thirty_classes(tmp_path: Path) -> None:
    for classes, expected in ((30, 3), (31, 2)):
        report = evaluate_classification(many_classes(tmp_path / f"{classes}.h5", classes))
        assert len(classification_tables(report)) == expected


def test_a_narrow_terminal_gets_a_hint_instead_of_a_cut_matrix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    report = evaluate_classification(many_classes(tmp_path / "s.h5", 25))
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("NO_COLOR", "1")
    narrow, pipe = Terminal(), io.StringIO()
    print_tables(classification_tables(report), classification_notes(report), narrow)
    print_tables(classification_tables(report), classification_notes(report), pipe)
    assert "widen the terminal" in narrow.getvalue() and "truth \\ predicted" not in narrow.getvalue()
    assert "truth \\ predicted" in pipe.getvalue()
    row = next(line for line in pipe.getvalue().splitlines() if line.startswith("24 action") and "%" not in line)
    counts = [int(cell) for cell in row.split("$words$")[1].split() if cell != "."]
    assert counts and sum(counts) == 4
    assert markdown_tables(classification_tables(report), classification_notes(report)).count("\n| 24 action") == 2


@pytest.mark.parametrize("classes", [2, 32])
def test_the_picture_shows_the_matrix(tmp_path: Path, classes: int) -> None:
    from PIL import Image

    path = tmp_path / "confusion.png"
    assert run(many_classes(tmp_path / "s.h5", classes), "--picture", path).exit_code == 0
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    dark_blue = (pixels[..., 2] > pixels[..., 0] + 60).sum()
    assert min(pixels.shape[:2]) > 500 + 30 * classes
    assert dark_blue > 1000  # the diagonal


def test_a_picture_that_cannot_be_written_is_said_before_the_work(scores: Path, tmp_path: Path) -> None:
    assert isinstance(run(scores, "--picture", tmp_path / "x.bmp").exception, UsageError)
    assert isinstance(run(scores, "--picture", tmp_path / "no" / "x.png").exception, DataError)
    result = run(scores, "--json", "--markdown")
    assert isinstance(result.exception, UsageError) and result.stdout == ""
