"""Several runs of one experiment: their mean, deviation and t interval by hand and against scipy, and what is refused."""

from __future__ import annotations

import json
import math

import h5py
import numpy as np
import pytest

from dpcli.errors import DataError, DpcError, UsageError
from dpcli.evaluate.classification.protocol import evaluate_classification
from dpcli.evaluate.classification.result_json import classification_json
from dpcli.evaluate.compare.runs import mean_with_t_interval
from dpcli.evaluate.report import collect
from dpcli.evaluate.segmentation.protocol import evaluate_segmentation
from dpcli.evaluate.segmentation.sequence_pass import Keeping
from tests.support.evaluating import evaluate
from tests.support.scores_helpers import write_scores


def test_runs_by_hand(run, scores):
    """Accuracies 55, 53 and 20 of 60: mean and sd by numpy, t quantile of two degrees of freedom from a table."""
    files = [scores[name] for name in ("good", "close", "shuffled")]
    found = json.loads(run("runs", *files, "--json"))
    values = np.array([55, 53, 20]) / 60
    own = found["metrics"]["accuracy"]
    assert own["values"] == pytest.approx(values) and own["n"] == 3
    assert own["mean"] == pytest.approx(values.mean()) and own["sd"] == pytest.approx(values.std(ddof=1))
    half = 4.302653 * values.std(ddof=1) / math.sqrt(3)
    assert half > 0.7 and own["interval"] == [0, 1]  # which no share leaves
    assert found["runs"] == ["seed 0", "seed 1", "seed 2"]  # of the training, not of the prediction
    assert found["samples"]["number"] == 60 and found["denominators"] == {"runs": 3, "samples": 60}
    text = run("runs", *files, "--markdown", "--metrics", "accuracy")
    assert f"| ± sd | {100 * values.std(ddof=1):.1f} |" in text and "| seed 1 | 88.3 |" in text


def test_spread_equals_scipy():
    from scipy.stats import t

    values = np.random.default_rng(0).normal(size=6)
    found = mean_with_t_interval(values, 0.9)
    expected = t.interval(0.9, 5, values.mean(), values.std(ddof=1) / math.sqrt(6))
    assert (found.interval.low, found.interval.high) == pytest.approx(expected, abs=1e-12)
    one = mean_with_t_interval([0.5])
    assert one.mean == 0.5 and math.isnan(one.sd) and not one.interval.defined


def test_the_interval_of_a_share_ends_where_its_mean_does():
    two = mean_with_t_interval([0.9, 0.98], share=True).interval  # two runs: 12.7 standard errors
    assert two.low == pytest.approx(0.94 - 12.7062 * 0.04, abs=1e-4) and two.high == 1
    assert mean_with_t_interval([0.02, 0.1], share=True).interval.low == 0
    for length in ([0.9, 0.98], [0.9, 1.4]):  # a length, or a share of the diameter that isn't one
        assert mean_with_t_interval(length, share=length[1] > 1).interval.high > 1.4


def test_runs_of_parts_and_of_their_json_are_the_same(run, parts, tmp_path):
    names = ("good", "twin")
    direct = json.loads(run("runs", *(parts[name] for name in names), "--truth", parts["truth"], "--json"))
    lines = [
        evaluate("segmentation", parts[name], "--truth", parts["truth"], "--json", "--resamples", 0).stdout
        for name in names
    ]
    (tmp_path / "both.json").write_text("".join(lines))
    by_json = json.loads(run("runs", tmp_path / "both.json", "--json"))
    for key, own in by_json["metrics"].items():
        for what, value in own.items():
            assert value == pytest.approx(direct["metrics"][key][what]), (key, what)
    assert by_json["runs"] == ["good", "twin"] and by_json["samples"] == direct["samples"]
    assert set(direct["metrics"]) > set(by_json["metrics"])  # motion, too
    (tmp_path / "first.json").write_text(lines[0])
    single = run("runs", tmp_path / "first.json")
    assert "One run only" in single


def test_runs_that_are_not_the_same_experiment(run, scores, parts, tmp_path):
    with pytest.raises(DataError, match="later.h5: another samples than .*number 59, not 60"):
        run("runs", scores["good"], write_scores(tmp_path / "later.h5", set(), count=59))
    with pytest.raises(DataError, match="moved.h5: another samples than .*names_sha256"):
        run("runs", scores["good"], write_scores(tmp_path / "moved.h5", set(), start=3))
    with pytest.raises(UsageError, match="good.h5: is named twice"):
        run("runs", scores["good"], scores["close"], scores["good"])
    with pytest.raises(DataError, match="fewer.h5: has no 's0'"):
        run("runs", parts["good"], parts["fewer"], "--truth", parts["truth"])
    words = ("segmentation", parts["good"], "--truth", parts["truth"], "--json", "--resamples", 0, "--protocol")
    objects = {protocol: evaluate(*words, protocol).stdout for protocol in ("dpc", "release")}
    path = tmp_path / "mixed.json"
    path.write_text(objects["dpc"] + objects["release"])
    with pytest.raises(DataError, match="mixed.json:2: another protocol than .*name 'release', not 'dpc'"):
        run("runs", path)
    path.write_text(objects["dpc"])
    with pytest.raises(DataError, match="another task than"):
        run("runs", scores["good"], path)
    for text, words in (
        ("", "empty"),
        ("{}\n", "not an object of"),
        ("hello", "neither a file"),
        ("\x00\xff", "neither"),
        (objects["dpc"].replace('"miou": ', '"miou": NaN, "x": ', 1), "miou of 8 metrics not finite"),
        (json.dumps(json.loads(objects["dpc"]) | {"samples": [8]}), "samples is a list"),
        (json.dumps(json.loads(objects["dpc"]) | {"denominators": "frames"}), "denominators is a str"),
        (json.dumps(json.loads(objects["dpc"]) | {"notes": 3}), "notes is a int"),
    ):
        path.write_text(text)
        with pytest.raises(DpcError, match=words):
            run("runs", path)


def test_runs_of_video_results_need_no_names(run, tmp_path):
    """Objects of `evaluate video` carry no sample names: their denominators are compared."""
    own = {
        "task": "video",
        "input": "a.h5",
        "protocol": {"name": "dpc"},
        "units": {"psnr": "dB", "ssim": "1"},
        "metrics": {"psnr": 30.0, "ssim": None, "per_view": []},
        "denominators": {"views": 2, "frames": 8},
    }
    path = tmp_path / "v.json"
    path.write_text("\n".join(json.dumps(own | {"metrics": {"psnr": p, "ssim": 0.5}}) for p in (30.0, 32.0)))
    found = json.loads(run("runs", path, "--json"))
    assert found["metrics"]["psnr"]["mean"] == 31 and found["runs"] == ["a #1", "a #2"]
    path.write_text("\n".join(json.dumps(own | {"denominators": {"views": 2, "frames": n}}) for n in (8, 9)))
    with pytest.raises(DataError, match="another denominators than .*frames 9, not 8"):
        run("runs", path)
    path.write_text(json.dumps(own) + "\n" + json.dumps(own))
    assert json.loads(run("runs", path, "--json"))["metrics"]["ssim"]["mean"] is None
    assert "undefined in some runs" in run("runs", path)


def test_scores_that_are_no_probabilities_have_no_further_metric(run, tmp_path):
    """Their reliability diagram is null, which is no number, and a run of probabilities is the same experiment."""
    objects = []
    for seed, scale in enumerate((1, 3)):
        path = write_scores(tmp_path / f"{seed}.h5", {seed}, seed=seed)
        with h5py.File(path, "r+") as file:
            file["scores"][...] *= scale
        objects.append(classification_json(evaluate_classification(path), str(path)))
    path = tmp_path / "runs.json"
    path.write_text("\n".join(map(json.dumps, objects)))
    found = json.loads(run("runs", path, "--json"))["metrics"]
    assert list(found) == ["accuracy", "balanced_accuracy", "macro_f1", "calibration_error"]
    assert found["calibration_error"]["mean"] is None and found["calibration_error"]["values"][1] is None


def test_kept_statistics_say_how_to_become_a_result(run, parts, tmp_path):
    kept = tmp_path / "kept.h5"
    evaluate_segmentation(parts["good"], parts["truth"], keeping=Keeping(kept))
    for words in (("runs", kept), ("compare", kept, kept), ("report", kept)):
        with pytest.raises(DataError, match="evaluate segmentation FILE --json"):
            collect([str(kept)]) if words[0] == "report" else run(*words)


def test_what_is_left_out_of_runs_is_counted(run, tmp_path):
    """A video without a label is in no number, whether runs are files or JSON; what all leave out is said once."""

    def unlabeled(name: str, row: int, **options) -> str:
        path = write_scores(tmp_path / f"{name}.h5", {1}, **options)
        with h5py.File(path, "r+") as file:
            file["label"][row] = -1
        return str(path)

    both = [unlabeled("a", 3, seed=0), unlabeled("b", 3, seed=1)]
    lines = [evaluate("classification", path, "--json", "--resamples", 0).stdout for path in both]
    (tmp_path / "both.json").write_text("".join(lines))
    told = "All runs: Left out, unknown label (-1): 1 sample (v3)."
    for files in (both, [tmp_path / "both.json"]):
        assert json.loads(run("runs", *files, "--json"))["notes"] == [told]
        assert run("runs", *files).count("Left out") == 1


def test_a_run_that_counts_twice_is_told(run, scores, tmp_path):
    copy = tmp_path / "copy.h5"
    copy.write_bytes(scores["good"].read_bytes())
    told = json.loads(run("runs", scores["good"], copy, scores["close"], "--json"))["notes"]
    assert len(told) == 1 and told[0].startswith("seed 0 #1 and seed 0 #2 have the same seed and equal metrics")
    equal = write_scores(tmp_path / "equal.h5", {0, 1, 2, 3, 4}, seed=7)  # as good by another training
    assert json.loads(run("runs", scores["good"], equal, "--json"))["notes"] == []
