"""Classical baselines: known motions are found, the same ids stay through the frames, odd input has an answer."""

from __future__ import annotations

import re
import time
import tracemalloc
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from sklearn.metrics import rand_score

from dpcli.errors import DataError, UsageError
from dpcli.segment.baselines.classical import classical_labels
from dpcli.segment.baselines.settings import METHODS, ClassicalSettings
from dpcli.segment.baselines.subspace import eigengap, sparse_affinity, spectral_parts, trajectory_affinity
from dpcli.segment.baselines.trajectories import consistent_labels, follow, residual_motion

Toy = tuple[list[np.ndarray], list[np.ndarray], dict]


@pytest.fixture(autouse=True)
def no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def box_surface(rng: np.random.Generator, count: int, size: tuple, center: tuple) -> np.ndarray:
    size = np.array(size)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    axis = rng.choice(3, count, p=(1 / size) / (1 / size).sum())
    points[np.arange(count), axis] = rng.choice([-0.5, 0.5], count)
    return points * size + center


def two_boxes(
    *, gap: float = 0.0, frames: int = 4, points: int = 300, turn: float = 0.0, move: float = 0.7, noise: float = 0.0
) -> Toy:
    """A box on another, which turns about a vertical axis beside it; all turn about a random axis by `turn` per frame.

    Frames are sampled independently; flows between all ordered pairs are exact but for `noise`.
    """
    rng = np.random.default_rng(0)
    pivot = np.array([-0.5, 0.0, 0.0])
    clouds, truth, pose = [], [], np.tile(np.eye(4), (frames, 2, 1, 1))
    for t in range(frames):
        whole = Rotation.from_rotvec(turn * rng.standard_normal(3)).as_matrix()
        swing = Rotation.from_rotvec([0, 0, move * t]).as_matrix()
        pose[t, 0, :3, :3], pose[t, 1, :3, :3] = whole, whole @ swing
        pose[t, 1, :3, 3] = whole @ (pivot - swing @ pivot)
        upper = (np.arange(points) % 5 < 2).astype(int)
        rest = box_surface(rng, points, (0.7, 0.5, 0.3), (0, 0, -0.15 - gap / 2))
        rest[upper == 1] = box_surface(rng, points, (0.6, 0.4, 0.2), (0, 0, 0.1 + gap / 2))[upper == 1]
        clouds.append(moved(pose[t, upper], rest))
        truth.append(upper)
    flows = {}
    for t in range(frames):
        for u in set(range(frames)) - {t}:
            motion = pose[u] @ np.linalg.inv(pose[t])
            flow = moved(motion[truth[t]], clouds[t]) - clouds[t] + noise * rng.standard_normal((points, 3))
            flows[t, u] = flow.astype(np.float32)
    return [cloud.astype(np.float32) for cloud in clouds], truth, flows


def moved(matrices: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", matrices[:, :3, :3], points) + matrices[:, :3, 3]


def labels_of(toy: Toy, method: str, num_parts: int | None = None, **options: object) -> list[np.ndarray]:
    settings = ClassicalSettings(method=method, parts=num_parts, **options)
    return classical_labels(toy[0], toy[2], settings, rng=np.random.default_rng(1))


def rand_index(found: list[np.ndarray], truth: list[np.ndarray]) -> float:
    """Over all frames at once, so that ids must agree between frames, too."""
    return rand_score(np.concatenate(truth), np.concatenate(found))


@pytest.mark.parametrize(
    ("method", "options", "estimated"),
    [
        ("dbscan", {"motion": "flow", "eps": 0.2}, 0.9),
        ("ward", {"motion": "flow", "motion_weight": 2.0, "threshold": 0.5}, 0.9),
        ("ssc", {}, 0.9),
        ("trajaffn", {}, 0.85),  # splits the turning box, whose points move differently
    ],
)
def test_motion_tells_touching_parts_apart(method: str, options: dict, estimated: float) -> None:
    toy = two_boxes(noise=0.01)
    assert rand_index(labels_of(toy, method, **options), toy[1]) > estimated
    assert rand_index(labels_of(toy, method, 2, **options), toy[1]) > 0.9


def test_coordinates_alone_need_a_gap() -> None:
    touching, apart = two_boxes(), two_boxes(gap=0.3, move=0.3)
    assert rand_index(labels_of(apart, "dbscan", eps=0.2), apart[1]) == 1
    assert rand_index(labels_of(apart, "ward", 2), apart[1]) > 0.9
    assert all(len(np.unique(found)) == 1 for found in labels_of((touching[0][:1], [], {}), "dbscan", eps=0.2))
    assert rand_index(labels_of((touching[0][:1], [], {}), "ward", 2), touching[1][:1]) < 0.8


def test_motion_of_the_whole_hides_parts_unless_it_is_removed() -> None:
    toy = two_boxes(turn=1.0, move=0.2)
    assert rand_index(labels_of(toy, "trajaffn", 2), toy[1]) > 0.9
    assert rand_index(labels_of(toy, "trajaffn", 2, motion="flow"), toy[1]) < 0.9
    assert rand_index(labels_of(toy, "ssc", 2), toy[1]) > 0.9  # affine subspaces stay what they are


@pytest.mark.parametrize("method", METHODS)
def test_ids_stay_and_equal_work_gives_equal_labels(method: str) -> None:
    toy = two_boxes(points=150, noise=0.02, move=0.4)
    first, again = labels_of(toy, method), labels_of(toy, method)
    for a, b, cloud in zip(first, again, toy[0], strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == np.int64 and a.shape == (len(cloud),) and a.min() >= 0 and a.max() < 8
    assert np.bincount(first[0]).argmax() == 0


@pytest.mark.parametrize("method", METHODS)
def test_one_motion_is_one_part_for_the_motion_methods(method: str) -> None:
    toy = two_boxes(turn=0.5, move=0.0, frames=3)
    found = labels_of(toy, method)
    if method in ("ssc", "trajaffn"):
        assert all((labels == 0).all() for labels in found)
    assert all(len(np.unique(labels)) == 1 for labels in labels_of(toy, method, 1))
    if method != "dbscan":
        assert all(len(np.unique(labels)) == 3 for labels in labels_of(toy, method, 3))


@pytest.mark.parametrize("method", METHODS)
@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 99),
    counts=st.lists(st.sampled_from([0, 1, 2, 3, 5, 9, 12]), min_size=1, max_size=3),
    kind=st.sampled_from(["random", "equal", "still", "two", "line"]),
    num_parts=st.sampled_from([None, 1, 2, 7]),
    missing=st.booleans(),
)
def test_odd_input_has_an_answer(
    method: str, seed: int, counts: list[int], kind: str, num_parts: int | None, missing: bool
) -> None:
    rng = np.random.default_rng(seed)
    frames = [rng.standard_normal((count, 3)).astype(np.float32) for count in counts]
    if kind == "equal":
        frames = [np.full_like(frame, 3.3) for frame in frames]
    if kind == "two":
        frames = [np.sign(frame[:, :1]) * np.ones(3, np.float32) for frame in frames]
    if kind == "line":
        frames = [frame * np.array([1, 0, 0], np.float32) for frame in frames]
    pairs = [(t, u) for t in range(len(frames)) for u in range(len(frames)) if t != u and not (missing and t > u)]
    flows = {(t, u): np.zeros_like(frames[t]) + rng.standard_normal(3).astype(np.float32) for t, u in pairs}
    if kind != "still":
        flows = {pair: flow + rng.standard_normal(flow.shape).astype(np.float32) for pair, flow in flows.items()}
    found = classical_labels(frames, flows, ClassicalSettings(method=method, parts=num_parts), rng=rng)
    for labels, frame in zip(found, frames, strict=True):
        assert labels.shape == (len(frame),)
        assert ((labels >= 0) & (labels < (num_parts or 8))).all()


@pytest.mark.parametrize("method", METHODS)
def test_large_frames_are_cut_in_a_sample(method: str) -> None:
    toy = two_boxes(points=3000, frames=2, noise=0.005)
    whole = labels_of(toy, method, 2, max_points=300)
    assert [len(labels) for labels in whole] == [3000, 3000]
    if method in ("ssc", "trajaffn"):
        assert rand_index(whole, toy[1]) > 0.9


@pytest.mark.parametrize("method", METHODS)
def test_is_fast(method: str) -> None:
    toy = two_boxes(points=512, noise=0.02)
    labels_of(toy, method)
    start = time.process_time()
    labels_of(toy, method)
    assert time.process_time() - start < 4 * 1.0  # measured 0.02..0.5 s for 4 frames, a core to itself


def test_follow_chains_what_is_missing() -> None:
    toy = two_boxes(points=500, move=0.2)
    adjacent = {pair: flow for pair, flow in toy[2].items() if abs(pair[0] - pair[1]) == 1}
    for t in range(4):
        exact, chained = follow(toy[0], toy[2], t), follow(toy[0], adjacent, t)
        assert exact.shape == chained.shape == (500, 3, 3)
        np.testing.assert_allclose(exact, np.stack([toy[2][t, u] for u in range(4) if u != t], 1), atol=1e-6)
        still = exact + np.linalg.norm(exact, axis=2).max()  # what not following at all would be wrong by
        assert np.abs(chained - exact).mean() < 0.02 < np.abs(still - exact).mean()
    assert follow(toy[0], {(0, 1): toy[2][0, 1]}, 2).shape == (500, 0, 3)


def test_residual_motion_is_that_of_the_smaller_part() -> None:
    toy = two_boxes(turn=0.7)
    residual = residual_motion(toy[0][0], follow(toy[0], toy[2], 0))
    lengths = np.linalg.norm(residual, axis=2)
    assert lengths[toy[1][0] == 0].max() < 0.01 < lengths[toy[1][0] == 1].min()


def test_consistent_labels_undo_a_permutation_and_name_what_is_new() -> None:
    toy = two_boxes(move=0.2)
    shuffled = [(labels + t) % 2 for t, labels in enumerate(toy[1])]
    for flows in (toy[2], {pair: flow for pair, flow in toy[2].items() if pair[0] > pair[1]}):
        assert rand_score(np.concatenate(toy[1]), np.concatenate(shuffled)) < 0.6
        assert rand_index(consistent_labels(toy[0], flows, shuffled, 8), toy[1]) > 0.97
    three = np.array([0, 0, 0, 1, 1, 2])
    line = np.arange(6)[:, None] * np.ones(3)
    renamed = consistent_labels([line, line, line], {}, [np.array([1, 1, 1, 0, 0, 0]), three, three[::-1]], 3)
    np.testing.assert_array_equal(renamed[0], [0, 0, 0, 1, 1, 1] if renamed[0][0] == 0 else [1, 1, 1, 0, 0, 0])
    assert set(renamed[1]) == {0, 1, 2} and renamed[1][0] == renamed[0][0] and renamed[1][5] == 2
    assert set(renamed[2]) == {0, 1, 2}


def test_sparse_codes_reach_the_lasso_minimum() -> None:
    """The codes against scikit-learn's coordinate descent, which is given the constraint as a row of large weight."""
    from sklearn.linear_model import Lasso

    from dpcli.segment.baselines.subspace import _affine_lasso

    data, fit = np.random.default_rng(5).standard_normal((6, 25)) / 3, 30.0
    stacked = np.concatenate([np.sqrt(fit) * data, np.full((1, 25), 100.0)])

    def excess(codes: np.ndarray, column: int, best: np.ndarray) -> float:
        """How far above the other's minimum, for the column's code over the other columns."""
        others = np.delete(stacked, column, 1)
        cost = [0.5 * np.square(others @ w - stacked[:, column]).sum() + np.abs(w).sum() for w in (codes, best)]
        return cost[0] / cost[1] - 1

    ours = _affine_lasso(data, fit, 20.0, 1000)
    for column in range(3):
        model = Lasso(1 / len(stacked), fit_intercept=False, tol=1e-9, max_iter=200_000)
        model.fit(np.delete(stacked, column, 1), stacked[:, column])
        code = np.delete(ours[:, column], column)
        assert ours[column, column] == 0 and abs(code.sum() - 1) < 1e-4
        assert excess(code, column, model.coef_) < 1e-4
        broken = np.roll(code, 1)
        assert excess(broken, column, model.coef_) > 0.01


def test_affinities_prefer_the_own_body() -> None:
    frames, truth, flows = two_boxes(noise=0.002)
    motion = follow(frames, flows, 0)
    tracks = np.concatenate([frames[0][:, None], frames[0][:, None] + motion], 1)
    same = truth[0][:, None] == truth[0]
    for affinity in (sparse_affinity(tracks), trajectory_affinity(tracks, motion)):
        np.testing.assert_allclose(affinity, affinity.T, atol=1e-6)
        assert affinity.min() >= 0 and affinity[same].mean() > 4 * affinity[~same].mean()


def test_trajectory_affinity_by_hand() -> None:
    tracks = np.array([[[0, 0, 0], [1, 0, 0]], [[0, 2, 0], [1, 2, 0]], [[0, 0, 1], [0, 0, 1]]], float)
    affinity = trajectory_affinity(tracks, tracks[:, 1:] - tracks[:, :1], sigma=2.0, reach=0.5)
    assert affinity[0, 1] == 1  # apart, but alike
    expected = np.exp(-((1 + np.sqrt(2)) / 2 / 0.5) * (1 / 4))
    np.testing.assert_allclose(affinity[0, 2], expected)


def test_the_memory_of_an_affinity_does_not_grow_with_the_frames() -> None:
    peaks = []
    for frames in (5, 50):
        tracks = np.random.default_rng(0).standard_normal((200, frames, 3))
        trajectory_affinity(tracks[:, :2], tracks[:, 1:2])  # imports
        tracemalloc.start()
        trajectory_affinity(tracks, tracks[:, 1:])
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]


def test_eigengap_and_spectral_parts() -> None:
    assert eigengap(np.array([0, 0, 0, 0.8, 0.9])) == 3
    assert eigengap(np.array([0, 0.8, 0.9, 0.95])) == 1 and eigengap(np.array([0, 0.8, 0.9, 0.95]), 2) == 2
    assert eigengap(np.array([0.0])) == 1 and eigengap(np.array([0.0, 0.0]), 2) == 2
    blocks = np.kron(np.eye(3), np.ones((4, 4)))
    order = np.random.default_rng(0).permutation(12)
    found = spectral_parts(blocks[order][:, order], None, 1, 8, np.random.default_rng(0))
    assert rand_score(order // 4, found) == 1


def test_settings_belong_to_methods() -> None:
    assert (
        ClassicalSettings(method="ssc").used()["fewest"] == 2
        and ClassicalSettings(method="ssc", fewest=3).used()["fewest"] == 3
    )
    assert [ClassicalSettings(method=method).resolved().motion for method in METHODS] == [
        "none",
        "none",
        "flow",
        "residual",
    ]
    for values, message in (
        (
            {"method": "kmeans"},
            "method = kmeans: expected one of multibody, scene, network, dbscan, ward, ssc, trajaffn",
        ),
        ({"method": "ward", "eps": 1.0}, "eps belongs to --method dbscan; ward has threshold, motion_weight"),
        ({"method": "dbscan", "eps": "far"}, "eps = far: expected a number"),
        ({"method": "dbscan", "eps": -1.0}, "eps = -1.0: expected a number above 0"),
        ({"method": "dbscan", "eps": float("nan")}, "eps = nan: expected a number above 0"),
        ({"method": "dbscan", "min_points": 2.5}, "min_points = 2.5: expected a whole number"),
        ({"method": "ssc", "motion": "none"}, "motion = none: --method ssc sees only motion"),
        ({"method": "ward", "parts": 0}, "parts = 0: expected at least 1"),
        ({"parts": 3}, "parts belongs to --method dbscan or ward or ssc or trajaffn; multibody finds its own"),
    ):
        with pytest.raises(UsageError, match=re.escape(message)):
            ClassicalSettings(**values)


def test_rejects() -> None:
    frame, flow, rng = np.zeros((4, 3), np.float32), np.zeros((4, 3), np.float32), np.random.default_rng(0)
    for frames, flows, message in (
        ([frame[:, :2]], {}, r"frame 0: points have shape \(4, 2\)"),
        ([frame, frame + np.inf], {}, "frame 1"),
        ([frame, frame], {(0, 2): flow}, "flow 0 -> 2: there are 2 frames"),
        ([frame, frame], {(0, 1): flow[:3]}, r"flow 0 -> 1 has shape \(3, 3\)"),
        ([frame, frame], {(0, 1): flow * np.nan}, "flow 0 -> 1"),
    ):
        with np.errstate(invalid="ignore"), pytest.raises(DataError, match=message):
            classical_labels(frames, flows, ClassicalSettings(method="ward"), rng=rng)
    with pytest.raises(ValueError, match="names no method of clustering"):
        classical_labels([frame], {}, ClassicalSettings(), rng=rng)
