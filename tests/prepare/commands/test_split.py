"""Dividing a file: by what it tells, a list, subjects, fractions; every sample once, in order, untouched."""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpcli.errors import DataError, UsageError
from dpcli.prepare.commands.merge import merge
from dpcli.prepare.commands.sources import open_source
from dpcli.prepare.commands.split import SplitChoice, draw_splits, split, splits_by_list
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter
from tests.support.commands import told as dpc


@pytest.fixture
def whole(tmp_path) -> Path:
    """Twelve samples of three classes and four subjects."""
    rng = np.random.default_rng(0)
    with CloudsWriter(
        tmp_path / "all.h5", class_names=["a", "b", "c"], fields=["track"], provenance={"config": {"k": 1}}
    ) as writer:
        for k in range(12):
            points = rng.normal(size=(5 + k, 3)).astype(np.float32)
            old = "train" if k < 9 else "test"
            writer.write(
                CloudSequence.from_frames(
                    f"s{k:02}", [points], split=old, label=k % 3, subject=1 + k // 3, track=[np.arange(5 + k)]
                )
            )
        writer.skipped = [("gone", "why")]
    return tmp_path / "all.h5"


def parts(folder: Path) -> dict[str, list[str]]:
    found = {}
    for path in sorted(folder.glob("*.h5")):
        with CloudsReader(path) as reader:
            assert set(reader.splits) == {path.stem}
            found[path.stem] = list(reader.names)
    return found


def test_the_splits_of_the_file_itself_and_nothing_else_changes(whole, tmp_path):
    assert split(whole, tmp_path / "d", SplitChoice()) == {"train": 9, "test": 3}
    assert {name: len(names) for name, names in parts(tmp_path / "d").items()} == {"train": 9, "test": 3}
    with CloudsReader(whole) as before, CloudsReader(tmp_path / "d" / "test.h5") as after:
        for key in ("points", "track", "frame_offsets", "label", "subject", "name", "split"):
            np.testing.assert_array_equal(getattr(before.read(10), key), getattr(after.read(1), key))
        assert after.class_names == ["a", "b", "c"] and after.skipped == [("gone", "why")]
        assert after.provenance[0] == {"config": {"k": 1}} and "clouds" in after.provenance[1]["inputs"]


@pytest.mark.parametrize("name", ["times", "my_labels", "activation/static", "Color"])
@pytest.mark.parametrize("joined", [True, False])
def test_data_sets_that_are_not_copied_are_told(whole, tmp_path, capsys, name, joined):
    with h5py.File(whole, "r+") as file:
        file[name] = np.zeros(len(file["points"]), np.float32)
    if joined:
        merge([whole], tmp_path / "new.h5")
    else:
        split(whole, tmp_path / "new.h5", SplitChoice(fractions=(0.5, 0, 0.5)))
    said = capsys.readouterr().err
    assert said.count("left out, no data sets of a clouds file's samples: " + name.partition("/")[0]) == 1


def test_by_subject(whole, tmp_path):
    split(whole, tmp_path / "d", SplitChoice(subjects={"train": (1, 4), "validation": (2,)}))
    found = parts(tmp_path / "d")
    assert found["train"] == ["s00", "s01", "s02", "s09", "s10", "s11"]
    assert (found["validation"], found["test"]) == (["s03", "s04", "s05"], ["s06", "s07", "s08"])
    with pytest.raises(DataError, match="subject 9 is not there; subjects of the file: 1,2,3,4"):
        split(whole, tmp_path / "e", SplitChoice(subjects={"train": (1, 9)}))
    with pytest.raises(UsageError, match="subject 1 is to be train and validation"):
        split(whole, tmp_path / "e", SplitChoice(subjects={"train": (1,), "validation": (1,)}))


@pytest.mark.parametrize(
    ("word", "split"), [("Training", "train"), ("VAL", "validation"), ("test set", "test"), ("odd", "odd")]
)
def test_a_list_may_spell_our_splits_in_its_own_way(tmp_path, whole, word, split):
    (tmp_path / "list.csv").write_text(f"Name,Split\ns03,{word}\n")
    assert splits_by_list(open_source(whole), tmp_path / "list.csv") == ["", "", "", split, *[""] * 8]


def test_by_list(whole, tmp_path):
    listed = tmp_path / "list.csv"
    listed.write_text("name,split\ns03,odd\ns00,train\n\ns07, odd\n")
    assert split(whole, tmp_path / "d", SplitChoice(listed=listed)) == {"train": 1, "": 9, "odd": 2}
    assert parts(tmp_path / "d") == {"odd": ["s03", "s07"], "train": ["s00"]}
    for text, message in (
        ("s03,a\ns03,b\n", "list.csv:2: 's03' appears twice"),
        ("s99,a\n", "names 's99', which is not among the samples"),
        (
            "s95,a\ns96,a\ns97,a\ns98,a\n",
            "names 's95', 's96', 's97' and 1 more, which are not among .* take their lines out",
        ),
        ("s03\n", "list.csv:1: 's03'; expected name,split"),
    ):
        listed.write_text(text)
        with pytest.raises(DataError, match=message):
            split(whole, tmp_path / "e", SplitChoice(listed=listed))
    listed.write_text("s03,../x\n")
    with pytest.raises(DataError, match="can't be a file name"):
        split(whole, tmp_path / "e", SplitChoice(listed=listed))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize("divider", [",", ";", "\t"])
@pytest.mark.parametrize(
    "lines",
    [
        ["name*split", "s03*test", "s05.ply*Training"],
        ["# Bänder", "split*name", "test*s03", "train*s05*"],
        ["Name*label*Split", '"s03"*"wäve"*test', "# s07 was cut", "s05*push*train"],
    ],
)
def test_a_list_in_any_dialect_of_tables(tmp_path, whole, encoding, divider, lines):
    text = "\r\n".join(lines).replace("*", divider)
    (tmp_path / "list.csv").write_bytes(text.encode(encoding))
    expected = ["", "", "", "test", "", "train", *[""] * 6]
    assert splits_by_list(open_source(whole), tmp_path / "list.csv") == expected


def test_a_misspelled_split_is_told(tmp_path, whole, capsys):
    (tmp_path / "list.csv").write_text("s03,trian\ns04,test\n")
    splits_by_list(open_source(whole), tmp_path / "list.csv")
    assert "stay as they are: trian" in capsys.readouterr().err


def test_into_one_file_with_new_splits(whole, tmp_path):
    choice = SplitChoice(fractions=(0.5, 0.25, 0.25), seed=3)
    split(whole, tmp_path / "new.H5", choice)
    with CloudsReader(tmp_path / "new.H5") as reader:
        assert list(reader.names) == [f"s{k:02}" for k in range(12)]
        assert Counter(reader.splits) == {"train": 6, "validation": 3, "test": 3}
        per_class = {(split_name, label): 0 for split_name in ("train", "validation", "test") for label in range(3)}
        for split_name, label in zip(reader.splits, reader.labels):
            per_class[split_name, int(label)] += 1
        assert sorted(per_class.values()) == [1] * 6 + [2] * 3  # stratified: each class 2, 1, 1
    other = SplitChoice(fractions=(0.5, 0.25, 0.25), seed=4)
    split(whole, tmp_path / "other.h5", other)
    with CloudsReader(tmp_path / "new.H5") as one, CloudsReader(tmp_path / "other.h5") as two:
        assert list(one.splits) != list(two.splits)
    with pytest.raises(UsageError, match="exists, made with"):
        split(whole, tmp_path / "new.H5", other)


@pytest.mark.parametrize(
    "words",
    [
        ("--fractions", "0.5,0.25,0.25"),
        ("--fractions", "0.5,0,0.5", "--by-subject", "--seed", "3"),
        ("--train-subjects", "1,3", "--validation-subjects", "2"),
        ("--list", "list.csv"),
        (),
    ],
)
@pytest.mark.parametrize("output", ["d", "new.h5"])
def test_the_same_command_again_finds_its_work_done(whole, tmp_path, monkeypatch, words, output):
    monkeypatch.chdir(tmp_path)
    Path("list.csv").write_text(
        "name,split\n" + "".join(f"s{k:02},{'train' if k % 2 else 'test'}\n" for k in range(12))
    )
    command = ("prepare", "split", whole.name, "-o", output, *words)
    first, again = dpc(*command), dpc(*command)
    assert first.returncode == again.returncode == 0 and first.stdout == again.stdout
    assert "already complete" in again.stderr and "already complete" not in first.stderr


@pytest.mark.parametrize("changed", ["c.h5", "list.csv"])
@pytest.mark.parametrize("output", ["d", "new.h5"])
def test_what_was_made_of_another_file_of_that_name_is_not_taken_for_this_one_s(
    whole, tmp_path, monkeypatch, output, changed
):
    monkeypatch.chdir(tmp_path)
    shutil.copy(whole, "c.h5")
    Path("list.csv").write_text("s00,train\ns01,test\n")
    split(Path("c.h5"), Path(output), SplitChoice(listed=Path("list.csv")))
    if changed == "c.h5":
        with h5py.File("c.h5", "r+") as file:
            file["points"][:3] += 1
    else:
        Path("list.csv").write_text("s00,test\ns01,train\n")
    with pytest.raises(UsageError, match=f"exists, made with another {'clouds' if changed == 'c.h5' else 'list'} file"):
        split(Path("c.h5"), Path(output), SplitChoice(listed=Path("list.csv")))


def test_subjects_stay_together(whole, tmp_path):
    split(whole, tmp_path / "new.H5", SplitChoice(fractions=(0.5, 0.25, 0.25), by_subject=True))
    with CloudsReader(tmp_path / "new.H5") as reader:
        where = {(int(subject), split_name) for subject, split_name in zip(reader.subjects, reader.splits)}
    assert len(where) == 4 and Counter(split_name for _, split_name in where) == {
        "train": 2,
        "validation": 1,
        "test": 1,
    }


@given(
    st.lists(st.integers(-1, 4), min_size=1, max_size=60),
    st.integers(0, 2**32 - 1),
    st.sampled_from([(0.8, 0.1, 0.1), (0.5, 0.5, 0.0), (1 / 3, 1 / 3, 1 / 3), (0.0, 0.0, 1.0), (0.99, 0.0, 0.01)]),
)
def test_fractions_hold_in_every_class_and_in_all(strata, seed, fractions):
    got = draw_splits(range(len(strata)), strata, fractions, seed)
    assert got == draw_splits(range(len(strata)), strata, fractions, seed)
    for chosen in [set(strata), *({one} for one in set(strata))]:
        own = [name for name, stratum in zip(got, strata) if stratum in chosen]
        for name, fraction in zip(("train", "validation", "test"), fractions):
            assert abs(own.count(name) - fraction * len(own)) < 2 + 1e-6
            assert fraction or not own.count(name)
    assert abs(got.count("train") - fractions[0] * len(got)) <= 2


def test_impossible_choices(whole, tmp_path):
    for options, message in (
        ({"fractions": (0.5, 0.1, 0.1)}, "sum to 1"),
        ({"fractions": (1.5, -0.5, 0.0)}, "from 0"),
        ({"fractions": (0.5, 0.5, 0.0), "listed": Path("x")}, "use one"),
    ):
        with pytest.raises(UsageError, match=message):
            SplitChoice(**options)
    with CloudsWriter(tmp_path / "plain.h5") as writer:
        writer.write(CloudSequence.from_frames("x", [np.zeros((1, 3), np.float32)]))
    with pytest.raises(DataError, match="has no splits"):
        split(tmp_path / "plain.h5", tmp_path / "d", SplitChoice())
    with pytest.raises(DataError, match="subjects are not known"):
        split(tmp_path / "plain.h5", tmp_path / "d", SplitChoice(fractions=(1.0, 0.0, 0.0), by_subject=True))


def test_the_command(whole, tmp_path):
    done = dpc("prepare", "split", whole, "-o", tmp_path / "d", "--train-subjects", "1,2")
    assert done.returncode == 0 and done.stdout == "train: 6 sequences\ntest: 6 sequences\n"
    assert sorted(parts(tmp_path / "d")) == ["test", "train"]
    wrong = dpc("prepare", "split", whole, "-o", tmp_path / "e", "--fractions", "0.5,0.5")
    assert wrong.returncode == 2 and "expected three numbers" in wrong.stderr


def test_stopped_in_the_middle_it_goes_on_to_the_same_bytes(whole, tmp_path, monkeypatch):
    """Ctrl-C at the sixth sample of the first part: five are not read again, and both parts end as those of one run."""
    split(whole, tmp_path / "once", SplitChoice())
    read, calls = CloudsReader.read, []

    def counted(self, index, *more, **options):
        calls.append(index)
        if len(calls) == 6:
            raise KeyboardInterrupt
        return read(self, index, *more, **options)

    monkeypatch.setattr(CloudsReader, "read", counted)
    with pytest.raises(KeyboardInterrupt):
        split(whole, tmp_path / "twice", SplitChoice())
    assert not list((tmp_path / "twice").glob("*.h5"))
    split(whole, tmp_path / "twice", SplitChoice())
    assert calls[6:] == [5, 6, 7, 8, 9, 10, 11]
    assert sorted(path.name for path in (tmp_path / "twice").iterdir()) == ["test.h5", "train.h5"]
    for name in ("train.h5", "test.h5"):
        assert (tmp_path / "twice" / name).read_bytes() == (tmp_path / "once" / name).read_bytes()
