"""True tables whose frames count in another way than ours, or whose classes nobody predicts, are told, and no others."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpcli.errors import DataError
from dpcli.evaluate.segments.truth_check import check_classes, doubts_of_frames
from dpcli.store.tables.segments import Segment, Segments, read_segments

LENGTHS = st.lists(st.lists(st.integers(3, 60), min_size=3, max_size=6), min_size=2, max_size=4)


def recordings(lengths: list[list[int]]) -> dict[str, list[tuple[int, int, str]]]:
    """Segments one behind the other, of these lengths, whose classes take turns."""
    made = {}
    for number, own in enumerate(lengths):
        ends = [sum(own[: k + 1]) for k in range(len(own))]
        made[f"r{number}"] = [(end - size, end, ("wave", "bow")[k % 2]) for k, (end, size) in enumerate(zip(ends, own))]
    return made


def doubts(predicted: dict, true: dict) -> str:
    tables = [
        Segments({name: [Segment(*row) for row in rows] for name, rows in side.items()}) for side in (predicted, true)
    ]
    return " ".join(doubts_of_frames(*tables, list(true)))


@given(LENGTHS, st.data())
def test_frames_that_count_as_ours_are_not_doubted(lengths, data):
    true = recordings(lengths)
    # without some in between: one that ends early in all recordings is doubted, and rightly
    kept = {name: [row for k, row in enumerate(rows) if k % 3 != 1 or row is rows[-1]] for name, rows in true.items()}
    assert not doubts(true, data.draw(st.sampled_from([true, kept])))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda start, end: (start, end - 1), "add 1"),
        (lambda start, end: (start + 1, end), "add 1"),
        (lambda start, end: (start + 1, end), "count from 1"),
        (lambda start, end: (start + 1, end + 1), "count from 1"),
        (lambda start, end: (2 * start, 2 * end), "another rate"),
        (lambda start, end: (start // 3, end // 3), "seconds"),
    ],
)
@given(lengths=LENGTHS)
def test_frames_that_count_in_another_way_are_told(change, told, lengths):
    ours = recordings(lengths)
    assert told in doubts(ours, {name: [(*change(a, b), c) for a, b, c in rows] for name, rows in ours.items()})


def test_classes_that_nobody_predicts_are_told(capsys):
    predicted, true = (Segments({"a": [Segment(0, 9, "wave"), Segment(9, 20, last)]}) for last in ("bow", "background"))
    check_classes(predicted, predicted, ["a"], "t.csv")
    assert not capsys.readouterr().err
    check_classes(predicted, true, ["a"], "t.csv")
    assert "nothing is predicted to be 'background'" in capsys.readouterr().err
    with pytest.raises(DataError, match="'Bow' is predicted as 'bow'"):
        check_classes(predicted, Segments({"a": [Segment(0, 9, "wave"), Segment(9, 20, "Bow")]}), ["a"], "t.csv")


@pytest.mark.parametrize("divider", [",", ";", "\t", ", "])
def test_tables_of_other_programs_are_read_alike(tmp_path, divider):
    rows = [("Recording", "START", "end", "Class"), ("a", "0", "10", "wave"), ("a", "10", "12", "")]
    path = tmp_path / "t.csv"
    path.write_text("\ufeff" + "".join(divider.join(row) + "\r\n" for row in rows), encoding="utf-8")
    found = [(one.start, one.end, one.name) for one in read_segments(path).recordings["a"]]
    assert found == [(0, 10, "wave"), (10, 12, "")]


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "latin-1"])
def test_tables_in_other_encodings_are_read_alike(tmp_path, encoding):
    (tmp_path / "t.csv").write_bytes("recording;start;end;class\nJürgen;0;10;drücken\n".encode(encoding))
    found = read_segments(tmp_path / "t.csv").recordings
    assert [(name, own.start, own.end, own.name) for name, (own,) in found.items()] == [("Jürgen", 0, 10, "drücken")]


def test_letters_composed_in_two_ways_are_the_same(tmp_path):
    (tmp_path / "t.csv").write_text("recording,start,end,class\nu\u0308,0,10,dru\u0308cken\n", encoding="utf-8")
    ((name, (own,)),) = read_segments(tmp_path / "t.csv").recordings.items()
    assert (name, own.name) == ("\u00fc", "dr\u00fccken")


def test_a_column_that_is_there_twice_is_named(tmp_path):
    (tmp_path / "t.csv").write_text("recording,start,end,class,Class\na,0,10,wave,bow\n")
    with pytest.raises(DataError, match="two columns 'class'"):
        read_segments(tmp_path / "t.csv")


def test_a_row_with_more_cells_than_columns_is_named(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("recording,start,end,class\na,0,10,wave\na,10,20,bow, deep\n")
    with pytest.raises(DataError, match="line 3: more cells"):
        read_segments(path)
