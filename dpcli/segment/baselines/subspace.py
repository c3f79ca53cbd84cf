"""The clustering of trajectories: an affinity that says which points move together, and its spectral clustering."""

from __future__ import annotations

import numpy as np

_STEPS = 100  # of ADMM; more change the scores of the parts by less than their noise
_STARTS = 5  # of k-means


def sparse_affinity(
    trajectories: np.ndarray,  # [N, T, 3]
    alpha: float = 800.0,
    steps: int = _STEPS,
) -> np.ndarray:  # [N, N]
    """Returns the affinity f32 (N,N) of sparse subspace clustering: symmetric, >= 0, columns scaled to maximum 1.

    Each trajectory is written as an affine combination of few others, min |C|_1 + lambda/2 |Y - Y C|^2 with diag C = 0
    and columns that sum to 1, because trajectories of one rigid body lie in an affine subspace of 3 dimensions (so
    motions that all points share change nothing); the affinity is |C| + |C|^T. lambda is alpha over the smallest, among
    the points, of their largest inner product; the solver is ADMM. Elhamifar & Vidal, Sparse Subspace Clustering, TPAMI
    2013.
    """
    data = trajectories.reshape(len(trajectories), -1).T.astype(np.float64)  # [3T, N]
    data -= data.mean(1, keepdims=True)
    data /= max(np.linalg.norm(data, axis=0).max(), 1e-12)
    likeness = np.abs(data.T @ data)
    np.fill_diagonal(likeness, 0)
    fit = alpha / max(likeness.max(0).min(), 1e-6)
    codes = np.abs(_affine_lasso(data, fit, alpha, steps))
    codes /= np.maximum(codes.max(0), 1e-12)
    return codes + codes.T


def _affine_lasso(data: np.ndarray, fit: float, rho: float, steps: int) -> np.ndarray:
    """Returns the codes C f32 (N,N) of `sparse_affinity`'s problem; rho is ADMM's penalty, everything is divided by it.

    The dense step's system I + low^T low has rank 3T + 1 beside the identity: solved through that (Woodbury).
    """
    count = data.shape[1]
    low = np.concatenate([np.sqrt(fit / rho) * data, np.ones((1, count))])
    inner = np.linalg.solve(np.eye(len(low)) + low @ low.T, low).astype(np.float32)
    low = low.astype(np.float32)
    goal = low.T @ low  # the data's own inner products, and the ones of the affine constraint
    codes, dual = np.zeros_like(goal), np.zeros_like(goal)
    sums = np.zeros(count, np.float32)
    for _ in range(steps):
        dense = goal + codes
        dense -= dual
        dense -= sums
        dense -= low.T @ (inner @ dense)
        dual += dense
        np.subtract(dual, np.clip(dual, -1 / rho, 1 / rho), out=codes)  # soft threshold
        np.fill_diagonal(codes, 0)
        dual -= codes
        sums += dense.sum(0) - 1
    return codes


def trajectory_affinity(
    trajectories: np.ndarray,  # [N, T, 3]
    motion: np.ndarray,  # [N, T - 1, 3]
    sigma: float = 0.1,
    reach: float = 0.1,
) -> np.ndarray:  # [N, N]
    """Returns the affinity f64 (N,N) in 0..1 of pairs, by their most different motion: exp(-max_t d |m_i - m_j|^2).

    d is the mean distance of two trajectories in units of `reach`, motions count in units of `sigma` (both lengths).
    Brox & Malik, ECCV 2010; Ochs, Malik & Brox, TPAMI 2014, with one sigma in place of the image's local variation.
    """
    from scipy.spatial.distance import cdist

    apart, differs = np.zeros((2, len(motion), len(motion)))
    # frame by frame: all of a long sequence's distances would fill the memory
    for points in trajectories.swapaxes(0, 1):
        apart += np.sqrt(cdist(points, points, "sqeuclidean"))
    for way in motion.swapaxes(0, 1):
        np.maximum(differs, cdist(way, way, "sqeuclidean"), out=differs)
    return np.exp(-(apart / trajectories.shape[1]) / reach * differs / sigma**2)


def spectral_parts(
    affinity: np.ndarray,  # [N, N]
    num_parts: int | None,
    fewest: int,
    most: int,
    rng: np.random.Generator,
) -> np.ndarray:  # [N]
    """Returns clusters i64 (N) of a graph, by its normalized Laplacian's lowest eigenvectors (Ng, Jordan & Weiss 2001).

    num_parts None: estimated by the eigengap, between fewest and most.
    """
    from scipy.linalg import eigh

    count = len(affinity)
    scale = 1 / np.sqrt(np.maximum(affinity.sum(1, dtype=np.float64), 1e-12))
    laplacian = np.eye(count) - scale[:, None] * affinity * scale
    highest = min(most if num_parts is None else num_parts, count - 1)
    values, vectors = eigh(laplacian, subset_by_index=[0, highest])
    if num_parts is None:
        num_parts = eigengap(values, fewest)
    rows = vectors[:, :num_parts]
    rows = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
    return _k_means(rows, num_parts, rng)


def eigengap(values: np.ndarray, fewest: int = 1) -> int:
    """Returns how many of the ascending eigenvalues (M) lie below the widest gap, fewest..M-1; of equal gaps the first.

    fewest, or M where that is less, when no gap is left. von Luxburg, A Tutorial on Spectral Clustering, 2007.

    >>> eigengap(np.array([0.0, 0.0, 0.0, 0.8, 0.9]))
    3
    """
    gaps = np.diff(values)[fewest - 1 :]
    return fewest + int(np.argmax(gaps > gaps.max() - 1e-9)) if len(gaps) else min(fewest, len(values))


def _k_means(rows: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Returns the clusters i64 (N) of rows (N,D); there are no more clusters than different rows."""
    from sklearn.cluster import KMeans

    count = min(count, len(np.unique(rows.round(6), axis=0)))
    if count == 1:
        return np.zeros(len(rows), np.int64)
    seed = int(rng.integers(2**31))
    return KMeans(count, n_init=_STARTS, random_state=seed).fit_predict(rows.round(6)).astype(np.int64)
