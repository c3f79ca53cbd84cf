"""Motion metrics: scene flow and rigid part motions of frame pairs -> sufficient statistics -> metrics."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.optimize import linear_sum_assignment

from dpcli.errors import DataError
from dpcli.evaluate.proportions import divide, mean_defined
from dpcli.evaluate.segmentation.part_matching import overlap

TAUS = (0.01, 0.05)  # length units: the released scale of SAPIEN and OGC-DR; of KITTI, Waymo and the thesis's text
RELEASE_BATCH = 6  # frame pairs
_RELATIVE = (0.05, 0.1, 0.1)  # of the true flow's length: AccS, AccR, Outlier
_TINY = 1e-10


@dataclass(frozen=True)
class MotionStatistics:
    """Sums over the points of each frame pair, concatenated in the order the pairs came.

    points i64 (Q); error f64 (Q): sum of the end-point errors; still f64 (Q): the same for predicting no motion;
    hits i64 (Q,2,3): points that are AccS, AccR, Outlier at each of TAUS. rotation f64 (M) radians, displacement
    f64 (M): errors of the motions of parts that were found; unmatched: true parts without any overlapping prediction.
    unknown: points left out for lack of a true part.
    """

    points: np.ndarray
    error: np.ndarray
    still: np.ndarray
    hits: np.ndarray
    rotation: np.ndarray
    displacement: np.ndarray
    unmatched: int = 0
    unknown: int = 0

    def __add__(self, other: MotionStatistics) -> MotionStatistics:
        """Statistics of both sets of pairs together."""
        return motion_merge([self, other])


@dataclass(frozen=True)
class FlowShares:
    """Shares of points, in [0, 1]: AccS error < tau or 5 %, AccR < 2 tau or 10 %, Outlier > 6 tau or > 10 %."""

    accs: float
    accr: float
    outlier: float


@dataclass(frozen=True)
class MotionMetrics:
    """epe3d: mean end-point error, still: that of predicting no motion, both in length units; shares: by tau.

    rotation, displacement: mean error of the matched parts' motions, in radians and length units (at the part's
    centroid). NaN = undefined.
    """

    epe3d: float
    still: float
    shares: dict[float, FlowShares]
    rotation: float
    displacement: float
    points: int
    pairs: int
    parts: int
    unmatched: int
    unknown: int


def true_motion(pose: np.ndarray, source: int, target: int) -> np.ndarray:
    """Motion of each part from frame `source` to `target`, f64 (parts,4,4), from part-to-world poses (F,parts,4,4).

    DataError when a pose is not finite or can't be inverted.
    """
    try:
        motion = pose[target] @ np.linalg.inv(pose[source])
    except np.linalg.LinAlgError:
        motion = np.full(1, np.nan)
    if not np.isfinite(motion).all():
        raise DataError(f"a true pose of frame {source} or {target} is not finite or can't be inverted")
    return motion


def true_flow(points: np.ndarray, part: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Displacement f64 (N,3) of points (N,3) that belong to parts i (N) >= 0 with motions (parts,4,4)."""
    own = motion[part]
    return np.einsum("nij,nj->ni", own[:, :3, :3], points.astype(np.float64)) + own[:, :3, 3] - points


def flow_update(predicted: np.ndarray, truth: np.ndarray) -> MotionStatistics:
    """Statistics of one frame pair: predicted and true flow f (N,3) in length units. DataError on other shapes."""
    if predicted.shape != truth.shape or truth.ndim != 2 or truth.shape[1] != 3:
        raise DataError(f"flow {predicted.shape} and true flow {truth.shape}: expected (points, 3) twice")
    truth = truth.astype(np.float64)
    error, length = np.linalg.norm(predicted - truth, axis=1), np.linalg.norm(truth, axis=1)
    relative = error / (length + _TINY)
    hits = [_hits(error, relative, tau) for tau in TAUS]
    none = np.zeros(0)
    return MotionStatistics(
        np.array([len(truth)]),
        np.array([error.sum()]),
        np.array([length.sum()]),
        np.array([hits], np.int64),
        none,
        none,
    )


def _hits(error: np.ndarray, relative: np.ndarray, tau: float) -> list[int]:
    strict, relaxed, outlier = _RELATIVE
    found = (
        (error < tau) | (relative < strict),
        (error < 2 * tau) | (relative < relaxed),
        (error > 6 * tau) | (relative > outlier),
    )
    return [int(points.sum()) for points in found]


def part_motion_update(
    points: np.ndarray,  # f (N,3) of the source frame
    truth: np.ndarray,  # i (N) true ids
    part: np.ndarray,  # i (N) predicted ids
    true_motions: np.ndarray,  # f (parts,4,4)
    motions: np.ndarray,  # f (K,4,4)
) -> MotionStatistics:
    """Errors of the predicted rigid motions of one frame pair.

    True and predicted parts are matched one to one for the largest sum of IoU; a true part that shares no point with
    its partner is unmatched. Rotation error: angle of R_pred^T R_true. Displacement error: how far apart the two
    motions put the centroid of the true part's points (a difference of translations would depend on the origin).
    """
    known = truth >= 0
    points, truth, part = points[known].astype(np.float64), truth[known], part[known]
    found = overlap(truth, part)
    union = found.truth_sizes[:, None] + found.sizes - found.shared
    rows, columns = linear_sum_assignment(found.shared / union, maximize=True)
    matched = found.shared[rows, columns] > 0
    rows, columns = rows[matched], columns[matched]
    said = motions[found.ids[columns]].astype(np.float64)
    real = true_motions[found.truth_ids[rows]]
    centroids = np.array([points[found.truth_rows == row].mean(axis=0) for row in rows]).reshape(-1, 3)
    apart = np.einsum("mij,mj->mi", (said - real)[:, :3], np.append(centroids, np.ones((len(rows), 1)), axis=1))
    none = np.zeros(0)
    return MotionStatistics(
        none.astype(np.int64),
        none,
        none,
        np.zeros((0, len(TAUS), 3), np.int64),
        rotation_angle(said[:, :3, :3], real[:, :3, :3]),
        np.linalg.norm(apart, axis=1),
        unmatched=len(found.truth_ids) - len(rows),
    )


def rotation_angle(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angle f64 (M) in radians, 0..pi, between rotations (M,3,3), precise also for small ones."""
    chord = np.linalg.norm(first - second, axis=(-2, -1)) / np.sqrt(8)
    return 2 * np.arcsin(np.clip(chord, 0, 1))


def motion_merge(parts: Iterable[MotionStatistics]) -> MotionStatistics:
    """Statistics of all parts together, equal to those of all pairs at once. DataError without parts."""
    parts = list(parts)
    if not parts:
        raise DataError("no statistics to merge: evaluate at least one frame pair")
    columns = {own.name: [getattr(part, own.name) for part in parts] for own in fields(MotionStatistics)}
    return MotionStatistics(
        **{key: np.concatenate(rows) if isinstance(rows[0], np.ndarray) else sum(rows) for key, rows in columns.items()}
    )


def motion_compute(statistics: MotionStatistics, batch: int | None = None) -> MotionMetrics:
    """Metrics from statistics: every point counts the same.

    `batch`: means over the points of each `batch` successive pairs, then over the batches, as the published code
    (6 pairs); differs when the last batch is smaller or frames have different sizes.
    """
    mean = _Mean(statistics.points, batch)
    shares = {
        tau: FlowShares(*(mean(statistics.hits[:, row, column]) for column in range(3))) for row, tau in enumerate(TAUS)
    }
    return MotionMetrics(
        epe3d=mean(statistics.error),
        still=mean(statistics.still),
        shares=shares,
        rotation=mean_defined(statistics.rotation),
        displacement=mean_defined(statistics.displacement),
        points=int(statistics.points.sum()),
        pairs=int((statistics.points > 0).sum()),
        parts=len(statistics.rotation) + statistics.unmatched,
        unmatched=statistics.unmatched,
        unknown=statistics.unknown,
    )


class _Mean:
    """Mean over points of sums by pair: over all at once, or by batch and then over batches."""

    def __init__(self, points: np.ndarray, batch: int | None) -> None:
        self.points, self.starts = points, np.arange(0, len(points), batch or max(len(points), 1))

    def __call__(self, sums: Sequence[float] | np.ndarray) -> float:
        if len(self.points) == 0:
            return float("nan")
        totals = np.add.reduceat(np.asarray(sums, np.float64), self.starts)
        return mean_defined(divide(totals, np.add.reduceat(self.points, self.starts)))
