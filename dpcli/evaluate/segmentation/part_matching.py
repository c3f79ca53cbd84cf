"""Predicted parts against true ones in one frame: overlaps, one-to-one matching, mean IoU, Rand index."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

IOU_THRESHOLD = 0.5
_TIE = 1e-9  # weight of a confidence beside an IoU: decides only between equal IoUs
_RELEASE_EPSILON = 1e-8  # in the published denominators


@dataclass(frozen=True)
class Overlap:
    """Points shared by the parts of one frame.

    shared f64 (G,P): points of true part g that are predicted as p; truth_sizes f64 (G); sizes f64 (P), both with the
    points in no part; truth_ids, ids: the parts' ids, ascending; truth_rows i64 (N), columns i64 (N): the part of each
    point as an index, -1 = in none. Only parts with points occur.
    """

    shared: np.ndarray
    truth_sizes: np.ndarray
    sizes: np.ndarray
    truth_ids: np.ndarray
    ids: np.ndarray
    truth_rows: np.ndarray
    columns: np.ndarray


@dataclass(frozen=True)
class FrameMatch:
    """Predictions that count, i (P): best IoU, whether they found a true part, confidence; true parts that count."""

    iou: np.ndarray
    matched: np.ndarray
    confidence: np.ndarray
    truth_parts: int


def overlap(truth: np.ndarray, part: np.ndarray) -> Overlap:
    """Overlap of true and predicted ids, i (N) each; negative = in no part."""
    truth_ids, truth_rows = _compressed(truth)
    ids, columns = _compressed(part)
    both = (truth_rows >= 0) & (columns >= 0)
    cells = truth_rows[both] * len(ids) + columns[both]
    shared = np.bincount(cells, minlength=len(truth_ids) * len(ids)).reshape(len(truth_ids), len(ids))
    sizes = [
        np.bincount(rows[rows >= 0], minlength=len(own)).astype(np.float64)
        for rows, own in ((truth_rows, truth_ids), (columns, ids))
    ]
    return Overlap(shared.astype(np.float64), *sizes, truth_ids, ids, truth_rows, columns)


def _compressed(ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ids that occur, ascending, and the index of each point's id among them; -1 for negative ids."""
    found = np.unique(ids[ids >= 0])
    return found, np.where(ids >= 0, np.searchsorted(found, ids), -1)


def match_parts(
    truth: np.ndarray,  # i (N) true ids, -1 = unknown
    part: np.ndarray,  # i (N) predicted hard ids, -1 = none
    probability: np.ndarray,  # f (N,K)
    *,
    ignore_below: int = 0,
    release: bool = False,
) -> FrameMatch:
    """Which predicted parts of a frame are found parts at IoU 0.5, and how confident they are.

    True parts of fewer than `ignore_below` points, and unknown points, are ignored ground: a prediction with more than
    half of its points there, or with none elsewhere, doesn't count; from the others those points are taken away.
    Confidence = mean of a part's own probability over its points. Matching is one to one, the largest number of pairs
    with the largest sum of IoU; of predictions with equal IoU the more confident one wins.
    `release`: as the published code, each prediction alone, IoU >= 0.5 with its best true part is a match (so a part
    can be found twice), and after dropping a prediction the later confidences are read from the wrong points.
    """
    found = overlap(truth, part)
    known = found.truth_sizes >= ignore_below
    ignored = found.sizes - found.shared[known].sum(axis=0)
    keep = (ignored <= 0.5 * found.sizes) & (ignored < found.sizes)
    iou = _iou(found.shared[known][:, keep], found.truth_sizes[known], (found.sizes - ignored)[keep])
    best = iou.max(axis=0, initial=0.0)
    columns = np.flatnonzero(keep)
    # the published row filter compares compressed ids with indices counted after dropping
    confidence = _confidence(found, probability, np.arange(len(columns)) if release else columns, columns)
    matched = best >= IOU_THRESHOLD
    if not release:
        best, matched = _one_to_one(iou, confidence, best)
    return FrameMatch(best, matched, confidence, int(known.sum()))


def _iou(shared: np.ndarray, truth_sizes: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    return shared / (truth_sizes[:, None] + sizes - shared)  # the parts have points: never 0/0


def _confidence(found: Overlap, probability: np.ndarray, points_of: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Mean probability of the ids of `columns` over the points of the columns `points_of`, f64 (columns)."""
    means = [
        probability[found.columns == rows, found.ids[column]].astype(np.float64).mean()
        for rows, column in zip(points_of, columns, strict=True)
    ]
    return np.array(means, np.float64)


def _one_to_one(iou: np.ndarray, confidence: np.ndarray, best: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """IoU of the matched part (of the best one where unmatched) and matched, from IoU f64 (G,P)."""
    reached = iou >= IOU_THRESHOLD
    rows, columns = linear_sum_assignment(np.where(reached, iou + _TIE * confidence, 0.0), maximize=True)
    real = reached[rows, columns]
    matched, best = np.zeros(iou.shape[1], bool), best.copy()
    matched[columns[real]] = True
    best[columns[real]] = iou[rows[real], columns[real]]
    return best, matched


def mean_iou(truth: np.ndarray, part: np.ndarray, *, ignore_below: int = 0, release: bool = False) -> float:
    """Mean over true parts of the IoU with their predicted part, matched one to one for the largest sum.

    Ids i (N) each; a true part without a partner has IoU 0; points of ignored parts and unknown ones are taken out.
    NaN when nothing is left. `release`: with `ignore_below` 0 every id up to the largest is a part, so that an absent
    one scores 0.
    """
    valid = valid_points(truth, ignore_below)
    if not valid.any():
        return np.nan
    found = overlap(truth[valid], part[valid])
    union = found.truth_sizes[:, None] + found.sizes - found.shared
    iou = found.shared / (union + (_RELEASE_EPSILON if release else 0))
    rows, columns = linear_sum_assignment(iou, maximize=True)
    parts = int(found.truth_ids[-1]) + 1 if release and ignore_below == 0 else len(found.truth_ids)
    return float(iou[rows, columns].sum() / parts)


def rand_index(truth: np.ndarray, part: np.ndarray, *, ignore_below: int = 0) -> float:
    """Share of ordered point pairs, a point with itself among them, on which "same part" agrees (Rand 1971).

    Ids i (N) each. Predicted -1 is one more group; unknown points and those of ignored parts are taken out.
    NaN when nothing is left.
    """
    valid = valid_points(truth, ignore_below)
    count = int(valid.sum())
    if count == 0:
        return np.nan
    found = overlap(truth[valid], part[valid].astype(np.int64) + 1)
    squares = [float((sizes**2).sum()) for sizes in (found.truth_sizes, found.sizes, found.shared)]
    return 1 - (squares[0] + squares[1] - 2 * squares[2]) / count**2


def valid_points(truth: np.ndarray, ignore_below: int = 0) -> np.ndarray:
    """Points whose true part is known and has at least `ignore_below` points, bool (N)."""
    known = truth >= 0
    if ignore_below <= 0 or not known.any():
        return known
    sizes = np.bincount(truth[known])
    return known & (sizes[np.where(known, truth, 0)] >= ignore_below)
