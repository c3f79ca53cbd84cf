"""Part discovery and surface tracks: a Gaussian scene against surface points whose true parts and paths are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.proportions import divide
from dpcli.evaluate.segmentation.rand_index import adjusted_rand_index
from dpcli.ops.rotations import quaternion_to_matrix
from dpcli.runtime.seeds import scikit_learn_state
from dpcli.store.gaussians import GaussianScene

PART_NEIGHBORS = 8
TRACK_NEIGHBORS = 4
SOLID = 0.1  # opacity of a Gaussian that may carry a surface; fainter ones float anywhere


@dataclass(frozen=True)
class PartScore:
    """Holds the adjusted Rand index (ARI) of the discovered parts at true surface points, and of two trivial answers.

    ari_one_part: everything one part (0 unless the truth is one part too). ari_kmeans: k-means on the positions in the
    first frame, k = true_parts, which the scene isn't told. points: that count; unknown: left out, no true part.
    discovered: parts that at least one point took.
    """

    ari: float
    ari_one_part: float
    ari_kmeans: float
    points: int
    unknown: int
    true_parts: int
    discovered: int


@dataclass(frozen=True)
class TrackScore:
    """Holds the mean distance between carried and true surface points over all frames but the first, in the truth's length unit.

    static: that of points which stay where they are. diameter: diagonal of the points' bounding box in the first frame.
    points, frames: whose product is the denominator.
    """

    epe: float
    static: float
    diameter: float
    points: int
    frames: int


def nearest_gaussians(
    points: np.ndarray, means: np.ndarray, opacity: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns indices i64 (M,k) of the k nearest solid Gaussians of points f (M,3), and their weights f64 (M,k), sum 1.

    Weight = opacity / distance: a Gaussian that a point lies on decides alone. Where fewer than k Gaussians have an
    opacity of at least SOLID, all may be found. k is at most the number of Gaussians.
    """
    from scipy.spatial import cKDTree

    solid = np.flatnonzero(opacity >= SOLID)
    solid = solid if len(solid) >= k else np.arange(len(means))
    k = min(k, len(solid))
    distance, near = cKDTree(means[solid]).query(points.astype(np.float64), k=range(1, k + 1))
    index = solid[near]
    nearness = opacity[index].astype(np.float64) / np.maximum(distance, 1e-9 * (np.ptp(means) or 1.0))
    total = nearness.sum(1, keepdims=True)
    return index, np.where(total > 0, divide(nearness, np.where(total > 0, total, 1)), 1 / k)


def surface_parts(scene: GaussianScene, points: np.ndarray, time: float) -> np.ndarray:
    """Returns the part i64 (M) of surface points f (M,3) at `time`, in seconds.

    It is the part with the largest weight among the nearest Gaussians; -1 where those have none; a tie goes to the
    lowest id.
    """
    index, weight = nearest_gaussians(points, scene.at(time)[0], scene.opacity, PART_NEIGHBORS)
    votes = np.zeros((len(points), scene.num_parts + 1))
    rows = np.arange(len(points))[:, None]
    np.add.at(votes, (rows, scene.part[index].astype(np.int64) + 1), weight)
    votes[:, 0] = np.where(votes[:, 1:].any(1), -1, votes[:, 0])  # any part at all counts before none
    return votes.argmax(1) - 1


def part_score(
    scene: GaussianScene,
    points: np.ndarray,  # f (M,3) at `time`
    part: np.ndarray,  # i (M) true parts, -1 unknown
    time: float,
    *,
    seed: int = 0,
) -> PartScore:
    """Scores how well a scene's parts are those of the truth. Raises DataError when no point has a true part."""
    known = part >= 0
    if not known.any():
        raise DataError("parts: no surface point of the truth has a known part (all are -1)")
    points, part = points[known], part[known]
    found = surface_parts(scene, points, time)
    true_parts = len(np.unique(part))
    return PartScore(
        ari=adjusted_rand_index(part, found),
        ari_one_part=adjusted_rand_index(part, np.zeros(len(part), int)),
        ari_kmeans=adjusted_rand_index(part, _kmeans_parts(points, true_parts, seed)),
        points=len(part),
        unknown=int((~known).sum()),
        true_parts=true_parts,
        discovered=len(np.unique(found[found >= 0])),
    )


def _kmeans_parts(points: np.ndarray, count: int, seed: int) -> np.ndarray:
    from sklearn.cluster import KMeans

    count = min(count, len(np.unique(points, axis=0)))
    return KMeans(count, n_init=10, random_state=scikit_learn_state(seed)).fit_predict(points.astype(np.float64))


def carry_points(scene: GaussianScene, points: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Returns the positions f64 (T,M,3) of surface points f (M,3) of times[0] at every time, moved by their nearest Gaussians.

    Each of the four moves a point rigidly, by its own shift and turn since times[0]; the weighted mean counts. Points
    of a rigidly moving scene are carried exactly.
    """
    means, turns = scene.at(float(times[0]))
    index, weight = nearest_gaussians(points, means, scene.opacity, TRACK_NEIGHBORS)
    back = np.swapaxes(quaternion_to_matrix(turns.astype(np.float64)), 1, 2)
    local = np.einsum("mkij,mkj->mki", back[index], points[:, None].astype(np.float64) - means[index])
    carried = np.empty((len(times), *points.shape))
    for frame, time in enumerate(times):
        means, turns = scene.at(float(time))
        moved = np.einsum("mkij,mkj->mki", quaternion_to_matrix(turns.astype(np.float64))[index], local) + means[index]
        carried[frame] = (weight[..., None] * moved).sum(1)
    return carried


def track_score(scene: GaussianScene, track: np.ndarray, times: np.ndarray) -> TrackScore:
    """Measures how far a scene carries true surface points f (T,M,3) from where they are at `times`, seconds (T).

    NaN errors when there is only one frame. Raises DataError without points.
    """
    frames, points = track.shape[:2]
    if points == 0:
        raise DataError("tracks: the truth has no surface points")
    truth = track.astype(np.float64)
    carried = carry_points(scene, truth[0], times)
    count = (frames - 1) * points
    errors = (
        np.linalg.norm(guess[1:] - truth[1:], axis=-1).sum()
        for guess in (carried, np.broadcast_to(truth[0], truth.shape))
    )
    epe, static = (float(divide(error, count)) for error in errors)
    return TrackScore(epe, static, float(np.linalg.norm(np.ptp(truth[0], axis=0))), points, frames - 1)
