"""Motion metrics: scene flow and rigid part motions of frame pairs -> sufficient statistics -> metrics.

`motion_compute` gives the metrics of all pairs, `motion_weighted` those of many resamples of their sequences at once;
both take end-point error, AccS, AccR and Outlier as means of the same sums (`_flow_sums`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import WeightedMetric, ratios_of_sums
from dpcli.evaluate.proportions import divide, mean_defined
from dpcli.evaluate.results import merge_statistics
from dpcli.evaluate.segmentation.part_matching import hungarian_matching
from dpcli.evaluate.segmentation.part_overlap import overlap
from dpcli.evaluate.segmentation.rigid_motion import rotation_angle
from dpcli.store.schema import METERS

# meters, or units that are no known length (diameters)
TAUS = (0.01, 0.05)  # the released scale of SAPIEN and OGC-DR; of KITTI, Waymo and the thesis's text
MAIN_TAU = {"dpc": 0.05, "release": 0.01}  # the thesis's text; what its code takes on SAPIEN and OGC-DR
RELEASE_BATCH = 6  # frame pairs
SHARES = ("accs", "accr", "outlier")
_RELATIVE = (0.05, 0.1, 0.1)  # of the true flow's length: AccS, AccR, Outlier
_TINY = 1e-10


@dataclass(frozen=True)
class MotionStatistics:
    """Holds sums over the points of each frame pair, concatenated in the order the pairs came.

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


@dataclass(frozen=True)
class FlowShares:
    """Holds shares of points, in [0, 1]: AccS error < tau or 5 %, AccR < 2 tau or 10 %, Outlier > 6 tau or > 10 %."""

    accs: float
    accr: float
    outlier: float


@dataclass(frozen=True)
class MotionMetrics:
    """Holds the mean end-point error epe3d, `still`, that of predicting no motion, both in length units, and shares by tau.

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


def flow_update(predicted: np.ndarray, truth: np.ndarray, meters: float = 1.0) -> MotionStatistics:
    """Returns the statistics of one frame pair from predicted and true flow f (N,3) in length units of so many meters.

    AccS, AccR and Outlier count points by absolute error at each of TAUS, or by the error relative to the true flow's
    length. A unit that is no known length counts as a meter. Raises DataError on other shapes.

    >>> found = motion_compute(flow_update(np.array([[1.0, 0, 0], [0, 0, 0]]), np.array([[1.0, 0, 0], [0, 1, 0]])))
    >>> found.epe3d, found.shares[0.05].accs, found.shares[0.05].accr, found.shares[0.05].outlier
    (0.5, 0.5, 0.5, 0.5)
    """
    if predicted.shape != truth.shape or truth.ndim != 2 or truth.shape[1] != 3:
        raise DataError(f"flow {predicted.shape} and true flow {truth.shape}: expected (points, 3) twice")
    truth = truth.astype(np.float64)
    error, length = np.linalg.norm(predicted - truth, axis=1), np.linalg.norm(truth, axis=1)
    relative = error / (length + _TINY)
    hits = [_threshold_hits(error * meters, relative, tau) for tau in TAUS]
    none = np.zeros(0)
    return MotionStatistics(
        np.array([len(truth)]),
        np.array([error.sum()]),
        np.array([length.sum()]),
        np.array([hits], np.int64),
        none,
        none,
    )


def tau_unit(length_unit: str) -> str:
    """Returns the unit of tau in a file of a unit of length: the meter for all known lengths.

    >>> tau_unit("mm"), tau_unit("object diameter")
    ('m', 'object diameter')
    """
    return "m" if length_unit in METERS else length_unit


def _threshold_hits(error: np.ndarray, relative: np.ndarray, tau: float) -> list[int]:
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
    """Returns the errors of the predicted rigid motions of one frame pair.

    True and predicted parts are matched one to one for the largest sum of IoU; a true part that shares no point with
    its partner is unmatched. Rotation error: angle of R_pred^T R_true. Displacement error: how far apart the two
    motions put the centroid of the true part's points (a difference of translations would depend on the origin).
    """
    known = truth >= 0
    points, truth, part = points[known].astype(np.float64), truth[known], part[known]
    found = overlap(truth, part)
    rows, columns = hungarian_matching(found.shared / found.union)
    matched = found.shared[rows, columns] > 0
    rows, columns = rows[matched], columns[matched]
    predicted = motions[found.ids[columns]].astype(np.float64)
    real = true_motions[found.truth_ids[rows]]
    centroids = np.array([points[found.truth_rows == row].mean(axis=0) for row in rows]).reshape(-1, 3)
    apart = np.einsum("mij,mj->mi", (predicted - real)[:, :3], np.append(centroids, np.ones((len(rows), 1)), axis=1))
    none = np.zeros(0)
    return MotionStatistics(
        none.astype(np.int64),
        none,
        none,
        np.zeros((0, len(TAUS), 3), np.int64),
        rotation_angle(predicted[:, :3, :3], real[:, :3, :3]),
        np.linalg.norm(apart, axis=1),
        unmatched=len(found.truth_ids) - len(rows),
    )


def flow_keys(tau: float) -> list[tuple[str, int, int]]:
    """Returns (metric, row, column of `hits`) of AccS, AccR, Outlier; those of the protocol's own `tau` without a number.

    >>> [key for key, _, _ in flow_keys(0.05)]
    ['accs_0.01', 'accr_0.01', 'outlier_0.01', 'accs', 'accr', 'outlier']
    """
    return [
        (name if own == tau else f"{name}_{own:g}", row, column)
        for row, own in enumerate(TAUS)
        for column, name in enumerate(SHARES)
    ]


def _flow_sums(statistics: MotionStatistics, tau: float) -> dict[str, np.ndarray]:
    """Returns what the flow's metrics are means over points of: a sum for each pair, (Q), by metric."""
    return {
        "epe3d": statistics.error,
        "epe3d_no_motion": statistics.still,
        **{key: statistics.hits[:, row, column] for key, row, column in flow_keys(tau)},
    }


def motion_compute(statistics: MotionStatistics, batch: int | None = None) -> MotionMetrics:
    """Returns the metrics that statistics stand for: every point counts the same.

    batch: means over the points of each `batch` successive pairs, then over the batches, as the published code
    (6 pairs); differs when the last batch is smaller or frames have different sizes.
    """
    tau = TAUS[0]
    means = _means_over_points(_flow_sums(statistics, tau), statistics.points, batch)
    shares: dict[float, list[float]] = {own: [np.nan] * len(SHARES) for own in TAUS}
    for key, row, column in flow_keys(tau):
        shares[TAUS[row]][column] = means[key]
    return MotionMetrics(
        epe3d=means["epe3d"],
        still=means["epe3d_no_motion"],
        shares={own: FlowShares(*values) for own, values in shares.items()},
        rotation=mean_defined(statistics.rotation),
        displacement=mean_defined(statistics.displacement),
        points=int(statistics.points.sum()),
        pairs=int((statistics.points > 0).sum()),
        parts=len(statistics.rotation) + statistics.unmatched,
        unmatched=statistics.unmatched,
        unknown=statistics.unknown,
    )


def _means_over_points(sums: Mapping[str, np.ndarray], points: np.ndarray, batch: int | None) -> dict[str, float]:
    """Returns the mean over points of sums by pair (Q): over all pairs at once, or by batch and then over batches."""
    if len(points) == 0:
        return dict.fromkeys(sums, np.nan)
    starts = np.arange(0, len(points), batch or len(points))
    counts = np.add.reduceat(points, starts)
    return {
        key: mean_defined(divide(np.add.reduceat(np.asarray(own, np.float64), starts), counts))
        for key, own in sums.items()
    }


def motion_weighted(sequences: Sequence[MotionStatistics], tau: float, batch: int | None = None) -> WeightedMetric:
    """Returns the metrics as functions of how often each sequence counts: epe3d, epe3d_no_motion, accs, accr, outlier of
    `tau` (of others: accs_TAU), part_rotation (degrees) and part_displacement.

    batch: as in `motion_compute`; the pairs of a resample are those of its sequences in their order, copies together.
    """
    tops = {
        "part_rotation": np.degrees([one.rotation.sum() for one in sequences]),
        "part_displacement": np.array([one.displacement.sum() for one in sequences]),
    }
    bottoms = dict.fromkeys(tops, np.array([len(one.rotation) for one in sequences]))
    if batch is not None:
        return _in_batches(sequences, tau, batch, ratios_of_sums(tops, bottoms))
    sums = [{key: own.sum() for key, own in _flow_sums(one, tau).items()} for one in sequences]
    flow = {key: np.array([own[key] for own in sums]) for key in sums[0]}
    points = np.array([one.points.sum() for one in sequences])
    return ratios_of_sums({**flow, **tops}, {**dict.fromkeys(flow, points), **bottoms})


def _in_batches(
    sequences: Sequence[MotionStatistics], tau: float, batch: int, part_motions: WeightedMetric
) -> WeightedMetric:
    """Returns flow metrics by recomputation: a batch of successive pairs spans sequences, so no sum over these gives them."""
    lengths = np.array([len(one.points) for one in sequences])
    points = np.concatenate([one.points for one in sequences])
    sums = _flow_sums(merge_statistics(sequences), tau)

    def metric(counts: np.ndarray) -> dict[str, np.ndarray]:
        resamples = [_rows_of_pairs(lengths, row) for row in counts.astype(np.int64)]
        means = [
            _means_over_points({key: own[pairs] for key, own in sums.items()}, points[pairs], batch)
            for pairs in resamples
        ]
        return {key: np.array([row[key] for row in means]) for key in sums} | part_motions(counts)

    return metric


def _rows_of_pairs(lengths: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Returns the rows of all pairs of a resample: those of each sequence, `lengths` many, as often as it counts."""
    drawn = np.repeat(np.arange(len(lengths)), counts)
    own = lengths[drawn]
    starts = (np.cumsum(lengths) - lengths)[drawn]
    return np.repeat(starts - (np.cumsum(own) - own), own) + np.arange(own.sum())
