"""The errors of a part's motions, measured: frames are registered to the others again, on halves of the points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.ops.rotations import motion_matrix, rotation_matrix, rotation_vector
from dpcli.segment.flow.surface_icp import Surface, columns
from dpcli.segment.rigid_motions import bring_to_rest
from dpcli.segment.thinning import spread_places

_SAMPLES = 12  # halves of the points that are registered anew
_FRAMES = 12  # of a part that are registered; others are known as surely as the nearest of these
_MOST = 256  # points of a part in a frame, and twice as many of all other frames together
_FEWEST = 9  # points that make a surface
_STEPS = 8  # of ICP
_SURE = 1e-3  # of the part's size: nothing is known better
_EXACT = 1e-4  # the same of points with an identity


@dataclass(frozen=True)
class Registration:
    """Holds motions f64 (T,4,4) since frame 0 and how surely they are known.

    center f64 (3), size: the moved thing's middle in frame 0, and the root mean square distance of its points from it.
    covariance f64 (T,6,6): of each motion's error, as frame 0 sees it: a rotation vector about the center, and the center's
    displacement.
    """

    motion: np.ndarray
    center: np.ndarray
    size: float
    covariance: np.ndarray

    def of_frames(self, chosen: np.ndarray) -> Registration:
        """Returns the same of some frames (an index or mask)."""
        return Registration(self.motion[chosen], self.center, self.size, self.covariance[chosen])


def register(clouds: list[np.ndarray], motion: np.ndarray, rng: np.random.Generator) -> Registration:
    """Returns the motions with their covariances: the spread of where ICP ends from starts a little off.

    clouds: the part's points f64 (n_t,3) in every frame; motion f64 (T,4,4): from frame 0. Each time half of a frame's
    points go onto half of all others' (the variance of estimates from halves is that of the whole's, Shao and Wu 1989); what
    slides along itself, such as a cap that turns about its own axis, so shows that its motion can't be known.
    """
    back = [bring_to_rest(cloud, m) for cloud, m in zip(clouds, motion)]
    joined = np.concatenate(back)
    center, size = joined.mean(0), max(float(np.sqrt(joined.var(0).sum())), 1e-9)
    unit = [_some((cloud - center) / (2 * size), _MOST, rng) for cloud in back]
    chosen = spread_places(len(unit), _FRAMES)
    spread = np.stack([_spread(unit[t], [unit[u] for u in chosen if u != t], rng) for t in chosen])
    lengths = np.repeat([1.0, 2 * size], 3)
    covariance = spread * lengths[:, None] * lengths
    nearest = np.abs(np.arange(len(unit))[:, None] - chosen).argmin(1)
    return Registration(motion, center, size, covariance[nearest])


def register_tracks(clouds: list[np.ndarray], tracks: list[np.ndarray], motion: np.ndarray) -> Registration:
    """Returns the motions with their covariances where points have an identity, tracks i64 (n_t): those of least squares.

    How far tracks lie from their mean places, at rest, is the noise. What points on a line don't tell, the turn about it, is
    as unknown as by `register`.
    """
    back = [bring_to_rest(cloud, m) for cloud, m in zip(clouds, motion)]
    joined = np.concatenate(back)
    center, size = joined.mean(0), max(float(np.sqrt(joined.var(0).sum())), 1e-9)
    _, row, count = np.unique(np.concatenate(tracks), return_inverse=True, return_counts=True)
    unit = (joined - center) / (2 * size)
    mean = np.stack([np.bincount(row, axis) for axis in unit.T], 1) / count[:, None]
    free = 3 * (len(unit) - len(mean)) - 6 * len(clouds)  # numbers that neither places nor motions have used up
    noise = ((unit - mean[row]) ** 2).sum() / max(free, 1)
    x, y, z = mean[row].T
    none, one = np.zeros_like(x), np.ones_like(x)
    shifts = np.stack([none, z, -y, one, none, none, -z, none, x, none, one, none, y, -x, none, none, none, one], -1)
    slopes = np.split(shifts.reshape(-1, 3, 6), np.cumsum([len(cloud) for cloud in clouds])[:-1])
    told = np.stack([np.einsum("nij,nik->jk", slope, slope) for slope in slopes]) / max(noise, _EXACT**2)
    lengths = np.repeat([1.0, 2 * size], 3)
    covariance = np.linalg.inv(told + np.eye(6)) + _EXACT**2 * np.eye(6)
    return Registration(motion, center, size, covariance * lengths[:, None] * lengths)


def _spread(own: np.ndarray, others: list[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """Returns the covariance (6,6) of a frame's points (n,3) about 0 registered to others; without enough points: of size 1."""
    rest = _some(np.concatenate(others), 4 * _MOST, rng)
    if len(own) < 6 or len(rest) < 2 * _FEWEST:
        return np.eye(6)
    ends = []
    for _ in range(_SAMPLES):
        surface = Surface(_some(rest, len(rest) // 2, rng))
        if not surface.spacing:  # its points lie on one another
            return np.eye(6)
        shake = rng.normal(size=6) * surface.spacing / np.sqrt(3)
        start = twist_motion(shake * np.repeat([2.0, 1.0], 3), np.zeros(3))
        half = columns(_some(own, len(own) // 2, rng))
        ends.append(surface.icp(half, start[:3], _STEPS, 2 * surface.spacing, surface.spacing))
    twist = motion_twist(np.stack(ends), np.zeros(3))
    return twist.T @ twist / _SAMPLES + _SURE**2 * np.eye(6)


def _some(points: np.ndarray, most: int, rng: np.random.Generator) -> np.ndarray:
    return points if len(points) <= most else points[rng.permutation(len(points))[:most]]


def twist_motion(twist: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Returns the motions f64 (...,4,4) that turn by the rotation vectors twist[...,:3] about a center and shift by twist[...,3:]."""
    turn = rotation_matrix(twist[..., :3])
    return motion_matrix(turn, center + twist[..., 3:] - turn @ center)


def motion_twist(motion: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Returns the twists f64 (...,6) of `twist_motion` that motions (...,4,4) or (...,3,4) make."""
    turn = motion[..., :3, :3]
    return np.concatenate([rotation_vector(turn), turn @ center + motion[..., :3, 3] - center], -1)


def relative_registration(parent: Registration, child: Registration) -> Registration:
    """Returns the child's motions in the parent's coordinates, both as in frame 0, with the errors of both."""
    motion = np.linalg.inv(parent.motion) @ child.motion
    x, y, z = np.moveaxis(motion[:, :3, :3] @ child.center + motion[:, :3, 3] - parent.center, -1, 0)
    none = np.zeros_like(x)
    # turns a rotation into a shift at the child
    arm = np.stack([none, z, -y, -z, none, x, y, -x, none], -1).reshape(-1, 3, 3)
    back = np.swapaxes(motion[:, :3, :3], 1, 2)
    seen = np.zeros((len(motion), 6, 6))
    seen[:, :3, :3] = seen[:, 3:, 3:] = back
    seen[:, 3:, :3] = back @ arm
    covariance = child.covariance + seen @ parent.covariance @ np.swapaxes(seen, 1, 2)
    return Registration(motion, child.center, child.size, covariance)
