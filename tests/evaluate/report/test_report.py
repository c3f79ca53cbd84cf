"""`dpc evaluate report`: one page that needs nothing, says nothing false, and lets nothing from a file become markup."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from functools import partial
from html.parser import HTMLParser
from io import BytesIO

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.bootstrap import Resampling
from dpcli.evaluate.classification.protocol import evaluate_classification
from dpcli.evaluate.classification.result_json import classification_json
from dpcli.evaluate.report import arrange, collect, report_html, report_latex, report_markdown
from dpcli.evaluate.report.blocks import Table, interval_text, sort_key, table, text_of
from dpcli.evaluate.report.error_clouds import Cloud, _rename_parts, pack_cloud, part_blocks
from dpcli.evaluate.report.markdown_and_latex import escape_latex
from dpcli.store import CloudSequence, CloudsWriter, PartsWriter, ScoresWriter
from tests.support.browser import needs_browser, open_page
from tests.support.evaluating import evaluate
from tests.support.parts_helpers import CHAIN, perfect, truth_sequence, write_parts, write_truth
from tests.support.report_helpers import EVIL

_FLAGS = "--disable-gpu --virtual-time-budget=3000 --window-size=700,600 --enable-logging=stderr".split()


class _Reader(HTMLParser):
    """Tags with attributes, and the text of everything that isn't script or style."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.words, self._inside = [], ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self._inside = tag

    def handle_endtag(self, tag):
        self._inside = ""

    def handle_data(self, data):
        if self._inside not in ("script", "style"):
            self.words.append(data)


def test_nothing_from_a_file_becomes_markup_and_nothing_is_fetched(page):
    read = _Reader(page)
    assert [tag for tag, _ in read.tags].count("script") == 1
    assert not any(name.startswith("on") for _, attributes in read.tags for name in attributes)
    assert all(own.get("src", "data:").startswith("data:") for _, own in read.tags)
    assert not any(tag in ("link", "iframe", "object", "embed", "base", "form") for tag, _ in read.tags)
    assert EVIL in "".join(read.words) and EVIL not in page
    assert not re.search(r"https?://|@import|url\(|fetch\(|XMLHttpRequest", page)
    assert "default-src 'none'" in page and len(page) < 2e6
    # the check can fail: the same page with its escapes undone has another script
    broken = _Reader(page.replace("&lt;", "<").replace("&gt;", ">"))
    assert [tag for tag, _ in broken.tags].count("script") > 1


def test_equal_inputs_give_equal_bytes(scores, parts, truth, page):
    again = report_html(arrange(collect([str(scores), str(parts)], truth), title=f"A {EVIL}"))
    assert again == page
    assert not re.search(r"20\d\d-\d\d-\d\d", page)


def test_the_page_has_the_numbers_of_the_command(scores, parts, truth, page):
    from dpcli.evaluate.classification.protocol import evaluate_classification
    from dpcli.evaluate.segmentation.protocol import evaluate_segmentation

    report, found = evaluate_classification(scores), evaluate_segmentation(parts, truth)
    words = "".join(_Reader(page).words)
    assert f"{100 * report.main.accuracy:.1f} %" in words and f"{report.main.correct}/{report.main.samples}" in words
    assert f"{100 * found.main.ap:.1f} %" in words and f"{100 * found.main.miou:.1f} %" in words
    cells = re.findall(r'<td class="[^"]*(?:right|wrong)" style="--s:([\d.]+)">(\d+)</td>', page)
    counts = sorted(report.main.confusion[report.main.confusion > 0].tolist())
    assert sorted(int(count) for _, count in cells) == counts
    assert "dpc prepare msraction3d RAW" in words and "dpc segment predict" in words
    assert "worst: bad, frame" in words and "End-point error of the frame pairs (meter)" in words


def test_the_page_shows_how_reliable_probabilities_are(tmp_path):
    """Of four samples that are said with 0.9, three are right; class names that begin with numbers are words."""
    names = ["2 hands", "10 hands"]
    with ScoresWriter(tmp_path / "s.h5", class_names=names, provenance=[]) as writer:
        for index in range(4):
            writer.write(f"v{index}", np.array([0.9, 0.1]), label=int(index == 3), split="test")
    (section,) = arrange(collect([str(tmp_path / "s.h5")])).sections
    tables = {block.title: block for block in section.blocks if isinstance(block, Table)}
    assert [[own.text for own in row] for row in tables["Reliability"].rows] == [
        ["0.87 to 0.93", "4", "90.0 %", "75.0 %"]
    ]
    assert re.search(r"calibration error of \d+\.\d % on average", tables["Reliability"].note)
    assert section.notes == []
    (confused,) = [own for title, own in tables.items() if title.startswith("Confused most")]
    assert [(own.text, own.sort) for own in confused.rows[0][:2]] == [("10 hands", None), ("2 hands", None)]


def test_files_and_their_json_make_the_same_sections(scores, folder):
    from dpcli.evaluate.bootstrap import Resampling
    from dpcli.evaluate.classification.protocol import evaluate_classification
    from dpcli.evaluate.classification.result_json import classification_json

    found = classification_json(evaluate_classification(scores, resampling=Resampling()), str(scores))
    (folder / "one.json").write_text(json.dumps(found))
    direct, printed = (arrange(collect([str(own)])) for own in (scores, folder / "one.json"))
    assert report_html(direct) == report_html(printed)
    piped = collect(["-"], stdin=BytesIO(json.dumps(found).encode()))
    assert piped.results[0].found == json.loads(json.dumps(found))


@pytest.mark.parametrize(("resamples", "level"), [(200, "80 % interval of accuracy"), (0, "interval of accuracy")])
def test_intervals_say_their_level_and_what_is_no_number_is_no_metric(scores, resamples, level):
    """The scores are no probabilities: without a reliability diagram, which is no metric of its own."""
    report = evaluate_classification(scores, resampling=Resampling(resamples, 0.8))
    report.rejected = np.arange(30) < 10
    words = json.dumps(classification_json(report, "s.h5"))
    (section,) = arrange(collect(["-"], stdin=BytesIO(words.encode()))).sections
    assert section.notes[0].startswith(
        f"Something was recognized in 20 samples, of which {report.accepted[1]} are right"
    )
    tables = {own.key: own for own in section.blocks if isinstance(own, Table)}
    assert tables["streams"].header[2] == level
    assert [row[0].text for row in tables["metrics"].rows] == [
        "accuracy",
        "balanced accuracy",
        "macro F1",
        "calibration error",
    ]


def test_motion_is_shown_where_the_truth_has_scene_flow(tmp_path):
    def written(pairs: np.ndarray) -> list[str]:
        points = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
        part = np.tile(np.repeat([0, 1], 10), 2).astype(np.int16)
        sequence = CloudSequence("s", points, np.array([0, 20, 40]), part=part)
        with PartsWriter(tmp_path / "p.h5", num_parts=2, length_unit="m", force=True) as writer:
            writer.write(sequence, np.eye(2)[part], pairs, np.tile(np.eye(4), (1, 2, 1, 1)), [np.zeros((20, 3))])
        sequence.scene_flow = np.full((40, 3), 0.1, np.float32)
        with CloudsWriter(tmp_path / "t.h5", fields=("part", "scene_flow"), length_unit="m", force=True) as writer:
            writer.write(sequence)
        sections = arrange(collect([f"{tmp_path / 'p.h5'}={tmp_path / 't.h5'}"])).sections
        return [*(f"{own.task} {own.headline.value.text}" for own in sections), *sections[0].notes]

    assert written(np.array([[0, 1]])) == ["segmentation 100.0 %", "motion 0.1732"]
    only, note = written(np.array([[1, 0]]))
    assert only == "segmentation 100.0 %" and note.startswith("No motion: ") and "none of its 1 frame pairs" in note


def test_comparisons_and_runs_have_a_row_for_each_metric():
    pair = {
        "task": "compare",
        "input": ["a.h5", "b.h5"],
        "units": {"accuracy": "fraction"},
        "provenance": [[{"command": "A"}], [{"command": "B"}]],
        "metrics": {"accuracy": {"a": 0.9, "b": 0.8, "difference": 0.1, "p": 0.03, "interval": [0.02, 0.2], "ties": 7}},
        "intervals": {
            "method": "paired bootstrap, percentile",
            "resamples": 2000,
            "confidence": 0.9,
            "metrics": {"accuracy": [0.02, 0.2]},
        },
        "mcnemar": {"only_a": 4, "only_b": 1, "p": 0.4},
        "most_changed": {"accuracy": [{"name": "v7", "a": 1.0, "b": 0.0}]},
    }
    runs = {
        "task": "runs",
        "input": ["a", "b"],
        "runs": ["seed 0", "seed 1"],
        "units": {"accuracy": "fraction"},
        "metrics": {"accuracy": {"mean": 0.85, "sd": 0.05, "n": 2, "interval": [0.4, 1.0], "values": [0.8, 0.9]}},
    }
    report = arrange(collect(["-"], stdin=BytesIO("\n".join(map(json.dumps, (pair, runs))).encode())))
    first, second = report.sections
    row = [own.text for own in first.blocks[0].rows[0]]
    assert row == ["accuracy", "90.0 %", "80.0 %", "10.0 %", "0.03", "2.0 to 20.0 %", "7"] and first.commands == [
        "A",
        "B",
    ]
    assert (first.headline.value.text, first.headline.interval) == ("10.0 %", "2.0 to 20.0 %")
    assert [own.key for own in first.blocks[1:]] == ["McNemar's exact test", "samples that differ most, by accuracy"]
    assert [[own.text for own in row] for row in second.blocks[1].rows] == [["seed 0", "80.0 %"], ["seed 1", "90.0 %"]]
    assert [own.text for own in first.blocks[2].rows[0]] == ["v7", "100.0 %", "0.0 %"]
    assert "Intervals: 90 %, paired bootstrap" in first.blocks[0].note


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("93.5 %", 93.5),
        ("1,024", 1024),
        ("-0.5 dB", -0.5),
        ("89.6 to 96.0 %", 89.6),
        ("-", None),
        ("", None),
        ("wave", None),
        ("nan", None),
        ("inf", None),
        ("12\u00b0", 12),
    ],
)
def test_sort_keys(text, value):
    assert sort_key(text) == value


def test_numbers_are_written_with_their_units():
    assert text_of(0.9351, "fraction") == "93.5 %" and text_of(None) == "-" and text_of(30.675, "dB").startswith("30.6")
    assert interval_text([0.896, 0.96], "fraction") == "89.6 to 96.0 %"
    assert interval_text({"low": 1.0, "high": 2.5}) == "1 to 2.5" and interval_text([1]) == interval_text(None) == ""


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty"),
        (b"\x00\xff\x01", "neither text nor HDF5"),
        (b"hello there\n", "line 1 is not JSON"),
        (b'{"task": "a"}\n{"task": ', "line 2 is not JSON"),
        (b"[1, 2]", "object 1: a int, no result"),
        (b'{"metrics": {}}', "no text `task`"),
        (b'{"task": "a", "metrics": 3}', "metrics is a int"),
        (b'{"task": "a", "metrics": {"x": NaN}}', "not JSON"),
        (b'{"task": "a", "provenance": ["x"]}', "provenance is not a list"),
        (b'{"task": "a", "notes": 3}', "notes is a int"),
        (b'{"task": "a", "left_out": [{"reason": "x", "names": 3}]}', "names is a int"),
        (b'{"task": "a", "metrics": {"streams": 2.5}}', "streams is a float"),
        (b'{"task": "motion", "metrics": {"thresholds": true}}', "thresholds is a bool"),
        (b'{"task": "classification", "metrics": {"per_class": 7}}', "per_class is a int"),
        (b'{"task": "classification", "metrics": {"confusion": [[1, 2]]}}', "confusion has shape (1, 2)"),
        (b'{"task": "classification", "metrics": {"streams": {"a": 3}}}', "can't be shown"),
    ],
)
def test_what_is_no_result_is_said(tmp_path, content, words):
    path = tmp_path / "x.json"
    path.write_bytes(content)
    with pytest.raises(DataError, match=re.escape(words)) as caught:
        arrange(collect([str(path)]), beside=["table-3.4", "table-B.3"])
    assert str(path) in str(caught.value)


def test_what_is_missing_is_said(parts, scores, truth, tmp_path):
    with pytest.raises(UsageError, match="is of parts files, and none is given without a truth of its own"):
        collect([str(scores), f"{parts}={truth}"], truth)
    with pytest.raises(UsageError, match="no results to report"):
        collect([])
    with pytest.raises(UsageError, match="add --truth"):
        collect([str(parts)])
    with pytest.raises(DataError, match="no such file"):
        collect([str(tmp_path / "none.json")])
    with pytest.raises(DataError, match="holds 'clouds'"):
        collect([str(truth)])
    with pytest.raises(UsageError, match="only once"):
        collect(["-", "-"])
    for name in ("a.mp4", "a.webm"):
        (tmp_path / name).write_bytes(b"\x1a\x45\xdf\xa3")
        with pytest.raises(DataError, match=r"holds 'video', which has no result in it; .* PRED=TRUTH"):
            collect([str(tmp_path / name)])


def test_unknown_tasks_are_shown_and_duplicates_named(tmp_path):
    found = {
        "task": "weather",
        "input": "w",
        "metrics": {"rain": 3.25, "days": [{"name": "Mon", "rain": 1.5}], "hours": [1, 2, 4]},
        "units": {"rain": "mm"},
        "intervals": {"rain": [3, 3.5]},
    }
    path = tmp_path / "w.jsonl"
    path.write_text("\n".join(json.dumps(own) for own in (found, found, found | {"input": "v"})))
    report = arrange(collect([str(path)]))
    assert [own.title for own in report.sections] == ["w", "v"] and "shown once" in report.left_out[0]
    words = " ".join(_Reader(report_html(report)).words)
    assert "rain (mm)" in words and "3 to 3.5" in words and "Mon" in words and "hours by frame" in words


_LEAVES = (
    st.none()
    | st.booleans()
    | st.integers(-9, 99)
    | st.text(max_size=6)
    | st.floats(allow_nan=False, allow_infinity=False)
)
_METRICS = st.recursive(
    _LEAVES,
    lambda own: st.lists(own, max_size=4) | st.dictionaries(st.text(max_size=5), own, max_size=4),
    max_leaves=12,
)


@settings(max_examples=60, deadline=None)
@given(_METRICS, st.sampled_from(["classification", "segmentation", "video", "x"]))
def test_any_object_is_shown_or_refused_with_a_sentence(metrics, task):
    data = json.dumps({"task": task, "metrics": metrics}).encode()
    try:
        report = arrange(collect(["-"], stdin=BytesIO(data), pictures=False))
    except DataError:
        return
    assert isinstance(metrics, dict) and len(report.sections) == 1
    read = _Reader(report_html(report))
    assert [tag for tag, _ in read.tags].count("script") == 1
    if "nan" not in data.decode().lower():
        assert not re.search(r"\bnan\b", " ".join(read.words).lower())
    report_markdown(report), report_latex(report)


@pytest.mark.parametrize(
    "metrics",
    [
        {"": [{}]},
        {"a": [{}, {}]},
        {"": {"": {}}},
        {"a": {"b": {}}},
        {"a": [{"b": {}}]},
        {"a": []},
        {"m": {"mean": 1.0, "values": []}},
        {"m": {"mean": {}}},
        {"": {"mean": {}}},
    ],
    ids=str,
)
@pytest.mark.parametrize("more", [{}, {"mcnemar": {}, "runs": [""]}, {"mcnemar": {"p": {}}, "runs": ["", ""]}], ids=str)
def test_records_without_a_column_are_no_table(metrics, more):
    data = json.dumps({"task": "x", "metrics": metrics, **more}).encode()
    report = arrange(collect(["-"], stdin=BytesIO(data), pictures=False))
    assert report_html(report) and report_markdown(report) and report_latex(report)


def test_markdown_escapes_and_lines_up(scores):
    text = report_markdown(arrange(collect([str(scores)]), title="a|b"))
    assert text.startswith("# a\\|b\n") and "&lt;/script\\>" in text and "<script>" not in re.sub(r"`[^`]*`", "", text)
    for block in re.findall(r"(?:^\|.*\n)+", text, re.M):
        lines = [re.sub(r"\\.", "", line) for line in block.splitlines()]
        assert len({line.count("|") for line in lines}) == 1


def test_latex_escapes():
    assert escape_latex("a_b 50% & #1 {x} $ ~ ^ \\") == (
        r"a\_b 50\% \& \#1 \{x\} \$ \textasciitilde{} \textasciicircum{} \textbackslash{}"
    )


def test_latex_tables_are_whole(scores):
    text = report_latex(arrange(collect([str(scores)])))
    tables = re.findall(r"\\begin\{tabular\}\{([lr]+)\}(.*?)\\end\{tabular\}", text, re.S)
    assert len(tables) >= 4 and text.count(r"\begin{table}") == text.count(r"\end{table}") == len(tables)
    for columns, body in tables:
        rows = [line for line in body.splitlines() if line.endswith(r"\\")]
        assert all(len(re.findall(r"(?<!\\)&", row)) == len(columns) - 1 for row in rows)
        assert body.count(r"\toprule") == body.count(r"\bottomrule") == 1
    bare = re.sub(r"\\[%&#_${}]", "", re.sub(r"^%.*$", "", text, flags=re.M))
    assert "%" not in bare and "#" not in bare and "_" not in bare


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex")
def test_latex_compiles(scores, tmp_path):
    text = report_latex(arrange(collect([str(scores)])))
    document = (
        "\\documentclass{article}\\usepackage{booktabs}\\usepackage[T1]{fontenc}\\begin{document}\n"
        + text
        + "\\end{document}"
    )
    (tmp_path / "t.tex").write_text(document, "utf-8")
    done = subprocess.run(
        ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "t.tex"], cwd=tmp_path, capture_output=True
    )
    assert done.returncode == 0, done.stdout[-800:]


def test_a_cloud_is_packed_up_to_rounding():
    points = np.random.default_rng(1).normal(size=(7, 3)).astype(np.float32)
    truth, part = np.array([-1, 0, 1, 2, 0, 1, 300]), np.array([0, -1, 1, 2, 0, 1, 2])
    data = pack_cloud(Cloud(points, truth, part, np.array([np.nan, 0, 1, 2, 4, 0.5, 3]), "m"))
    steps = np.frombuffer(data[:42], "<u2").reshape(3, 7).T / 65535
    side = np.ptp(points, axis=0).max()
    np.testing.assert_allclose((steps - steps[0]) * side, points - points[0], atol=side / 60000)
    rest = np.frombuffer(data[42:], np.uint8).reshape(3, 7)
    assert rest[0].tolist() == [0, 1, 2, 3, 1, 2, 255] and rest[1].tolist() == [1, 0, 2, 3, 1, 2, 3]
    assert rest[2].tolist() == [0, 0, 64, 128, 255, 32, 191]


@pytest.mark.parametrize("unit", ["m", ""])
def test_the_color_of_a_cloud_is_named_by_what_it_shows(tmp_path, unit):
    """End-point errors where a pair begins at the frame shown, whether the files name a unit or not; else wrong parts."""
    sequences = [truth_sequence(f"s{k}", seed=k) for k in range(2)]
    truth = write_truth(tmp_path / "t.h5", sequences, length_unit=unit)
    for pairs, told in ((CHAIN, "red: end-point error up to"), (CHAIN[:0], "red: wrong part")):
        samples = [perfect(one, 4, pairs) for one in sequences]
        parts = write_parts(tmp_path / f"{len(pairs)}.h5", samples, length_unit=unit)
        (cloud,) = (own for own in part_blocks(parts, truth, motion=True) if own.title == "Error clouds")
        assert cloud.html.count(told) == 2


def test_predicted_parts_take_the_names_of_the_true_ones():
    truth, part = np.array([0, 0, 0, 1, 1, 5, -1]), np.array([7, 7, 3, 3, 3, 9, -1])
    assert _rename_parts(truth, part).tolist() == [0, 0, 1, 1, 1, 5, -1]
    assert _rename_parts(truth, np.array([2, 2, 2, 2, 2, 4, 6])).tolist() == [0, 0, 0, 0, 0, 5, 8]
    assert _rename_parts(truth, np.full(7, -1)).tolist() == [-1] * 7


def test_a_video_has_its_pictures_in_the_page(tmp_path):
    ours, theirs = tmp_path / "ours.npy", tmp_path / "theirs.npy"
    frames = np.random.default_rng(2).integers(0, 255, (3, 24, 24, 3), np.uint8)
    np.save(theirs, frames)
    np.save(ours, 255 - frames)
    report = arrange(collect([f"{ours}={theirs}"]))
    text = report_html(report)
    assert re.search(r'<img alt="view [^"]*frames 0, 1, 2" [^>]*src="data:image/jpeg;base64,/9j/', text)
    bare = arrange(collect([f"{ours}={theirs}"], pictures=False))
    assert "<img" not in report_html(bare) and bare.summary.rows[0][3] == report.summary.rows[0][3]
    found = collect([f"{ours}={theirs}"], pictures=False).results[0].found
    ours.unlink()
    gone = collect(["-"], stdin=BytesIO(json.dumps(found).encode()))
    assert "not where the object says" in gone.results[0].notes[0]


def test_a_video_of_several_views_has_an_interval(tmp_path):
    frames = np.random.default_rng(2).integers(0, 99, (3, 2, 24, 24, 3), np.uint8)
    np.save(tmp_path / "ours.npy", frames + np.arange(1, 4, dtype=np.uint8).reshape(3, 1, 1, 1, 1))
    np.save(tmp_path / "theirs.npy", frames)
    found = collect([f"{tmp_path / 'ours.npy'}={tmp_path / 'theirs.npy'}"], pictures=False)
    low, high = map(float, arrange(found).summary.rows[0][4].text.split(" to "))
    # errors of 1, 2 and 3 of 255
    assert 20 * np.log10(255 / 3) - 0.1 < low < high < 20 * np.log10(255) + 0.1


def test_the_command(scores, tmp_path):
    run = partial(evaluate, "report")
    page = tmp_path / "r.html"
    assert run(scores, "-o", page, "--title", "T").exit_code == 0 and "<title>T</title>" in page.read_text("utf-8")
    assert isinstance(run(scores, "-o", page).exception, UsageError)  # exists
    assert run(scores, "-o", page, "--force").exit_code == 0
    assert run(scores, "--markdown").stdout.startswith("# Results")
    assert run(scores, "-o", tmp_path / "r.tex").exit_code == 0 and r"\toprule" in (tmp_path / "r.tex").read_text(
        "utf-8"
    )
    wrong = (
        (scores,),
        (scores, "--markdown", "--latex"),
        (scores, "-o", tmp_path / "r.pdf"),
        (scores, "--markdown", "--beside", "x"),
    )
    assert all(isinstance(run(*args).exception, UsageError) for args in wrong)
    assert isinstance(run(scores, "-o", tmp_path / "no" / "r.html").exception, DataError)
    assert os.listdir(tmp_path) and not list(tmp_path.glob(".*.part"))


@needs_browser
def test_a_browser_opens_and_sorts_the_page(page, tmp_path):
    """Ascending and descending by a number, and the missing last both ways; no script of a file has run."""
    made = table("S", ("name", "x"), [["a", "10 %"], ["b", "9 %"], ["c", "-"], ["d", "100 %"]], key="toy")
    from dpcli.evaluate.report.page import _table

    path = tmp_path / "page.html"
    path.write_text(page.replace("<main>", "<main>" + _table(made)), "utf-8")
    for direction, order in (("ascending", "badc"), ("descending", "dabc")):
        html, said = open_page(f"{path.as_uri()}#sort=toy:1:{direction}", tmp_path, *_FLAGS)
        assert 'data-state="ready"' in html and "CONSOLE" not in said
        toy = re.search(r'data-key="toy">(.*?)</table>', html, re.S)[1]
        assert "".join(re.findall(r'<th scope="row">(\w)</th>', toy)) == order
        assert f'aria-sort="{direction}"' in toy and "<button" in toy
        assert "<img" not in html
