"""The joint between two parts: the simplest of fixed, prismatic, revolute and free that explains their relative motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from dpcli.ops.rotations import rotation_matrix, rotation_vector
from dpcli.segment.kinematics.registration import Registration, motion_twist, twist_motion
from dpcli.segment.rigid_motions import move
from dpcli.store.joints import FIXED, FREE, PRISMATIC, REVOLUTE

_RARE = 6.0  # 2 ln 20: parts that move against each other nearly always do so by a hinge or a slide
_OUTLIER = 2.0  # standard deviations from which an error counts linearly
_NUDGE = 1e-7  # of a parameter, for derivatives
_NEAR, _CHOICES = np.cos(np.radians(35)), 3  # directions of the surfaces that are tried as axes


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


def fit_joint(seen: Registration, directions: np.ndarray | None = None) -> JointFit:
    """Returns the joint with the least description length (BIC, Schwarz 1978): misfit and number of parameters weighed.

    seen: the child's motions in the parent's coordinates, with their covariances, which say what misfit is noise.
    directions f64 (D,3): of the parts' surfaces; an axis along one of them costs no parameters but the choice.
    """
    points = seen.center + seen.size * np.concatenate([np.eye(3), -np.eye(3)])
    target = move(seen.motion, points)
    first = [_fit_fixed(target, points), *nearest_joints(seen.motion, points)]
    tried = [_weighed(seen, fit, points) for fit in first]
    for fit in first[1:]:
        near = [d for d in (() if directions is None else directions) if abs(d @ fit.axis) > _NEAR]
        near = sorted(near, key=lambda d: -abs(d @ fit.axis))[:_CHOICES]
        along = [replace(fit, axis=d * (1 if d @ fit.axis > 0 else -1)) for d in near]
        tried += [_weighed(seen, one, points, 2 * np.log(len(directions))) for one in along]
    free = JointFit(FREE, np.zeros(3), np.zeros(3), np.zeros(len(target)), 0.0)
    measured = 6 * (len(target) - 1)
    tried.append(replace(free, length=measured * np.log(max(measured, 2)) + _RARE))
    return min(tried, key=lambda fit: fit.length)


def _weighed(seen: Registration, start: JointFit, points: np.ndarray, choice: float | None = None) -> JointFit:
    """Returns the joint of a kind nearest to the motions, as their covariances weigh, and its description length.

    choice: the price of an axis that is given; none: the axis is fitted too. Besides, the child may lie otherwise in its own
    coordinates than the motion of frame 0, which is an estimate too, says.
    """
    from scipy.optimize import least_squares

    white = np.swapaxes(np.linalg.cholesky(np.linalg.inv(seen.covariance)), 1, 2)
    back = np.linalg.inv(seen.motion)
    across = np.linalg.svd(start.axis[None])[2][1:] if start.kind != FIXED else np.zeros((2, 3))
    turns = 2 if choice is None and start.kind != FIXED else 0

    def joint(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        tilted = start.axis + parameters[..., 6 : 6 + turns] @ across[:turns]
        shift = seen.size * parameters[..., 6 + turns :] @ across[: parameters.shape[-1] - 6 - turns]
        return tilted / np.maximum(np.linalg.norm(tilted, axis=-1, keepdims=True), 1e-9), start.point + shift

    def whitened(parameters: np.ndarray, value: np.ndarray) -> np.ndarray:
        child = twist_motion(parameters[..., :6], seen.center)[..., None, :, :]
        placed = joint_motion(start.kind, *joint(parameters), value) @ child
        return np.einsum("tij,...tj->...ti", white, motion_twist(back @ placed, seen.center))

    def misfit(parameters: np.ndarray) -> np.ndarray:
        errors = _at_best_value(whitened, parameters, start, seen.size)[0]
        return errors.reshape(*parameters.shape[:-1], -1)

    def slope(parameters: np.ndarray) -> np.ndarray:
        """Returns the derivatives by differences, all parameters at once: a call costs the same for one as for ten."""
        rows = misfit(np.vstack([parameters, parameters + _NUDGE * np.eye(len(parameters))]))
        return (rows[1:] - rows[0]).T / _NUDGE

    count = 6 + turns + (2 if start.kind == REVOLUTE else 0)
    solved = least_squares(misfit, np.zeros(count), slope, loss="soft_l1", f_scale=_OUTLIER, max_nfev=30)
    axis, point = joint(solved.x)
    value = _at_best_value(whitened, solved.x, start, seen.size)[1]
    steps = len(value) - 1
    parameters = count - 6 + (0 if start.kind == FIXED else steps)
    length = 2 * solved.cost + parameters * np.log(max(6 * steps, 2)) + (choice or 0.0)
    residual = _residual(move(joint_motion(start.kind, axis, point, value), points), move(seen.motion, points))
    return JointFit(start.kind, axis, point, value, residual, float(length + (_RARE if start.kind == FIXED else 0.0)))


def _at_best_value(
    whitened: Callable[[np.ndarray, np.ndarray], np.ndarray], parameters: np.ndarray, start: JointFit, size: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the whitened errors (...,T,6) of parameters (...,P) at the joint's best values (...,T), found by a Gauss-Newton step.

    Frame 0's value stays 0.
    """
    error = whitened(parameters, start.value)
    if start.kind == FIXED:
        return error, start.value
    step = 1e-4 * (size if start.kind == PRISMATIC else 1.0)
    slope = (whitened(parameters, start.value + step) - error) / step
    change = -(slope * error).sum(-1) / np.maximum((slope * slope).sum(-1), 1e-12)
    change[..., 0] = 0
    return error + slope * change[..., None], start.value + change


def nearest_joints(motion: np.ndarray, points: np.ndarray) -> list[JointFit]:
    """Returns the slide and the hinge that take points (M,3) nearest to where motions f64 (T,4,4) do."""
    target = move(motion, points)
    return [_fit_prismatic(target, points), _fit_revolute(motion, target, points)]


def joint_motion(kind: int, axis: np.ndarray, point: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Returns the motions f64 (...,T,4,4) of joints, whose axes and points are (...,3), at values (T)."""
    motion = np.zeros((*axis.shape[:-1], len(value), 4, 4))
    motion[...] = np.eye(4)
    if kind == PRISMATIC:
        motion[..., :3, 3] = value[:, None] * axis[..., None, :]
    elif kind == REVOLUTE:
        motion[..., :3, :3] = rotation_matrix(value[:, None] * axis[..., None, :])
        motion[..., :3, 3] = point[..., None, :] - (motion[..., :3, :3] @ point[..., None, :, None])[..., 0]
    return motion


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

    turns = rotation_vector(relative[:, :3, :3])
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
