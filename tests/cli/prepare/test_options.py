"""Options of `dpc prepare`: the legal words are those of the readers, and lists say what they expected."""

from __future__ import annotations

from typing import get_args

import pytest

from dpcli.cli.prepare.app import ROOM, SYNTHETIC
from dpcli.cli.prepare.lists import degrees, three_shares, whole_numbers, words
from dpcli.errors import UsageError
from dpcli.prepare import thinning
from dpcli.prepare.actions import depth, ntu60, preprocessed
from dpcli.prepare.articulated import articulated_sequence
from dpcli.prepare.scans import kitti_files, kitti_sf, semantickitti
from dpcli.prepare.synthetic import gait
from dpcli.prepare.views import matting
from tests.support.prepare_helpers import dpc


def legal_words(path: str, option: str) -> list[str]:
    *group, name = path.split()
    commands = (SYNTHETIC if group else ROOM).application((name,)).registered_commands
    (run,) = (entry.callback for entry in commands)
    literal, _ = get_args(run.__annotations__[option[2:].replace("-", "_")])
    return list(get_args(literal))


@pytest.mark.parametrize(
    ("command", "option", "known"),
    [
        ("msraction3d", "--sampling", thinning.METHODS),
        ("depth", "--background", depth.BACKGROUNDS),
        ("ntu60", "--protocol", ntu60.PUBLISHED),
        ("preprocessed", "--form", preprocessed._FORMS),
        ("kitti-sf", "--labels", kitti_sf.LABELS),
        ("kitti-det", "--coordinates", kitti_files.COORDINATES),
        ("semantickitti", "--group", semantickitti.GROUPS),
        ("sapien", "--view", articulated_sequence.VIEWS),
        ("synthetic articulated", "--orientation", articulated_sequence.ORIENTATIONS),
        ("synthetic animal", "--motion", gait.MOTIONS),
        ("video", "--holes", matting.HOLES),
    ],
)
def test_words_that_an_option_takes_are_those_its_reader_knows(command, option, known):
    assert legal_words(command, option) == list(known)


def test_lists():
    assert words(" a, b,,") == ("a", "b") and words("") == ()
    assert whole_numbers("3, 1", "--x") == (3, 1) and degrees("-75,1.5", "--x") == (-75.0, 1.5)
    for read, text, message in (
        (whole_numbers, "1,b", "--x 1,b: expected whole numbers with commas"),
        (degrees, "north", "--x north: expected degrees with commas"),
    ):
        with pytest.raises(UsageError, match=message):
            read(text, "--x")
        with pytest.raises(UsageError, match="--x 1,nan: expected"):
            read("1,nan", "--x")  # which would pass all comparisons
    for text in ("1", "1,0", "1,0,0,0", "a,b,c", "", "nan,0,0", "inf,0,0"):
        with pytest.raises(UsageError, match="expected three numbers, such as 0.8,0.1,0.1"):
            three_shares(text)


@pytest.mark.parametrize("seed", ["-1", "1.5", "x", str(2**63)])
def test_a_seed_is_a_whole_number_that_files_hold(seed, tmp_path):
    done = dpc("prepare", "synthetic", "gestures", "-o", tmp_path / "a.h5", f"--seed={seed}")
    assert done.returncode == 2 and f"--seed {seed}: expected a whole number from 0 to" in done.stderr
    assert not list(tmp_path.iterdir())


def test_help_of_a_seed_prints_no_range():
    done = dpc("prepare", "msraction3d", "--help")
    assert "--seed INTEGER" in done.stdout and "9223372036854775807" not in done.stdout
    assert "random|fps|voxel" in done.stdout
