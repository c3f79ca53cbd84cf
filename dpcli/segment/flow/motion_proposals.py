"""Proposals for the search of rigid bodies: regions of a cloud, and motions that articulated things often make."""

from __future__ import annotations

import numpy as np

from dpcli.ops import fps_numpy
from dpcli.segment.flow.icp_kernels import distinct_kernel, lloyd_kernel

ANGLES = (-0.6, -0.3, 0.3, 0.6)  # radians
SHIFTS = (-0.18, -0.08, 0.08, 0.18)  # diameters
SPINS = (-0.4, 0.4)  # radians
_HINGES, _ACROSS = np.array([0, 1, 0, 1]), np.array([1, 0, 2, 2])  # axes of the edges turned about, and where they lie
_TURNED = np.array([*np.tile(np.repeat(_HINGES, len(ANGLES)), 2), 2, 2])  # the axis of each turn and spin
_ANGLES = np.array([*ANGLES * 8, *SPINS])
_LLOYD_ROUNDS = 5  # of k-means


def turn_about(axes: np.ndarray, angles: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Returns motions (H,3,4) that turn by angles (H), radians, about unit axes (H,3) through centers (H,3) or (3).

    By Rodrigues' formula.
    """
    x, y, z = axes.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    sine, versine = np.sin(angles)[:, None, None], 1 - np.cos(angles)[:, None, None]
    rotation = np.eye(3) + sine * cross + versine * cross @ cross
    centers = np.broadcast_to(centers, axes.shape)[:, :, None]
    return np.concatenate([rotation, centers - rotation @ centers], 2)


def shift_by(offsets: np.ndarray) -> np.ndarray:
    """Returns motions (H,3,4) that shift by offsets (H,3) and don't turn."""
    return np.concatenate([np.broadcast_to(np.eye(3), (len(offsets), 3, 3)), offsets[:, :, None]], 2)


def propose_motions(points: np.ndarray, lonely: np.ndarray) -> np.ndarray:
    """Returns motions (H,3,4) that a part (n,3) is likely to make.

    They turn about its edges (doors, lids), about its normal (blades), leave it where it is, shift along its axes (drawers),
    and shift it onto each of the places `lonely` (Q,3) of the other frame that nothing has reached yet.
    """
    center = points.mean(0)
    apart = points - center
    axes = np.linalg.eigh(apart.T @ apart)[1].T[::-1]  # longest first, the normal last
    extent = np.abs(apart @ axes.T).max(0)
    edge = extent[_ACROSS, None] * axes[_ACROSS]
    sides = np.repeat(np.concatenate([-edge, edge]), len(ANGLES), 0)
    offsets = [np.zeros((1, 3)), (np.array(SHIFTS)[:, None, None] * axes).reshape(-1, 3), lonely - center]
    turns = turn_about(axes[_TURNED], _ANGLES, center + np.concatenate([sides, np.zeros((len(SPINS), 3))]))
    return np.concatenate([turns, shift_by(np.concatenate(offsets))])


def choose_distinct(motions: np.ndarray, score: np.ndarray, points: np.ndarray, apart: float, most: int) -> list[int]:
    """Returns indices of the best (lowest) scored motions, at most `most`.

    No two of them move every point to within `apart` of each other.
    """
    chosen = np.empty(most, np.int64)
    corners = points[:: max(1, len(points) // 12)]
    moved = np.einsum("hij,nj->hni", motions[:, :, :3], corners) + motions[:, None, :, 3]
    found = distinct_kernel(moved, np.argsort(score, kind="stable"), apart, chosen)
    return chosen[:found].tolist()


def cluster_patches(points: np.ndarray, count: int) -> np.ndarray:
    """Returns the patch i64 (N) of each point (N,3 or more): k-means (Lloyd) from farthest points; the same every time."""
    center = points[fps_numpy(points[:, :3], min(count, len(points)))].astype(np.float64)
    patch = np.zeros(len(points), np.int64)
    lloyd_kernel(np.ascontiguousarray(points, np.float32), center, _LLOYD_ROUNDS, patch)
    return patch


def find_patch_centers(points: np.ndarray) -> np.ndarray:
    """Returns up to 4 centers (Q,3) of patches of about 12 points; none for fewer than 6 points."""
    if len(points) < 6:
        return np.zeros((0, 3))
    patch = cluster_patches(points, min(4, max(1, len(points) // 12)))
    return np.stack([points[patch == k].mean(0) for k in np.unique(patch)]).astype(np.float64)


def find_components(chosen: np.ndarray, neighbors: np.ndarray) -> list[np.ndarray]:
    """Returns connected sets of the chosen points (mask (N)) in the graph of neighbors (N,k), as index arrays."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    index = np.flatnonzero(chosen)
    place = np.full(len(chosen), -1)
    place[index] = np.arange(len(index))
    ends = place[neighbors[index]]
    row, column = np.nonzero(ends >= 0)
    graph = coo_matrix((np.ones(len(row)), (row, ends[row, column])), (len(index), len(index)))
    count, part = connected_components(graph, directed=False)
    return [index[part == k] for k in range(count)]
