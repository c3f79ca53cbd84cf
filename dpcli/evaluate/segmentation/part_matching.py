"""Hungarian matching of predicted parts to true ones in one frame, and the mean IoU of matched parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from dpcli.evaluate.segmentation.part_overlap import Overlap, overlap, valid_points

IOU_THRESHOLD = 0.5
_TIE = 1e-9  # weight of a confidence beside an IoU: decides only between equal IoUs
_RELEASE_EPSILON = 1e-8  # in the published denominators


@dataclass(frozen=True)
class FrameMatch:
    """Holds the predictions that count, (P): best IoU, whether they found a true part, confidence; true parts that count."""

    iou: np.ndarray
    matched: np.ndarray
    confidence: np.ndarray
    truth_parts: int


def hungarian_matching(iou: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the rows and columns i64 (min(G,P)) that pair true and predicted parts one to one for the largest sum.

    iou f64 (G,P): what a pair is worth. The Hungarian method (Kuhn 1955), as in scipy.

    >>> rows, columns = hungarian_matching(np.array([[0.6, 0.5], [0.5, 0.0]]))
    >>> columns.tolist()
    [1, 0]
    """
    return linear_sum_assignment(iou, maximize=True)


def match_parts(
    truth: np.ndarray,  # i (N) true ids, -1 = unknown
    part: np.ndarray,  # i (N) predicted hard ids, -1 = none
    probability: np.ndarray,  # f (N,K)
    *,
    ignore_below: int = 0,
    release: bool = False,
) -> FrameMatch:
    """Returns which predicted parts of a frame found a true part at IoU 0.5, and how confident they are.

    True parts of fewer than `ignore_below` points, and unknown points, are ignored ground: a prediction with more than
    half of its points there, or with none elsewhere, doesn't count; from the others those points are taken away.
    Confidence = mean of a part's own probability over its points. Matching is one to one, the largest number of pairs
    with the largest sum of IoU; of predictions with equal IoU the more confident one wins.
    release: as in the published code each prediction stands alone, IoU >= 0.5 with its best true part is a match (so a part
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
    """Returns the mean probability of the ids of `columns` over the points of the columns `points_of`, f64 (columns)."""
    means = [
        probability[found.columns == rows, found.ids[column]].astype(np.float64).mean()
        for rows, column in zip(points_of, columns, strict=True)
    ]
    return np.array(means, np.float64)


def _one_to_one(iou: np.ndarray, confidence: np.ndarray, best: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the IoU of the matched part (of the best one where unmatched) and whether one is matched, from IoU f64 (G,P)."""
    reached = iou >= IOU_THRESHOLD
    rows, columns = hungarian_matching(np.where(reached, iou + _TIE * confidence, 0.0))
    real = reached[rows, columns]
    matched, best = np.zeros(iou.shape[1], bool), best.copy()
    matched[columns[real]] = True
    best[columns[real]] = iou[rows[real], columns[real]]
    return best, matched


def mean_iou(truth: np.ndarray, part: np.ndarray, *, ignore_below: int = 0, release: bool = False) -> float:
    """Returns mIoU: the mean over true parts of the IoU with their predicted part, matched one to one for the largest sum.

    Ids i (N) each; a true part without a partner has IoU 0; unknown points and those of true parts of fewer than
    `ignore_below` points are taken out. NaN when nothing is left. release: with `ignore_below` 0 every id up to the
    largest is a part, so that an absent one scores 0.

    >>> mean_iou(np.array([0, 0, 1, 1]), np.array([5, 5, 5, 7]))
    0.5833333333333333
    """
    valid = valid_points(truth, ignore_below)
    if not valid.any():
        return np.nan
    found = overlap(truth[valid], part[valid])
    iou = found.shared / (found.union + (_RELEASE_EPSILON if release else 0))
    rows, columns = hungarian_matching(iou)
    parts = int(found.truth_ids[-1]) + 1 if release and ignore_below == 0 else len(found.truth_ids)
    return float(iou[rows, columns].sum() / parts)
