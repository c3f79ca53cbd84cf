"""The thesis's tables beside ours: whole, equal to its text, chosen by data or name, in its units and at its thresholds."""

from __future__ import annotations

import json
import re
from io import BytesIO

import pytest

from dpcli.errors import UsageError
from dpcli.evaluate.report import arrange, collect
from dpcli.evaluate.report.blocks import is_number
from dpcli.evaluate.report.thesis_tables import ThesisTable, choose_tables, thesis_tables


def test_motion_beside_the_thesis_is_at_its_threshold():
    """Ours at tau 0.05 must not stand beside the thesis's numbers at 0.01."""
    found = {
        "task": "motion",
        "input": "m.h5",
        "provenance": [{"command": "dpc prepare sapien X"}],
        "metrics": {"epe3d": 0.02, "accs": 0.9, "thresholds": [{"tau": 0.01, "accs": 0.4}, {"tau": 0.05, "accs": 0.9}]},
        "units": {"epe3d": "meter", "accs": "fraction"},
    }
    report = arrange(collect(["-"], stdin=BytesIO(json.dumps(found).encode())))
    row = report.beside[0].rows[0]
    assert report.beside[0].key == "table-B.3" and [own.text for own in row[3:5]] == ["2.00", "40.00"]
    found["metrics"].pop("thresholds")
    report = arrange(collect(["-"], stdin=BytesIO(json.dumps(found).encode())))
    assert report.beside[0].rows[0][4].text == "-"


def test_video_beside_the_thesis_is_of_the_reference_view():
    """The thesis's PSNR is of the reference view; our mean over all views must not stand beside it."""
    found = {
        "task": "video",
        "input": "v.h5",
        "metrics": {"psnr": 20.0, "ssim": 0.9, "per_role": {"reference": {"psnr": 25.0}}},
        "units": {"psnr": "dB", "ssim": "1"},
    }
    row = (
        arrange(collect(["-"], stdin=BytesIO(json.dumps(found).encode()), pictures=False), beside=["table-5.1"])
        .beside[0]
        .rows[0]
    )
    assert [own.text for own in row[3:5]] == ["25.00", "-"] and "reference" in row[2].text


def printed_numbers(own: ThesisTable) -> dict[tuple[str, ...], float]:
    """Every number of a table, by the table, method, setting and metric."""
    return {
        (own.number, row["method"], row["setting"], metric): float(value)
        for row in own.rows
        for metric, value in zip(own.metrics, row["values"], strict=True)
        if is_number(value)
    }


def test_every_row_of_the_thesis_is_whole():
    tables = thesis_tables()
    assert len({own.number for own in tables}) == len(tables) == 15
    for own in tables:
        assert all(len(row["values"]) == len(own.metrics) == len(own.units) for row in own.rows)
        assert all(own.units) and all(row["method"] for row in own.rows)
    value = {key: number for own in tables for key, number in printed_numbers(own).items()}
    assert value["3.4", "Kinet", "Point Cloud, 24 frames", "accuracy"] == 93.27
    assert (
        value["4.2", "thesis", "unsupervised", "ap"] == 63.8 and value["4.2", "thesis", "supervised", "epe3d"] == 3.86
    )
    assert value["5.1", "MotionStruct4D", "", "psnr"] == 30.68


def test_the_rows_of_the_thesis_equal_its_text(shared_data):
    """Every value of the file stands in the thesis, digit for digit."""
    text = shared_data.parent / "thesis.txt"
    if not text.is_file():
        pytest.skip("the thesis's text is not here")
    printed = {float(number) for number in re.findall(r"\d+\.?\d*", text.read_text("utf-8"))}
    wrong = [key for own in thesis_tables() for key, value in printed_numbers(own).items() if value not in printed]
    assert not wrong


def test_tables_are_chosen_by_data_or_by_name(scores):
    found = {"task": "classification", "provenance": [{"command": "dpc prepare msraction3d RAW"}]}
    named = {
        "task": "classification",
        "metrics": {
            "per_class": [
                {"name": name.upper()} for name in ("high arm wave", "side boxing", "tennis serve", "golf swing")
            ]
        },
    }
    other = {"task": "classification", "provenance": [{"command": "dpc prepare synthetic gestures"}]}
    assert (
        [own.id for own in choose_tables([], [found])]
        == ["table-3.4"]
        == [own.id for own in choose_tables([], [named])]
    )
    assert choose_tables([], [other]) == [] == choose_tables(["none"], [found])
    assert [own.id for own in choose_tables(["table-3.1"], [other])] == ["table-3.1"]
    with pytest.raises(UsageError, match="table-9.9.*expected none or some of table-3.1"):
        choose_tables(["table-9.9"], [])
    rows = arrange(collect([str(scores)])).beside[0].rows
    assert {own[0].mark for own in rows[:3]} == {"ours"} and {own[0].mark for own in rows[3:]} == {"thesis"}
    assert all(own[1].text.startswith("thesis") for own in rows[3:])
