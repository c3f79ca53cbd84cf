"""Segmentation metrics against golden values, brute force and hand-worked examples; both protocols; the command."""

from __future__ import annotations

import itertools
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import adjusted_rand_score

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.results import merge_statistics
from dpcli.evaluate.segmentation.metrics import (
    Frame,
    SegmentationMetrics,
    average_precision,
    segmentation_compute,
    segmentation_update,
)
from dpcli.evaluate.segmentation.part_matching import match_parts, mean_iou
from dpcli.evaluate.segmentation.protocol import compressed_over_pairs, evaluate_segmentation
from dpcli.evaluate.segmentation.rand_index import rand_index
from tests.support.evaluating import evaluate
from tests.support.parts_helpers import perfect, truth_sequence, write_parts, write_truth

TOLERANCE = 1e-6


@pytest.fixture(scope="module")
def golden(golden_file) -> dict[str, dict[str, np.ndarray]]:
    """Cases of the published metric code: inputs and outputs."""
    cases: dict[str, dict[str, np.ndarray]] = {}
    for key, value in golden_file("seg_metrics.npz").items():
        cases.setdefault(key[:6], {})[key[7:]] = value
    return cases


def seven(metrics: SegmentationMetrics) -> list[float]:
    return [getattr(metrics, key) for key in ("ap", "pq", "f1", "pre", "rec", "miou", "ri")]


def one_frame(truth, part, own, slots: int, protocol: str, ignore_below: int = 0) -> SegmentationMetrics:
    """Metrics of one frame; `own` = probability of each point's own part, the rest is spread evenly."""
    truth, part, own = np.array(truth), np.array(part), np.array(own, float)
    probability = np.repeat((1 - own)[:, None] / (slots - 1), slots, axis=1)
    probability[np.arange(len(part)), part] = own
    frame = Frame(truth, part, probability)
    return segmentation_compute(segmentation_update([frame], ignore_below=ignore_below, protocol=protocol), protocol)


A = ([0] * 5 + [1] * 3 + [2] * 2, [0, 0, 0, 0, 3, 1, 1, 3, 1, 3], [0.9, 0.9, 0.8, 0.8, 0.95, 0.7, 0.7, 0.9, 0.6, 0.85])
B = (
    [0] * 5 + [1] * 4 + [2] * 2 + [3],
    [2, 2, 2, 3, 3, 0, 0, 0, 2, 1, 1, 0],
    [0.8, 0.8, 0.8, 0.6, 0.6, 0.7, 0.7, 0.7, 0.8, 0.99, 0.99, 0.7],
)


def test_golden_cases_of_the_published_code(golden):
    assert len(golden) >= 10
    for name, case in golden.items():
        below = int(case["ignore_npoint_thresh"])
        frames = [Frame(ids, mask.argmax(1), mask) for ids, mask in zip(case["segm"], case["mask"], strict=True)]
        found = merge_statistics(
            segmentation_update([frame], ignore_below=below, protocol="release") for frame in frames
        )
        metrics = segmentation_compute(found, "release")
        np.testing.assert_allclose(seven(metrics)[:5], case["seg_scores"], atol=TOLERANCE, err_msg=name)
        np.testing.assert_allclose(found.object_iou, case["miou_per_frame"], atol=TOLERANCE, err_msg=name)
        np.testing.assert_allclose(found.object_rand, case["ri_per_frame"], atol=TOLERANCE, err_msg=name)
        for ids, mask, adjusted in zip(case["segm"], case["mask"], found.object_adjusted, strict=True):
            counts = [np.count_nonzero(ids == one) >= below for one in ids]
            expected = adjusted_rand_score(ids[counts], mask.argmax(1)[counts])
            np.testing.assert_allclose(adjusted, expected, atol=TOLERANCE, err_msg=name)
        np.testing.assert_allclose(found.iou, case["pred_iou"], atol=TOLERANCE, err_msg=name)
        np.testing.assert_allclose(found.confidence, case["confidence"], atol=TOLERANCE, err_msg=name)
        assert np.array_equal(found.matched, case["pred_matched"]), name
        assert found.truth_parts == case["n_gt_inst"], name


def test_the_fixed_protocol_differs_from_golden_only_where_it_should(golden):
    """Its mIoU differs in the cases with absent ids, F1 in the case of a part found twice, AP after drops."""
    different = {"miou": set(), "f1": set(), "ap": set()}
    for name, case in golden.items():
        below = int(case["ignore_npoint_thresh"])
        frames = [Frame(ids, mask.argmax(1), mask) for ids, mask in zip(case["segm"], case["mask"], strict=True)]
        found = segmentation_compute(merge_statistics(segmentation_update([f], ignore_below=below) for f in frames))
        expected = {"miou": case["miou_per_frame"].mean(), "f1": case["seg_scores"][2], "ap": case["seg_scores"][0]}
        for key, value in expected.items():
            if abs(getattr(found, key) - value) > TOLERANCE:
                different[key].add(name)
    assert different["miou"] <= {"case20", "case21"} and different["f1"] <= {"case22"}
    assert different["ap"] <= {f"case{n}" for n in (*range(10, 18), 22, 29)}
    assert all(different.values())


@pytest.mark.parametrize("protocol", ["dpc", "release"])
def test_worked_example_a(protocol):
    expected = [0.442244, 0.433333, 0.666667, 0.666667, 0.666667, 0.516667, 0.76]
    assert seven(one_frame(*A, 4, protocol)) == pytest.approx(expected, abs=TOLERANCE)


def test_worked_example_b():
    expected = [0.752475, 0.525, 0.75, 0.75, 0.75, 0.525, 0.791667]
    for protocol in ("dpc", "release"):
        assert seven(one_frame(*B, 4, protocol)) == pytest.approx(expected, abs=TOLERANCE)
    expected = [0.834983, 0.5, 0.8, 0.666667, 1, 0.625, 0.703704]
    assert seven(one_frame(*B, 4, "release", 3)) == pytest.approx(expected, abs=TOLERANCE)


def test_confidences_after_a_dropped_prediction():
    truth, part, own = map(np.array, B)
    probability = np.repeat((1 - own)[:, None] / 3, 4, axis=1)
    probability[np.arange(12), part] = own
    release = match_parts(truth, part, probability, ignore_below=3, release=True)
    assert release.confidence == pytest.approx([0.7, 0.003333, 0.066667], abs=TOLERANCE)
    fixed = match_parts(truth, part, probability, ignore_below=3)
    assert fixed.confidence == pytest.approx([0.7, 0.8, 0.6])
    assert fixed.iou == pytest.approx([0.75, 0.5, 0.4]) and fixed.matched.tolist() == [True, True, False]


def test_a_part_is_found_once():
    """Ten points of one part, two predicted halves of IoU exactly 0.5: the more confident one finds it."""
    halves = ([0] * 10, [0] * 5 + [1] * 5, [0.6] * 5 + [0.9] * 5)
    release, fixed = (one_frame(*halves, 2, protocol) for protocol in ("release", "dpc"))
    assert seven(release)[1:] == pytest.approx([2 / 3, 4 / 3, 1, 2, 0.5, 0.5])
    assert seven(fixed)[1:] == pytest.approx([0.5 / 1.5, 2 / 3, 0.5, 1, 0.5, 0.5])
    assert fixed.ap == 1  # the confident half comes first, with precision 1 up to recall 1
    sure = one_frame(halves[0], halves[1], [0.9] * 5 + [0.6] * 5, 2, "dpc")
    assert sure.ap == 1 and sure.true_positives == 1


def test_an_absent_id_is_no_part():
    found = [one_frame([0] * 4 + [2] * 4, [0] * 4 + [1] * 4, [0.9] * 8, 2, protocol) for protocol in ("release", "dpc")]
    assert [one.miou for one in found] == pytest.approx([2 / 3, 1])
    assert [one.ap for one in found] == [1, 1]


def test_matching_keeps_a_found_part_that_a_larger_sum_of_iou_would_lose():
    """P1 and G1 overlap with IoU 0.51; pairing each with another part sums to more, but finds nothing."""
    truth = np.array([0] * 51 + [1] * 25 + [0] * 24)
    part = np.array([0] * 51 + [0] * 25 + [1] * 24)
    match = match_parts(truth, part, np.full((100, 2), 0.5))
    iou = np.array([[51 / 100, 24 / 75], [25 / 76, 0]])
    assert iou[0, 0] < iou[0, 1] + iou[1, 0]
    assert match.matched.tolist() == [True, False] and match.iou == pytest.approx([0.51, 0.32])


def brute_matches(truth: np.ndarray, part: np.ndarray) -> int:
    """Largest number of one-to-one pairs with IoU >= 0.5, by trying all assignments."""
    sets = [[set(np.flatnonzero(ids == one)) for one in np.unique(ids[ids >= 0])] for ids in (truth, part)]
    fewer, more = sorted(sets, key=len)
    return max(
        sum(2 * len(a & b) >= len(a | b) for a, b in zip(fewer, chosen, strict=True))
        for chosen in itertools.permutations(more, len(fewer))
    )


def brute_miou(truth: np.ndarray, part: np.ndarray) -> float:
    truths, parts = ([set(np.flatnonzero(ids == one)) for one in np.unique(ids[ids >= 0])] for ids in (truth, part))
    parts += [set()] * len(truths)
    if not truths:
        return np.nan
    return max(
        np.mean([len(a & b) / len(a | b) for a, b in zip(truths, chosen, strict=True)])
        for chosen in itertools.permutations(parts, len(truths))
    )


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(-1, 3), st.integers(-1, 2)), min_size=1, max_size=16), st.integers(0, 4))
def test_one_frame_equals_brute_force(points, least):
    truth, part = np.array(points).T
    match = match_parts(truth, part, np.full((len(part), 3), 1 / 3), ignore_below=least)
    sizes = {one: int((truth == one).sum()) for one in set(truth.tolist()) - {-1}}
    ground = np.array([sizes.get(one, -1) < max(least, 0) for one in truth.tolist()])
    owners = {one: ground[part == one] for one in set(part.tolist()) - {-1}}
    dropped = [one for one, own in owners.items() if 2 * own.sum() > len(own) or own.all()]
    kept = np.where(ground | np.isin(part, dropped), -1, part)
    assert match.truth_parts == sum(size >= least for size in sizes.values())
    assert len(match.matched) == len(owners) - len(dropped)
    assert match.matched.sum() == brute_matches(np.where(ground, -1, truth), kept)
    truth, part = truth[~ground], part[~ground]
    assert mean_iou(*np.array(points).T, ignore_below=least) == pytest.approx(brute_miou(truth, part), nan_ok=True)
    agree = (truth[:, None] == truth) == (part[:, None] == part)
    found = rand_index(*np.array(points).T, ignore_below=least)
    assert found == pytest.approx(agree.mean() if len(truth) else np.nan, nan_ok=True)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 5), st.booleans()), min_size=1, max_size=30), st.integers(0, 10))
def test_average_precision_equals_its_definition(rows, missed):
    confidence, matched = np.array([c / 5 for c, _ in rows]), np.array([m for _, m in rows])
    truth = int(matched.sum()) + missed
    if truth == 0:
        assert np.isnan(average_precision(confidence, matched, truth))
        return
    points = [(matched[confidence >= t].sum() / truth, matched[confidence >= t].mean()) for t in set(confidence)]
    grid = np.linspace(0, 1, 101)
    expected = np.mean([max((p for r, p in points if r >= level), default=0) for level in grid])
    assert average_precision(confidence, matched, truth) == pytest.approx(expected, abs=1e-12)
    order = np.random.default_rng(0).permutation(len(rows))
    again = average_precision(confidence[order], matched[order], truth)
    assert again == average_precision(confidence, matched, truth)


def test_equal_confidences_depend_on_order_in_the_published_protocol_only():
    confidence, matched = np.ones(4), np.array([True, True, False, False])
    release = [average_precision(confidence, m, 2, keep_order=True) for m in (matched, matched[::-1])]
    assert release == [1, 0.5]
    assert [average_precision(confidence, m, 2) for m in (matched, matched[::-1])] == [0.5, 0.5]


def random_frames(seed: int, count: int = 4) -> list[Frame]:
    rng = np.random.default_rng(seed)
    frames = []
    for _ in range(count):
        truth = rng.integers(-1, 4, 60)
        probability = rng.dirichlet(np.ones(5) * 0.3, 60)
        right = rng.random(60) < 0.7
        part = np.where(right & (truth >= 0), truth, probability.argmax(1))
        frames.append(Frame(truth, part, probability))
    return frames


@pytest.mark.parametrize("protocol", ["dpc", "release"])
def test_shards_add_up_exactly(protocol):
    objects = [segmentation_update(random_frames(seed), ignore_below=8, protocol=protocol) for seed in range(6)]
    whole = segmentation_compute(merge_statistics(objects), protocol)
    halves = merge_statistics([merge_statistics(objects[:2]), merge_statistics(objects[2:])])
    assert segmentation_compute(halves, protocol) == whole
    with pytest.raises(DataError, match="no statistics"):
        merge_statistics([])


def test_names_of_parts_and_order_of_points_do_not_matter():
    rng = np.random.default_rng(3)
    for frame in random_frames(7):
        points, slots, ids = rng.permutation(60), rng.permutation(5), rng.permutation(9)
        renamed = np.where(frame.truth >= 0, ids[frame.truth], -1)[points]
        moved = Frame(renamed, slots[frame.part][points], frame.probability[points][:, np.argsort(slots)])
        one, other = (segmentation_compute(segmentation_update([f], ignore_below=6)) for f in (frame, moved))
        assert seven(one) == pytest.approx(seven(other), abs=1e-12)


def test_unknown_points_are_ignored_ground():
    """Appending unknown points changes nothing but the predictions that lie mostly there."""
    frame = Frame(np.array([0] * 6 + [1] * 6), np.array([0] * 6 + [1] * 6), np.full((12, 3), 1 / 3))
    more = Frame(np.append(frame.truth, [-1] * 9), np.append(frame.part, [0] * 4 + [2] * 5), np.full((21, 3), 1 / 3))
    one, other = (segmentation_compute(segmentation_update([f])) for f in (frame, more))
    assert seven(one) == seven(other) == [1] * 7
    assert (other.unknown, other.dropped, other.predictions) == (9, 1, 2)


def test_frames_without_truth_are_skipped_and_counted_or_fail_as_published():
    empty = Frame(np.full(60, -1), np.zeros(60, int), np.full((60, 5), 0.2))
    frames = random_frames(0)
    with_empty = segmentation_update([frames[0], empty, *frames[1:]])
    assert with_empty.skipped == 1 and with_empty.frames == 4
    assert seven(segmentation_compute(with_empty)) == seven(segmentation_compute(segmentation_update(frames)))
    with pytest.raises(DataError, match="frame 1 has no true part"):
        segmentation_update([frames[0], empty], protocol="release")


def test_no_prediction_at_all_is_a_score_not_a_nan():
    frame = Frame(np.array([0, 0, 1]), np.full(3, -1), np.zeros((3, 2)))
    metrics = segmentation_compute(segmentation_update([frame]))
    assert (metrics.ap, metrics.pq, metrics.f1, metrics.rec, metrics.miou) == (0, 0, 0, 0, 0)
    assert np.isnan(metrics.pre)  # 0 of 0
    assert metrics.ri == pytest.approx(5 / 9)  # one group of three: the pairs of the first part, and the diagonal


def test_published_ids_are_counted_over_a_pair_of_frames():
    frames = [np.array([1, 5, -1]), np.array([5, 5]), np.array([3, 7])]
    found = [ids.tolist() for ids in compressed_over_pairs(frames)]
    assert found == [[0, 1, -1], [1, 1], [0, 2]]
    assert compressed_over_pairs([np.array([4, 9])])[0].tolist() == [0, 1]


# ---- the protocol on files, and the command ----


def objects() -> list:
    return [truth_sequence(f"s{i}", seed=i, label=i % 2, split="train" if i == 3 else "test") for i in range(4)]


@pytest.fixture
def truths() -> list:
    return objects()


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[Path, Path]:
    """Truth of three test objects and one of training; the first predicted perfectly, the others as one part."""
    folder, truths = tmp_path_factory.mktemp("files"), objects()
    samples = [perfect(truth, 4, slots=np.array([2, 0, 3, 1])) for truth in truths[:3]]
    for sequence, probability, *_ in samples[1:]:
        sequence.part[:] = 0
        probability[:] = [0.7, 0.1, 0.1, 0.1]
    return write_parts(folder / "parts.h5", samples), write_truth(folder / "truth.h5", truths)


def run(*arguments: object):
    return evaluate("segmentation", *arguments)


def test_json_says_numbers_units_and_denominators(files):
    parts, truth = files
    found = json.loads(run(parts, "--truth", truth, "--json").stdout)
    metrics = found["metrics"]
    # 9 true parts x 3 frames of which 9 are found, by 9 of 15 predictions; the six of one part have IoU 1/3
    assert metrics["rec"] == pytest.approx(9 / 27) and metrics["pre"] == pytest.approx(9 / 15)
    assert metrics["pq"] == metrics["f1"] == pytest.approx(18 / 42)
    assert metrics["ap"] == pytest.approx(34 / 101)  # precision 1 up to recall 1/3
    each = [[np.bincount(ids).max() / len(ids) / 3 for ids in _frames(t)] for t in _truths(truth)[1:3]]
    assert metrics["miou"] == pytest.approx((1 + np.mean(each[0]) + np.mean(each[1])) / 3)
    assert set(found["units"].values()) == {"fraction"} and set(found["units"]) <= set(metrics)
    assert found["denominators"] == {
        "sequences": 3,
        "frames": 9,
        "true_parts": 27,
        "predictions": 15,
        "true_positives": 9,
        "frames_without_truth": 0,
        "predictions_on_ignored_ground": 0,
        "points_without_truth": 0,
    }
    assert found["protocol"]["name"] == "dpc" and len(found["protocol"]["fixes"]) == 5
    assert [(row["name"], row["sequences"]) for row in metrics["per_class"]] == [("door", 2), ("lamp", 1)]


def _truths(path: Path) -> list:
    from dpcli.store import CloudsReader

    with CloudsReader(path) as reader:
        return [reader.read(index) for index in range(len(reader))]


def _frames(sequence) -> list[np.ndarray]:
    return np.split(sequence.part, sequence.frame_offsets[1:-1])


def test_release_protocol_on_a_file(tmp_path):
    """A part that is gone in the second of three frames: release scores it 0 there, dpc leaves it out."""
    truth = truth_sequence("x", frames=3)
    ids = _frames(truth)
    ids[1][ids[1] == 1] = 2
    truth.part = np.concatenate(ids)
    parts, path = write_parts(tmp_path / "p.h5", [perfect(truth, 4)]), write_truth(tmp_path / "t.h5", [truth])
    assert evaluate_segmentation(parts, path).main.miou == 1
    found = evaluate_segmentation(parts, path, protocol="release").main
    assert found.miou == pytest.approx((1 + 2 / 3 + 1) / 3) and found.ap == 1


def test_table_markdown_and_notes(files):
    parts, truth = files
    text = run(parts, "--truth", truth).stdout
    assert "42.9 %" in text and "33.3 %" in text and "60.0 %" in text and "0 door" in text and "1 lamp" in text
    assert "9 found of 27 true parts, 15 predictions, pooled over 9 frames" in text
    assert "matched one to one" in text and "release" in text
    release = run(parts, "--truth", truth, "--protocol", "release").stdout
    assert "as the published code" in release and "one to one" not in release
    row = next(line for line in run(parts, "--truth", truth, "--markdown").stdout.splitlines() if "| all" in line)
    assert [cell.strip() for cell in row.strip("|").split("|")][:6] == ["all", "3", "9", "27", "15", "9"]


def test_small_true_parts_can_be_ignored(files):
    parts, truth = files
    found = json.loads(run(parts, "--truth", truth, "--ignore-below", 14, "--json").stdout)
    sizes = np.array([np.bincount(ids, minlength=3) for t in _truths(truth)[:3] for ids in _frames(t)])
    assert 0 < (sizes < 14).sum() < sizes.size  # sizes of 13 and 14 points occur
    assert found["denominators"]["true_parts"] == (sizes >= 14).sum()
    result = run(parts, "--truth", truth, "--ignore-below", 1000)
    assert isinstance(result.exception, DataError) and "not one frame has a true part of at least 1000" in str(
        result.exception
    )
    result = run(parts, "--truth", truth, "--ignore-below", 1000, "--protocol", "release")
    assert "s0: frame 0 has no true part" in str(result.exception)


def test_a_pipe_gives_the_same(files):
    parts, truth = files
    piped = evaluate("segmentation", "-", "--truth", truth, "--json", stdin=parts.read_bytes())
    found = json.loads(piped.stdout)
    assert found["metrics"] == json.loads(run(parts, "--truth", truth, "--json").stdout)["metrics"]


def test_split_and_intersect(files, tmp_path, truths):
    parts, truth = files
    result = run(parts, "--truth", truth, "--split", "all")
    assert "has no 's3' of split 'all'" in str(result.exception) and "--intersect" in str(result.exception)
    found = json.loads(run(parts, "--truth", truth, "--split", "all", "--intersect", "--json").stdout)
    assert found["left_out"] == [{"reason": "not predicted", "count": 1, "names": ["s3"]}]
    assert "no sequence of split 'train'" in str(
        run(parts, "--truth", truth, "--split", "train", "--intersect").exception
    )
    fewer = write_truth(tmp_path / "fewer.h5", truths[1:])
    assert "has no 's0', which" in str(run(parts, "--truth", fewer).exception)
    text = run(parts, "--truth", fewer, "--intersect").stdout
    assert "the truth doesn't have: 1 sequence (s0)" in text


def test_files_that_do_not_fit_name_the_first_difference(files, tmp_path, truths):
    parts, truth = files

    def said(change) -> str:
        changed = [truth_sequence(t.name, seed=i, label=i % 2) for i, t in enumerate(truths[:3])]
        changed[1] = change(changed[1])
        path = write_truth(tmp_path / "changed.h5", changed, force=True)
        error = run(parts, "--truth", path).exception
        assert isinstance(error, DataError) and "'s1'" in str(error)
        return str(error)

    assert "has 3 frames, 4 in" in said(lambda t: truth_sequence("s1", frames=4))
    assert "has 40 points in frame 0, 30 in" in said(lambda t: truth_sequence("s1", points=30))

    def move(sequence):
        sequence.points[45, 1] += 0.5
        return sequence

    assert "point 5 of frame 1 at (" in said(move)


def test_wrong_files_and_options_are_explained(files, tmp_path, truths):
    parts, truth = files
    assert "holds 'clouds', expected 'parts'" in str(run(truth, "--truth", truth).exception)
    plain = write_truth(tmp_path / "plain.h5", truths, fields=["pose"])
    assert f"{plain}: no part in it, so it can't be the truth" in str(run(parts, "--truth", plain).exception)
    for wrong in (("--protocol", "x"), ("--json", "--markdown"), ("--picture", tmp_path / "x.bmp")):
        result = run(parts, "--truth", truth, *wrong)
        assert isinstance(result.exception, UsageError) and result.stdout == ""
    assert "--truth FILE is missing" in str(run(parts).exception)


def test_a_truth_perfectly_predicted_scores_one_and_a_broken_twin_less(tmp_path, truths):
    samples = [perfect(truth, 4) for truth in truths]
    path = write_truth(tmp_path / "t.h5", truths)
    good = write_parts(tmp_path / "good.h5", samples)
    assert seven(evaluate_segmentation(good, path, split="all").main) == [1] * 7
    samples[2][0].part[7] = (samples[2][0].part[7] + 1) % 3
    broken = evaluate_segmentation(write_parts(tmp_path / "bad.h5", samples), path, split="all").main
    assert 0.99 < broken.miou < 1 and 0.99 < broken.ri < 1 and broken.pq < 1 and broken.f1 == 1


def test_picture(files, tmp_path):
    from PIL import Image

    parts, truth = files
    assert run(parts, "--truth", truth, "--picture", tmp_path / "a.png").exit_code == 0
    with Image.open(tmp_path / "a.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert (pixels[..., 2] > pixels[..., 0] + 60).mean() > 0.005  # bars
    shutil.copy(tmp_path / "a.png", tmp_path / "first.png")
    run(parts, "--truth", truth, "--picture", tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "first.png").read_bytes()
