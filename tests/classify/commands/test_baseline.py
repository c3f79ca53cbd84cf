"""The forest on descriptors: right where classes differ, at chance where they don't, and who was judged is said."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from dpcli.classify.commands import baseline as command
from dpcli.classify.data.descriptors import descriptor
from dpcli.errors import DataError, UsageError
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, ScoresReader
from dpcli.store.schema import kept_name
from tests.support.commands import exit_code

UP, DOPPLER = ("up", "down", "still"), kept_name("doppler")


@pytest.fixture(autouse=True)
def few_trees(monkeypatch):
    monkeypatch.setattr(command, "TREES", 30)


def write(path, *, videos=8, splits=True, people=True, labels=UP, field=False, lone=False, same=False):
    """Points that move up, down or not at all, with far outliers and frames of one point; some tell themselves by Doppler."""
    rng = np.random.default_rng(0)
    with CloudsWriter(path, class_names=labels, fields=[DOPPLER] if field else []) as writer:
        for number in range(videos * len(labels)):
            label, length = number % len(labels), int(rng.integers(5, 12))
            step = 0.0 if same or field else (0.1, -0.1, 0.0)[label % 3]
            frames = [
                rng.normal((0, t * step, 2), 0.05, (int(rng.integers(1, 9)), 3)).astype(np.float32)
                for t in range(length)
            ]
            frames[0][0] = (0, 0, 30)
            sequence = CloudSequence.from_frames(f"v{number}", frames, label=label)
            sequence.subject = number % 4 if people else -1
            sequence.split = ("test" if number % 4 == 3 else "train") if splits else ""
            if field:
                sequence.extra = {DOPPLER: rng.normal(label, 0.3, len(sequence.points)).astype(np.float32)}
            if not (lone and label == 2 and number > 2):
                writer.write(sequence)
    return str(path)


def test_what_moves_in_another_way_is_told_and_scores_are_written(tmp_path, monkeypatch):
    data, output = write(tmp_path / "a.h5"), tmp_path / "s.h5"
    result = command.baseline(data, output=str(output))
    assert (result.learned, result.judged, result.classes) == (18, 6, 3) and result.accuracy > 0.8
    assert result.seen == "of unseen people"
    scores = ScoresReader(output)
    assert scores.class_names == list(UP) and set(scores.splits) == {"test"}
    assert np.abs(scores.scores.sum(1) - 1).max() < 1e-5
    assert (scores.scores.argmax(1) == scores.labels).sum() == result.right
    monkeypatch.setattr(command, "descriptors", None)  # nothing may be computed for what can't be written
    with pytest.raises(UsageError, match="exists already; --force"):
        command.baseline(data, output=str(output))
    with CloudsReader(data) as reader:
        assert set(scores.names) == {name for name, split in zip(reader.names, reader.splits) if split == "test"}


def test_where_nothing_differs_it_is_no_better_than_chance(tmp_path):
    assert command.baseline(write(tmp_path / "a.h5", videos=20, same=True)).accuracy < 0.65


def test_kept_columns_count(tmp_path):
    assert command.baseline(write(tmp_path / "a.h5", field=True)).accuracy == 1.0


@pytest.mark.parametrize(
    "people, seen",
    [(True, "of unseen people"), (False, "of people whom it may know: the file doesn't say who is seen")],
)
def test_without_a_test_split_every_video_is_judged_in_turn(tmp_path, people, seen):
    result = command.baseline(write(tmp_path / "a.h5", splits=False, people=people))
    assert result.judged == 24 and result.seen == seen and result.accuracy > 0.7


def test_people_of_both_splits_are_told(tmp_path):
    data = write(tmp_path / "a.h5")
    with CloudsReader(data) as reader, CloudsWriter(tmp_path / "b.h5", class_names=UP) as writer:
        for index in range(len(reader)):
            sequence = reader.read(index)
            sequence.subject = index % 3
            writer.write(sequence)
    assert "people never seen come out lower" in command.baseline(str(tmp_path / "b.h5")).seen


def test_videos_of_other_splits_are_not_learned_from_and_told(tmp_path, capsys):
    data, output = write(tmp_path / "a.h5"), tmp_path / "s.h5"
    with CloudsReader(data) as reader, CloudsWriter(tmp_path / "b.h5", class_names=UP) as writer:
        for index in range(len(reader)):
            writer.write(reader.read(index))
        for split, label in (("dev", 0), ("", 1), ("train", -1)):
            extra = reader.read(0)
            extra.name, extra.split, extra.label = f"{split or 'none'} one", split, label
            writer.write(extra)
    scores = []
    for name in ("a", "b"):
        result = command.baseline(str(tmp_path / f"{name}.h5"), output=str(output), force=True)
        assert (result.learned, result.judged) == (18, 6)
        scores.append(ScoresReader(output).scores)
    assert np.array_equal(*scores)
    said = " ".join(capsys.readouterr().err.split())
    assert "1 video of the split 'dev' left out: dev one; 1 video of no split left out: none one" in said
    assert "1 video without a label left out: train one" in said


def test_judged_videos_of_a_class_that_nothing_was_learned_of_are_told(tmp_path, capsys):
    write(tmp_path / "a.h5")
    with CloudsReader(tmp_path / "a.h5") as reader, CloudsWriter(tmp_path / "b.h5", class_names=UP) as writer:
        for index in range(len(reader)):
            sequence = reader.read(index)
            sequence.split = "test" if sequence.label == 2 else sequence.split
            writer.write(sequence)
    command.baseline(str(tmp_path / "b.h5"))
    assert "8 of 12 judged videos count as wrong" in (said := capsys.readouterr().err) and ": still" in said
    command.baseline(str(tmp_path / "a.h5"))
    assert "count as wrong" not in capsys.readouterr().err


def test_too_few_videos_are_refused_by_name(tmp_path, capsys):
    with pytest.raises(DataError, match="a class of one video and no test split"):
        command.baseline(write(tmp_path / "a.h5", splits=False, people=False, lone=True))
    with pytest.raises(DataError, match="all labeled videos are of one class"):
        command.baseline(write(tmp_path / "one.h5", labels=("up",)))
    with CloudsWriter(tmp_path / "b.h5") as writer:
        writer.write(CloudSequence.from_frames("v", [np.zeros((1, 3), np.float32)]))
    with pytest.raises(DataError, match="no video has a label"):
        command.baseline(str(tmp_path / "b.h5"))
    assert exit_code("classify", "train", tmp_path / "b.h5", "-o", tmp_path / "run") == 3
    assert "no video has a label; prepare it with --labels" in capsys.readouterr().err


def test_videos_without_points_or_with_odd_numbers_are_described():
    odd = np.float32([[np.nan, 0, 1], [np.inf, 1e38, -1e38], [0, 0, 1]])
    for frames in ([np.zeros((0, 3), np.float32)] * 2, [odd, odd]):
        found = descriptor(CloudSequence.from_frames("v", frames), ())
        assert np.isfinite(found.astype(np.float32)).all()
    assert len(found) == len(descriptor(CloudSequence.from_frames("v", [odd]), ()))


def test_training_tells_the_forest_beside_the_network(tmp_path, capsys):
    data = write(tmp_path / "a.h5", videos=12)
    few = "--epochs 1 --set epochs_dynamic=1 --preset tiny --frames 4 --points 64 --validation 0.25".split()
    assert exit_code("classify", "train", data, "-o", tmp_path / "run", *few) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[1].startswith("6 validation videos: static ")
    assert told[2].startswith("a random forest on hand-made descriptors: ") and told[2].split()[6] in ("83.3", "100.0")
    assert told[3].startswith("note: 2 people train and validate")


def test_the_command_reads_stdin_and_prints_one_line(tmp_path, monkeypatch, capsys):
    data = write(tmp_path / "a.h5")
    with open(data) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        assert exit_code("classify", "baseline", "-") == 0
    told = capsys.readouterr().out
    assert told.startswith("forest: ") and told.count("\n") == 1 and "of 6 videos, 3 classes" in told
    assert exit_code("classify", "baseline", data, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["judged"] == 6 and found["accuracy"] == found["right"] / 6


def test_a_video_stands_where_it_was_seen_whatever_was_taken_off_its_coordinates():
    """`prepare clouds` takes a corner off far clouds, and only of those: in millimeters of some videos of a file."""
    rng = np.random.default_rng(0)
    frames = [rng.normal(0, 1, (4, 3)).astype(np.float32) for _ in range(6)]
    moved = CloudSequence.from_frames("v", [frame - np.float32(300) for frame in frames])
    moved.shift = np.full(3, 300.0)
    own, other = (descriptor(one, ()) for one in (CloudSequence.from_frames("v", frames), moved))
    assert np.allclose(own, other, atol=1e-3)
