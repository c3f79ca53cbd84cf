"""Bootstrap intervals: coverage, scipy on the same resamples, exact resampled metrics, degenerate cases, the commands."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dpcli.errors import UsageError
from dpcli.evaluate.bootstrap import (
    Resampling,
    bootstrap,
    drawn_counts,
    interval,
    left_out_once,
    means_of_samples,
    ratios_of_sums,
    replicates,
    two_sided_p,
)
from dpcli.evaluate.classification.metrics import classification_metrics, classification_weighted
from dpcli.evaluate.results import merge_statistics
from dpcli.evaluate.segmentation.metrics import SegmentationStatistics, segmentation_compute, segmentation_weighted
from dpcli.evaluate.segmentation.motion_metrics import TAUS, MotionStatistics, motion_compute, motion_weighted
from dpcli.runtime.seeds import generator
from dpcli.store import ScoresWriter
from tests.support.evaluating import evaluate
from tests.support.parts_helpers import perfect, truth_sequence, write_parts, write_truth


def mean_of(values: np.ndarray):
    return means_of_samples({"mean": np.asarray(values, float)})


def percentile(metric, samples, rng, *, resamples, confidence=0.95):
    """As `bootstrap`, without bias correction and acceleration: what differences of two files get."""
    estimate = metric(np.ones((1, samples)))["mean"][0]
    return {"mean": interval(estimate, replicates(metric, samples, rng, resamples)["mean"], confidence)}


# ---- the interval itself ----


@pytest.mark.parametrize("method", [bootstrap, percentile])
@pytest.mark.parametrize(
    "draw",
    [lambda rng: rng.normal(3, 2, 120), lambda rng: (rng.random(120) < 0.7).astype(float)],
    ids=["normal", "bernoulli"],
)
def test_coverage(method, draw):
    """A 95 % interval holds the true mean in 95 % of 400 samples, give or take two standard errors (1.1 % each)."""
    truth = {"normal": 3, "bernoulli": 0.7}["bernoulli" if draw(np.random.default_rng(0)).max() <= 1 else "normal"]
    covered = 0
    for number in range(400):
        values = draw(np.random.default_rng([7, number]))
        found = method(mean_of(values), 120, generator(1, number), resamples=500)["mean"]
        covered += found.low <= truth <= found.high
    assert 0.93 <= covered / 400 <= 0.97


@pytest.mark.parametrize(("method", "scipys"), [(bootstrap, "BCa"), (percentile, "percentile")])
@pytest.mark.parametrize("confidence", [0.95, 0.8])
def test_equals_scipy_on_the_same_resamples(method, scipys, confidence):
    from scipy.stats import bootstrap as reference

    values = np.random.default_rng(5).exponential(size=40)
    expected = reference(
        (values,),
        np.mean,
        n_resamples=999,
        batch=999,
        confidence_level=confidence,
        method=scipys,
        rng=np.random.default_rng(3),
    ).confidence_interval
    found = method(mean_of(values), 40, np.random.default_rng(3), resamples=999, confidence=confidence)
    assert (found["mean"].low, found["mean"].high) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_counts_are_draws_with_replacement_and_blocks_do_not_matter(monkeypatch):
    whole = np.concatenate(list(drawn_counts(7, 50, np.random.default_rng(0))))
    assert whole.shape == (50, 7) and (whole.sum(axis=1) == 7).all() and whole.max() > 1 and whole.min() == 0
    monkeypatch.setattr("dpcli.evaluate.bootstrap._BLOCK", 30)
    blocks = list(drawn_counts(7, 50, np.random.default_rng(0)))
    assert len(blocks) > 10 and np.array_equal(np.concatenate(blocks), whole)


def test_leaving_out_by_blocks(monkeypatch):
    values = np.array([1.0, 2, 4, 8, 16])
    expected = (values.sum() - values) / 4
    assert left_out_once(mean_of(values), 5)["mean"] == pytest.approx(expected)
    monkeypatch.setattr("dpcli.evaluate.bootstrap._BLOCK", 10)
    assert left_out_once(mean_of(values), 5)["mean"] == pytest.approx(expected)
    assert left_out_once(mean_of(np.zeros(2001)), 2001) is None


def test_same_seed_same_interval():
    values = np.random.default_rng(0).normal(size=20)
    one, again, other = (Resampling(200, seed=seed).intervals(mean_of(values), 20) for seed in (4, 4, 5))
    assert one == again != other


def test_degenerate_samples():
    equal = bootstrap(mean_of(np.full(9, 0.1)), 9, generator(0), resamples=200)["mean"]
    assert equal.low == equal.high == pytest.approx(0.1)
    assert not bootstrap(mean_of(np.ones(1)), 1, generator(0), resamples=200)["mean"].defined
    assert Resampling(0).intervals(mean_of(np.ones(3)), 3) == {}
    undefined = bootstrap(mean_of(np.full(3, np.nan)), 3, generator(0), resamples=200)["mean"]
    assert not undefined.defined
    assert not interval(1.0, np.array([np.nan, np.nan, 1.0])).defined  # mostly 0/0


def test_p_value():
    assert two_sided_p(np.zeros(999)) == 1
    assert two_sided_p(np.ones(999)) == pytest.approx(2 / 1000)
    assert two_sided_p(np.append(np.ones(989), -np.ones(10))) == pytest.approx(22 / 1000)
    rng = np.random.default_rng(0)
    for shift in (0.1, 0.19, 0.21, 0.3):  # agrees with the interval that is read beside it
        draws = rng.normal(shift, 0.1, 1999)
        assert (two_sided_p(draws) < 0.05) == (interval(shift, draws).low > 0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"confidence": 95}, "--confidence 95"),
        ({"confidence": 0}, "--confidence 0"),
        ({"resamples": 5}, "--resamples 5"),
    ],
)
def test_wrong_options(options, words):
    with pytest.raises(UsageError, match=words):
        Resampling(**options)


# ---- metrics of resamples against the metrics of files in which samples stand several times ----


def counts_of(samples: int, seed: int = 0) -> np.ndarray:
    drawn = np.concatenate(list(drawn_counts(samples, 12, np.random.default_rng(seed))))
    return np.concatenate([np.ones((1, samples)), drawn])


def repeated(row: np.ndarray) -> np.ndarray:
    return np.repeat(np.arange(len(row)), row.astype(int))


@pytest.mark.parametrize("classes", [3, 8])
def test_classification_of_resamples(classes):
    rng = np.random.default_rng(classes)
    scores, labels = rng.integers(0, 5, (25, classes)).astype(float), rng.integers(0, classes, 25)
    counts = counts_of(25)
    found = classification_weighted(scores, labels)(counts)
    assert ("top5_accuracy" in found) == (classes == 8)
    for number, row in enumerate(counts):
        rows = repeated(row)
        expected = classification_metrics(scores[rows], labels[rows])
        for key, values in found.items():
            own = getattr(expected, "top_accuracy" if key == "top5_accuracy" else key)
            assert values[number] == pytest.approx(own, abs=1e-12), key


def random_objects(count: int, seed: int = 0, ties: bool = True) -> list[SegmentationStatistics]:
    rng = np.random.default_rng(seed)
    made = []
    for number in range(count):
        said = int(rng.integers(0, 7)) if number else 0  # the first one predicts nothing
        confidence = rng.integers(0, 5, said) / 4 if ties else rng.random(said)
        matched = rng.random(said) < 0.6
        mean = np.array([np.nan if number == 1 else rng.random()])
        made.append(
            SegmentationStatistics(
                rng.random(said),
                matched,
                confidence,
                mean,
                mean.copy(),
                mean - 0.2,
                int(matched.sum() + rng.integers(0, 3)),
                2,
                0,
                0,
                0,
            )
        )
    return made


@pytest.mark.parametrize("block", [1 << 18, 40])
@pytest.mark.parametrize("ties", [True, False])
@pytest.mark.parametrize("protocol", ["dpc", "release"])
def test_segmentation_of_resamples(protocol, ties, block, monkeypatch):
    monkeypatch.setattr("dpcli.evaluate.segmentation.average_precision._BLOCK", block)
    objects = random_objects(12, ties=ties)
    counts = counts_of(12)
    found = segmentation_weighted(objects, protocol)(counts)
    for number, row in enumerate(counts):
        expected = segmentation_compute(merge_statistics([objects[i] for i in repeated(row)]), protocol)
        for key, values in found.items():
            if protocol == "release" and key == "ap" and ties:
                continue  # copies of a sequence apart in the file: ties in another order
            assert values[number] == pytest.approx(getattr(expected, key), abs=1e-12, nan_ok=True), key


def random_motions(count: int, seed: int = 0) -> list[MotionStatistics]:
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        pairs, parts = int(rng.integers(1, 5)), int(rng.integers(0, 4))
        points = rng.integers(5, 30, pairs)
        hits = rng.integers(0, 5, (pairs, len(TAUS), 3))
        made.append(
            MotionStatistics(
                points,
                rng.random(pairs) * points,
                rng.random(pairs) * points,
                hits,
                rng.random(parts),
                rng.random(parts),
            )
        )
    return made


@pytest.mark.parametrize("batch", [None, 6])
def test_motion_of_resamples(batch):
    objects, counts = random_motions(9), counts_of(9)
    found = motion_weighted(objects, 0.05, batch)(counts)
    for number, row in enumerate(counts):
        expected = motion_compute(merge_statistics([objects[i] for i in repeated(row)]), batch)
        own = {
            "epe3d": expected.epe3d,
            "epe3d_no_motion": expected.still,
            "part_displacement": expected.displacement,
            "part_rotation": np.degrees(expected.rotation),
        }
        for tau, suffix in ((0.05, ""), (0.01, "_0.01")):
            own |= {f"{key}{suffix}": getattr(expected.shares[tau], key) for key in ("accs", "accr", "outlier")}
        assert set(own) == set(found)
        for key, value in own.items():
            assert found[key][number] == pytest.approx(value, abs=1e-12, nan_ok=True), key


def test_zero_counts_are_undefined_not_nan_of_a_crash():
    """A jackknife of sequences of which one has all the truth: 0/0, not an exception."""
    assert np.isnan(ratios_of_sums({"x": np.array([1.0, 0])}, {"x": np.array([2.0, 0])})(np.array([[0.0, 1]]))["x"])
    for protocol in ("dpc", "release"):
        found = segmentation_weighted(random_objects(4), protocol)(np.zeros((1, 4)))
        assert np.isnan(found["ap"]) and np.isnan(found["miou"])


def test_replicates_of_a_metric_that_is_no_ratio_spread_like_a_brute_resampling():
    objects = random_objects(30, seed=3)
    fast = replicates(segmentation_weighted(objects), 30, np.random.default_rng(0), 400)["ap"]
    rng = np.random.default_rng(0)
    slow = [
        segmentation_compute(merge_statistics([objects[i] for i in rng.integers(0, 30, 30)])).ap for _ in range(400)
    ]
    assert fast == pytest.approx(slow, abs=1e-12)  # the same stream of draws


# ---- the commands ----


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    truths = [truth_sequence(f"s{i}", seed=i, label=i % 2) for i in range(6)]
    samples = [perfect(truth, 4) for truth in truths]
    rng = np.random.default_rng(0)
    for sequence, probability, _, _, flow in samples[2:]:
        wrong = rng.random(len(sequence.part)) < 0.3
        sequence.part[wrong] = 3
        probability[wrong] = [0.1, 0.1, 0.1, 0.7]
        for one in flow:
            one += rng.normal(scale=0.05, size=one.shape).astype(np.float32)
    with ScoresWriter(folder / "scores.h5", class_names=("a", "b", "c")) as writer:
        for i in range(40):
            writer.write(f"v{i}", np.eye(3)[i % 3 if i % 4 else 0], label=i % 3)
    return {
        "parts": write_parts(folder / "p.h5", samples),
        "truth": write_truth(folder / "t.h5", truths),
        "single": write_parts(folder / "one.h5", samples[3:4]),
        "scores": folder / "scores.h5",
    }


def run(*arguments: object):
    result = evaluate(*arguments)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.stdout


@pytest.mark.parametrize("task", ["classification", "segmentation", "motion"])
def test_intervals_beside_the_numbers(files, task):
    given = [files["scores"]] if task == "classification" else [files["parts"], "--truth", files["truth"]]
    found = json.loads(run(task, *given, "--json", "--seed", 3, "--resamples", 500))
    ends = found["intervals"]["metrics"]
    assert found["intervals"]["seed"] == 3 and found["intervals"]["resamples"] == 500
    assert found["intervals"]["number"] == found["samples"]["number"] == (40 if task == "classification" else 6)
    wide = {"classification": "accuracy", "segmentation": "miou", "motion": "epe3d"}[task]
    for key, own in ends.items():
        if key in found["metrics"]:
            assert own[0] - 1e-9 <= found["metrics"][key] <= own[1] + 1e-9, key
    assert ends[wide][0] < ends[wide][1]
    narrow = json.loads(run(task, *given, "--json", "--seed", 3, "--resamples", 500, "--confidence", 0.5))["intervals"]
    assert ends[wide][0] < narrow["metrics"][wide][0] and narrow["metrics"][wide][1] < ends[wide][1]
    text = run(task, *given)
    assert "2000 resamples" in text and "95 % interval" in text
    off = json.loads(run(task, *given, "--json", "--resamples", 0))
    assert (
        off["intervals"]["resamples"] == 0 and off["intervals"]["metrics"] == {} and off["metrics"] == found["metrics"]
    )
    assert "bootstrap" not in run(task, *given, "--resamples", 0)


def test_one_sequence_has_no_interval_and_says_so(files):
    for task in ("segmentation", "motion"):
        given = (task, files["single"], "--truth", files["truth"], "--intersect")
        assert set(json.loads(run(*given, "--json"))["intervals"]["metrics"].values()) == {None}
        assert "undefined" in run(*given)


def test_the_wilson_interval_follows_the_confidence(files):
    from scipy.stats import binomtest

    found = json.loads(run("classification", files["scores"], "--json", "--confidence", 0.9))
    assert found["protocol"]["accuracy_interval"] == "Wilson score, 90 %"
    expected = binomtest(found["denominators"]["correct"]["scores"], 40).proportion_ci(0.9, "wilson")
    assert found["metrics"]["accuracy_interval"] == pytest.approx([expected.low, expected.high])
