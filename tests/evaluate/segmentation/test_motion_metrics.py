"""Flow and part motion metrics against golden values, hand-worked examples and group action; the command."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpcli.errors import DataError
from dpcli.evaluate.results import merge_statistics
from dpcli.evaluate.segmentation.motion_metrics import FlowShares, flow_update, motion_compute, part_motion_update
from dpcli.evaluate.segmentation.rigid_motion import rotation_angle, true_flow, true_motion
from tests.support.evaluating import evaluate
from tests.support.parts_helpers import CHAIN, perfect, rigid, rotation, truth_sequence, write_parts, write_truth

TOLERANCE = 1e-6


def test_golden_cases_of_the_published_code(golden_file) -> None:
    arrays = golden_file("seg_metrics.npz")
    cases = sorted({key[:6] for key in arrays})
    for case in cases:
        pairs = zip(arrays[f"{case}_pred_flow"], arrays[f"{case}_gt_flow"], strict=True)
        metrics = motion_compute(merge_statistics(flow_update(*pair) for pair in pairs))
        found = metrics.shares[float(arrays[f"{case}_epe_norm_thresh"])]
        values = [metrics.epe3d, found.accs, found.accr, found.outlier]
        np.testing.assert_allclose(values, arrays[f"{case}_flow_scores"], atol=TOLERANCE, err_msg=case)
    assert len(cases) >= 10


def test_worked_example() -> None:
    truth = np.array([[0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.02], [1, 0, 0], [0, 0, 0]])
    said = np.array([[0.105, 0, 0], [0, 0.23, 0], [0, 0, 0], [1.04, 0, 0], [0, 0, 0.008]])
    metrics = motion_compute(flow_update(said, truth))
    assert metrics.epe3d == pytest.approx(0.0206) and metrics.still == pytest.approx(1.32 / 5)
    assert metrics.shares == {0.01: FlowShares(0.6, 0.6, 0.6), 0.05: FlowShares(1, 1, 0.6)}


def test_the_same_motion_for_all_is_that_flow() -> None:
    """Flow of a point of part s is pose[j,s] inv(pose[i,s]) p - p: check against points tracked in part frames."""
    rng = np.random.default_rng(0)
    pose = np.array([[rigid(rng) for _ in range(3)] for _ in range(2)])
    part, local = rng.integers(0, 3, 30), rng.normal(size=(30, 3))
    world = [np.array([(pose[t, s] @ [*p, 1])[:3] for s, p in zip(part, local, strict=True)]) for t in range(2)]
    flow = true_flow(world[0], part, true_motion(pose, 0, 1))
    np.testing.assert_allclose(flow, world[1] - world[0], atol=1e-12)
    backwards = true_flow(world[1], part, true_motion(pose, 1, 0))
    np.testing.assert_allclose(backwards, -flow, atol=1e-12)


def test_a_flow_seen_from_elsewhere_has_the_same_errors() -> None:
    rng = np.random.default_rng(1)
    said, truth = rng.normal(size=(2, 50, 3)) * 0.05
    turned = rotation(rng)
    one, other = (
        motion_compute(flow_update(said, truth)),
        motion_compute(flow_update(said @ turned.T, truth @ turned.T)),
    )
    assert one.epe3d == pytest.approx(other.epe3d) and one.shares == other.shares


def test_every_point_counts_the_same_and_batches_are_the_published_way() -> None:
    """Seven pairs of error 1, the last of error 8: published, the last batch of one pair weighs as much as six."""
    truth = np.zeros((4, 3))
    pairs = [flow_update(truth + [error, 0, 0], truth) for error in (1, 1, 1, 1, 1, 1, 8)]
    merged = merge_statistics(pairs)
    assert motion_compute(merged).epe3d == pytest.approx(14 / 7)
    assert motion_compute(merged, batch=6).epe3d == pytest.approx((1 + 8) / 2)
    ragged = merge_statistics([flow_update(np.ones((30, 3)), np.zeros((30, 3))), flow_update(truth[:2], truth[:2])])
    assert motion_compute(ragged).epe3d == pytest.approx(30 * np.sqrt(3) / 32)


def test_shards_add_up_exactly() -> None:
    rng = np.random.default_rng(2)
    pairs = [flow_update(*rng.normal(size=(2, n, 3))) for n in (5, 9, 1, 30, 2)]
    whole = motion_compute(merge_statistics(pairs))
    halves = merge_statistics([merge_statistics(pairs[:2]), merge_statistics(pairs[2:])])
    assert motion_compute(halves).shares == whole.shares
    with pytest.raises(DataError, match="no statistics"):
        merge_statistics([])


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.3, 2.0, np.pi])
def test_rotation_angle(angle: float) -> None:
    rng = np.random.default_rng(4)
    first = rotation(rng)
    second = first @ rotation(rng, angle)
    assert rotation_angle(first[None], second[None])[0] == pytest.approx(angle, abs=1e-7)
    many = Rotation.random(200, random_state=0)  # rounding takes some half turns' chords above 1
    turned = Rotation.from_rotvec(angle * Rotation.random(200, random_state=1).apply([1.0, 0, 0])) * many
    assert rotation_angle(many.as_matrix(), turned.as_matrix()) == pytest.approx(np.full(200, angle), abs=1e-7)


def test_part_motions_by_hand() -> None:
    """Part 0 has 0.2 rad too much about its centroid, part 1 is 0.5 off, part 2 has no prediction."""
    rng = np.random.default_rng(5)
    points, truth = rng.normal(size=(60, 3)), np.arange(60) % 3
    real = np.array([rigid(rng) for _ in range(3)])
    centroid, extra = points[truth == 0].mean(axis=0), np.eye(4)
    extra[:3, :3] = rotation(rng, 0.2)
    extra[:3, 3] = centroid - extra[:3, :3] @ centroid
    shifted = real[1].copy()
    shifted[:3, 3] += [0.3, 0.4, 0]
    said = np.array([np.eye(4), shifted, np.eye(4), real[0] @ extra])
    part = np.choose(truth, [3, 1, -1])
    found = part_motion_update(points, truth, part, real, said)
    assert found.rotation == pytest.approx([0.2, 0], abs=1e-7) and found.displacement == pytest.approx([0, 0.5])
    assert found.unmatched == 1
    alone = motion_compute(found)  # motions without any flow
    assert np.isnan([alone.epe3d, alone.still, alone.shares[0.05].accs]).all() and alone.rotation == pytest.approx(0.1)
    unknown = part_motion_update(points, np.where(truth == 1, -1, truth), part, real, said)
    assert unknown.rotation == pytest.approx([0.2]) and unknown.unmatched == 1


@pytest.mark.parametrize("seed", range(30))
def test_part_motions_are_those_of_the_best_of_all_pairings(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, truth, part = rng.normal(size=(24, 3)), rng.integers(-1, 4, 24), rng.integers(0, 4, 24)
    part = np.where(rng.random(24) < 0.4, (truth + 2) % 4, part)
    part = np.where(part == 3, 0, part) if seed % 2 else part  # fewer predictions than parts
    real, said = (np.array([rigid(rng) for _ in range(4)]) for _ in range(2))
    sides = [{k: set(np.flatnonzero((ids == k) & (truth >= 0))) for k in range(4)} for ids in (truth, part)]
    iou = np.array([[len(a & b) / max(len(a | b), 1) for b in sides[1].values()] for a in sides[0].values()])
    pairings = sorted((iou[range(4), order].sum(), order) for order in itertools.permutations(range(4)))
    found = part_motion_update(points, truth, part, real, said)
    expected = []
    for g, p in enumerate(pairings[-1][1]):
        if iou[g, p] > 0:
            center = np.append(points[truth == g].mean(0), 1)
            turn = Rotation.from_matrix(real[g, :3, :3] @ said[p, :3, :3].T).magnitude()
            expected.append((turn, np.linalg.norm(real[g] @ center - said[p] @ center)))
    if pairings[-1][0] - pairings[-2][0] > 1e-9:  # else more than one is best
        assert np.stack([found.rotation, found.displacement], 1) == pytest.approx(np.array(expected), abs=1e-6)
        assert found.unmatched == sum(map(bool, sides[0].values())) - len(expected)


def test_bad_poses_and_shapes_are_said() -> None:
    pose = np.tile(np.eye(4), (2, 1, 1, 1))
    pose[0, 0, 0, 0] = 0
    with pytest.raises(DataError, match="frame 0 or 1 is not finite or can't be inverted"):
        true_motion(pose, 0, 1)
    with pytest.raises(DataError, match="expected \\(points, 3\\) twice"):
        flow_update(np.zeros((3, 3)), np.zeros((4, 3)))


# ---- the protocol on files, and the command ----


@pytest.fixture
def truths() -> list:
    return [truth_sequence(f"s{i}", seed=i, label=i % 2, pad=4) for i in range(3)]


def run(*arguments: object):
    return evaluate("motion", *arguments)


def test_the_truth_has_no_error_and_a_broken_twin_has(tmp_path, truths) -> None:
    truth = write_truth(tmp_path / "t.h5", truths)
    samples = [perfect(one, 4) for one in truths]
    found = json.loads(run(write_parts(tmp_path / "a.h5", samples), "--truth", truth, "--json").stdout)
    metrics = found["metrics"]
    assert metrics["epe3d"] < 1e-6 and metrics["part_rotation"] < 1e-4 and metrics["part_displacement"] < 1e-6
    assert (metrics["accs"], metrics["accr"], metrics["outlier"]) == (1, 1, 0)
    assert metrics["epe3d_no_motion"] > 0.1
    assert found["units"]["epe3d"] == "m" and set(found["units"]) - {"tau"} <= set(metrics)
    points = sum(len(flow) for *_, flows in samples for flow in flows)
    assert found["denominators"] == {
        "sequences": 3,
        "pairs": 9,
        "points": points,
        "true_part_motions": 27,
        "unmatched_part_motions": 0,
        "points_without_truth": 0,
        "pairs_without_truth": 0,
    }
    for *_, flows in samples:  # source and target exchanged
        flows[:] = [-flow for flow in flows]
    broken = json.loads(run(write_parts(tmp_path / "b.h5", samples), "--truth", truth, "--json").stdout)
    assert broken["metrics"]["epe3d"] == pytest.approx(2 * metrics["epe3d_no_motion"], rel=1e-5)


def test_protocols_and_thresholds(tmp_path, truths) -> None:
    """An error of 0.02 everywhere: within tau 0.05, between 0.01 and 2 x 0.01 only where the flow is long."""
    samples = [perfect(one, 4) for one in truths]
    for *_, flows in samples:
        flows[:] = [flow + np.float32([0.02, 0, 0]) for flow in flows]
    parts = write_parts(tmp_path / "a.h5", samples)
    truth = write_truth(tmp_path / "t.h5", truths)
    dpc_, release = (
        json.loads(run(parts, "--truth", truth, "--json", "--protocol", name, "--resamples", 0).stdout)
        for name in ("dpc", "release")
    )
    assert (dpc_["protocol"]["tau"], release["protocol"]["tau"]) == (0.05, 0.01)
    assert dpc_["metrics"]["accs"] == 1 > release["metrics"]["accs"]
    both = dpc_["metrics"]["thresholds"]
    assert [row["tau"] for row in both] == [0.01, 0.05] and both[1]["accs"] == 1 > both[0]["accs"]
    assert dpc_["metrics"]["epe3d"] == pytest.approx(0.02, abs=1e-6)
    assert [row["name"] for row in dpc_["metrics"]["per_class"]] == ["door", "lamp"]


@pytest.mark.parametrize(("unit", "meters"), [("mm", 1e-3), ("ft", 0.3048), ("object diameter", 1.0)])
def test_thresholds_are_meters_in_every_known_unit(unit, meters, tmp_path, truths) -> None:
    """Errors of 0.012, 0.07 or 0.4 m: the same points count whatever unit the files are in."""

    def measured(place, scale, length_unit):
        samples = []
        for one, error in zip(truths, (0.012, 0.07, 0.4), strict=True):
            sequence, probability, pairs, motion, flows = perfect(one, 4)
            motion, flows = motion.copy(), [(flow + np.float32([error, 0, 0])) * np.float32(scale) for flow in flows]
            motion[..., :3, 3] *= scale
            sequence.points = one.points * np.float32(scale)
            samples.append((sequence, probability, pairs, motion, flows))
        scaled = [replace(one, points=one.points * np.float32(scale), pose=one.pose.copy()) for one in truths]
        for one in scaled:
            one.pose[..., :3, 3] *= scale
        parts = write_parts(tmp_path / f"{place}-p.h5", samples, length_unit=length_unit)
        truth = write_truth(tmp_path / f"{place}-t.h5", scaled, length_unit=length_unit)
        return json.loads(run(parts, "--truth", truth, "--json", "--resamples", 0).stdout)

    meter, other = measured("m", 1.0, "m"), measured("other", 1 / meters, unit)
    assert meter["metrics"]["thresholds"] == other["metrics"]["thresholds"]
    assert 0.2 < meter["metrics"]["accs"] < meter["metrics"]["accr"] < 1
    assert other["metrics"]["epe3d"] * meters == pytest.approx(meter["metrics"]["epe3d"], rel=1e-5)
    assert (other["units"]["epe3d"], other["units"]["tau"]) == (unit, "m" if unit in ("mm", "ft") else unit)


def test_table_says_of_what(tmp_path, truths) -> None:
    parts = write_parts(tmp_path / "a.h5", [perfect(one, 4) for one in truths])
    truth = write_truth(tmp_path / "t.h5", truths)
    text = run(parts, "--truth", truth).stdout
    assert "9 frame pairs of 3 sequences; means over all points" in text and "EPE3D (m)" in text
    assert "AccS 0.01" in text and "Outlier 0.05" in text and "rotation error (deg)" in text and "100.0 %" in text
    assert "| all | 9 |" in run(parts, "--truth", truth, "--markdown").stdout
    assert "6 pairs" in run(parts, "--truth", truth, "--protocol", "release", "--resamples", 0).stdout
    assert run(parts, "--truth", truth, "--picture", tmp_path / "p.png").exit_code == 0
    assert (tmp_path / "p.png").stat().st_size > 10_000


def test_points_without_a_true_part_do_not_count(tmp_path, truths) -> None:
    samples = [perfect(one, 4) for one in truths]
    samples[0][4][0][:7] += 100  # wrong flow, where the truth is unknown
    truths[0].part[:7] = -1
    found = json.loads(
        run(write_parts(tmp_path / "a.h5", samples), "--truth", write_truth(tmp_path / "t.h5", truths), "--json").stdout
    )
    assert found["metrics"]["epe3d"] < 1e-6 and found["denominators"]["points_without_truth"] == 7


def test_sequences_without_pairs_are_listed_or_explained(tmp_path, truths) -> None:
    none = np.zeros((0, 2), np.int32)
    samples = [perfect(one, 4, none if i else CHAIN) for i, one in enumerate(truths)]
    truth = write_truth(tmp_path / "t.h5", truths)
    found = json.loads(run(write_parts(tmp_path / "a.h5", samples), "--truth", truth, "--json").stdout)
    assert found["left_out"] == [{"reason": "no frame pair predicted", "count": 2, "names": ["s1", "s2"]}]
    bare = write_parts(tmp_path / "b.h5", [perfect(one, 4, none) for one in truths])
    assert "holds no frame pairs" in str(run(bare, "--truth", truth).exception)


def test_a_truth_without_good_poses_is_explained(tmp_path, truths) -> None:
    parts = write_parts(tmp_path / "a.h5", [perfect(one, 4) for one in truths])
    plain = write_truth(tmp_path / "plain.h5", truths, fields=["part"])
    assert f"{plain}: no pose in it, nor scene_flow" in str(run(parts, "--truth", plain).exception)
    broken = write_truth(tmp_path / "nan.h5", truths)
    with h5py.File(broken, "r+") as file:
        file["pose"][4, 2] = np.nan  # of s1
    result = run(parts, "--truth", broken)
    assert isinstance(result.exception, DataError) and f"{broken}: sample 's1': pose holds NaN" in str(result.exception)
    truths[1].part[3] = 9
    few = write_truth(tmp_path / "few.h5", truths)
    assert "part 9, but there are poses of 4 parts" in str(run(parts, "--truth", few).exception)


# ---- a truth that knows the flow of points, not the poses of parts ----


def scene_flow(truth) -> np.ndarray:
    """Each frame's displacement to the next, the last one's to the frame before, point by point from the poses."""
    rows = []
    for t in range(truth.num_frames):
        other = t + 1 if t + 1 < truth.num_frames else t - 1
        for point, part in zip(truth.frame(t), truth.part[truth.frame_offsets[t] : truth.frame_offsets[t + 1]]):
            moved = truth.pose[other, part] @ np.linalg.inv(truth.pose[t, part]) @ [*point, 1]
            rows.append(moved[:3] - point)
    return np.float32(rows)


def noisy(truths: list, pairs: np.ndarray = CHAIN) -> list:
    rng = np.random.default_rng(3)
    samples = [perfect(one, 4, pairs) for one in truths]
    for *_, flows in samples:
        flows[:] = [flow + np.float32(rng.normal(size=flow.shape) * 0.05) for flow in flows]
    return samples


@pytest.mark.parametrize("protocol", ["dpc", "release"])
def test_scene_flow_as_truth_gives_the_numbers_of_the_poses(tmp_path, truths, protocol) -> None:
    """On pairs f -> f + 1; the same predictions against poses, with those pairs alone, are the other side."""
    forward = np.array([[0, 1], [1, 2]], np.int32)
    known = write_truth(tmp_path / "pose.h5", truths)
    for one in truths:
        one.scene_flow = scene_flow(one)
    flow = write_truth(tmp_path / "flow.h5", truths, fields=["scene_flow"])  # not even parts
    parts = write_parts(tmp_path / "a.h5", noisy(truths))
    samples = noisy(truths)
    kept = [(*own[:2], forward, own[3][:2], own[4][:2]) for own in samples]
    only = write_parts(tmp_path / "b.h5", kept)
    options = ("--json", "--protocol", protocol, "--resamples", 100)
    ours, theirs = (
        json.loads(run(*pair, *options).stdout) for pair in ((parts, "--truth", flow), (only, "--truth", known))
    )
    for key in ("epe3d", "epe3d_no_motion", "accs", "accr", "outlier"):
        assert ours["metrics"][key] == pytest.approx(theirs["metrics"][key], rel=1e-5), key
        assert ours["intervals"]["metrics"][key] == pytest.approx(theirs["intervals"]["metrics"][key], rel=1e-5), key
    assert ours["protocol"]["true_flow"] == "scene_flow, frame f to f + 1" and ours["metrics"]["part_rotation"] is None
    counts = ours["denominators"]
    assert counts["points"] == theirs["denominators"]["points"] and counts["true_part_motions"] == 0
    assert (counts["pairs"], counts["pairs_without_truth"]) == (6, 3)
    table = run(parts, "--truth", flow, "--protocol", protocol, "--resamples", 100).stdout
    assert "frame pairs other than f -> f + 1: 3" in table and "matched parts" not in table and "rotation" not in table


def test_flow_of_the_wrong_direction_scores_worse(tmp_path, truths) -> None:
    samples = noisy(truths)
    for one in truths:
        one.scene_flow = scene_flow(one)
    truth = write_truth(tmp_path / "flow.h5", truths, fields=["part", "scene_flow"])
    good = json.loads(run(write_parts(tmp_path / "a.h5", samples), "--truth", truth, "--json").stdout)["metrics"]
    for *_, flows in samples:
        flows[:] = [-flow for flow in flows]
    bad = json.loads(run(write_parts(tmp_path / "b.h5", samples), "--truth", truth, "--json").stdout)["metrics"]
    assert good["epe3d"] < 0.1 < good["epe3d_no_motion"] < bad["epe3d"] and bad["accr"] < 0.2 < good["accr"]


def test_scene_flow_tells_of_no_other_pairs(tmp_path, truths) -> None:
    for one in truths:
        one.scene_flow = scene_flow(one)
    truth = write_truth(tmp_path / "flow.h5", truths, fields=["scene_flow"])
    back = np.array([[2, 1], [0, 2]], np.int32)
    result = run(write_parts(tmp_path / "a.h5", [perfect(one, 4, back) for one in truths]), "--truth", truth)
    assert "none of its 6 frame pairs is f -> f + 1" in str(result.exception)
    some = [perfect(one, 4, CHAIN if n else back) for n, one in enumerate(truths)]
    found = json.loads(run(write_parts(tmp_path / "b.h5", some), "--truth", truth, "--json").stdout)
    assert found["left_out"] == [{"reason": "no frame pair f -> f + 1 predicted", "count": 1, "names": ["s0"]}]
    both = write_truth(tmp_path / "both.h5", truths, fields=["part", "pose", "scene_flow"])
    found = json.loads(run(tmp_path / "b.h5", "--truth", both, "--json").stdout)  # poses tell of all pairs
    assert found["denominators"]["pairs"] == 8 and found["denominators"]["pairs_without_truth"] == 0
    with h5py.File(truth, "r+") as file:
        file["scene_flow"][130:133, 1] = np.nan  # of s1, frame 0: each has 40 + 41 + 42 points
    result = run(tmp_path / "b.h5", "--truth", truth)
    assert isinstance(result.exception, DataError) and "sample 's1': scene_flow holds NaN" in str(result.exception)
