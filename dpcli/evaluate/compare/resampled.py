"""The metrics of many resamples at once: each as a function of how often each sample counts (`bootstrap.Weighted`).

With every count 1 each function gives the numbers of `classification_compute`, `segmentation_compute` and
`motion_compute`; with other counts those of a file in which each sample stands that often.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dpcli.evaluate.bootstrap import Weighted
from dpcli.evaluate.classification.metrics import TOP_K, predicted_labels, top_hits
from dpcli.evaluate.proportions import divide
from dpcli.evaluate.segmentation.metrics import FLOOR, RECALLS, SegmentationStatistics, segmentation_merge
from dpcli.evaluate.segmentation.motion_metrics import TAUS, MotionStatistics, motion_compute

_BLOCK = 1 << 18  # predictions times resamples in memory at once


def ratios(tops: Mapping[str, np.ndarray], bottoms: Mapping[str, np.ndarray]) -> Weighted:
    """Metrics that are a ratio of sums over the samples: numerator and denominator of each sample, f64 (n) by metric."""
    keys = list(tops)
    top, bottom = (np.stack([np.asarray(side[key], np.float64) for key in keys], axis=1) for side in (tops, bottoms))

    def metric(counts: np.ndarray) -> dict[str, np.ndarray]:
        return dict(zip(keys, divide(counts @ top, counts @ bottom).T, strict=True))

    return metric


def means(values: Mapping[str, np.ndarray]) -> Weighted:
    """Metrics that are a mean over the samples: f64 (n) by metric; NaN = the sample doesn't count for it."""
    defined = {key: ~np.isnan(value) for key, value in values.items()}
    return ratios({key: np.nan_to_num(value) for key, value in values.items()}, defined)


def classification_weighted(scores: np.ndarray, labels: np.ndarray, top_k: int = TOP_K) -> Weighted:
    """accuracy, top-k accuracy where there are more classes, balanced_accuracy and macro_f1 of scores f (S,C)."""
    classes = scores.shape[1]
    best = predicted_labels(scores)
    # samples of equal truth and prediction are alike: counts are summed over these cells, then over classes
    cells, order = np.unique(labels.astype(np.int64) * classes + best, return_inverse=True)
    truth, said = np.eye(classes)[cells // classes], np.eye(classes)[cells % classes]
    right = truth * said
    sort = np.argsort(order, kind="stable")
    starts = np.searchsorted(order[sort], np.arange(len(cells)))
    shares = {"accuracy": best == labels}
    if classes > top_k:
        shares[f"top{top_k}_accuracy"] = top_hits(scores, labels, top_k)
    of_samples = means({key: hit.astype(np.float64) for key, hit in shares.items()})

    def metric(counts: np.ndarray) -> dict[str, np.ndarray]:
        summed = np.add.reduceat(counts[:, sort], starts, axis=1)
        support, predicted, hits = summed @ truth, summed @ said, summed @ right
        return of_samples(counts) | {
            "balanced_accuracy": _mean_over(divide(hits, support)),
            "macro_f1": _mean_over(divide(2 * hits, support + predicted)),
        }

    return metric


def _mean_over(values: np.ndarray) -> np.ndarray:
    """Mean of each row over its defined entries, f64 (R)."""
    return divide(np.nansum(values, axis=1), (~np.isnan(values)).sum(axis=1))


def segmentation_weighted(sequences: Sequence[SegmentationStatistics], protocol: str = "dpc") -> Weighted:
    """ap, pq, f1, pre, rec, miou and ri from the statistics of each sequence."""
    release = protocol == "release"
    whole = segmentation_merge(sequences)
    unit = np.repeat(np.arange(len(sequences)), [len(one.iou) for one in sequences])
    hit, said, iou = (
        np.bincount(unit, weights, len(sequences)) for weights in (whole.matched, None, whole.iou * whole.matched)
    )
    sums = np.stack([hit, said, iou, [one.truth_parts for one in sequences]], axis=1).astype(np.float64)
    over_sequences = means({"miou": whole.object_iou, "ri": whole.object_rand})
    ap = _WeightedPrecision(whole, unit, keep_order=release)
    share = (lambda top, bottom: top / np.maximum(bottom, FLOOR)) if release else divide

    def metric(counts: np.ndarray) -> dict[str, np.ndarray]:
        hits, predictions, found, truth = (counts @ sums).T
        pre, rec = share(hits, predictions), share(hits, truth)
        return {
            "ap": ap(counts, truth),
            "pq": share(found, (predictions + truth) / 2),
            "f1": share(2 * pre * rec, pre + rec) if release else share(2 * hits, predictions + truth),
            "pre": pre,
            "rec": rec,
            **over_sequences(counts),
        }

    return metric


class _WeightedPrecision:
    """Average precision of resamples, as `average_precision`; predictions are sorted once.

    Copies of a prediction enter together, which with `keep_order` gives what one after another would: along copies of a
    hit the precision rises, along those of a miss the envelope lies at its start.
    """

    def __init__(self, statistics: SegmentationStatistics, unit: np.ndarray, *, keep_order: bool) -> None:
        order = np.argsort(-statistics.confidence, kind="stable")
        self.unit, self.matched = unit[order], statistics.matched[order].astype(np.float64)
        ends = np.append(np.diff(statistics.confidence[order]) != 0, True)[: len(order)]
        self.ends = np.arange(len(order)) if keep_order else np.flatnonzero(ends)

    def __call__(self, counts: np.ndarray, truth: np.ndarray) -> np.ndarray:
        """AP f64 (R) of counts f64 (R,n) with `truth` f64 (R) true parts; NaN where there are none."""
        rows = max(1, _BLOCK // max(len(self.unit), 1))
        blocks = [self._block(counts[at : at + rows], truth[at : at + rows]) for at in range(0, len(counts), rows)]
        return np.where(truth > 0, np.concatenate(blocks), np.nan)

    def _block(self, counts: np.ndarray, truth: np.ndarray) -> np.ndarray:
        own = counts[:, self.unit]
        said, hits = np.cumsum(own, axis=1), np.cumsum(np.multiply(own, self.matched, out=own), axis=1)
        if len(self.ends) < len(self.unit):
            said, hits = said[:, self.ends], hits[:, self.ends]
        precision = np.divide(hits, np.maximum(said, 1, out=said), out=said)  # 0/0 before the first copy: 0
        envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
        envelope = np.append(envelope, np.zeros((len(own), 1)), axis=1)
        recall = hits / np.maximum(truth, 1)[:, None]
        levels = [np.searchsorted(row, RECALLS, side="left") for row in recall]
        return np.take_along_axis(envelope, np.array(levels), axis=1).mean(axis=1)


def motion_weighted(sequences: Sequence[MotionStatistics], tau: float, batch: int | None = None) -> Weighted:
    """epe3d, epe3d_no_motion, part_rotation (degrees), part_displacement; accs, accr, outlier of `tau` (others: accs_TAU).

    `batch` as in `motion_compute`: the pairs of a resample are those of its sequences in their order, copies together.
    """
    tops, bottoms = _part_sums(sequences)
    if batch is not None:
        return _in_batches(sequences, tau, batch, ratios(tops, bottoms))
    flow = _flow_sums(sequences, tau)
    points = np.array([one.points.sum() for one in sequences])
    return ratios({**{key: value for key, value in flow.items()}, **tops}, {**dict.fromkeys(flow, points), **bottoms})


def flow_keys(tau: float) -> list[tuple[str, int, int]]:
    """(metric, row, column of `hits`) of AccS, AccR, Outlier; those of the protocol's own `tau` without a number."""
    return [
        (name if own == tau else f"{name}_{own:g}", row, column)
        for row, own in enumerate(TAUS)
        for column, name in enumerate(("accs", "accr", "outlier"))
    ]


def _flow_sums(sequences: Sequence[MotionStatistics], tau: float) -> dict[str, np.ndarray]:
    hits = np.array([one.hits.sum(axis=0) for one in sequences])
    return {
        "epe3d": np.array([one.error.sum() for one in sequences]),
        "epe3d_no_motion": np.array([one.still.sum() for one in sequences]),
        **{key: hits[:, row, column] for key, row, column in flow_keys(tau)},
    }


def _part_sums(sequences: Sequence[MotionStatistics]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    tops = {
        "part_rotation": np.degrees([one.rotation.sum() for one in sequences]),
        "part_displacement": np.array([one.displacement.sum() for one in sequences]),
    }
    return tops, dict.fromkeys(tops, np.array([len(one.rotation) for one in sequences]))


def _in_batches(sequences: Sequence[MotionStatistics], tau: float, batch: int, parts: Weighted) -> Weighted:
    """Flow metrics by recomputation: a batch of successive pairs spans sequences, so no sum over these gives them."""
    none, lengths = np.zeros(0), np.array([len(one.points) for one in sequences])
    columns = [np.concatenate([getattr(one, key) for one in sequences]) for key in ("points", "error", "still", "hits")]

    def metric(counts: np.ndarray) -> dict[str, np.ndarray]:
        rows = []
        for row in counts.astype(np.int64):
            pairs = _pairs_of(lengths, row)
            found = motion_compute(MotionStatistics(*(column[pairs] for column in columns), none, none), batch)
            shares = {
                key: getattr(found.shares[TAUS[at]], ("accs", "accr", "outlier")[column])
                for key, at, column in flow_keys(tau)
            }
            rows.append({"epe3d": found.epe3d, "epe3d_no_motion": found.still, **shares})
        return {key: np.array([row[key] for row in rows]) for key in rows[0]} | parts(counts)

    return metric


def _pairs_of(lengths: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Rows of all pairs of a resample: those of each sequence, `lengths` many, as often as it counts."""
    drawn = np.repeat(np.arange(len(lengths)), counts)
    own = lengths[drawn]
    starts = (np.cumsum(lengths) - lengths)[drawn]
    return np.repeat(starts - (np.cumsum(own) - own), own) + np.arange(own.sum())
