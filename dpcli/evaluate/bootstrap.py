"""Bootstrap intervals: how far a metric would move with other samples of the same kind (Efron & Tibshirani 1993).

Whole samples are resampled: a video of a scores file, a sequence of a parts file with all its frames and frame pairs,
which are not independent of one another. A metric is a function of how often each sample counts (`WeightedMetric`), so
a resample is a row of counts and a thousand of them are a few sums.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from dpcli.errors import UsageError
from dpcli.evaluate.proportions import divide
from dpcli.runtime.seeds import generator

WeightedMetric = Callable[[np.ndarray], dict[str, np.ndarray]]
"""Counts f64 (R,n), how often each of n samples counts in each of R resamples -> value f64 (R) by metric, NaN = 0/0."""

FEW = 10  # samples below which a bootstrap underestimates how far they may be from others
TOO_FEW = "Of 95 % intervals of a mean of 4 normal values, 80 % hold the true one; of 10, 89 %."
_BLOCK = 1 << 21  # counts in memory at once
_MOST_LEFT_OUT = 2000  # samples up to which each is left out once, for BCa's acceleration
_EQUAL = 1e-12  # relative: sums in another order


@dataclass(frozen=True)
class Resampling:
    """Says how to resample: `resamples` times (0 = no intervals), for intervals of `confidence` (0..1), from `seed`.

    Raises UsageError for a confidence outside 0..1 and for fewer than 100 resamples, of which intervals can't be read.
    """

    resamples: int = 2000
    confidence: float = 0.95
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.confidence < 1:
            raise UsageError(f"--confidence {self.confidence:g}: expected a share between 0 and 1, such as 0.95")
        if self.resamples < 0 or 0 < self.resamples < 100:
            raise UsageError(f"--resamples {self.resamples}: expected 100 or more, or 0 for no intervals")

    @property
    def title(self) -> str:
        """Returns what tables call the intervals, such as `95 % interval`."""
        return f"{100 * self.confidence:.4g} % interval"

    def intervals(self, metric: WeightedMetric, samples: int) -> dict[str, Interval]:
        """Returns the interval of each metric over `samples` samples; no intervals when `resamples` is 0."""
        if self.resamples == 0:
            return {}
        rng = generator(self.seed)
        return bootstrap(metric, samples, rng, resamples=self.resamples, confidence=self.confidence)


NO_INTERVALS = Resampling(0)


@dataclass(frozen=True)
class Interval:
    """Holds the ends of an interval in the metric's own unit; NaN = undefined (fewer than two samples, or a metric of 0/0)."""

    low: float
    high: float

    @property
    def defined(self) -> bool:
        """Tells whether the interval has ends."""
        return not np.isnan(self.low)


def ratios_of_sums(tops: Mapping[str, np.ndarray], bottoms: Mapping[str, np.ndarray]) -> WeightedMetric:
    """Returns the metrics that are a ratio of sums over the samples.

    tops, bottoms: numerator and denominator of each sample, f64 (n) by metric.

    >>> half = ratios_of_sums({"share": np.array([1, 0])}, {"share": np.array([1, 1])})
    >>> half(np.array([[1.0, 1], [2, 0]]))["share"].tolist()
    [0.5, 1.0]
    """
    keys = list(tops)
    top, bottom = (np.stack([np.asarray(side[key], np.float64) for key in keys], axis=1) for side in (tops, bottoms))

    def metric(counts: np.ndarray) -> dict[str, np.ndarray]:
        return dict(zip(keys, divide(counts @ top, counts @ bottom).T, strict=True))

    return metric


def means_of_samples(values: Mapping[str, np.ndarray]) -> WeightedMetric:
    """Returns the metrics that are a mean over the samples: f64 (n) by metric; NaN = the sample doesn't count for it."""
    defined = {key: ~np.isnan(value) for key, value in values.items()}
    return ratios_of_sums({key: np.nan_to_num(value) for key, value in values.items()}, defined)


def values_of_all(metric: WeightedMetric, samples: int) -> dict[str, float]:
    """Returns the value of each metric where each of `samples` samples counts once.

    >>> values_of_all(means_of_samples({"mean": np.arange(4.0)}), 4)
    {'mean': 1.5}
    """
    return {key: float(value[0]) for key, value in metric(np.ones((1, samples))).items()}


def drawn_counts(
    samples: int, resamples: int, rng: np.random.Generator
) -> Iterator[np.ndarray]:  # f64 (R,samples), blocks of rows
    """Draws `samples` samples with replacement, `resamples` times, and yields how often each was, blocks f64 (b,samples)."""
    rows = max(1, _BLOCK // max(samples, 1))
    for start in range(0, resamples, rows):
        count = min(rows, resamples - start)
        drawn = rng.integers(0, samples, (count, samples)) + samples * np.arange(count)[:, None]
        yield np.bincount(drawn.ravel(), minlength=count * samples).reshape(count, samples).astype(np.float64)


def replicates(metric: WeightedMetric, samples: int, rng: np.random.Generator, resamples: int) -> dict[str, np.ndarray]:
    """Returns the value of each metric in each resample, f64 (resamples)."""
    return _joined(metric(counts) for counts in drawn_counts(samples, resamples, rng))


def left_out_once(metric: WeightedMetric, samples: int) -> dict[str, np.ndarray] | None:
    """Returns the jackknife: the value of each metric without each sample, f64 (samples).

    Returns None for more than 2,000 of them: the acceleration that these values serve falls with the root of their
    number and no longer moves an interval there.
    """
    if samples > _MOST_LEFT_OUT:
        return None
    rows = max(1, _BLOCK // samples)
    return _joined(
        metric((np.arange(samples) != np.arange(start, min(start + rows, samples))[:, None]).astype(np.float64))
        for start in range(0, samples, rows)
    )


def _joined(parts: Iterator[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    parts = list(parts)
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def bootstrap(
    metric: WeightedMetric, samples: int, rng: np.random.Generator, *, resamples: int = 2000, confidence: float = 0.95
) -> dict[str, Interval]:
    """Returns the interval of each metric from resamples of `samples` samples: bias-corrected and accelerated (Efron 1987).

    A resample in which a metric is 0/0 doesn't count for it; when most are, or there is one sample only, the interval is
    undefined.

    >>> metric = means_of_samples({"mean": np.arange(10.0)})
    >>> ends = bootstrap(metric, 10, np.random.default_rng(0), resamples=1000)["mean"]
    >>> ends.low < 4.5 < ends.high
    True
    """
    estimate = values_of_all(metric, samples)
    if samples < 2:
        return {key: Interval(np.nan, np.nan) for key in estimate}
    found = replicates(metric, samples, rng, resamples)
    jackknife = left_out_once(metric, samples) or {}
    return {
        key: interval(estimate[key], found[key], confidence, bca=True, jackknife=jackknife.get(key)) for key in estimate
    }


def interval(
    estimate: float,
    replicate: np.ndarray,  # f64 (R), NaN = undefined
    confidence: float = 0.95,
    *,
    bca: bool = False,
    jackknife: np.ndarray | None = None,  # f64 (n)
) -> Interval:
    """Returns the interval of an estimate from its replicates: their percentiles, with `bca` moved by bias and acceleration.

    jackknife: the estimate without each sample; without it the acceleration is 0. Undefined where most replicates are.
    """
    defined = replicate[~np.isnan(replicate)]
    if np.isnan(estimate) or 2 * len(defined) < len(replicate) or len(defined) == 0:
        return Interval(np.nan, np.nan)
    defined = snapped(defined, estimate)
    shares = np.array([(1 - confidence) / 2, (1 + confidence) / 2])
    if bca:
        shares = _bca_shares(estimate, defined, shares, jackknife)
    low, high = np.quantile(defined, shares)
    return Interval(float(low), float(high))


def snapped(replicate: np.ndarray, estimate: float) -> np.ndarray:
    """Returns the replicates, those that equal the estimate but for rounding made equal to it."""
    return np.where(np.abs(replicate - estimate) <= _EQUAL * max(1.0, abs(estimate)), estimate, replicate)


def _bca_shares(estimate: float, replicate: np.ndarray, shares: np.ndarray, jackknife: np.ndarray | None) -> np.ndarray:
    """Returns the percentiles to take instead of `shares`: the same where all replicates lie on one side of the estimate."""
    below = float(((replicate < estimate).mean() + (replicate <= estimate).mean()) / 2)
    if not 0 < below < 1:
        return shares
    normal = NormalDist()  # scipy.special takes a quarter of a small evaluation to load
    bias, quantiles = normal.inv_cdf(below), np.array([normal.inv_cdf(share) for share in shares])
    moved = bias + (bias + quantiles) / (1 - _acceleration(jackknife) * (bias + quantiles))
    return np.array([normal.cdf(quantile) for quantile in moved])


def _acceleration(jackknife: np.ndarray | None) -> float:
    if jackknife is None or np.isnan(jackknife).any():
        return 0.0
    away = jackknife.mean() - jackknife
    spread = float((away**2).sum())
    return float((away**3).sum() / (6 * spread**1.5)) if spread > 1e-24 else 0.0


def two_sided_p(replicate: np.ndarray) -> float:
    """Returns the p value of "no difference" from replicates of a difference, f64 (R).

    It is twice the smaller share on one side of 0, counts the observed data as one more resample (so it is never 0),
    falls below 1 - confidence where the percentile interval leaves out 0, and is 1 where nothing differs. NaN without
    defined replicates.

    >>> two_sided_p(np.array([0.1] * 98 + [-0.1]))
    0.04
    """
    defined = replicate[~np.isnan(replicate)]
    if len(defined) == 0:
        return float("nan")
    sides = [(1 + int((sign * defined <= _EQUAL).sum())) / (1 + len(defined)) for sign in (1, -1)]
    return min(1.0, 2 * min(sides))
