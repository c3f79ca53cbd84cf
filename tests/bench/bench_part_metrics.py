"""Speed of the segmentation metrics and of their bootstrap: 2,880 frames of 512 points, as in the published test set.

    python -m tests.bench.bench_part_metrics [--sequences 720] [--frames 4] [--points 512] [--resamples 1000]

Ours computes all seven scores; beside it scikit-learn, what one would take instead, compute two of them
(mIoU, Rand index) from the same frames, and must agree, or the bench fails. The bootstrap recomputes all seven in each
resample; beside it the same by merging the statistics again, on fewer resamples, which must give the same numbers.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
from scipy.optimize import linear_sum_assignment

from dpcli.evaluate.bootstrap import replicates
from dpcli.evaluate.results import merge_statistics
from dpcli.evaluate.segmentation.metrics import (
    Frame,
    SegmentationMetrics,
    SegmentationStatistics,
    segmentation_compute,
    segmentation_update,
    segmentation_weighted,
)

LIMIT_S = 10.0
_AGAIN = 10  # resamples by merging


def sequences(count: int, frames: int, points: int, parts: int = 4, slots: int = 8) -> list[list[Frame]]:
    """Objects of `parts` parts of which nine points in ten are predicted rightly."""
    rng = np.random.default_rng(0)

    def frame() -> Frame:
        truth = np.sort(rng.integers(0, parts, points))
        part = np.where(rng.random(points) < 0.9, truth, rng.integers(0, slots, points))
        probability = rng.random((points, slots), np.float32)
        probability[np.arange(points), part] += 2
        return Frame(truth, part, probability / probability.sum(axis=1, keepdims=True))

    return [[frame() for _ in range(frames)] for _ in range(count)]


def timed(function: Callable[[], object], repeat: int) -> tuple[float, object]:
    """Median of `repeat` calls in seconds, and the last result."""
    times, found = [], None
    for _ in range(repeat):
        start = time.perf_counter()
        found = function()
        times.append(time.perf_counter() - start)
    return statistics.median(times), found


def ours(objects: list[list[Frame]]) -> tuple[list[SegmentationStatistics], SegmentationMetrics]:
    found = [segmentation_update(frames) for frames in objects]
    return found, segmentation_compute(merge_statistics(found))


def libraries(objects: list[list[Frame]]) -> tuple[float, float]:
    """mIoU and Rand index by scikit-learn's contingency matrix and `rand_score`, scipy's assignment."""
    from sklearn.metrics import rand_score
    from sklearn.metrics.cluster import contingency_matrix

    def frame(own: Frame) -> tuple[float, float]:
        shared = contingency_matrix(own.truth, own.part).astype(float)
        iou = shared / (shared.sum(1, keepdims=True) + shared.sum(0) - shared)
        count = len(own.truth)
        rand = (rand_score(own.truth, own.part) * (count - 1) + 1) / count  # ours counts a point with itself
        return iou[linear_sum_assignment(iou, maximize=True)].sum() / len(shared), rand

    miou, rand = np.array([[frame(own) for own in frames] for frames in objects]).mean(axis=(0, 1))
    return float(miou), float(rand)


def merged(found: list[SegmentationStatistics], resamples: int) -> np.ndarray:
    """AP of resamples the plain way."""
    rng = np.random.default_rng(0)
    draws = rng.integers(0, len(found), (resamples, len(found)))
    return np.array([segmentation_compute(merge_statistics([found[i] for i in row])).ap for row in draws])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (("sequences", 720), ("frames", 4), ("points", 512), ("resamples", 1000), ("repeat", 3)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    objects = sequences(options.sequences, options.frames, options.points)
    frames = options.sequences * options.frames
    own_s, (found, metrics) = timed(lambda: ours(objects), options.repeat)
    other_s, two = timed(lambda: libraries(objects), 1)
    print(
        f"{frames} frames x {options.points} points: ours (7 scores) {own_s:.2f} s, "
        f"scikit-learn (2 scores) {other_s:.2f} s"
    )
    metric, count = segmentation_weighted(found), len(found)
    boot_s, draws = timed(
        lambda: replicates(metric, count, np.random.default_rng(0), options.resamples), options.repeat
    )
    again_s, plain = timed(lambda: merged(found, _AGAIN), 1)
    print(
        f"{options.resamples} resamples of {count} sequences, {metrics.predictions} predictions: ours "
        f"{boot_s:.2f} s, merging again {again_s / _AGAIN * options.resamples:.1f} s (from {_AGAIN})"
    )
    same = np.allclose(two, (metrics.miou, metrics.ri), atol=1e-9) and np.allclose(
        draws["ap"][:_AGAIN], plain, atol=1e-9
    )
    if not same:
        print("the numbers differ", file=sys.stderr)
    if frames * options.points <= 2880 * 512 and own_s >= LIMIT_S:
        print(f"slower than {LIMIT_S:g} s", file=sys.stderr)
        return 1
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
