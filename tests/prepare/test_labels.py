"""Tables of labels and folders of classes in the spellings of other programs; what can't be known is told."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpcli.errors import DataError
from dpcli.prepare.labels import labels_of_folders, read_labels
from dpcli.prepare.reader import SPLITS, split_called

WORDS = {"train": "train", "Training": "train", "val": "validation", "VALID": "validation", "testing": "test"}
AFFIXES = ("{}", "{}_set", "{}set", "{} data", "{}-split", "split_{}", "set.{}", "{}_videos")


@given(st.sampled_from(list(WORDS)), st.sampled_from(AFFIXES))
def test_words_for_splits_are_known_with_what_people_add(word, affix):
    assert split_called(affix.format(word)) == WORDS[word]


@pytest.mark.parametrize(
    "word", ["dev", "eval", "data", "set", "videos", "trainer", "contest", "attest", "latest data", ""]
)
def test_other_words_are_no_splits(word):
    assert split_called(word) == ""


@pytest.mark.parametrize("affix", AFFIXES)
def test_splits_below_their_classes_are_read(tmp_path, affix):
    names = [f"{label}/{affix.format(split)}/{k}" for label in ("wave", "bow") for split in WORDS for k in range(2)]
    table = labels_of_folders(tmp_path, names, "CLASS/VIDEO")
    assert table.class_names == ["bow", "wave"]
    for name, row in table.rows.items():
        label, split, _ = name.split("/")
        assert table.class_names[row.label] == label
        assert row.split == WORDS[next(word for word in WORDS if affix.format(word) == split)]


@pytest.mark.parametrize(
    "names", [["wave/train/1", "bow/a/2"], ["wave/train/1", "bow/train/2"], ["wave/train", "bow/test"]]
)
def test_a_folder_called_train_alone_makes_no_splits(tmp_path, names):
    assert {row.split for row in labels_of_folders(tmp_path, names, "CLASS/VIDEO").rows.values()} == {""}


@pytest.mark.parametrize("people", [("s1", "s2"), ("subject 01", "subject 12"), ("7", "8")])
def test_people_above_their_actions_are_told(tmp_path, capsys, people):
    labels_of_folders(tmp_path, [f"{one}/{label}" for one in people for label in ("wave", "bow")], "CLASS")
    assert "the folders below are the same in each (bow, wave)" in " ".join(capsys.readouterr().err.split())
    labels_of_folders(tmp_path, [f"a{label}/{one}" for one in people for label in ("1", "2")], "CLASS")
    assert not capsys.readouterr().err


def table(folder: Path, text: str):
    (folder / "labels.csv").write_text(text)
    return read_labels(folder / "labels.csv")


@pytest.mark.parametrize("name", ["id", "clip", "Sequence", "file_name", "video_id"])
@pytest.mark.parametrize("label", ["action", "Gesture", "class_name", "label"])
def test_headers_of_other_programs_are_read(tmp_path, name, label):
    header = f"{name},{label},participant,set"
    read = table(tmp_path, f"{header}\na,wave,s03,Test set\nb,bow,s12,train\n")
    assert [(one, row.label, row.subject, row.split) for one, row in read.rows.items()] == [
        ("a", 1, 3, "test"),
        ("b", 0, 12, "train"),
    ]


def test_a_plain_name_goes_before_one_that_may_mean_the_same(tmp_path, capsys):
    read = table(tmp_path, "id,name,label,action\n0,a,wave,x\n1,b,bow,y\n")
    assert list(read.rows) == ["a", "b"] and read.class_names == ["bow", "wave"]
    assert "columns not read: id, action" in capsys.readouterr().err


@pytest.mark.parametrize("spelled", ["s{:02}", "P{}", "subject_{}", "{}.0", "{:03}"])
def test_subjects_are_the_numbers_in_their_names(tmp_path, spelled):
    rows = "".join(f"v{k},wave,{spelled.format(k) if k else ''}\n" for k in (0, 3, 12))
    assert [row.subject for row in table(tmp_path, "name,label,subject\n" + rows).rows.values()] == [-1, 3, 12]


def test_people_called_by_name_have_the_same_numbers_in_every_table(tmp_path, capsys):
    def people(*names):
        rows = "".join(f"v{k};wave;{name}\n" for k, name in enumerate(names))
        return [row.subject for row in table(tmp_path, "name;label;subject\n" + rows).rows.values()]

    first = people("J\u00f6rg", "Anna-Lena Groß", "李雷", "NaN", "")
    assert "Anna-Lena Groß" in capsys.readouterr().err
    assert people("Zoe", "li", "jo\u0308rg", "unknown", "李雷")[2:] == [first[0], -1, first[2]]
    assert len({*first, *people("Zoe", "li")}) == 6 and max(first) < 1 << 31 and first[3:] == [-1, -1]


@pytest.mark.parametrize("comma", [".", ","])
def test_whole_numbers_may_be_written_with_a_fraction_of_0(tmp_path, comma):
    rows = "".join(f"v{k};{k}{comma}0;{k + 7}{comma}00\n" for k in (0, 2, 11))
    read = table(tmp_path, "name;label;subject\n" + rows)
    assert [(row.label, row.subject) for row in read.rows.values()] == [(0, 7), (2, 9), (11, 18)]


@pytest.mark.parametrize("subjects", [("m1", "f1"), ("anna", "ben2"), ("s1", "2"), ("1.5", "2.5"), ("+", "*")])
def test_subjects_whose_numbers_may_be_of_two_people_are_refused(tmp_path, subjects):
    with pytest.raises(DataError, match="expected a whole number .*: number the people, alike in all tables"):
        table(tmp_path, "name,label,subject\n" + "".join(f"v{k},wave,{one}\n" for k, one in enumerate(subjects)))


@pytest.mark.parametrize("word", ["dev", "0", "probe"])
def test_splits_of_other_names_are_told(tmp_path, capsys, word):
    read = table(tmp_path, f"name,label,split\na,wave,{word}\nb,bow,train\n")
    assert read.rows["a"].split == word
    assert f"none of {', '.join(SPLITS)} stay as they are: {word}" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("cell", ["NaN", "null", "#N/A", ""])
def test_a_cell_without_a_value_is_no_class(tmp_path, cell):
    with pytest.raises(DataError, match=r"labels\.csv:3"):
        table(tmp_path, f"name,label\na,wave\nb,{cell}\n")


@pytest.mark.parametrize(
    ("one", "other", "told"),
    [
        ("two hand wave", "two_hand  Wave", True),
        ("wave\uff11", "wave1", True),
        ("wave1", "wave 1", False),
        ("a-b", "a b", True),
    ],
)
def test_classes_that_look_alike_are_told(tmp_path, capsys, one, other, told):
    (tmp_path / "labels.csv").write_text(f"name,label\na,{one}\nb,{other}\n", encoding="utf-8")
    assert len(read_labels(tmp_path / "labels.csv").class_names) == 2
    assert ("are different classes" in capsys.readouterr().err) == told


def test_a_class_is_one_however_its_letters_are_composed(tmp_path):
    """A model trained on a folder from a Mac refused test videos of the same classes, under names that look alike."""
    own = ["gr\u00f6\u00dfe/a", "gro\u0308\u00dfe/b", "wink/c"]
    (tmp_path / "labels.csv").write_text("".join(f"{name},{name.split('/')[0]}\n" for name in own), encoding="utf-8")
    for found in (read_labels(tmp_path / "labels.csv"), labels_of_folders(tmp_path, own, "CLASS/VIDEO")):
        assert found.class_names == ["gr\u00f6\u00dfe", "wink"]
        assert {name: row.label for name, row in found.rows.items()} == dict(zip(own, (0, 0, 1)))


def test_lines_end_where_spreadsheets_end_them(tmp_path):
    """Three dots of Windows, which are a line's end in another encoding, and a cell of two lines."""
    (tmp_path / "labels.csv").write_bytes(b'name,label\na,wave\x85\nb,bow\x85low\n"c\nd",bow\ne,\n')
    with pytest.raises(DataError, match=r"labels\.csv:6: 'e,'"):
        read_labels(tmp_path / "labels.csv")
    (tmp_path / "labels.csv").write_bytes(b"name,label\na,wave\x85\nb,bow\x85low\n")
    assert read_labels(tmp_path / "labels.csv").class_names == ["bow\x85low", "wave"]


@pytest.mark.parametrize("line", ["sep=;\n", '"sep=;"\r\n', "\ufeffsep=;\n"])
def test_a_line_that_tells_spreadsheets_the_divider_is_none_of_the_table(tmp_path, line):
    (tmp_path / "labels.csv").write_text(line + "name;label\na;wave\nb;\n", encoding="utf-8")
    with pytest.raises(DataError, match=r"labels\.csv:4: 'b,'"):
        read_labels(tmp_path / "labels.csv")
    (tmp_path / "labels.csv").write_text(line + "a, left;wave\nb;bow\n", encoding="utf-8")
    assert list(read_labels(tmp_path / "labels.csv").rows) == ["a, left", "b"]  # without a header, and with a comma


@pytest.mark.parametrize(
    ("above", "hint"),
    [
        ("data", "give {root}/data"),
        ("data/deep", "give {root}/data/deep"),
        ("train/data", "move them up, out of 'data'"),
    ],
)
def test_folders_above_the_classes_are_told(above, hint, tmp_path, capsys):
    names = [f"{above}/{label}/{one}" for label in ("wave", "bow") for one in ("a", "b")]
    names += [name.replace("train", "test") for name in names if "train" in name]
    (tmp_path / "data/deep").mkdir(parents=True)
    if "train" in above:
        (tmp_path / "data/deep").rmdir()
        (tmp_path / "data").rmdir()
    labels_of_folders(tmp_path, names, "CLASS/VIDEO")
    said = " ".join(capsys.readouterr().err.split())
    assert "all samples are of one class, 'data'" in said and hint.format(root=tmp_path) in said


def test_splits_between_one_folder_and_the_classes_are_told(tmp_path, capsys):
    names = [f"data/{split}/{label}/{one}" for split in ("train", "test") for label in ("wave", "bow") for one in "ab"]
    labels_of_folders(tmp_path, names, "CLASS/VIDEO")
    assert "all samples are of one class, 'data'" in capsys.readouterr().err
    labels_of_folders(tmp_path, [f"wave/{split}/{one}" for split in ("train", "test") for one in "ab"], "CLASS/VIDEO")
    assert not capsys.readouterr().err


@pytest.mark.parametrize(("labels", "told"), [(("1", "01", "2"), True), (("01", "02", "03"), False)])
def test_one_number_in_two_spellings_is_told(labels, told, tmp_path, capsys):
    table = tmp_path / "labels.csv"
    table.write_text("name,label\n" + "".join(f"v{row},{label}\n" for row, label in enumerate(labels)))
    rows = read_labels(table).rows
    assert [row.label for row in rows.values()] == list(map(int, labels))
    assert ("labels '01' and '1' are one number, so one class, 1" in capsys.readouterr().err) == told
