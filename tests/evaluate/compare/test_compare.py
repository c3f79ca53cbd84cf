"""`dpc evaluate compare` and `runs`: paired differences, tests by hand, symmetry, broken twins, and what is refused."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import rankdata

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.bootstrap import Resampling, bootstrap, means_of_samples
from dpcli.evaluate.classification.protocol import evaluate_classification
from dpcli.evaluate.compare.file_metrics import EvaluationOptions, metrics_of_values
from dpcli.evaluate.compare.paired import CompareReport, pair_metrics
from dpcli.evaluate.compare.paired_picture import draw_comparison
from dpcli.evaluate.compare.paired_tables import compare_notes, compare_tables
from dpcli.evaluate.compare.result_json import compare_json
from dpcli.evaluate.compare.significance_tests import mcnemar
from dpcli.evaluate.results import LeftOut
from dpcli.evaluate.text_tables import resampling_note
from dpcli.store import PartsReader, PartsWriter, ScoresWriter
from tests.support.evaluating import evaluate
from tests.support.parts_helpers import CHAIN, perfect, truth_sequence, write_parts
from tests.support.scores_helpers import CLASSES, write_scores


@pytest.fixture(scope="module")
def differences(run, parts) -> dict:
    """Those of the good prediction and its twin, by metric."""
    words = ("compare", parts["good"], parts["twin"], "--truth", parts["truth"], "--json")
    return json.loads(run(*words))["metrics"]


def test_identical_files_do_not_differ(run, scores, parts):
    for given in ((scores["good"],) * 2, (parts["good"], parts["good"], "--truth", parts["truth"])):
        found = json.loads(run("compare", *given, "--json"))
        assert len(found["metrics"]) == (3 if len(given) == 2 else 14)
        for own in found["metrics"].values():
            assert own["difference"] == 0 and own["p"] == 1 and own["interval"] == [0, 0]
            assert not own["a_better"] and not own["b_better"] and own["wilcoxon_p"] in (1, None)
        assert not any(found["most_changed"].values())


def test_a_broken_twin_is_clearly_worse(run, scores, differences):
    found = json.loads(run("compare", scores["good"], scores["shuffled"], "--json"))
    assert all(
        own["difference"] > 0 and own["p"] < 0.01 and own["interval"][0] > 0 for own in found["metrics"].values()
    )
    assert found["mcnemar"]["p"] < 1e-4
    for key in ("miou", "ap", "ri", "accs"):
        own = differences[key]
        assert own["difference"] > 0 and own["p"] < 0.01 and own["a_better"] == 8, key
        assert own["wilcoxon_p"] == pytest.approx(2 / 2**8)  # all eight on one side
    assert differences["epe3d"]["difference"] < 0 and differences["epe3d"]["a_better"] == 8  # lower is better
    assert differences["part_rotation"]["interval"] is not None


def test_numbers_are_those_of_the_single_commands(run, parts, scores, differences):
    for task in ("segmentation", "motion"):
        for side, name in (("a", "good"), ("b", "twin")):
            result = evaluate(task, parts[name], "--truth", parts["truth"], "--json", "--resamples", 0)
            for key, value in json.loads(result.stdout)["metrics"].items():
                if key in differences:
                    assert differences[key][side] == pytest.approx(value, abs=1e-12), key
    found = json.loads(run("compare", scores["good"], scores["close"], "--json"))["metrics"]
    assert found["accuracy"]["a"] == evaluate_classification(scores["good"]).main.accuracy
    assert found["macro_f1"]["b"] == pytest.approx(evaluate_classification(scores["close"]).main.macro_f1)


def test_swapping_the_files_turns_the_signs(run, parts):
    options = ("--truth", parts["truth"], "--json", "--protocol", "release", "--resamples", 100)
    one, other = (
        json.loads(run("compare", parts[a], parts[b], *options))["metrics"]
        for a, b in (("good", "twin"), ("twin", "good"))
    )
    for key, own in one.items():
        back = other[key]
        assert own["difference"] == pytest.approx(-back["difference"], abs=1e-12)
        assert own["interval"] == pytest.approx([-end for end in back["interval"][::-1]], abs=1e-12)
        assert own["p"] == back["p"] and own["wilcoxon_p"] == back["wilcoxon_p"]
        assert (own["a_better"], own["b_better"], own["ties"]) == (back["b_better"], back["a_better"], back["ties"])


def test_mcnemar_by_hand(run, scores):
    """3 and 4 wrong in one file only: p = P(at least as far from half of 6) = 2 P(X <= 2), X of 6 draws."""
    found = json.loads(run("compare", scores["good"], scores["close"], "--json"))
    assert found["mcnemar"] == {"only_a": 4, "only_b": 2, "p": pytest.approx(2 * (1 + 6 + 15) / 64)}
    own = found["metrics"]["accuracy"]
    assert (own["a_better"], own["b_better"], own["ties"]) == (4, 2, 54)
    assert own["difference"] == pytest.approx(2 / 60) and own["p"] > 0.2 and own["interval"][0] < 0 < own["interval"][1]
    assert {row["name"] for row in found["most_changed"]["accuracy"]} == {"v3", "v4", "v10", "v11", "v12", "v13"}
    assert mcnemar(0, 0).p == 1 and mcnemar(1, 9).p == pytest.approx(2 * (1 + 10) / 1024)


def test_pairing_takes_away_what_is_hard_for_both():
    """A constant gain under a large spread of samples: the paired interval sees it, separate ones overlap."""
    hard = np.random.default_rng(0).normal(20, 5, 30)
    tables = [{f"x{i}": {"psnr": v + shift} for i, v in enumerate(hard)} for shift in (0.2, 0)]
    sides = [metrics_of_values(name, table, {"psnr": "dB"}) for name, table in zip("AB", tables, strict=True)]
    found = pair_metrics(*sides, Resampling(500)).changes["psnr"]
    assert found.interval.low == pytest.approx(0.2) == found.interval.high and found.p < 0.01
    single = Resampling(500).intervals(sides[0].metric, 30)["psnr"]
    assert single.high - single.low > 2


def test_bootstrap_difference_of_means_equals_scipy():
    from scipy.stats import bootstrap

    a, b = np.random.default_rng(0).normal(size=(2, 25))
    sides = [metrics_of_values("x", {str(i): {"m": v} for i, v in enumerate(side)}, {"m": "dB"}) for side in (a, b)]
    found = pair_metrics(*sides, Resampling(4000)).changes["m"]
    expected = bootstrap(
        (a, b),
        lambda x, y, axis=-1: (x - y).mean(axis=axis),
        paired=True,
        vectorized=True,
        method="percentile",
        n_resamples=4000,
        rng=np.random.default_rng(1),
    )
    close = 4 * expected.standard_error / math.sqrt(4000) * 3  # Monte-Carlo error of a 2.5 % quantile
    assert [found.interval.low, found.interval.high] == pytest.approx(list(expected.confidence_interval), abs=close)


@pytest.mark.parametrize("seed", range(6))
def test_single_samples_are_compared_by_all_signs_that_their_differences_could_have(seed):
    rng = np.random.default_rng(seed)
    a = rng.integers(0, 9, 9) / 8.0
    b = np.where(rng.random(9) < 0.3, a, rng.integers(0, 9, 9) / 8)
    b[0], apart = np.nan, (a - b)[1:]
    ranks = rankdata(np.abs(apart[apart != 0]))
    sums = np.array([np.sum(ranks[list(signs)]) for signs in itertools.product([False, True], repeat=len(ranks))])
    farther = np.abs(sums - sums.mean()) >= abs(ranks[apart[apart != 0] > 0].sum() - sums.mean()) - 1e-9
    for unit, key, better in (("dB", "psnr", 1), ("1", "lpips", -1)):
        sides = [
            metrics_of_values(n, {str(i): {key: v} for i, v in enumerate(x)}, {key: unit}) for n, x in zip("AB", (a, b))
        ]
        found = pair_metrics(*sides, Resampling(0))
        own = found.changes[key]
        assert [own.a_better, own.b_better, own.ties] == [
            (better * apart > 0).sum(),
            (better * apart < 0).sum(),
            (apart == 0).sum(),
        ]
        assert own.wilcoxon_p == pytest.approx(farther.mean()) and own.difference == pytest.approx(
            np.mean(a) - np.nanmean(b)
        )
        named = [abs(one - other) for _, one, other in found.changed]
        assert named == sorted(np.abs(apart[apart != 0]), reverse=True)


def test_a_table_of_values_becomes_a_whole_report(tmp_path):
    """What a video's views or frames need: tables, notes, JSON and picture from {sample: {metric: value}}."""
    tables = [{f"view {i}": {"psnr": 20 + i + s, "lpips": 0.1 * i + s / 10} for i in range(4)} for s in (0, 1)]
    sides = [
        metrics_of_values(f"{n}.h5", table, {"psnr": "dB", "lpips": "1"}) for n, table in zip("ab", tables, strict=True)
    ]
    part = pair_metrics(*sides, Resampling(200))
    report = CompareReport(("a.h5", "b.h5"), EvaluationOptions(), Resampling(200), [part], ([], []))
    found = json.loads(json.dumps(compare_json(report), allow_nan=False))
    assert found["metrics"]["psnr"]["interval"] == pytest.approx([-1, -1])
    assert (found["metrics"]["psnr"]["b_better"], found["metrics"]["lpips"]["a_better"]) == (4, 4)
    (table, changed), notes = compare_tables(report), compare_notes(report)
    assert table.rows[0][:4] == ["PSNR (dB)", "21.5", "22.5", "-1"] and len(changed.rows) == 4
    assert any("4 views" in line for line in notes) and found["units"] == {"psnr": "dB", "lpips": "1"}
    part = replace(report.parts[0], left_out=[LeftOut("not of split 'test'", ["view 9"])])
    twice = compare_notes(replace(report, parts=[part, part]))  # as of a parts file: segmentation and motion
    assert sum("Left out" in line for line in twice) == 1
    draw_comparison(report, tmp_path / "v.png")
    assert (tmp_path / "v.png").stat().st_size > 5000


def test_values_that_are_missing_or_infinite():
    units = {"psnr": "dB"}
    a = metrics_of_values("a", {"x": {"psnr": 1.0}, "y": {"psnr": 2.0}, "z": {}}, units)
    b = metrics_of_values("b", {"x": {"psnr": 2.0}, "y": {"psnr": 4.0}, "z": {}}, units)
    found = pair_metrics(a, b, Resampling(200)).changes["psnr"]
    assert found.difference == -1.5 and (found.a_better, found.b_better, found.ties) == (0, 2, 0)
    with pytest.raises(DataError, match="psnr of 2 views is infinite: 'y', 'z'"):
        metrics_of_values("f", {"x": {"psnr": 1}, "y": {"psnr": np.inf}, "z": {"psnr": -np.inf}}, units)
    with pytest.raises(DataError, match="no views"):
        metrics_of_values("f", {}, units)
    with pytest.raises(DataError, match="unit of psnr: 'dB' in a, 'bel' in c"):
        pair_metrics(a, metrics_of_values("c", {"x": {"psnr": 1}}, {"psnr": "bel"}), Resampling(0))
    alone = metrics_of_values("a", {"x": {"psnr": 1.0}}, units)
    only = pair_metrics(alone, alone, Resampling(200)).changes["psnr"]
    assert not only.interval.defined and np.isnan(only.p)


def test_text_markdown_and_picture(run, scores, parts, tmp_path):
    text = run("compare", scores["good"], scores["close"], "--picture", tmp_path / "a.png")
    assert (
        "91.7" in text
        and "88.3" in text
        and "+3.3" in text
        and "McNemar's exact test: p 0.688" in text
        and "v10" in text
    )
    text = run(
        "compare",
        parts["good"],
        parts["twin"],
        "--truth",
        parts["truth"],
        "--picture",
        tmp_path / "b.png",
        "--markdown",
    )
    assert "| mIoU (%) |" in text and "EPE3D (m) ↓ |" in text and "&lt; 0.001" in text
    assert all((tmp_path / name).read_bytes()[:4] == b"\x89PNG" for name in ("a.png", "b.png"))


def test_other_samples_are_named_or_left_out(run, scores, parts, tmp_path):
    later = write_scores(tmp_path / "later.h5", {20}, count=58, start=5)
    with pytest.raises(DataError, match="later.h5: has no 'v0', 'v1', 'v2', 'v3', 'v4', which .*good.h5 has"):
        run("compare", scores["good"], later)
    found = json.loads(run("compare", scores["good"], later, "--intersect", "--json"))
    assert found["denominators"] == {"classification": {"samples": 55}}
    assert found["metrics"]["accuracy"]["a"] == 1 and found["metrics"]["accuracy"]["b"] == pytest.approx(54 / 55)
    assert [(e["count"], e["names"][0]) for e in found["left_out"]] == [(5, "v0"), (3, "v60")]
    with pytest.raises(DataError, match="not one of their samples in common"):
        run("compare", scores["good"], write_scores(tmp_path / "far.h5", set(), start=100), "--intersect")
    options = ("--truth", parts["truth"], "--resamples", 0)
    with pytest.raises(DataError, match="fewer.h5: has no 's0', 's1' of split"):
        run("compare", parts["good"], parts["fewer"], *options)
    found = json.loads(run("compare", parts["fewer"], parts["good"], *options, "--intersect", "--json"))
    assert found["denominators"]["segmentation"] == {"sequences": 6} and "s0" in json.dumps(found["left_out"])
    told = json.loads(run("compare", parts["fewer"], parts["fewer"], *options, "--intersect", "--json"))
    only = told["metrics"]
    assert told["notes"][0] == "A and B are the same file, so nothing can differ."
    assert found["metrics"]["miou"]["a"] == only["miou"]["a"]


def test_what_cannot_be_compared(run, scores, parts, tmp_path):
    truth = ("--truth", parts["truth"], "--resamples", 0)
    with pytest.raises(DataError, match="number 1 is 'push' in .* 'pull' in"):
        run("compare", scores["good"], write_scores(tmp_path / "names.h5", set(), class_names=("wave", "pull", "push")))
    with pytest.raises(DataError, match="2 classes|3 in .*, 4 in"):
        with ScoresWriter(tmp_path / "four.h5", class_names=(*CLASSES, "x")) as writer:
            for i in range(60):
                writer.write(f"v{i}", np.eye(4)[0], label=i % 3, split="test")
        run("compare", scores["good"], tmp_path / "four.h5")
    with pytest.raises(DataError, match="true label of 'v0': 0 in .*good.h5, 1 in .*labels.h5"):
        with ScoresWriter(tmp_path / "labels.h5", class_names=CLASSES) as writer:
            for i in range(60):
                writer.write(f"v{i}", np.eye(3)[0], label=(i + (i == 0)) % 3, split="test")
        run("compare", scores["good"], tmp_path / "labels.h5")
    with pytest.raises(DataError, match="frame pairs of 's0': 3 in .*good.h5, 2 in .*pairs.h5"):
        run("compare", parts["good"], parts["pairs"], *truth)
    assert json.loads(run("compare", parts["good"], parts["pairs"], *truth, "--metrics", "miou", "--json"))["metrics"]
    truths = [truth_sequence(f"s{i}", seed=i, label=i % 2) for i in range(8)]
    still = write_parts(tmp_path / "still.h5", [perfect(one, 4, pairs=CHAIN[:0]) for one in truths])
    found = json.loads(run("compare", parts["good"], still, *truth, "--json"))
    assert "epe3d" not in found["metrics"] and f"only {parts['good']} can be evaluated" in found["notes"][0]
    with pytest.raises(UsageError, match="a parts file holds no truth"):
        run("compare", parts["good"], parts["twin"])
    with pytest.raises(DataError, match="good.h5: scores, .*good.h5: parts; nothing to compare"):
        run("compare", scores["good"], parts["good"], *truth)
    with pytest.raises(UsageError, match="--metrics psnr: of scores expected some of accuracy"):
        run("compare", scores["good"], scores["good"], "--metrics", "psnr")
    with pytest.raises(DataError, match="a clouds file; expected scores or parts"):
        run("compare", parts["truth"], parts["truth"])
    with pytest.raises(UsageError, match="--protocol and --ignore-below are for parts"):
        run("compare", scores["good"], scores["good"], "--ignore-below", 3)
    with pytest.raises(UsageError, match="--ignore-below is of ap, .*, and --metrics names none"):
        run("compare", parts["good"], parts["pairs"], *truth, "--metrics", "epe3d", "--ignore-below", 3)


def test_rounding_is_no_difference(run, parts, tmp_path):
    """The same sequences in another order: the sums of a mean differ in their last bit."""
    turned = tmp_path / "turned.h5"
    with (
        PartsReader(parts["twin"]) as reader,
        PartsWriter(turned, num_parts=4, length_unit=reader.length_unit) as writer,
    ):
        for row in (5, 2, 7, 0, 3, 6, 1, 4):
            said = reader.read_parts(row)
            sequence = reader.read(row, fields=("part",))
            writer.write(sequence, said.probability, said.pairs, said.motion, said.flow)
    words = run("compare", parts["twin"], turned, "--truth", parts["truth"], "--json", "--resamples", 200)
    for own in json.loads(words)["metrics"].values():
        assert (own["difference"], own["interval"], own["p"]) == (0, [0, 0], 1)


def test_few_samples_are_said_to_make_intervals_too_narrow(run, parts, tmp_path):
    """Eight sequences are few, sixty samples aren't; a bootstrap of two that agree says p < 0.001."""
    text = run("compare", parts["good"], parts["twin"], "--truth", parts["truth"], "--resamples", 100)
    assert "8 sequences are few for a bootstrap" in text and "can't be below 0.0078" in " ".join(text.split())
    assert not any("few for" in line for line in resampling_note(Resampling(), "samples", 60))
    assert any("9 samples are few" in line for line in resampling_note(Resampling(), "samples", 9))
    covered, rng = 0, np.random.default_rng(0)
    for _ in range(300):
        metric = means_of_samples({"mean": rng.normal(size=4)})
        ends = bootstrap(metric, 4, rng, resamples=200)["mean"]
        covered += ends.low <= 0 <= ends.high
    assert 0.75 < covered / 300 < 0.85  # as the sentence says
