"""`dpc classify fuse`: the mean by hand, videos matched by name, what doesn't fit refused with its first difference."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.special import softmax
from typer.testing import CliRunner

from dpcli.classify.commands.fuse import stream_names
from dpcli.classify.fusion import geometric_weights, likelihood_weights, mean_scores, parse_weights
from dpcli.cli.app import app
from dpcli.cli.classify.fuse import fuse as fuse_files
from dpcli.errors import DataError, UsageError
from dpcli.store import ScoresReader, ScoresWriter
from tests.support.commands import exit_code

CLASSES = ["push", "wave", "bend"]
POINTS = {"v0": (0, [0.6, 0.3, 0.1]), "v1": (1, [0.5, 0.4, 0.1]), "v2": (2, [0.2, 0.2, 0.6])}
FLOW = {"v2": (2, [0.1, 0.1, 0.8]), "v0": (0, [0.3, 0.4, 0.3]), "v1": (1, [0.1, 0.8, 0.1])}
MEAN = {"v0": [0.45, 0.35, 0.2], "v1": [0.3, 0.6, 0.1], "v2": [0.15, 0.15, 0.7]}


def write(path: Path, rows: dict, classes: list[str] = CLASSES, split: str = "test") -> Path:
    path.parent.mkdir(exist_ok=True)
    with ScoresWriter(path, class_names=classes, provenance={"config": path.name}) as writer:
        for name, (label, scores) in rows.items():
            writer.write(name, np.array(scores), label=label, split=split)
    return path


@pytest.fixture
def two(tmp_path) -> list[Path]:
    return [write(tmp_path / "points.h5", POINTS), write(tmp_path / "flow.h5", FLOW)]


def fuse(inputs: list, output: Path, weights: str | None = None, force: bool = False) -> ScoresReader:
    fuse_files([str(path) for path in inputs], str(output), weights=weights, force=force)
    return ScoresReader(output)


def test_the_mean_by_hand(two, tmp_path, capsys):
    found = fuse(two, tmp_path / "both.h5")
    assert capsys.readouterr().out == f"{tmp_path / 'both.h5'}: mean of 2 scores of 3 videos\n"
    assert found.names == ["v0", "v1", "v2"] and found.labels.tolist() == [0, 1, 2] and found.splits == ["test"] * 3
    np.testing.assert_allclose(found.scores, list(MEAN.values()), atol=1e-7)
    np.testing.assert_array_equal(found.streams["points"], np.float32([row for _, row in POINTS.values()]))
    np.testing.assert_array_equal(found.streams["flow"], np.float32([FLOW[name][1] for name in found.names]))
    entry = found.provenance[-1]
    assert entry["config"]["fuse"] == ["points", "flow"] and entry["config"]["weights"] == [0.5, 0.5]
    assert entry["config"]["sources"] == [[{"config": "points.h5"}], [{"config": "flow.h5"}]]
    assert set(entry["inputs"]) == {"points", "flow"}


def test_the_order_of_files_and_videos_does_not_matter(two, tmp_path):
    rng = np.random.default_rng(0)
    draws = rng.dirichlet(np.ones(3), 6)
    third = write(tmp_path / "third.h5", {f"v{k}": (-1, draws[k]) for k in (1, 2, 0)}, split="")
    one, other = fuse([*two, third], tmp_path / "abc.h5"), fuse([third, two[1], two[0]], tmp_path / "cba.h5")
    assert other.names == ["v1", "v2", "v0"] and other.labels.tolist() == [1, 2, 0] and other.splits == ["test"] * 3
    np.testing.assert_array_equal(other.scores, one.scores[[1, 2, 0]])
    np.testing.assert_allclose(one.scores[0], (np.array([0.9, 0.7, 0.4]) + draws[0]) / 3, atol=1e-7)


def test_weights(two, tmp_path):
    found = fuse(two, tmp_path / "weighed.h5", "3,1")
    np.testing.assert_allclose(found.scores[0], [0.525, 0.325, 0.15], atol=1e-7)
    np.testing.assert_array_equal(fuse(two, tmp_path / "first.h5", "1,0").scores, found.streams["points"])
    np.testing.assert_allclose(parse_weights("0.7,0.3", ["a", "b"]), [0.7, 0.3])
    np.testing.assert_allclose(parse_weights("b=0.3,a=0.7", ["a", "b"]), [0.7, 0.3])
    for text, message in (
        ("0.5", "1 weight for 2"),
        ("a,b", "expected numbers"),
        ("-1,2", "from 0 up"),
        ("0,0", "not all"),
        ("nan,1", "from 0 up"),
        ("inf,1", "from 0 up"),
        ("a=1,c=1", "expected a=NUMBER,b=NUMBER"),
        ("a=1,a=1", "expected a="),
        ("a=1,b", "expected numbers"),
    ):
        with pytest.raises(UsageError, match=message):
            parse_weights(text, ["a", "b"])
    with pytest.raises(UsageError, match="expected a=NUMBER,b=NUMBER"):
        parse_weights("1,2", ["a", "b"], named=True)
    with pytest.raises(UsageError, match="1 weight for 2"):  # told before any file is looked at
        fuse([tmp_path / "absent.h5", two[0]], tmp_path / "none.h5", "0.5")


def test_streams_have_names_of_their_own(two, tmp_path):
    assert stream_names(["a", "b", "a", "fused", "a"]) == ["a", "b", "a-2", "fused-2", "a-3"]
    assert stream_names(["a", "a", "a-2"]) == ["a", "a-2", "a-2-2"]
    again, third = (write(tmp_path / name / "points.h5", POINTS) for name in ("other", "one more"))
    assert set(fuse([again, third, two[1]], tmp_path / "out.h5").streams) == {"other", "one more", "flow"}


def test_files_called_scores_are_averaged_like_any(tmp_path):
    """A stream may have the name of the data set that holds the mean."""
    inputs = [write(tmp_path / "scores.h5", POINTS), write(tmp_path / "flow.h5", FLOW)]
    for order in (inputs, inputs[::-1]):
        found = fuse(order, tmp_path / "out.h5", force=True)
        for row, name in enumerate(found.names):
            np.testing.assert_allclose(found.scores[row], MEAN[name], rtol=1e-6)
            np.testing.assert_allclose(found.streams["scores"][row], POINTS[name][1], rtol=1e-6)


@pytest.mark.parametrize(
    ("rows", "classes", "split", "message"),
    [
        (
            {k: v for k, v in FLOW.items() if k != "v1"},
            CLASSES,
            "test",
            r"other.h5: no scores of 'v1', which .*points.h5 has \(1",
        ),
        ({**FLOW, "w": (0, [1, 0, 0])}, CLASSES, "test", "points.h5: no scores of 'w', which .*other.h5 has"),
        ({**FLOW, "v1": (2, [1, 0, 0])}, CLASSES, "test", "other.h5: label 2 of 'v1', in .*points.h5 it is 1"),
        (FLOW, ["push", "bend", "wave"], "test", "class 1 is 'bend', in .*points.h5 it is 'wave'"),
        ({k: (0, [*v, 0]) for k, (_, v) in FLOW.items()}, [*CLASSES, "x"], "test", "4 classes, in .* 3"),
        (FLOW, CLASSES, "train", "'v0' is of split 'train', in .* of 'test'"),
    ],
)
def test_the_first_difference_is_named(two, tmp_path, rows, classes, split, message):
    other = write(tmp_path / "other.h5", rows, classes, split)
    with pytest.raises(DataError, match=message):
        fuse([two[0], other], tmp_path / "out.h5")
    assert not (tmp_path / "out.h5").exists()


def test_labels_that_only_later_files_know_must_agree_too(tmp_path):
    unknown = write(tmp_path / "unknown.h5", {"v": (-1, [1, 0, 0])})
    one, two = (write(tmp_path / f"{k}.h5", {"v": (k, [1, 0, 0])}) for k in (1, 2))
    assert fuse([unknown, one], tmp_path / "fine.h5").labels.tolist() == [1]
    with pytest.raises(DataError, match="2.h5: label 2 of 'v', in .*1.h5 it is 1"):
        fuse([unknown, one, two], tmp_path / "out.h5")


def test_files_named_twice_and_other_outputs_are_refused(two, tmp_path):
    for inputs, output in (([two[0], two[0]], tmp_path / "out.h5"), (two, two[1])):
        with pytest.raises(UsageError, match="named twice"):
            fuse(inputs, output, force=True)
    with pytest.raises(UsageError, match="stdin is one file"):
        fuse(["-", two[0], "-"], tmp_path / "out.h5")
    before = fuse(two, tmp_path / "out.h5").path.read_bytes()
    fuse(two, tmp_path / "out.h5")  # complete
    with pytest.raises(UsageError, match="or --force"):
        fuse(two, tmp_path / "out.h5", "3,1")
    assert before == (tmp_path / "out.h5").read_bytes() != fuse(two, tmp_path / "out.h5", "3,1", True).path.read_bytes()


def test_stdin_and_stdout_and_the_evaluation(two, tmp_path, monkeypatch, capsysbinary):
    with open(two[0]) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        assert exit_code("classify", "fuse", "-", two[1], "-o", "-") == 0
    (tmp_path / "piped.h5").write_bytes(capsysbinary.readouterr().out)
    np.testing.assert_array_equal(ScoresReader(tmp_path / "piped.h5").scores, fuse(two, tmp_path / "both.h5").scores)
    said = CliRunner().invoke(app, ["evaluate", "classification", str(tmp_path / "piped.h5"), "--json"])
    streams = json.loads(said.stdout)["metrics"]["streams"]
    assert {name: round(values["accuracy"], 3) for name, values in streams.items()} == {
        "flow": 0.667,
        "stdin": 0.667,
        "fused": 1.0,
    }
    refused = CliRunner().invoke(app, ["classify", "fuse", str(two[0]), "-o", str(tmp_path / "x.h5")])
    assert refused.exit_code != 0 and "two or more" in str(refused.exception)


def with_streams(path: Path, rows: dict, split: str = "test") -> Path:
    """rows: name -> (label, static, dynamic); the fused scores are their mean."""
    with ScoresWriter(path, class_names=CLASSES, streams=("static", "dynamic")) as writer:
        for name, (label, static, dynamic) in rows.items():
            own = {"static": np.array(static), "dynamic": np.array(dynamic)}
            writer.write(name, sum(own.values()) / 2, label=label, split=split, streams=own)
    return path


def test_the_streams_of_one_file_get_another_mean(tmp_path, monkeypatch, capsys):
    rows = {"v0": (0, [0.6, 0.3, 0.1], [0.2, 0.3, 0.5]), "v1": (1, [1, 0, 0], [0, 1, 0])}
    one = with_streams(tmp_path / "one.h5", rows)
    found = fuse([one], tmp_path / "out.h5", "static=1,dynamic=3")
    np.testing.assert_allclose(found.scores, [[0.3, 0.3, 0.4], [0.25, 0.75, 0]], atol=1e-7)
    np.testing.assert_array_equal(found.streams["static"], ScoresReader(one).streams["static"])
    np.testing.assert_allclose(fuse([one], tmp_path / "same.h5").scores, ScoresReader(one).scores, atol=1e-7)
    with pytest.raises(UsageError, match="expected dynamic=NUMBER,static=NUMBER"):
        fuse([one], tmp_path / "x.h5", "1,3")
    with open(one) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        words = ("-", "-o", tmp_path / "piped.h5", "--weights", "dynamic=3,static=1")
        assert exit_code("classify", "fuse", *words) == 0
    assert "weights dynamic 0.75, static 0.25" in capsys.readouterr().out
    np.testing.assert_array_equal(ScoresReader(tmp_path / "piped.h5").scores, found.scores)


@pytest.mark.parametrize("models", [2, 3])
def test_likelihood_weights_are_the_best_there_are(models):
    draws = np.random.default_rng(models).beta(1, 2, (models, 40))

    def likelihood(weights):
        return np.log(weights @ draws).sum()

    found = likelihood_weights(draws)
    np.testing.assert_allclose(found.sum(), 1)
    steps = np.linspace(0, 1, 101)
    grid = np.stack(np.meshgrid(*[steps] * (models - 1)), -1).reshape(-1, models - 1)
    grid = np.concatenate([grid, 1 - grid.sum(1, keepdims=True)], 1)
    best = max(likelihood(weights) for weights in grid[grid[:, -1] >= -1e-9].clip(0))
    assert best <= likelihood(found) + 1e-9 and likelihood(found) < best + 0.05  # not a likelihood of something else
    assert likelihood(found) > likelihood(np.full(models, 1 / models)) + 1e-3  # equal weights are rejected
    np.testing.assert_allclose(likelihood_weights(np.array([[0.5, 0.9], [0.0, 0.1]])), [1, 0], atol=1e-6)
    np.testing.assert_allclose(likelihood_weights(np.full((2, 5), 0.3)), [0.5, 0.5])
    np.testing.assert_allclose(likelihood_weights(np.array([[1.0, 0], [0, 1], [0, 1]])), [0.5, 0.25, 0.25], atol=1e-6)


def test_the_geometric_mean_is_that_of_logits(two, tmp_path, capsys):
    fuse_files([str(path) for path in two], str(tmp_path / "g.h5"), weights="3,1", force=False, mean="geometric")
    assert "geometric mean of 2 scores of 3 videos" in capsys.readouterr().out
    found = ScoresReader(tmp_path / "g.h5")
    for row, name in enumerate(found.names):
        logits = 0.75 * np.log(POINTS[name][1]) + 0.25 * np.log(FLOW[name][1])
        np.testing.assert_allclose(found.scores[row], np.exp(logits) / np.exp(logits).sum(), rtol=1e-5)
    assert np.abs(found.scores - fuse(two, tmp_path / "a.h5", "3,1").scores).max() > 0.01
    assert found.provenance[-1]["config"]["mean"] == "geometric"
    draws = np.random.default_rng(0).dirichlet(np.ones(4), (3, 5))
    draws[0, 0] = [1, 0, 0, 0]  # a score of 0 is finite for the others
    weights = np.array([0.5, 0.3, 0.2])
    for mean in ("arithmetic", "geometric"):
        there, back = mean_scores(draws, weights, mean), mean_scores(draws[::-1], weights[::-1], mean)
        np.testing.assert_array_equal(there, back)
        assert np.isfinite(there).all()
        np.testing.assert_allclose(there.sum(-1), 1)
    with pytest.raises(UsageError, match="--mean harmonic: expected arithmetic or geometric"):
        fuse_files([str(path) for path in two], str(tmp_path / "x.h5"), weights=None, force=False, mean="harmonic")


@pytest.mark.parametrize("models", [2, 3])
def test_geometric_weights_are_the_best_there_are(models):
    rng = np.random.default_rng(models)
    draws, labels = rng.dirichlet(np.ones(4), (models, 60)), rng.integers(0, 4, 60)
    for k in range(models):  # models that are right more or less often
        named = np.where(rng.random(60) < 0.4 + 0.15 * k, labels, rng.integers(0, 4, 60))
        draws[k, np.arange(60), named] += 0.5
    draws /= draws.sum(-1, keepdims=True)

    def likelihood(powers):
        logits = np.tensordot(powers, np.log(draws), 1)
        return float(np.log(softmax(logits, -1)[np.arange(60), labels]).sum())

    found = geometric_weights(draws, labels)
    np.testing.assert_allclose(found.sum(), 1)
    scales = np.linspace(0.2, 8, 200)
    best = max(likelihood(found * scale) for scale in scales)
    others = [weights for weights in rng.dirichlet(np.ones(models), 60) if np.abs(weights - found).max() > 0.05]
    assert all(best > likelihood(weights * scale) for weights in others for scale in scales)
    equal = max(likelihood(np.full(models, scale / models)) for scale in scales)
    assert best > equal + 1e-3 and np.argmax(found) == models - 1
    sure = np.full((2, 3, 2), 0.5)
    sure[0], sure[1] = [0.9, 0.1], [0.4, 0.6]
    np.testing.assert_allclose(geometric_weights(sure, np.zeros(3, int)), [1, 0])  # one always right, one always wrong
    np.testing.assert_allclose(geometric_weights(np.full((2, 3, 2), 0.5), np.zeros(3, int)), [0.5, 0.5])


def test_weights_are_chosen_on_other_videos(tmp_path):
    rows = {"v0": (0, [0.6, 0.3, 0.1], [0.2, 0.3, 0.5]), "v1": (1, [1, 0, 0], [0, 1, 0])}
    one = with_streams(tmp_path / "one.h5", rows)
    held = {
        "w0": (0, [0.1, 0.9, 0], [0.4, 0.3, 0.3]),
        "w1": (1, [0.5, 0.5, 0], [0.4, 0.4, 0.2]),
        "w2": (-1, [1, 0, 0], [0, 0, 1]),
    }
    judge = with_streams(tmp_path / "held.h5", held, "validation")

    def chosen(inputs, by, output="out.h5"):
        fuse_files([str(path) for path in inputs], str(tmp_path / output), weights=None, force=True, weights_from=by)
        return ScoresReader(tmp_path / output)

    found = chosen([one], str(judge))
    entry = found.provenance[-1]["config"]
    assert entry["fuse"] == ["dynamic", "static"] and len(entry["weights_from"]) == 1
    best = likelihood_weights(np.array([[0.4, 0.4], [0.1, 0.5]]))
    np.testing.assert_allclose(entry["weights"], best, atol=1e-6)
    np.testing.assert_allclose(
        found.scores[0], best[0] * np.array([0.2, 0.3, 0.5]) + best[1] * np.array([0.6, 0.3, 0.1]), atol=1e-6
    )

    two = [write(tmp_path / "points.h5", POINTS), write(tmp_path / "flow.h5", FLOW)]
    fuse_files([str(one)], str(tmp_path / "g.h5"), weights=None, force=False, weights_from=str(judge), mean="geometric")
    static, dynamic = np.array([held[name][1:] for name in ("w0", "w1")]).swapaxes(0, 1)
    np.testing.assert_allclose(
        ScoresReader(tmp_path / "g.h5").provenance[-1]["config"]["weights"],
        geometric_weights(np.stack([dynamic, static]), np.array([0, 1])),
        atol=1e-5,
    )
    judges = [write(tmp_path / "a.h5", {"w": (0, [0.9, 0.1, 0])}), write(tmp_path / "b.h5", {"w": (0, [0.1, 0.9, 0])})]
    by = ",".join(map(str, judges))
    np.testing.assert_allclose(chosen(two, by).provenance[-1]["config"]["weights"], [1, 0], atol=1e-3)
    for inputs, judged, error, message in (
        ([one], str(one), DataError, "'v0' is among the fused videos"),
        (two, str(judge), UsageError, "1 file for 2"),
        ([one], str(two[0]), UsageError, "without streams"),
        (two, f"{two[0]},{two[1]}", DataError, r"\(3 such videos\)"),
        (
            [one],
            str(with_streams(tmp_path / "unknown.h5", {"w": (-1, [1, 0, 0], [1, 0, 0])})),
            DataError,
            "no video has a label",
        ),
    ):
        with pytest.raises(error, match=message):
            chosen(inputs, judged, "x.h5")
    assert not (tmp_path / "x.h5").exists()
    kept = judge.read_bytes()
    with pytest.raises(UsageError, match="held.h5: is named twice"):
        chosen([one], str(judge), "held.h5")  # the output would have taken its place
    assert judge.read_bytes() == kept
    with pytest.raises(UsageError, match="one of the two"):
        fuse_files(
            [str(one)], str(tmp_path / "x.h5"), weights="static=1,dynamic=1", force=False, weights_from=str(judge)
        )


@pytest.mark.parametrize("row", [[-1.0, 1.0, 1.0], [30.0, 15.0, 5.0], [0.3, 0.3, 0.3], [0.0, 0.0, 0.0]])
def test_scores_that_are_no_probabilities_are_refused(row, two, tmp_path):
    odd = write(tmp_path / "odd.h5", {**POINTS, "v1": (1, row)})
    with pytest.raises(DataError, match=r"odd.h5: scores of 'v1' are not probabilities \(1 such samples\)"):
        fuse([two[0], odd], tmp_path / "out.h5")
    assert not (tmp_path / "out.h5").exists()


def test_marks_that_fused_scores_do_not_keep_are_told(tmp_path, capsys):
    for name, rejected in (("a", True), ("b", False)):
        with ScoresWriter(tmp_path / f"{name}.h5", class_names=["x", "y"], rejects=True) as writer:
            writer.write("v", np.array([0.5, 0.5], np.float32), rejected=rejected)
    fuse([str(tmp_path / "a.h5"), str(tmp_path / "b.h5")], str(tmp_path / "c.h5"))
    assert "a.h5: marks 1 video as not recognized" in (said := capsys.readouterr().err) and "b.h5" not in said
    assert ScoresReader(tmp_path / "c.h5").rejected is None
