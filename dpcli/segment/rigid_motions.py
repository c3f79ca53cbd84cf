"""Rigid motions as matrices of a rotation and a shift, (...,3,4) or (...,4,4): moved by, fitted, composed and compared."""

from __future__ import annotations

import numpy as np

HOLD = 4  # common points that can hold a motion


def move(motion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Returns points (N,3) after motions (...,3,4) or (...,4,4): (...,N,3).

    >>> move(np.eye(4), np.ones((1, 3))).tolist()
    [[1.0, 1.0, 1.0]]
    """
    return points @ np.swapaxes(motion[..., :3, :3], -1, -2) + motion[..., None, :3, 3]


def move_each(motions: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Returns each of points (N,3) after its own of motions (N,3,4) or (N,4,4)."""
    return np.einsum("nij,nj->ni", motions[:, :3, :3], points) + motions[:, :3, 3]


def bring_to_rest(points: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Returns points (N,3) in a body's own coordinates, from which a motion (3,4) or (4,4) takes them to where they are."""
    return (points - motion[:3, 3]) @ motion[:3, :3]


def compose(after: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Returns motions (...,3,4) that make `before` and then `after`, (...,3,4) each."""
    turn = after[..., :3]
    return np.concatenate([turn @ before[..., :3], turn @ before[..., 3:] + after[..., 3:]], -1)


def invert(motion: np.ndarray) -> np.ndarray:
    """Returns the inverses of motions (...,3,4)."""
    back = np.swapaxes(motion[..., :3], -1, -2)
    return np.concatenate([back, -back @ motion[..., 3:]], -1)


def motion_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Returns the motions (...,3,4) that lead from where motions `first` take a body to where `second` do, (...,3,4) each."""
    turn = second[..., :3] @ np.swapaxes(first[..., :3], -1, -2)
    return np.concatenate([turn, second[..., 3:] - turn @ first[..., 3:]], -1)


def fit_motions(source: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Returns the rigid motions (B,3,4) that take source (B,n,3) nearest to target (B,n,3), in the least squares.

    weights: f (B,n), of points. Fewer than four points, which hold no turn surely, are shifted.
    """
    weights = np.ones(source.shape[:2]) if weights is None else weights
    weights = (weights / weights.sum(1, keepdims=True))[..., None]
    a, b = (weights * source).sum(1), (weights * target).sum(1)
    rotation = np.tile(np.eye(3), (len(source), 1, 1))
    if source.shape[1] >= HOLD:
        left, _, right = np.linalg.svd(np.swapaxes(target - b[:, None], 1, 2) @ (weights * (source - a[:, None])))
        left[:, :, 2] *= np.where(np.linalg.det(left @ right) < 0, -1, 1)[:, None]
        rotation = left @ right
    return np.concatenate([rotation, (b - (rotation @ a[..., None])[..., 0])[..., None]], 2)
