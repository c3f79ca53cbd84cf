"""The Frechet distance between two sets of features taken as normal distributions, and its sufficient statistics."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce

import numpy as np

from dpcli.errors import DataError

ROOTS = ("eig", "scipy", "svd")
_JITTER = 1e-6
_TINY = 1e-10  # singular values under it are not rooted by TF-GAN's square root


@dataclass(frozen=True)
class FeatureStatistics:
    """Holds the sufficient statistics of N samples of D features, all f64.

    rows (R,D): samples as they came, at most D of them. count, total (D), outer (D,D): how many more were summed up,
    their sum, and the sum of their outer products; None where none was. Few samples keep every digit this way: a
    covariance of less than full rank has no square root worth its name when it comes from sums.
    """

    rows: np.ndarray
    count: int = 0
    total: np.ndarray | None = None
    outer: np.ndarray | None = None

    @property
    def samples(self) -> int:
        """Returns the number N of samples."""
        return self.count + len(self.rows)

    @property
    def mean(self) -> np.ndarray:
        """Returns the mean, f64 (D). Raises DataError without samples."""
        if not self.samples:
            raise DataError("no features: an empty set has no mean")
        return (self.rows.sum(0) + (0 if self.total is None else self.total)) / self.samples

    @property
    def covariance(self) -> np.ndarray:
        """Returns the covariance, f64 (D,D), denominator N - 1. Raises DataError for fewer than two samples."""
        self._check_spread()
        factor = self.rows - self.mean
        summed = factor.T @ factor
        if self.outer is not None:
            mean = self.total / self.count
            apart = mean - self.mean
            summed += self.outer - self.count * np.outer(mean, mean) + self.count * np.outer(apart, apart)
        return summed / (self.samples - 1)

    def factor(self) -> np.ndarray:
        """Returns A, f64 (R,D), with A^T A = covariance; R = number of samples, or D where some are summed up."""
        self._check_spread()
        if self.outer is None:
            return (self.rows - self.mean) / np.sqrt(self.samples - 1)
        values, vectors = np.linalg.eigh(self.covariance)
        return np.sqrt(values.clip(0))[:, None] * vectors.T

    def __add__(self, other: FeatureStatistics) -> FeatureStatistics:
        """Returns the statistics of both sets together. Raises DataError when they have different numbers of features."""
        if self.rows.shape[1] != other.rows.shape[1]:
            raise DataError(
                f"features of {self.rows.shape[1]} and of {other.rows.shape[1]} values: two networks' can't be compared"
            )
        rows = np.concatenate([self.rows, other.rows])
        total, outer = (_sum(getattr(self, key), getattr(other, key)) for key in ("total", "outer"))
        return _folded(FeatureStatistics(rows, self.count + other.count, total, outer))

    def _check_spread(self) -> None:
        if self.samples < 2:
            raise DataError(
                f"{self.samples} sample where a distribution needs at least 2: compare more videos, cut them "
                "into windows, or take one against one by the closed form (fvd variant consistent4d)"
            )


def feature_update(features: np.ndarray, before: FeatureStatistics | None = None) -> FeatureStatistics:
    """Adds features f (N,D) to the statistics and returns them. Raises DataError for non-finite ones, ValueError for shapes."""
    rows = np.asarray(features, np.float64)
    if rows.ndim != 2:
        raise ValueError(f"features must have shape (N,D), but have {rows.shape}")
    broken = ~np.isfinite(rows).all(1)
    if broken.any():
        raise DataError(
            f"features of {int(broken.sum())} of {len(rows)} samples are NaN or infinite, the first is sample "
            f"{int(broken.argmax())}: look at its pictures, or fetch the network's weights again"
        )
    found = _folded(FeatureStatistics(rows))
    return found if before is None else before + found


def feature_merge(parts: Iterable[FeatureStatistics]) -> FeatureStatistics:
    """Returns the statistics of all sets together. Raises DataError when there is none."""
    parts = list(parts)
    if not parts:
        raise DataError("no features to merge: no video had enough frames")
    return reduce(FeatureStatistics.__add__, parts)


def frechet_distance(a: FeatureStatistics, b: FeatureStatistics, *, root: str = "eig", single: str = "error") -> float:
    """Returns |mu_a - mu_b|^2 + Tr(S_a + S_b - 2 (S_a S_b)^(1/2)), in float64, never under 0 (Dowson & Landau 1982).

    root: how the trace of (S_a S_b)^(1/2) is found. eig: the sum of the singular values of A B^T, where S_a = A^T A, S_b
    = B^T B: exact for any rank; scipy: scipy.linalg.sqrtm of the product, with 1e-6 on both diagonals where that is
    not finite (StyleGAN-V, DisCo, pytorch-fid); svd: TF-GAN's symmetric square roots (VideoGPT).
    single: with fewer than two samples on a side, "error" (DataError) or "mean": the first term alone (common_metrics).
    Raises ValueError for another root.

    >>> left, right = (feature_update(np.array([[0.0], [2.0]]) + shift) for shift in (0, 3))
    >>> round(frechet_distance(left, right), 9)
    9.0
    """
    if root not in ROOTS:
        raise ValueError(f"root {root!r}: expected {', '.join(ROOTS)}")
    if a.rows.shape[1] != b.rows.shape[1]:
        raise DataError(f"features of {a.rows.shape[1]} and of {b.rows.shape[1]} values: from two networks?")
    between = float(np.square(a.mean - b.mean).sum())
    if single == "mean" and min(a.samples, b.samples) < 2:
        return between
    if root == "eig":
        own, other = a.factor(), b.factor()
        spread = np.square(own).sum() + np.square(other).sum()
        shared = np.linalg.svd(own @ other.T, compute_uv=False).sum()
    else:
        own, other = a.covariance, b.covariance
        spread = np.trace(own) + np.trace(other)
        shared = _trace_sqrtm(own, other) if root == "scipy" else _trace_svd(own, other)
    return max(between + float(spread - 2 * shared), 0.0)


def single_video_distance(predicted: np.ndarray, truth: np.ndarray) -> float:
    """Returns |f - g|^2 + (std f - std g)^2, std over a video's D features with denominator D - 1: one video against one.

    What Consistent4D's script gives with numpy < 2.2, whose `cov` reads one row of features as D observations of one
    variable (numpy 2.2 and later give NaN). f, g (D). Raises DataError for features that are not finite.

    >>> single_video_distance(np.array([0.0, 2.0]), np.array([1.0, 3.0]))
    2.0
    """
    f, g = (feature_update(np.asarray(values).reshape(1, -1)).rows[0] for values in (predicted, truth))
    if f.shape != g.shape or len(f) < 2:
        raise ValueError(f"features of {len(f)} and {len(g)} values; expected equally many, 2 or more")
    return float(np.square(f - g).sum() + (f.std(ddof=1) - g.std(ddof=1)) ** 2)


def _sum(own: np.ndarray | None, other: np.ndarray | None) -> np.ndarray | None:
    return other if own is None else own if other is None else own + other


def _folded(found: FeatureStatistics) -> FeatureStatistics:
    """Returns the same statistics, rows summed up where they are more than the sums would be."""
    rows = found.rows
    if len(rows) <= rows.shape[1]:
        return found
    total, outer = _sum(found.total, rows.sum(0)), _sum(found.outer, rows.T @ rows)
    return FeatureStatistics(rows[:0], found.count + len(rows), total, outer)


def _trace_sqrtm(own: np.ndarray, other: np.ndarray) -> float:
    import warnings

    from scipy.linalg import sqrtm

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the product is singular is known, and looked at below
        found = np.asarray(sqrtm(own @ other))
        if not np.isfinite(found).all():
            shift = np.eye(len(own)) * _JITTER
            found = np.asarray(sqrtm((own + shift) @ (other + shift)))
    if not np.isfinite(found).all():
        raise DataError("the covariances' product has no finite square root; root eig has no such limit")
    return float(np.trace(found).real)


def _trace_svd(own: np.ndarray, other: np.ndarray) -> float:
    half = _symmetric_root(own)
    return float(np.trace(_symmetric_root(half @ other @ half)))


def _symmetric_root(matrix: np.ndarray) -> np.ndarray:
    u, s, vt = np.linalg.svd(matrix)
    return (u * np.where(s < _TINY, s, np.sqrt(s))) @ vt
