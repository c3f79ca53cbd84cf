"""The joint between two parts: the simplest of fixed, prismatic, revolute and free that explains their relative motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dpcli.segment.kinematics.part_trajectories import moved
from dpcli.store.joints import FIXED, FREE, PRISMATIC, REVOLUTE

_PARAMETERS = {
    FIXED: 0,
    PRISMATIC: 2,
    REVOLUTE: 4,
}  # of the axis; each frame after the first has one more but where fixed


@dataclass(frozen=True)
class JointFit:
    """Holds a joint of a child part, in the parent's coordinates, where both are as in frame 0.

    kind: as `store.joints` numbers them. axis f64 (3) unit, point f64 (3) on it, value f64 (T): radians or length_unit, 0
    in frame 0; zeros where the kind has none. residual: root mean square distance of the child's points from where the
    joint puts them, in length_unit. length: the description length of the relative motion, in nats; lower is better.
    """

    kind: int
    axis: np.ndarray
    point: np.ndarray
    value: np.ndarray
    residual: float
    length: float = np.inf


def fit_joint(relative: np.ndarray, points: np.ndarray, noise: float) -> JointFit:
    """Returns the joint with the least description length (BIC, Schwarz 1978): misfit and number of parameters weighed.

    relative f64 (T,4,4): motion of the child since frame 0, in the parent's coordinates. points f64 (M,3): the child's, in
    frame 0. noise: how far the motions may be off at the points, in length_unit, above 0.
    """
    target = moved(relative, points)
    found = [_fit_fixed(target, points), _fit_prismatic(target, points), _fit_revolute(relative, target, points)]
    free = JointFit(FREE, np.zeros(3), np.zeros(3), np.zeros(len(relative)), 0.0)
    weighed = [replace(fit, length=_description_length(fit, noise)) for fit in (*found, free)]
    return min(weighed, key=lambda fit: fit.length)


def _description_length(fit: JointFit, noise: float) -> float:
    steps = len(fit.value) - 1
    measured = 6 * steps  # numbers that a relative motion consists of
    moving = 0 if fit.kind == FIXED else steps
    parameters = measured if fit.kind == FREE else _PARAMETERS[fit.kind] + moving
    return measured * np.log(fit.residual**2 / noise**2 + 1) + parameters * np.log(max(measured, 2))


def _residual(placed: np.ndarray, target: np.ndarray) -> float:
    return float(np.sqrt(((placed - target) ** 2).sum(-1).mean()))


def _fit_fixed(target: np.ndarray, points: np.ndarray) -> JointFit:
    return JointFit(FIXED, np.zeros(3), np.zeros(3), np.zeros(len(target)), _residual(points[None], target))


def _fit_prismatic(target: np.ndarray, points: np.ndarray) -> JointFit:
    shift = (target - points).mean(1)
    axis = _main_direction(shift)
    value = shift @ axis
    placed = points + value[:, None, None] * axis
    return JointFit(PRISMATIC, axis, points.mean(0), value, _residual(placed, target))


def _fit_revolute(relative: np.ndarray, target: np.ndarray, points: np.ndarray) -> JointFit:
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(relative[:, :3, :3]).as_rotvec()
    axis = _main_direction(turns)
    center, size = points.mean(0), max(float(np.sqrt(points.var(0).sum())), 1e-9)
    start = _point_on_axis(relative, axis, center)
    across = np.linalg.svd(axis[None])[2][1:]  # two directions at right angles to the axis

    def line(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        tilted = axis + parameters[:2] @ across
        return tilted / np.linalg.norm(tilted), start + size * parameters[2:] @ across

    def misfit(parameters: np.ndarray) -> np.ndarray:
        direction, point = line(parameters)
        return ((_turned(points, direction, point, _angles(points, target, direction, point)) - target) / size).ravel()

    solved = least_squares(misfit, np.zeros(4), loss="soft_l1", f_scale=0.05, max_nfev=30).x
    direction, point = line(solved)
    angles = _angles(points, target, direction, point)
    point = point + direction * ((center - point) @ direction)  # the place on the axis beside the part's middle
    placed = _turned(points, direction, point, angles)
    return JointFit(REVOLUTE, direction, point, np.unwrap(angles), _residual(placed, target))


def _main_direction(vectors: np.ndarray) -> np.ndarray:
    """Returns the unit vector along which vectors (T,3) are longest, pointing where most of them do."""
    direction = np.linalg.eigh(vectors.T @ vectors)[1][:, -1]
    return direction if (vectors @ direction).sum() >= 0 else -direction


def _point_on_axis(relative: np.ndarray, axis: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Returns the point that the motions leave at its place, best in the mean, and nearest to `center` where many serve."""
    still = np.eye(3) - relative[:, :3, :3]
    shift = relative[:, :3, 3] - np.outer(relative[:, :3, 3] @ axis, axis)
    rows, right = still.reshape(-1, 3), (shift - still @ center).reshape(-1)
    return center + np.linalg.lstsq(rows, right, rcond=1e-3)[0]


def _angles(points: np.ndarray, target: np.ndarray, axis: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Returns the turns about a line f64 (T) that bring points nearest to targets (T,M,3) in the mean square."""
    before, after = points - point, target - point
    before = before - np.outer(before @ axis, axis)
    after = after - (after @ axis)[..., None] * axis
    sine = (np.cross(before, after) @ axis).sum(-1)
    return np.arctan2(sine, (before * after).sum((-1, -2)))


def _turned(points: np.ndarray, axis: np.ndarray, point: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Returns points (M,3) turned about a line by angles (T), f64 (T,M,3); Rodrigues' formula."""
    arm = points - point
    along = np.outer(arm @ axis, axis)
    cosine, sine = np.cos(angles)[:, None, None], np.sin(angles)[:, None, None]
    return point + along + cosine * (arm - along) + sine * np.cross(axis, arm)
