"""What counts where no split was asked for."""

from __future__ import annotations

import pytest

from dpcli.evaluate.results import tell_split


@pytest.mark.parametrize(
    ("split", "splits", "told"),
    [
        (None, ["train", "Test"], True),
        (None, ["train", "validation", ""], True),
        ("all", ["train", "Test"], False),
        ("Test", ["train", "Test"], False),
        (None, ["train", "test", "probe"], False),
        (None, ["train", "train"], False),
        (None, ["", ""], False),
    ],
)
def test_training_samples_that_count_beside_others_are_told(capsys, split, splits, told):
    tell_split("a.h5", split, splits)
    assert ("those of 'train', too" in capsys.readouterr().err) == told


def test_training_samples_that_count_are_told_once_of_a_file(capsys):
    """A comparison of two parts files evaluates the segmentation and the motion of both against one truth."""
    for _ in range(4):
        tell_split("b.h5", None, ["train", "Test"])
    assert capsys.readouterr().err.count("those of 'train', too") == 1
