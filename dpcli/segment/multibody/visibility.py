"""Depth maps: what a camera could see of a frame, and which moved points would be hidden from it.

A surface that turns out of view leaves its points without a match in other frames. Where a motion takes a point behind what
the camera saw there, the missing match says nothing against that motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dpcli.ops.cpu.jit import inlined, kernel
from dpcli.segment.rigid_motions import compose, move

_HIDDEN_COST = 0.5  # of a hidden point at most: between what is explained (some 0.2) and what isn't (1)
_BEHIND = 1.5  # spacings that a hidden point lies behind all that is seen there
_CELL = 1.2  # spacings that a cell of a depth map is wide at the points' mean depth
_MOST_CELLS = 512  # of a depth map along an axis


@dataclass(frozen=True)
class DepthMap:
    """Holds how deep one frame's points lie in the cells of a picture.

    camera (3,4): takes coordinates to right, down and ahead of the camera. per_cell: cells of a unit at depth 1. first (2):
    row and column of cell [0, 0]. far f32 (H,W): the largest depth in a cell and the eight around it, -inf without a point.
    near f32 (H,W): the smallest depth in a cell, inf without a point. margin: how much deeper than `far` a hidden point lies.
    """

    camera: np.ndarray
    per_cell: float
    first: np.ndarray
    far: np.ndarray
    near: np.ndarray
    margin: float

    @classmethod
    def of(cls, points: np.ndarray, camera: np.ndarray, spacing: float) -> DepthMap:
        """Returns the depth map of points (N,3); those that are not ahead of the camera are left out."""
        place = move(camera, points)
        place = place[place[:, 2] > spacing]
        if not len(place):
            nowhere = np.full((1, 1), np.inf, np.float32)
            return cls(camera, 1.0, np.zeros(2, np.int64), -nowhere, nowhere, spacing)
        flat = place[:, 1::-1] / place[:, 2:]
        low, high = flat.min(0), flat.max(0)
        per_cell = 1 / max(_CELL * spacing / float(place[:, 2].mean()), float((high - low).max()) / _MOST_CELLS)
        first = np.floor(low * per_cell).astype(np.int64) - 1
        rows, columns = np.floor(high * per_cell).astype(np.int64) - first + 2
        far, near = np.full((rows, columns), -np.inf, np.float32), np.full((rows, columns), np.inf, np.float32)
        draw_kernel(np.floor(flat * per_cell).astype(np.int64) - first, place[:, 2], far, near)
        return cls(camera, per_cell, first, far, near, _BEHIND * spacing)

    def look(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the depths (n) of points (n,3), and the largest and smallest depth f32 (n) seen where they are."""
        seen = np.empty((3, len(points)), np.float32)
        look_kernel(points, self.camera, self.per_cell, self.first, self.far, self.near, seen)
        return tuple(seen)

    def hide(self, points: np.ndarray, motion: np.ndarray, start: int, cost: np.ndarray, nearest: np.ndarray) -> None:
        """Takes back what `Surface.explain` held against points f32 (3,n) that a motion (3,4) hides in this frame.

        Of these the cost f32 (n) is no more than `_HIDDEN_COST`, and if it was, the point itself, `start` plus its index, is
        in `nearest` i32 (n), so that its label needs no support from this frame.
        """
        camera = compose(self.camera, motion)
        hide_kernel(
            points, camera, self.per_cell, self.first, self.far, self.margin, _HIDDEN_COST, start, cost, nearest
        )


@kernel
def draw_kernel(index, depth, far, near):
    """Draws points of depths f64 (n) in cells i64 (n,2), off the rim, into `far` and `near` of a `DepthMap`."""
    for i in range(len(depth)):
        row, column = index[i, 0], index[i, 1]
        near[row, column] = min(near[row, column], depth[i])
        for r in range(row - 1, row + 2):
            for c in range(column - 1, column + 2):
                far[r, c] = max(far[r, c], depth[i])


@kernel
def look_kernel(points, camera, per_cell, first, far, near, seen):
    """Writes depth, `far` and `near` of points f64 (n,3) to seen f32 (3,n); see `DepthMap.look`."""
    for i in range(len(points)):
        row, column, depth = _cell(points[i, 0], points[i, 1], points[i, 2], camera, per_cell, first, far.shape)
        seen[0, i] = depth
        seen[1, i] = far[row, column]
        seen[2, i] = near[row, column]


@kernel
def hide_kernel(points, camera, per_cell, first, far, margin, most, start, cost, nearest):
    """Lowers cost f32 (n) to `most` where points f32 (3,n) lie deeper than `far` and `margin`; see `DepthMap.hide`."""
    for i in range(points.shape[1]):
        if cost[i] > most:
            row, column, depth = _cell(points[0, i], points[1, i], points[2, i], camera, per_cell, first, far.shape)
            if far[row, column] > 0 and depth > far[row, column] + margin:
                cost[i] = most
                nearest[i] = start + i


@inlined
def _cell(x, y, z, camera, per_cell, first, shape):
    """Returns row, column and depth of a point; on the rim, which is empty, if it is in no cell or not before the camera."""
    depth = camera[2, 0] * x + camera[2, 1] * y + camera[2, 2] * z + camera[2, 3]
    if depth > 1e-6:
        scale = per_cell / depth
        right = camera[0, 0] * x + camera[0, 1] * y + camera[0, 2] * z + camera[0, 3]
        down = camera[1, 0] * x + camera[1, 1] * y + camera[1, 2] * z + camera[1, 3]
        row, column = math.floor(down * scale) - first[0], math.floor(right * scale) - first[1]
        if 0 <= row < shape[0] and 0 <= column < shape[1]:
            return row, column, depth
    return 0, 0, depth
