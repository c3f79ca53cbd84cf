"""The classical baselines of the thesis's Table 4.2: DBSCAN, Ward linkage, SSC and trajectory affinity.

All lengths among the settings are meant for objects of diameter 1: scale other clouds and their flows first.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dpcli.errors import DataError
from dpcli.segment.baselines.settings import ClassicalSettings
from dpcli.segment.baselines.subspace import sparse_affinity, spectral_parts, trajectory_affinity
from dpcli.segment.baselines.trajectories import Flows, consistent_labels, find_nearest, follow, residual_motion

_NO_LENGTH = 1e-9


def classical_labels(
    frames: Sequence[np.ndarray],  # T of [N_t, 3]
    flows: Flows,
    settings: ClassicalSettings,
    *,
    rng: np.random.Generator,
) -> list[np.ndarray]:  # T of [N_t]
    """Returns parts i64 (N_t) of every frame, 0 = the largest of the first, the same id for a part through the frames.

    flows[t, u] f32 (N_t,3) leads from frame t to u; what is missing is chained from what there is. settings.parts: their
    number, None to estimate it in each frame (at most max_parts; DBSCAN finds its own number and merges what is beyond).
    SSC and trajectory affinity see only motion: a frame without flow, or one that moves as a whole, is one part, or cut
    by Ward linkage when the number is given. Equal work gives equal labels. Raises DataError on wrong shapes and
    non-finite values, ValueError where the settings name no method.
    """
    if not settings.classical:
        raise ValueError(f"{settings.method} names no method of clustering")
    _check_frames(frames, flows)
    settings = settings.resolved()
    import sklearn.cluster  # noqa: F401  (its threads must be there to be limited)
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):  # matrices this small only wait for one another's threads
        labels = [_label_frame(frames, flows, t, settings, rng) for t in range(len(frames))]
    return consistent_labels(frames, flows, labels, settings.parts or settings.max_parts)


def _check_frames(frames: Sequence[np.ndarray], flows: Flows) -> None:
    """Raises DataError for clouds and flows of wrong shapes, or with values that are not finite."""
    for t, points in enumerate(frames):
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise DataError(f"frame {t}: points have shape {points.shape}; expected finite coordinates (points, 3)")
    for (t, u), flow in flows.items():
        if not (0 <= t < len(frames) and 0 <= u < len(frames)):
            raise DataError(f"flow {t} -> {u}: there are {len(frames)} frames only")
        if flow.shape != frames[t].shape or not np.isfinite(flow).all():
            raise DataError(f"flow {t} -> {u} has shape {flow.shape}; expected finite {frames[t].shape}")


def _label_frame(
    frames: Sequence[np.ndarray], flows: Flows, t: int, settings: ClassicalSettings, rng: np.random.Generator
) -> np.ndarray:
    """Returns the parts i64 (N_t) of one frame, which no other frame knows of yet."""
    from dpcli.ops import fps_numpy

    points = np.asarray(frames[t], np.float64)
    if len(points) == 0 or np.ptp(points, axis=0).max() < _NO_LENGTH or settings.parts == 1:
        return np.zeros(len(points), np.int64)
    motion = follow(frames, flows, t) if settings.motion != "none" else np.zeros((len(points), 0, 3))
    if settings.motion == "residual":
        motion = residual_motion(points, motion)
    kept = np.arange(len(points))
    if len(points) > settings.max_points:
        kept = fps_numpy(points.astype(np.float32), settings.max_points)
    parts = _cluster(points[kept], motion[kept], settings, rng)
    parts = _merge_parts(
        parts, points[kept], settings.smallest_cluster * len(kept), settings.parts or settings.max_parts
    )
    if len(kept) == len(points):
        return parts
    space = _join_features(points, motion, 1.0)
    return parts[find_nearest(space[kept], space)[1]]


def _cluster(
    points: np.ndarray, motion: np.ndarray, settings: ClassicalSettings, rng: np.random.Generator
) -> np.ndarray:
    """Returns raw clusters i64 (N); -1 for DBSCAN's outliers."""
    parts = settings.parts
    if settings.method == "dbscan":
        from sklearn.cluster import DBSCAN

        space = _join_features(points, motion, settings.motion_weight)
        return DBSCAN(eps=settings.eps, min_samples=settings.min_points).fit_predict(space)
    if settings.method == "ward":
        return _cluster_ward(_join_features(points, motion, settings.motion_weight), parts, settings.threshold)
    if motion.shape[1] == 0 or np.sqrt(np.square(residual_motion(points, motion)).sum(-1).mean()) <= settings.still:
        return np.zeros(len(points), np.int64) if parts is None else _cluster_ward(points, parts, 0)
    trajectories = np.concatenate([points[:, None], points[:, None] + motion], 1)
    if settings.method == "ssc":
        affinity = sparse_affinity(trajectories, settings.alpha)
    else:
        affinity = trajectory_affinity(trajectories, motion, settings.sigma, settings.reach)
    return spectral_parts(affinity, parts, settings.fewest, settings.max_parts, rng)


def _join_features(points: np.ndarray, motion: np.ndarray, weight: float) -> np.ndarray:
    """Returns coordinates beside motion, which is scaled so that its distance is the root mean square over the frames."""
    return np.concatenate([points, motion.reshape(len(points), -1) * (weight / max(motion.shape[1], 1) ** 0.5)], 1)


def _cluster_ward(space: np.ndarray, num_parts: int | None, threshold: float) -> np.ndarray:
    """Returns the clusters (N) of Ward linkage: so many, or as many as lie further apart than the threshold."""
    from sklearn.cluster import AgglomerativeClustering

    if num_parts is None:
        return AgglomerativeClustering(None, distance_threshold=threshold * len(space) ** 0.5).fit_predict(space)
    return AgglomerativeClustering(min(num_parts, len(space))).fit_predict(space)


def _merge_parts(parts: np.ndarray, points: np.ndarray, smallest: float, most: int) -> np.ndarray:
    """Returns parts 0..K-1, K <= most: outliers (-1) go to the nearest point's part, then the smallest to their neighbors."""
    if (parts < 0).all():
        return np.zeros(len(parts), np.int64)
    inside = np.flatnonzero(parts >= 0)
    parts = parts[inside][find_nearest(points[inside], points)[1]]
    while True:
        ids, parts, counts = np.unique(parts, return_inverse=True, return_counts=True)
        least = int(np.argmin(counts))
        if len(ids) == 1 or (len(ids) <= most and counts[least] >= smallest):
            return parts.astype(np.int64)
        others, members = np.flatnonzero(parts != least), np.flatnonzero(parts == least)
        distance, index = find_nearest(points[others], points[members])
        parts[members] = parts[others[index[np.argmin(distance)]]]
