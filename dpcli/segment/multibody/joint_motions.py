"""Motions of one degree of freedom: a body turns about one axis of another body, or slides along it, through all frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from dpcli.segment.flow.surface_icp import columns
from dpcli.segment.kinematics.joint_fit import JointFit, joint_motion, nearest_joints
from dpcli.segment.multibody.explanation import Body, Explanation, body_of
from dpcli.segment.multibody.frames import Frames, Trajectory, compose, relative_motion
from dpcli.store.joints import REVOLUTE

_PRICE = 1.5  # costs of a point that each number of a motion must save
_PARENTS = 2  # larger bodies tried, those that it touches most
_FEWEST = 6  # points in every frame of a body
_STEPS, _WIDE, _NARROW = 8, 1.5, 0.5  # of Gauss-Newton, and its first and last residual in spacings
_LONGEST = 0.5  # step, in radians and sizes of the body
_NUDGE = 1e-5  # of a number, for derivatives


def simplify_motions(frames: Frames, found: Explanation) -> Explanation:
    """Returns the explanation with hinges and slides where a body's own motion in every frame explains little more.

    Motions are chosen by their description length: costs of the body's points, and a price for each number. A free motion
    has six numbers a frame, a hinge one and the four of its line, a slide one and the two of its direction. Labels and costs
    stay as they are.
    """
    bodies = found.bodies[:1]
    for k, body in enumerate(found.bodies[1:], start=1):
        inside = found.label == k
        touched = np.bincount(found.label[frames.neighbors[inside]].ravel(), minlength=k)[:k]
        parents = [p for p in np.argsort(-touched, kind="stable")[:_PARENTS] if touched[p] or p == 0]
        seen = all(inside[frames.slice(t)].sum() >= _FEWEST for t in range(len(frames)))
        bodies.append(_simplest(frames, body, inside, [bodies[p].trajectory for p in parents]) if seen else body)
    return replace(found, bodies=bodies)


def _simplest(frames: Frames, body: Body, inside: np.ndarray, parents: list[Trajectory]) -> Body:
    """Returns the body with the motion of the least description length, free or by a joint to one of the parents."""
    values = len(frames) - 1
    tried, numbers = [body], [6 * values]
    for parent in parents:
        for start in _first_joints(frames, body.trajectory, inside, parent):
            tried.append(body_of(frames, _Fit(frames, inside, parent, start).run()))
            numbers.append(values + (4 if start.kind == REVOLUTE else 2))
    length = [one.cost[inside].sum(dtype=np.float64) + _PRICE * count for one, count in zip(tried, numbers)]
    return tried[int(np.argmin(length))]


def _first_joints(frames: Frames, trajectory: Trajectory, inside: np.ndarray, parent: Trajectory) -> list[JointFit]:
    """Returns the slide and the hinge nearest to a body's motion since frame 0, in the parent's own coordinates."""
    child = np.stack([compose(_inverse(p), c) for p, c in zip(parent, trajectory)])
    motion = np.tile(np.eye(4), (len(child), 1, 1))
    motion[:, :3] = [compose(one, _inverse(child[0])) for one in child]
    first = frames.points[frames.slice(0)][inside[frames.slice(0)]]
    points = (first - parent[0, :, 3]) @ parent[0, :, :3]
    center, size = points.mean(0), max(float(np.sqrt(points.var(0).sum())), frames.spacing)
    return nearest_joints(motion, center + size * np.concatenate([np.eye(3), -np.eye(3)]))


class _Fit:
    """Fits a joint to a body's points (mask) of all frames: robust Gauss-Newton onto whole frames, all pairs at once."""

    def __init__(self, frames: Frames, inside: np.ndarray, parent: Trajectory, start: JointFit) -> None:
        self.frames, self.parent, self.joint = frames, parent, replace(start, value=start.value - start.value[0])
        self.points = [columns(frames.points[frames.slice(t)][inside[frames.slice(t)]]) for t in range(len(frames))]
        self.size = max(float(np.sqrt(self.points[0].var(1).sum())), frames.spacing)
        self.pairs = [(t, u) for t in range(len(frames)) for u in frames.partners[t]]
        self.across = np.linalg.svd(start.axis[None])[2][1:]
        self.shifts = 2 if start.kind == REVOLUTE else 0

    def run(self) -> Trajectory:
        """Returns the body's trajectory by the joint after all steps."""
        for scale in np.geomspace(_WIDE, _NARROW, _STEPS) * self.frames.spacing:
            step = self._step(float(scale))
            self.joint = self._moved(step * min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-12)))
        return self._trajectory(self.joint)

    def _moved(self, change: np.ndarray) -> JointFit:
        """Returns the joint with its axis tilted by change[:2], its line shifted, and its values since frame 0 changed."""
        axis = self.joint.axis + change[:2] @ self.across
        point = self.joint.point + self.size * change[2 : 2 + self.shifts] @ self.across[: self.shifts]
        unit = 1.0 if self.shifts else self.size
        value = self.joint.value + np.concatenate([[0.0], unit * change[2 + self.shifts :]])
        return replace(self.joint, axis=axis / np.linalg.norm(axis), point=point, value=value)

    def _trajectory(self, joint: JointFit) -> Trajectory:
        motion = joint_motion(joint.kind, joint.axis, joint.point, joint.value)[:, :3]
        return np.stack([compose(before, own) for before, own in zip(self.parent, motion)])

    def _relative(self, joint: JointFit) -> np.ndarray:
        """Returns the motions (P,3,4) of all pairs of frames."""
        trajectory = self._trajectory(joint)
        return np.stack([relative_motion(trajectory, t, u) for t, u in self.pairs])

    def _step(self, scale: float) -> np.ndarray:
        """Returns the step of Gauss-Newton, in the numbers of `_moved`."""
        motion = self._relative(self.joint)
        equations = [
            self.frames.surfaces[u].linearize(self.points[t], one, scale) for (t, u), one in zip(self.pairs, motion)
        ]
        matrix, vector, center = (np.stack(values) for values in zip(*equations))
        nudges = _NUDGE * np.eye(2 + self.shifts + len(self.frames) - 1)
        slope = np.stack([_twists(self._relative(self._moved(one)), motion, center) for one in nudges], 2) / _NUDGE
        total = np.einsum("pji,pjk,pkl->il", slope, matrix, slope)
        total[np.diag_indices(len(total))] += 1e-6 * np.trace(total) / len(total) + 1e-9
        return np.linalg.solve(total, np.einsum("pji,pj->i", slope, vector))


def _inverse(motion: np.ndarray) -> np.ndarray:
    return np.concatenate([motion[:, :3].T, -(motion[:, :3].T @ motion[:, 3])[:, None]], 1)


def _twists(after: np.ndarray, before: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Returns the twists (P,6), about centers (P,3), that lead from motions (P,3,4) to others."""
    turn = after[:, :, :3] @ np.swapaxes(before[:, :, :3], 1, 2)
    place = np.einsum("pij,pj->pi", turn, center - before[:, :, 3]) + after[:, :, 3]
    return np.concatenate([Rotation.from_matrix(turn).as_rotvec(), place - center], 1)
