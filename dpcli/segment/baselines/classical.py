"""The classical baselines of the thesis's Table 4.2: DBSCAN, Ward linkage, SSC and trajectory affinity.

All lengths among the options are meant for objects of diameter 1: scale other clouds and their flows first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.segment.baselines.subspace import sparse_affinity, spectral_parts, trajectory_affinity
from dpcli.segment.baselines.trajectories import Flows, consistent_labels, follow, nearest, residual_motion

MOTIONS = ("none", "flow", "residual")
_NO_LENGTH = 1e-9


@dataclass(frozen=True)
class ClassicalOptions:
    """What all methods know.

    motion: what stands beside the coordinates: none, the flow, or the residual, which is the flow less the dominant
    rigid motion of the frame. max_parts: the most parts when their number is estimated. smallest: parts of a smaller
    share of the frame's points join their neighbor. max_points: larger frames are cut in a sample of so many.
    """

    motion: str = "none"
    max_parts: int = 8
    smallest: float = 0.02
    max_points: int = 1024


@dataclass(frozen=True)
class DbscanOptions(ClassicalOptions):
    """DBSCAN (Ester et al., KDD 1996): eps is a length; motion counts motion_weight times as much as space."""

    eps: float = 0.1
    min_points: int = 5
    motion_weight: float = 1.0


@dataclass(frozen=True)
class WardOptions(ClassicalOptions):
    """Agglomerative clustering that merges where the variance grows least (Ward, JASA 1963).

    threshold: a length; merges stop where Ward's distance over the root of the number of points would exceed it.
    """

    threshold: float = 0.2
    motion_weight: float = 1.0


@dataclass(frozen=True)
class SscOptions(ClassicalOptions):
    """Sparse subspace clustering of trajectories (Elhamifar & Vidal, TPAMI 2013).

    alpha: weight of the fit. fewest: least number of parts when it is estimated. still: a frame whose points follow one
    rigid motion up to this length (root mean square) is one part.
    """

    motion: str = "flow"
    alpha: float = 800.0
    fewest: int = 2
    still: float = 0.005


@dataclass(frozen=True)
class TrajAffnOptions(ClassicalOptions):
    """Spectral clustering of trajectory affinities (Ochs, Malik & Brox, TPAMI 2014).

    sigma: the difference of motion that counts as one; reach: the distance that does. fewest, still: as for SSC.
    The published affinity compares the flow itself; the residual, ours, finds more where the whole object turns.
    """

    motion: str = "residual"
    sigma: float = 0.1
    reach: float = 0.1
    fewest: int = 1
    still: float = 0.005


METHODS: dict[str, type[ClassicalOptions]] = {
    "dbscan": DbscanOptions,
    "ward": WardOptions,
    "ssc": SscOptions,
    "trajaffn": TrajAffnOptions,
}


def classical_options(method: str, values: Mapping[str, Any] | None = None) -> ClassicalOptions:
    """The options of a method with some of them given by name; UsageError on an unknown method, name or value."""
    if method not in METHODS:
        raise UsageError(f"--method {method}: expected one of {', '.join(METHODS)}")
    defaults = {field.name: field.default for field in fields(METHODS[method])}
    chosen = {}
    for name, value in (values or {}).items():
        if name not in defaults:
            raise UsageError(f"--method {method} has no option {name!r}; it has {', '.join(sorted(defaults))}")
        chosen[name] = _converted(f"option {name} of --method {method}", value, defaults[name])
    options = METHODS[method](**chosen)
    allowed = MOTIONS[1:] if method in ("ssc", "trajaffn") else MOTIONS
    if options.motion not in allowed:
        raise UsageError(f"option motion of --method {method} is {options.motion!r}; expected {', '.join(allowed)}")
    return options


def _converted(where: str, value: Any, default: Any) -> Any:
    """The value as the default's type; numbers must be finite and positive (smallest, still and motion_weight: or zero), and
    points at least 2, so that there is something to cluster."""
    try:
        converted = type(default)(value)
    except (TypeError, ValueError):
        raise UsageError(f"{where} is {value!r}; expected {type(default).__name__}") from None
    if isinstance(default, str):
        return converted
    whole = not isinstance(default, int) or converted == float(value)
    name = where.split()[1]
    least = {"max_points": 2, "smallest": 0, "still": 0, "motion_weight": 0}.get(name)
    if not (whole and np.isfinite(converted) and (converted > 0 if least is None else converted >= least)):
        expected = (
            f"a positive {type(default).__name__}" if least is None else f"{type(default).__name__}, {least} or more"
        )
        raise UsageError(f"{where} is {value!r}; expected {expected}")
    return converted


def classical_labels(
    frames: Sequence[np.ndarray],  # T of [N_t, 3]
    flows: Flows,
    method: str,
    num_parts: int | None = None,
    *,
    rng: np.random.Generator,
    options: ClassicalOptions | Mapping[str, Any] | None = None,
) -> list[np.ndarray]:  # T of [N_t]
    """Parts i64 (N_t) of every frame, 0 = the largest of the first frame, the same id for a part through the frames.

    method: dbscan, ward, ssc or trajaffn. flows[t, u] f32 (N_t,3) leads from frame t to u; what is missing is chained
    from what there is. num_parts: their number, None to estimate it in each frame (at most options.max_parts; DBSCAN
    finds its own number and merges what is beyond). SSC and trajectory affinity see only motion: a frame without flow,
    or one that moves as a whole, is one part, or cut by Ward linkage when num_parts is given.
    Equal work gives equal labels. Raises DataError on wrong shapes and non-finite values, UsageError on wrong options.
    """
    _check(frames, flows, num_parts)
    if not isinstance(options, ClassicalOptions):
        options = classical_options(method, options)
    elif not isinstance(options, METHODS.get(method, ())):
        raise UsageError(f"--method {method}: options are {type(options).__name__}")
    import sklearn.cluster  # noqa: F401  (its threads must be there to be limited)
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):  # matrices this small only wait for one another's threads
        labels = [_frame_labels(frames, flows, t, num_parts, options, rng) for t in range(len(frames))]
    return consistent_labels(frames, flows, labels, num_parts or options.max_parts)


def _check(frames: Sequence[np.ndarray], flows: Flows, num_parts: int | None) -> None:
    if num_parts is not None and num_parts < 1:
        raise UsageError(f"--parts {num_parts}: expected 1 or more")
    for t, points in enumerate(frames):
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise DataError(f"frame {t}: points have shape {points.shape}; expected finite coordinates (points, 3)")
    for (t, u), flow in flows.items():
        if not (0 <= t < len(frames) and 0 <= u < len(frames)):
            raise DataError(f"flow {t} -> {u}: there are {len(frames)} frames only")
        if flow.shape != frames[t].shape or not np.isfinite(flow).all():
            raise DataError(f"flow {t} -> {u} has shape {flow.shape}; expected finite {frames[t].shape}")


def _frame_labels(
    frames: Sequence[np.ndarray],
    flows: Flows,
    t: int,
    num_parts: int | None,
    options: ClassicalOptions,
    rng: np.random.Generator,
) -> np.ndarray:
    from dpcli.ops import fps_numpy

    points = np.asarray(frames[t], np.float64)
    if len(points) == 0 or np.ptp(points, axis=0).max() < _NO_LENGTH or num_parts == 1:
        return np.zeros(len(points), np.int64)
    motion = follow(frames, flows, t) if options.motion != "none" else np.zeros((len(points), 0, 3))
    if options.motion == "residual":
        motion = residual_motion(points, motion)
    kept = np.arange(len(points))
    if len(points) > options.max_points:
        kept = fps_numpy(points.astype(np.float32), options.max_points)
    parts = _cut(points[kept], motion[kept], num_parts, options, rng)
    parts = _tidy(parts, points[kept], options.smallest * len(kept), num_parts or options.max_parts)
    if len(kept) == len(points):
        return parts
    space = _features(points, motion, 1.0)
    return parts[nearest(space[kept], space)]


def _cut(
    points: np.ndarray, motion: np.ndarray, num_parts: int | None, options: ClassicalOptions, rng: np.random.Generator
) -> np.ndarray:
    """Raw clusters i64 (N); -1 for DBSCAN's outliers."""
    if isinstance(options, DbscanOptions):
        from sklearn.cluster import DBSCAN

        space = _features(points, motion, options.motion_weight)
        return DBSCAN(eps=options.eps, min_samples=options.min_points).fit_predict(space)
    if isinstance(options, WardOptions):
        return _ward(_features(points, motion, options.motion_weight), num_parts, options.threshold)
    if motion.shape[1] == 0 or np.sqrt(np.square(residual_motion(points, motion)).sum(-1).mean()) <= options.still:
        return np.zeros(len(points), np.int64) if num_parts is None else _ward(points, num_parts, 0)
    trajectories = np.concatenate([points[:, None], points[:, None] + motion], 1)
    if isinstance(options, SscOptions):
        affinity = sparse_affinity(trajectories, options.alpha)
    else:
        affinity = trajectory_affinity(trajectories, motion, options.sigma, options.reach)
    return spectral_parts(affinity, num_parts, options.fewest, options.max_parts, rng)


def _features(points: np.ndarray, motion: np.ndarray, weight: float) -> np.ndarray:
    """Coordinates beside motion, which is scaled so that its distance is the root mean square over the frames."""
    return np.concatenate([points, motion.reshape(len(points), -1) * (weight / max(motion.shape[1], 1) ** 0.5)], 1)


def _ward(space: np.ndarray, num_parts: int | None, threshold: float) -> np.ndarray:
    from sklearn.cluster import AgglomerativeClustering

    if num_parts is None:
        return AgglomerativeClustering(None, distance_threshold=threshold * len(space) ** 0.5).fit_predict(space)
    return AgglomerativeClustering(min(num_parts, len(space))).fit_predict(space)


def _tidy(parts: np.ndarray, points: np.ndarray, smallest: float, most: int) -> np.ndarray:
    """Parts 0..K-1, K <= most: outliers (-1) go to the nearest point's part, then the smallest to their neighbors."""
    if (parts < 0).all():
        return np.zeros(len(parts), np.int64)
    inside = np.flatnonzero(parts >= 0)
    parts = parts[inside][nearest(points[inside], points)]
    while True:
        ids, parts, counts = np.unique(parts, return_inverse=True, return_counts=True)
        least = int(np.argmin(counts))
        if len(ids) == 1 or (len(ids) <= most and counts[least] >= smallest):
            return parts.astype(np.int64)
        others, members = np.flatnonzero(parts != least), np.flatnonzero(parts == least)
        index, distance = nearest(points[others], points[members], with_distance=True)
        parts[members] = parts[others[index[np.argmin(distance)]]]
