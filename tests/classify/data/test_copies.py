"""Videos that are in a file twice: told where a copy judges what learned from the other, or has another label."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.classify.data.copies import copy_groups, tell_copies
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter
from tests.support.commands import exit_code as dpc

pytestmark = pytest.mark.usefixtures("one_thread")


def frames(seed, points=3, count=6):
    rng = np.random.default_rng(seed)
    return [rng.normal(size=(points, 3)).astype(np.float32) for _ in range(count)]


def clouds(path, videos):
    """A file of videos, each (name, its frames, label, split, subject)."""
    with CloudsWriter(path, class_names=["push", "pull"]) as writer:
        for name, made, label, split, subject in videos:
            writer.write(CloudSequence.from_frames(name, made, label=label, split=split, subject=subject))
    return path


def people(count=3):
    return [(f"v{k}", frames(k), k % 2, "train" if k < 2 * count else "test", k // 2) for k in range(2 * count + 2)]


def test_copies_have_the_same_points_in_the_same_frames_whatever_their_names(tmp_path):
    one = frames(0)
    videos = [
        ("a", one),
        ("b", frames(1)),
        ("in other frames", [np.concatenate(one[:2]), *one[2:], one[0][:0]]),
        ("moved", [frame + 1 for frame in one]),
        ("backward", one[::-1]),
        ("c", one),
        ("one point", frames(7, 1, 1)),
        ("the same one", frames(7, 1, 1)),
    ]
    path = clouds(tmp_path / "c.h5", [(name, made, 0, "train", 0) for name, made in videos])
    with CloudsReader(path) as reader:
        assert copy_groups(reader, range(len(reader))) == [[0, 5]]


@pytest.mark.parametrize("command", ["train", "baseline"])
@pytest.mark.parametrize(
    "split, label, person, judged, mixed",
    [
        (None, 0, 0, 0, 0),
        ("test", 0, 3, 1, 0),  # a training video among those for tests
        ("train", 1, 0, 0, 1),  # the same person's: in one fold
        ("test", 1, 3, 1, 1),
    ],
)
def test_a_copy_that_judges_or_has_another_label_is_told(
    command, split, label, person, judged, mixed, tmp_path, capsys, monkeypatch
):
    for forests in ("commands.baseline", "training.forests"):  # what they say is not looked at
        monkeypatch.setattr(f"dpcli.classify.{forests}.TREES", 2)
    more = [("again", frames(0), label, split, person)] if split else []
    path = clouds(tmp_path / "c.h5", [*people(), *more])
    words = ["-o", tmp_path / "run", "--epochs", 0, "--set", "members=2"] if command == "train" else []
    assert dpc("classify", command, path, *words) == 0
    said = capsys.readouterr().err
    assert said.count("the same points under different labels") == mixed
    assert ("1 video that is judged" in said) == bool(judged)


def test_a_copy_in_another_fold_judges_what_learned_from_it(tmp_path, capsys):
    path = clouds(tmp_path / "c.h5", [*people(), ("again", frames(0), 0, "train", 1)])
    with CloudsReader(path) as reader:
        tell_copies(reader, [([0, 1], [8]), ([8], [0, 1])])
        assert "2 videos that are judged" in capsys.readouterr().err
        tell_copies(reader, [([0, 8], [1]), ([1], [0, 8])])
        assert not capsys.readouterr().err
