"""Average precision of predicted parts: of all predictions, or of many resamples of the sequences they belong to."""

from __future__ import annotations

import numpy as np

RECALL_LEVELS = np.linspace(0, 1, 101)  # the 101 points of COCO
_BLOCK = 1 << 18  # predictions times resamples in memory at once


def average_precision(
    confidence: np.ndarray, matched: np.ndarray, truth_parts: int, *, keep_order: bool = False
) -> float:
    """Returns the mean of the precision envelope at recall 0, 0.01, ..., 1 (COCO, Lin et al. 2014); NaN without true parts.

    confidence f (P), matched bool (P): whether a prediction found a true part. Predictions of equal confidence enter
    together, so their order doesn't matter; with `keep_order` they enter one after the other in the given order, as in
    the published code.

    >>> round(average_precision(np.array([0.9, 0.8, 0.7]), np.array([True, False, True]), 2), 4)
    0.835
    """
    ranked = RankedPredictions(confidence, matched, np.zeros(len(matched), np.int64), keep_order=keep_order)
    return float(ranked.average_precision(np.ones((1, 1)), np.array([float(truth_parts)]))[0])


class RankedPredictions:
    """Holds predictions by falling confidence, sorted once for the average precision of many resamples.

    confidence f (P), matched bool (P), sequence i (P): the sequence that a prediction belongs to, 0..n-1. keep_order: as
    in `average_precision`. Copies of a prediction enter together, which with `keep_order` gives what one after another
    would: along copies of a hit the precision rises, along those of a miss the envelope lies at its start.
    """

    def __init__(
        self, confidence: np.ndarray, matched: np.ndarray, sequence: np.ndarray, *, keep_order: bool = False
    ) -> None:
        order = np.argsort(-confidence, kind="stable")
        self.sequence, self.matched = sequence[order], matched[order].astype(np.float64)
        ends = np.append(np.diff(confidence[order]) != 0, True)[: len(order)]
        self.ends = np.arange(len(order)) if keep_order else np.flatnonzero(ends)

    def average_precision(self, counts: np.ndarray, truth_parts: np.ndarray) -> np.ndarray:
        """Returns the AP of each resample, f64 (R); NaN where it has no true parts.

        counts f64 (R,n): how often each sequence counts. truth_parts f64 (R): true parts of each resample.
        """
        rows = max(1, _BLOCK // max(len(self.sequence), 1))
        blocks = [
            self._block(counts[at : at + rows], truth_parts[at : at + rows]) for at in range(0, len(counts), rows)
        ]
        return np.where(truth_parts > 0, np.concatenate(blocks), np.nan)

    def _block(self, counts: np.ndarray, truth_parts: np.ndarray) -> np.ndarray:
        own = counts[:, self.sequence]
        predicted, hits = np.cumsum(own, axis=1), np.cumsum(np.multiply(own, self.matched, out=own), axis=1)
        if len(self.ends) < len(self.sequence):
            predicted, hits = predicted[:, self.ends], hits[:, self.ends]
        # 0/0 before the first copy: 0
        precision = np.divide(hits, np.maximum(predicted, 1, out=predicted), out=predicted)
        envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
        envelope = np.append(envelope, np.zeros((len(own), 1)), axis=1)
        recall = hits / np.maximum(truth_parts, 1)[:, None]
        levels = [np.searchsorted(row, RECALL_LEVELS, side="left") for row in recall]
        return np.take_along_axis(envelope, np.array(levels), axis=1).mean(axis=1)
