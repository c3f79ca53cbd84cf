"""True rigid motions of parts and the scene flow that follows from them, from part-to-world poses."""

from __future__ import annotations

import numpy as np

from dpcli.errors import DataError


def true_motion(pose: np.ndarray, source: int, target: int) -> np.ndarray:
    """Returns the motion of each part from frame `source` to `target`, f64 (parts,4,4), from part-to-world poses (F,parts,4,4).

    Raises DataError when a pose is not finite or can't be inverted.
    """
    try:
        motion = pose[target] @ np.linalg.inv(pose[source])
    except np.linalg.LinAlgError:
        motion = np.full(1, np.nan)
    if not np.isfinite(motion).all():
        raise DataError(f"a true pose of frame {source} or {target} is not finite or can't be inverted")
    return motion


def true_flow(points: np.ndarray, part: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Returns the displacement f64 (N,3) of points f (N,3) that belong to parts i (N) >= 0 with motions f (parts,4,4).

    >>> shift = np.eye(4)[None].copy()
    >>> shift[0, :3, 3] = 1, 0, 0
    >>> true_flow(np.zeros((1, 3)), np.array([0]), shift).tolist()
    [[1.0, 0.0, 0.0]]
    """
    own = motion[part]
    return np.einsum("nij,nj->ni", own[:, :3, :3], points.astype(np.float64)) + own[:, :3, 3] - points


def rotation_angle(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Returns the angle f64 (M) in radians, 0..pi, between rotations f (M,3,3), precise also for small angles.

    >>> quarter = np.array([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]])
    >>> bool(np.isclose(rotation_angle(np.eye(3)[None], quarter), np.pi / 2)[0])
    True
    """
    chord = np.linalg.norm(first - second, axis=(-2, -1)) / np.sqrt(8)
    return 2 * np.arcsin(np.clip(chord, 0, 1))
