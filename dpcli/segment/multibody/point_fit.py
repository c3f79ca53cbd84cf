"""Fits a hinge or slide to the points of its two parts, in all frames at once, by robust Gauss-Newton onto whole frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpcli.ops.rotations import rotation_matrix, rotation_vector
from dpcli.segment.flow.surface_icp import columns
from dpcli.segment.kinematics.joint_fit import JointFit
from dpcli.segment.multibody.frames import Frames, Trajectory
from dpcli.segment.rigid_motions import compose, motion_between
from dpcli.store.joints import REVOLUTE

NUMBER_PRICE = 1.5  # costs of a point that each number of a motion must save
_NARROW = 0.5  # last residual, in spacings
_LONGEST = 0.5  # step, in radians and sizes of the parts
_NUDGE = 1e-5  # of a number, for derivatives


class PointFit:
    """Holds a joint between two parts of `Frames` while it is fitted: to the child's points, and the parent's if it may move.

    joint: in the parent's own coordinates, its value 0 in frame 0. parent: trajectory (T,3,4), at rest in frame 0. Numbers of
    a step: tilt of the axis (2, unless it is kept), shift of a hinge's line (2), values since frame 0 (T-1), and twists of
    the parent since frame 0 (6(T-1), if it may move).
    """

    def __init__(
        self,
        frames: Frames,
        child: np.ndarray,
        trajectory: Trajectory,
        start: JointFit,
        *,
        parent: np.ndarray | None = None,
        keep_axis: bool = False,
    ) -> None:
        """Begins at a joint, and the parent's trajectory. child, parent: masks (N) of points; none: the parent stays as it is."""
        self.frames, self.parent = frames, trajectory
        self.joint = replace(start, value=start.value - start.value[0])
        self._pairs = np.array([(t, u) for t in range(len(frames)) for u in frames.partners[t]]).T
        self._across = np.linalg.svd(start.axis[None])[2][1:]
        self._tilts, self._shifts = 0 if keep_axis else 2, 2 if start.kind == REVOLUTE else 0
        self._child, self._size = self._points(child)
        self._moving, self._moving_size = (None, 1.0) if parent is None else self._points(parent)

    def _points(self, inside: np.ndarray) -> tuple[list[np.ndarray], float]:
        """Returns a part's points (3,n) of each frame, and its size in the first."""
        points = self.frames.points_of(inside)
        size = float(np.sqrt(points[0].var(0).sum())) if len(points[0]) else 0.0
        return [columns(own) for own in points], max(size, self.frames.spacing)

    @property
    def trajectory(self) -> Trajectory:
        """Returns the child's trajectory by the joint as it is."""
        return self._trajectories(np.zeros((1, self._count)))[1][0]

    @property
    def _count(self) -> int:
        values = len(self.frames) - 1
        return self._tilts + self._shifts + values + (0 if self._moving is None else 6 * values)

    def run(self, steps: int, wide: float) -> PointFit:
        """Returns itself after steps whose residuals narrow from so many spacings."""
        for scale in np.geomspace(wide, _NARROW, steps) * self.frames.spacing:
            step = self._step(float(scale))
            step *= min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-12))
            axis, point, value, parent = (numbers[0] for numbers in self._moved(step[None]))
            self.joint, self.parent = replace(self.joint, axis=axis, point=point, value=value), parent
        return self

    def _moved(self, change: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Returns axes (n,3), points (n,3), values (n,T) and the parent's trajectories (n,T,3,4) after changes (n,numbers)."""
        joint, values = self.joint, len(self.frames) - 1
        tilt, shift, value, twist = np.split(change, np.cumsum([self._tilts, self._shifts, values]), axis=1)
        axis = joint.axis + tilt @ self._across[: self._tilts]
        point = joint.point + self._size * shift @ self._across[: self._shifts]
        unit = 1.0 if self._shifts else self._size
        values_after = joint.value + np.concatenate([np.zeros((len(change), 1)), unit * value], 1)
        parent = np.broadcast_to(self.parent, (len(change), *self.parent.shape))
        if self._moving is not None:
            parent = _twisted(parent, twist.reshape(len(change), values, 6), self._moving, self._moving_size)
        return axis / np.linalg.norm(axis, axis=1, keepdims=True), point, values_after, parent

    def _trajectories(self, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the trajectories (n,T,3,4) of parent and child after changes (n,numbers)."""
        axis, point, value, parent = self._moved(change)
        motion = np.zeros((*value.shape, 3, 4))
        if self._shifts:
            motion[..., :3] = rotation_matrix(value[..., None] * axis[:, None])
            motion[..., 3] = point[:, None] - (motion[..., :3] @ point[:, None, :, None])[..., 0]
        else:
            motion[..., :3], motion[..., 3] = np.eye(3), value[..., None] * axis[:, None]
        return parent, compose(parent, motion)

    def _step(self, scale: float) -> np.ndarray:
        """Returns the step of Gauss-Newton, in the numbers of `_moved`."""
        count = self._count
        now = self._trajectories(np.zeros((1, count)))
        nudged = self._trajectories(_NUDGE * np.eye(count))
        total, right = np.zeros((count, count)), np.zeros(count)
        for points, before, after in zip((self._moving, self._child), now, nudged, strict=True):
            if points is None:
                continue
            motion = self._between_pairs(before)[0]
            matrix, vector, center = self._linearized(points, motion, scale)
            slope = _twists(self._between_pairs(after), motion, center) / _NUDGE
            weighed = np.einsum("npi,pij->npj", slope, matrix)
            total += weighed.reshape(count, -1) @ slope.reshape(count, -1).T
            right += slope.reshape(count, -1) @ vector.ravel()
        total[np.diag_indices(count)] += 1e-6 * np.trace(total) / count + 1e-9
        return np.linalg.solve(total, right)

    def _between_pairs(self, trajectory: np.ndarray) -> np.ndarray:
        """Returns the motions (n,P,3,4) between all pairs of frames of trajectories (n,T,3,4)."""
        source, target = self._pairs
        return motion_between(trajectory[:, source], trajectory[:, target])

    def _linearized(
        self, points: list[np.ndarray], motion: np.ndarray, scale: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the normal equations (P,6,6), (P,6) and their centers (P,3) of all pairs; zeros where a frame has no point."""
        nothing = np.zeros((6, 6)), np.zeros(6), np.zeros(3)
        equations = [
            self.frames.surfaces[u].linearize(points[t], one, scale) if points[t].size else nothing
            for t, u, one in zip(*self._pairs, motion)
        ]
        matrix, vector, center = (np.stack(values) for values in zip(*equations))
        return matrix, vector, center


def _twisted(parent: np.ndarray, twist: np.ndarray, points: list[np.ndarray], size: float) -> np.ndarray:
    """Returns trajectories (n,T,3,4) turned in every frame but the first, about the middle of its points, and shifted."""
    middle = np.stack([own.mean(1) if own.size else np.zeros(3) for own in points[1:]]).astype(np.float64)
    step = np.zeros((*twist.shape[:2], 3, 4))
    step[..., :3] = rotation_matrix(twist[..., :3])
    step[..., 3] = middle + size * twist[..., 3:] - (step[..., :3] @ middle[..., None])[..., 0]
    return np.concatenate([parent[:, :1], compose(step, parent[:, 1:])], 1)


def _twists(after: np.ndarray, before: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Returns the twists (n,P,6), about centers (P,3), that lead from motions (P,3,4) to others (n,P,3,4)."""
    turn = after[..., :3] @ np.swapaxes(before[..., :3], -1, -2)
    place = (turn @ (center - before[..., 3])[..., None])[..., 0] + after[..., 3]
    return np.concatenate([rotation_vector(turn), place - center], -1)
