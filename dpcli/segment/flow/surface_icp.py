"""A cloud prepared for many searches (normals, neighbors, a grid of nearest points), and the ICP onto it."""

from __future__ import annotations

import numpy as np

from dpcli.segment.flow.icp_kernels import (
    cover_kernel,
    explain_kernel,
    hypotheses_kernel,
    icp_kernel,
    linearize_kernel,
    residual_kernel,
)

_CELL, _MARGIN = 0.03, 0.12  # of the grid, in diameters of the cloud: callers scale their clouds to about 1
_CELLS = 96  # at most, along an axis
_AROUND = 9  # points tried per look-up: the nearest to the cell's center and its neighbors
_OF_EIGHTH = 0.31  # nearest over 8th nearest distance in random samples of a surface; duplicates make the former small
SHARE = 0.3  # of the distance to the point itself in an ICP step, besides the distance to its plane


class Surface:
    """Holds points (N,3) f32, of diameter about 1 and N >= 9, with what a search needs.

    `neighbors` i64 (N,8) without the point itself; `normals` f32 (N,3) by the plane through 8 points, of either sign;
    `spacing`: mean distance of neighbors.
    """

    def __init__(self, points: np.ndarray) -> None:
        from scipy.spatial import cKDTree

        self.points = np.ascontiguousarray(points, np.float32)
        distance, found = cKDTree(self.points).query(self.points, _AROUND)
        self.spacing = float(max(distance[:, 1].mean(), _OF_EIGHTH * distance[:, -1].mean()))
        self.neighbors = found[:, 1:]
        patch = self.points[found[:, :8]].astype(np.float64)
        patch -= patch.mean(1, keepdims=True)
        self.normals = np.linalg.eigh(patch.transpose(0, 2, 1) @ patch)[1][:, :, 0].astype(np.float32)
        origin = self.points.min(0) - np.float32(_MARGIN)
        extent = self.points.max(0) + np.float32(_MARGIN) - origin
        cell = max(_CELL, float(extent.max()) / _CELLS)
        cells = np.ceil(extent / cell).astype(int) + 1
        self.columns = columns(self.points)
        grid = np.full(cells, -1, np.int32)
        near = np.full((len(self.points), 3, 16), 1e9, np.float32)
        near[:, :, :_AROUND] = self.points[found].transpose(0, 2, 1)
        self._search = (
            self.columns,
            columns(self.normals),
            found.astype(np.int32),
            near,
            grid,
            origin,
            np.float32(1 / cell),
        )

    def icp(self, source: np.ndarray, motion: np.ndarray, steps: int, wide: float, narrow: float) -> np.ndarray:
        """Returns the motion (3,4) that brings source (3,n) f32 onto the cloud, from a first one.

        The ICP is robust and point to plane.
        """
        motion = motion.copy()
        icp_kernel(source, self._search, motion, steps, wide, narrow, SHARE)
        return motion

    def icp_many(
        self,
        source: np.ndarray,
        motions: np.ndarray,
        steps: int,
        wide: float,
        narrow: float,
        share: float,
        scale: float,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns where ICP ends from motions (H,3,4): motions (h,3,4), and their mean saturated residuals (h).

        After a third of the steps the worse half is given up.
        """
        motions, score = motions.copy(), np.empty(len(motions))
        settings = (SHARE, share, scale)
        half, middle = steps // 3, (wide * wide * narrow) ** (1 / 3)
        hypotheses_kernel(source, self._search, motions, half, wide, middle, *settings, score)
        best = np.argsort(score, kind="stable")[: max(len(motions) // 2, 4)]
        motions, score = motions[best], score[best]
        hypotheses_kernel(source, self._search, motions, steps - half, middle, narrow, *settings, score)
        return motions, score

    def linearize(
        self, source: np.ndarray, motion: np.ndarray, scale: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the normal equations of a step of `icp` at a motion: matrix (6,6), vector (6), center (3).

        Their solution is a rotation vector about the center, and a shift. source (3,n) f32, n >= 1.
        """
        matrix, vector, center = np.empty((6, 6)), np.empty(6), np.empty(3)
        linearize_kernel(source, self._search, motion, scale, SHARE, matrix, vector, center)
        return matrix, vector, center

    def residuals(self, source: np.ndarray, motion: np.ndarray, share: float) -> np.ndarray:
        """Returns squared residuals (n) of source (3,n) f32, moved: point to plane, and `share` of point to point."""
        out, at = np.empty(source.shape[1]), np.empty(source.shape[1], np.int64)
        residual_kernel(source, self._search, motion, share, out, at)
        return out

    def explain(
        self,
        source: np.ndarray,
        motion: np.ndarray,
        share: float,
        scale: float,
        first: int,
        cost: np.ndarray,
        nearest: np.ndarray,
    ) -> None:
        """Adds d^2 / (d^2 + scale^2) to cost f32 (n), d^2 as in `residuals`.

        nearest i32 (n) gets `first` plus each nearest point's index.
        """
        explain_kernel(source, self._search, motion, share, scale, first, cost, nearest)

    def covered_by(self, moved: np.ndarray, normals: np.ndarray, share: float) -> np.ndarray:
        """Returns squared residuals (N) of this cloud's points to another one, moved (n,3), with its normals (n,3)."""
        out = np.empty(len(self.points))
        cover_kernel(columns(moved), columns(normals), self.columns, share, out)
        return out


def columns(points: np.ndarray) -> np.ndarray:
    """Returns points (N,3) as contiguous f32 (3,N)."""
    return np.ascontiguousarray(np.asarray(points, np.float32).T)
